"""Slips of a column map are said when the log is imported: units, sides, order, clock.

And what the commands say of a log that does not fit the robot or the map.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.archive import ArchiveHeader, Findings, Samples, open_archive
from hil.cli import app
from hil.errors import InputError, SourceError
from hil.importers import ColumnMap, Robot, import_log
from hil.importers.findings import check_clock, examine
from tests.hil.simulated_logs import Simulated, simulate
from tests.hil.test_importers_rosbag2 import STATE, bag, state

DEGREES = 57.29578


@pytest.fixture(scope="module")
def arm() -> Simulated:
    return simulate("ur5_robot.urdf", np.arange(0.0, 20.0, 0.01))


@pytest.fixture(scope="module")
def panda() -> Simulated:
    """An arm whose joints have ranges of their own."""
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    return simulate("panda.urdf", np.arange(0.0, 20.0, 0.01), locked=fingers)


def warnings(
    arm: Simulated, *, position=1.0, velocity=1.0, torque=1.0, clock=1.0, order=None
) -> list[str]:
    stamp = np.rint(arm.time * clock * 1e9).astype(np.int64)
    joints = range(len(arm.joint_names)) if order is None else order
    samples = Samples(
        stamp,
        arm.position * position,
        velocity=arm.velocity[:, list(joints)] * velocity,
        torque=arm.torque * torque,
    )
    return list(examine(samples, arm.joint_names, arm.urdf.read_text()).warnings)


class TestSlips:
    def test_a_log_without_one_has_no_warning(self, arm: Simulated, panda: Simulated) -> None:
        assert warnings(arm) == []
        assert warnings(panda) == []

    @pytest.mark.parametrize(
        ("slip", "sentence"),
        [
            ({"position": DEGREES}, "degrees read as radians"),
            ({"position": 1 / DEGREES}, "no joint moves further than"),
            ({"velocity": 0.0}, "does not follow its position"),
            ({"torque": 1000.0}, "its limit in the URDF is 150 N·m (or N): is its unit right"),
            ({"torque": 0.0}, "is zero throughout"),
            ({"clock": 1e3}, "0.1 samples a second is unusual"),
            ({"clock": 1e-3}, "1e+05 samples a second is unusual"),
        ],
    )
    def test_is_named(self, arm: Simulated, slip: dict[str, float], sentence: str) -> None:
        found = warnings(arm, **slip)
        assert any(sentence in warning for warning in found), found

    @pytest.mark.parametrize("factor", [DEGREES, 1 / DEGREES, 9.5493, -1.0])
    def test_a_unit_or_sign_of_velocity_shows_as_a_factor(
        self, panda: Simulated, factor: float
    ) -> None:
        (sentence,) = warnings(panda, velocity=factor)
        factors = sentence.partition(":")[0].partition(" times ")[2].split(", ")
        found = [float(one.split()[0]) for one in factors]
        assert found == pytest.approx([factor] * len(panda.joint_names), rel=1e-2)

    def test_a_factor_is_said_per_joint(self, arm: Simulated) -> None:
        (sentence,) = warnings(arm, velocity=np.array([1.0, 3.0, 1.0, 1.0, 1.0, 0.2]))
        factors = sentence.partition(":")[0].partition(" times ")[2].split(", ")
        assert [float(one.split()[0]) for one in factors] == pytest.approx([3.0, 0.2], rel=1e-2)
        assert factors[0].endswith("for shoulder_lift_joint")

    def test_degrees_have_two_readings_with_errors(self, panda: Simulated) -> None:
        (sentence, *others) = warnings(panda, position=DEGREES, velocity=DEGREES)
        assert sentence.startswith("as mapped, 100 % of the rows leave the limits of the URDF")
        assert 'as degrees read as radians, none would: write unit = "deg"' in sentence
        assert all("degrees" in other for other in others)


class TestOrder:
    def test_velocities_in_another_order_are_told_with_the_order(self, arm: Simulated) -> None:
        names = list(arm.joint_names)
        (sentence,) = warnings(arm, order=(1, 2, 0, 3, 4, 5))
        right = [names[1], names[2], names[0], *names[3:]]
        assert f"as those of {', '.join(right)} by 0 %" in sentence
        assert "as mapped they miss their slopes by" in sentence

    def test_positions_that_fit_other_limits_are_told_with_an_order(self, panda: Simulated) -> None:
        """Joint 4 of this arm bends one way only, joint 6 the other way."""
        names = list(panda.joint_names)
        order = [0, 1, 2, 5, 4, 3, 6]
        samples = Samples(np.rint(panda.time * 1e9).astype(np.int64), panda.position[:, order])
        found = examine(samples, names, panda.urdf.read_text()).warnings
        assert "% of the rows leave the limits of the URDF" in found[0]
        assert f"those of {', '.join(names[j] for j in order)}, none would" in found[0]

    def test_a_zero_that_is_off_is_no_order(self, panda: Simulated) -> None:
        position = panda.position.copy()
        position[:, 3] += 20.0
        samples = Samples(np.rint(panda.time * 1e9).astype(np.int64), position)
        found = examine(samples, panda.joint_names, panda.urdf.read_text()).warnings
        assert "check unit, sign and zero in the column map" in found[0]
        assert "order" not in found[0]


class TestClock:
    """A recording whose clock cannot be that of a motion is refused by file and field."""

    def stamps(self, *seconds: float) -> NDArray[np.int64]:
        return np.rint(np.array(seconds) * 1e9).astype(np.int64)

    @pytest.mark.parametrize("rate", [10.0, 125.0, 1000.0, 50_000.0])
    def test_usual_rates_pass(self, rate: float) -> None:
        check_clock(self.stamps(*(np.arange(50) / rate)), Path("x"))

    @pytest.mark.parametrize("seconds", [(3.0,), (0.0, 0.01, 0.01, 0.02)])
    def test_single_stamps_and_repeats_pass(self, seconds: tuple[float, ...]) -> None:
        check_clock(self.stamps(*seconds), Path("x"))

    @pytest.mark.parametrize(
        ("seconds", "sentence"),
        [
            (
                range(0, 1000, 10),
                r"x: time: there would be 0\.1 samples .* would make it 100 samples a second",
            ),
            (
                (0.0, 0.01, 0.02, 0.005, 0.015),
                r"sample 3 is 0\.015 s older than the one before it \(1 such steps\)",
            ),
            ((3.0, 3.0, 3.0), "all 3 samples have the same time"),
        ],
    )
    def test_that_of_no_motion_is_refused(self, seconds: Sequence[float], sentence: str) -> None:
        with pytest.raises(SourceError, match=sentence):
            check_clock(self.stamps(*seconds), Path("x"))

    def test_the_file_with_the_times_is_named(self, arm: Simulated, tmp_path: Path) -> None:
        np.savetxt(tmp_path / "q.txt", arm.position)
        np.savetxt(tmp_path / "t.txt", 1e3 * arm.time)
        columns = ColumnMap.model_validate(
            {"time": {"column": 0, "file": "t.txt"}, "position": {"file": "q.txt"}}
        )
        with pytest.raises(SourceError, match=r"t\.txt: time: there would be 0\.1 samples"):
            import_log(
                tmp_path, tmp_path / "a.mcap", robot=Robot.from_urdf(arm.urdf), columns=columns
            )
        assert not (tmp_path / "a.mcap").exists()


class TestCommand:
    def test_it_says_what_it_read_and_the_archive_keeps_it(
        self, arm: Simulated, tmp_path: Path
    ) -> None:
        np.savez(tmp_path / "log.npz", q=np.degrees(arm.position), t=arm.time)
        (tmp_path / "map.toml").write_text(
            '[time]\ncolumn = "t"\n[position]\ncolumns = "q"\n'  # the unit is missing
        )
        arguments = ["import", "npz", str(tmp_path / "log.npz"), "-o", str(tmp_path / "log.mcap")]
        arguments += ["--map", str(tmp_path / "map.toml"), "--urdf", str(arm.urdf)]
        result = CliRunner().invoke(app, [*arguments, "--kind", "validation"])
        assert result.exit_code == 0
        assert "2000 samples in 19.99 s, 100 Hz" in result.stdout
        assert "warning: as mapped" in result.stdout
        assert 'write unit = "deg"' in result.stdout
        header = open_archive(tmp_path / "log.mcap").header
        assert header.serves_as == "validation"
        assert any("deg" in warning for warning in header.findings.warnings)
        assert json.loads(header.entries["source"]) == ["log.npz"]

    def test_an_earlier_archive_gives_its_warnings_too(self) -> None:
        """They had another name in its metadata."""
        stored = json.dumps({"lines": ["a"], "doubts": ["b"]})
        entries = {"kind": "imported", "joint_names": '["a"]', "attachments": "[]"}
        found = ArchiveHeader.of({**entries, "findings": stored}).findings
        assert found == Findings(lines=("a",), warnings=("b",))


URDF = Path(__file__).parents[1] / "identification" / "two_link.urdf"


LOADED = "gains a.mcap --loaded b.mcap --mass 4"
NONSENSE = {
    "gains a.mcap --delay nan": "--delay",
    "gains a.mcap --delay 20": "--delay",
    "gains a.mcap --loaded a.mcap --mass 4": "with load and without",
    f"{LOADED} --inertia=-1,0,0,-1,0,-1": "no body",
    f"{LOADED} --inertia=1,0,0,1,0,3": "no body",
    "import log a.csv -o a.mcap --map m.toml --urdf r.urdf --cell c.toml": (
        "--urdf and --cell: exclude each other"
    ),
}


@pytest.mark.parametrize("arguments", NONSENSE)
def test_nonsense_is_refused_in_one_sentence(arguments: str) -> None:
    result = CliRunner().invoke(app, arguments.split())

    assert result.exit_code != 0
    assert NONSENSE[arguments] in str(result.exception) + result.output


class TestRobotOfAnImport:
    """Options that say what the robot is, of both importers."""

    @pytest.fixture
    def place(self, tmp_path: Path) -> Path:
        time = np.arange(200) / 100.0
        q, tau = np.sin(time), np.sin(2.0 * time)
        rows = np.column_stack([time, q, tau])
        np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,q1,tau1", comments="")
        messages = [
            state(round(t * 1e9) + 1, [angle], names=["elbow"], effort=[1.0])
            for t, angle in zip(time.tolist(), q.tolist(), strict=True)
        ]
        bag(tmp_path / "bag.db3", {"/js": (STATE, messages)})
        (tmp_path / "map.toml").write_text(
            'joints = ["elbow"]\n[time]\ncolumn = "t"\n[position]\ncolumns = "q{}"\n'
            '[torque]\ncolumns = "tau{}"\n'
        )
        return tmp_path

    def run(self, place: Path, kind: str, *options: str) -> Result:
        source = ["log.csv", "--map", str(place / "map.toml")] if kind == "log" else ["bag.db3"]
        arguments = ["import", kind, str(place / source[0]), *source[1:]]
        return CliRunner().invoke(app, [*arguments, "-o", str(place / "o.mcap"), *options])

    @pytest.mark.parametrize("kind", ["log", "rosbag2"])
    def test_others_are_locked_on_demand_and_named(self, place: Path, kind: str) -> None:
        refused = self.run(place, kind, "--urdf", str(URDF))
        assert isinstance(refused.exception, SourceError)
        assert "--lock-others" in str(refused.exception)

        result = self.run(place, kind, "--urdf", str(URDF), "--lock-others")

        assert result.exit_code == 0, result.exception
        assert "locked, rad or m: shoulder at 0" in result.output
        assert open_archive(place / "o.mcap").joint_names == ("elbow",)

    def test_joints_of_a_bag_can_have_other_names(self, place: Path) -> None:
        messages = [state(10**7 * k, [0.1 * k], names=["j2"]) for k in range(9)]
        bag(place / "other.db3", {"/js": (STATE, messages)})
        arguments = ["import", "rosbag2", str(place / "other.db3"), "-o", str(place / "o.mcap")]
        arguments += ["--urdf", str(URDF), "--lock-others"]
        refused = CliRunner().invoke(app, arguments)
        assert "recorded are j2" in str(refused.exception)
        assert "--rename RECORDED=URDF" in str(refused.exception)
        assert "--rename" in str(CliRunner().invoke(app, [*arguments, "--rename", "j2"]).exception)
        assert CliRunner().invoke(app, [*arguments, "--rename", "j2=elbow"]).exit_code == 0
        assert open_archive(place / "o.mcap").joint_names == ("elbow",)

    def test_a_map_without_names_cannot_say_which_are_others(self, place: Path) -> None:
        text = (place / "map.toml").read_text()
        (place / "map.toml").write_text(text.replace('joints = ["elbow"]\n', ""))
        refused = self.run(place, "log", "--urdf", str(URDF), "--lock-others")
        assert isinstance(refused.exception, InputError)
        assert "map.toml: joints: does not say which joints were recorded" in str(refused.exception)

    @pytest.mark.parametrize("kind", ["log", "rosbag2"])
    def test_gravity_has_any_direction_and_size(self, place: Path, kind: str) -> None:
        options = ["--urdf", str(URDF), "--lock-others", "--gravity", "0", "-1.62", "3"]
        result = self.run(place, kind, *options)
        assert result.exit_code == 0, result.exception
        cell = tomllib.loads(open_archive(place / "o.mcap").text("cell.toml"))
        assert cell["robot"]["gravity"] == [0.0, -1.62, 3.0]

    def test_gravity_is_finite(self, place: Path) -> None:
        refused = self.run(place, "log", "--urdf", str(URDF), "--gravity", "0", "nan", "0")
        assert isinstance(refused.exception, InputError)
        assert "--gravity" in str(refused.exception)

    @pytest.mark.parametrize("kind", ["log", "rosbag2"])
    def test_friction_is_offset_coulomb_and_viscous_unless_named(
        self, place: Path, kind: str
    ) -> None:
        options = ["--urdf", str(URDF), "--lock-others"]
        for friction, third, offset in [([], "none", True), (["coulomb,cubic"], "cubic", False)]:
            result = self.run(
                place, kind, *options, *(["--friction", *friction] if friction else [])
            )
            assert result.exit_code == 0, result.exception
            law = tomllib.loads(open_archive(place / "o.mcap").text("cell.toml"))["robot"][
                "friction"
            ]
            assert (law["third"], law["offset"]) == (third, offset)
            (place / "o.mcap").unlink()
