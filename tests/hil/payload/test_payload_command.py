"""`hil payload`, by the commands of `docs/payload.md`; `hil torque-constants`; refusals of both."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Silent
from hil.cell import Cell
from hil.cli import app
from hil.importers.column_map import Drive
from hil.payload.payload_run import find_payload, require_one_arm
from sim_fixtures.ns16 import CELL_PATH
from tests import messages
from tests.docs.typed import ROOT, commands
from tests.hil.fast_cell import QUICK
from tests.hil.payload.load_archives import CENTRE, CONSTANTS, LAW, MASS, archive_of_currents
from tests.hil.simulated_logs import Simulated, archive_of, simulate
from tests.near import near

pytestmark = pytest.mark.long

TENSOR = np.diag([0.01, 0.02, 0.015])
BOTH = ("--loaded", "full.mcap", "--mass", "4", "--centre", "0,0.09,0.12")


def record(folder: Path, name: str, mass: float, seed: int) -> Path:
    time = np.arange(0.0, 12.0, 8e-3)
    load = None if mass == 0.0 else pin.Inertia(mass, CENTRE, TENSOR * mass / MASS)
    return archived(folder / name, simulate("ur5_robot.urdf", time, seed=seed, load=load))


def archived(path: Path, made: Simulated) -> Path:
    arrays = {"t": made.time, "q": made.position, "tau": made.torque}
    return archive_of(path, made.urdf, law=LAW, **arrays)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("payload")
    record(folder, "empty.mcap", 0.0, 1)
    record(folder, "full.mcap", MASS, 2)
    return folder


def run(folder: Path, *arguments: str, command: str = "payload") -> tuple[int, str]:
    named = [str(folder / a) if a.endswith(".mcap") else a for a in arguments]
    result = CliRunner().invoke(app, [command, *named])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


@pytest.fixture(scope="module")
def printed(folder: Path) -> dict[str, object]:
    status, text = run(
        folder, "empty.mcap", "--loaded", "full.mcap", "--json", "--check", "mass=4.5"
    )
    assert status == 5
    document: dict[str, object] = json.loads(text)
    return document


SHORTER = {"design": ("--seed", "1"), "run": ("--accept-dry-run",)}
"""Words that a test adds to a command."""


class TestPage:
    def test_every_command_of_the_page_runs(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """docs/payload.md, in a folder with the recordings that it names."""
        monkeypatch.chdir(folder)
        for name, source in (("bare", "empty.mcap"), ("gripper", "full.mcap")):
            (folder / name).mkdir()
            (folder / name / source).write_bytes((folder / source).read_bytes())
        for file in ("cell.toml", "robot.urdf"):
            (folder / file).write_bytes((ROOT / "examples" / "two_joints" / file).read_bytes())
        (folder / "quick.toml").write_text(QUICK)
        for program, *arguments in commands(ROOT / "docs" / "payload.md"):
            assert program == "hil"
            if "--dry-run" not in arguments and "--accept-dry-run" not in arguments:
                arguments += SHORTER.get(arguments[0], ())
            result = CliRunner().invoke(app, arguments)
            assert result.exit_code == 0, (shlex.join(arguments), result.output, result.exception)


class TestFigures:
    def test_intervals_are_near_the_truth(self, printed: dict[str, dict[str, dict]]) -> None:
        """Smoothing leaves a bias of some tenths of a percent."""
        figures = printed["figures"]
        assert figures["mass"]["value"] == pytest.approx(MASS, rel=0.01)
        low, high = figures["mass"]["interval"]
        assert low < figures["mass"]["value"] < high
        assert printed["frame"] == "tool0"
        assert np.trace(TENSOR) == pytest.approx(
            sum(figures[name]["value"] for name in ("Ixx", "Iyy", "Izz")), rel=0.3
        )

    def test_each_controller_has_its_own_units(self, printed: dict[str, dict]) -> None:
        """COMAU uses mm, UR and Franka m; Franka the complete matrix."""
        typed = printed["controllers"]
        figures = printed["figures"]
        centre = [figures[name]["value"] for name in ("cx", "cy", "cz")]
        assert f"$TOOL_CNTR := POS({1e3 * centre[0]:.2f}, {1e3 * centre[1]:.2f}" in typed["COMAU"]
        assert f"$TOOL_INERTIA[2] := {figures['Iyy']['value']:.5f}" in typed["COMAU"]
        assert typed["UR"].startswith(f"set_target_payload({figures['mass']['value']:.3f}, [")
        six = typed["UR"].split("[")[2].strip("])").split(", ")
        assert six[:2] == [f"{figures[name]['value']:.5f}" for name in ("Ixx", "Iyy")]
        nine = typed["Franka"].split("{")[2].strip("});").split(", ")
        assert (len(nine), nine[1], nine[4]) == (9, nine[3], six[1])


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bare arm in two other motions."""
    folder = tmp_path_factory.mktemp("arm")
    for seed in (11, 12):
        made = simulate("ur5_robot.urdf", np.arange(0.0, 20.0, 8e-3), seed=seed)
        archived(folder / f"{seed}.mcap", made)
    return folder


@pytest.fixture(scope="module")
def by_model(folder: Path, arm: Path) -> dict[str, Any]:
    """The payload against the model of the arm."""
    status, text = run(folder, "--model", str(arm), "full.mcap", "--json")
    assert status == 0
    weighed: dict[str, Any] = json.loads(text)
    return weighed


class TestByModel:
    """`hil payload --model`: loaded recordings alone, against the model of the arm."""

    def test_the_mass_is_within_two_percent(self, by_model: dict[str, Any]) -> None:
        mass = by_model["figures"]["mass"]
        assert mass["value"] == pytest.approx(MASS, rel=0.02)
        assert mass["interval"][0] < MASS < mass["interval"][1]
        assert by_model["bare"] == [] and by_model["loaded"] == ["full.mcap"]
        assert "against the model of the arm" in by_model["method"]

    def test_it_agrees_with_a_bare_recording_and_is_not_surer(
        self, by_model: dict[str, Any], printed: dict[str, Any]
    ) -> None:
        for name in ("mass", "cx", "cy", "cz"):
            alone = by_model["figures"][name]
            both = printed["figures"][name]
            low, high = alone["interval"]
            assert low <= both["interval"][1] and both["interval"][0] <= high
        widths = [
            np.diff(result["figures"]["mass"]["interval"])[0] for result in (by_model, printed)
        ]
        assert widths[0] > 0.5 * widths[1]

    def test_a_recording_that_the_arm_only_predicted_is_weighed(self, tmp_path: Path) -> None:
        """`hil identify A --predict B` puts both into one folder."""
        bare = simulate("ur5_robot.urdf", np.arange(0.0, 20.0, 8e-3), seed=11)
        archived(tmp_path / "bare.mcap", bare)
        load = pin.Inertia(MASS, CENTRE, TENSOR)
        full = simulate("ur5_robot.urdf", np.arange(0.0, 12.0, 8e-3), seed=2, load=load)
        arrays = {"t": full.time, "q": full.position, "tau": full.torque}
        archive_of(tmp_path / "full.mcap", full.urdf, law=LAW, use="validation", **arrays)
        status, text = run(tmp_path, "--model", str(tmp_path), "full.mcap", "--json")
        assert status == 0
        weighed = json.loads(text)
        assert weighed["figures"]["mass"]["value"] == pytest.approx(MASS, rel=0.02)
        assert weighed["loaded"] == ["full.mcap"]

    def test_another_arm_and_nothing_carried_are_refused(self, folder: Path, arm: Path) -> None:
        with pytest.raises(InputError, match=r"empty\.mcap: shows no payload|does not separate"):
            run(folder, "--model", str(arm), "empty.mcap")
        other = archived(
            arm.parent / "ur10.mcap", simulate("ur10_robot.urdf", np.arange(0.0, 6.0, 8e-3), seed=1)
        )
        with pytest.raises(ArchiveError, match=r"another arm .* robot\.urdf"):
            run(folder, "--model", str(arm), str(other))


def test_the_same_recording_and_another_arm_are_named(folder: Path, tmp_path: Path) -> None:
    empty = [folder / "empty.mcap"]
    with pytest.raises(InputError, match="is a copy of"):
        find_payload(empty, empty, Silent())
    time = np.arange(0.0, 6.0, 8e-3)
    other = archived(tmp_path / "ur10.mcap", simulate("ur10_robot.urdf", time, seed=1))
    with pytest.raises(ArchiveError, match=r"ur10\.mcap.*another arm .* robot\.urdf"):
        find_payload(empty, [other], Silent())


def test_another_gravity_is_not_another_arm() -> None:
    """Such as that of a torque from which a controller removed the weight of the arm."""
    bare = Cell.load(CELL_PATH)
    loaded = bare.with_values({"robot.gravity": [0.0, 0.0, 0.0]})
    with pytest.raises(
        ArchiveError, match=r"is read with the gravity .* as bare\.mcap is"
    ) as raised:
        require_one_arm(bare, loaded, "bare.mcap", Path("full.mcap"))
    assert "both with the weight of the arm, or both without it" in str(raised.value)
    other = loaded.with_values({"robot.rotor_inertia": False})
    with pytest.raises(ArchiveError, match=r"another arm than bare\.mcap: \[robot\] differ"):
        require_one_arm(bare, other, "bare.mcap", Path("full.mcap"))


TYPE = np.array([12.0, 12.0, 10.0, 5.0, 5.0, 5.0])  # N·m/A, joint side
WALL = (0.0, -9.81, 0.0)


@pytest.fixture(scope="module")
def currents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gains")
    time = np.arange(0.0, 30.0, 4e-3)
    archive_of_currents(folder, "empty", simulate("ur5_robot.urdf", time, seed=1))
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    archive_of_currents(folder, "full", simulate("ur5_robot.urdf", time, seed=2, load=load))
    return folder


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The constants of another type: 9 % too large."""
    folder = tmp_path_factory.mktemp("wrong")
    time = np.arange(0.0, 12.0, 8e-3)
    for seed, (name, mass) in enumerate({"empty": 0.0, "full": MASS}.items(), 1):
        load = None if mass == 0.0 else pin.Inertia(mass, CENTRE, TENSOR)
        made = simulate("ur5_robot.urdf", time, seed=seed, load=load)
        for kind, drive in (
            ("assumed", {}),
            ("stated", {"torque_uncertainty": 0.1}),
            ("exact", {"torque_uncertainty": [0.0] * 6}),
        ):
            columns = {
                "time": {"column": "t"},
                "position": {"columns": "q"},
                "motor_current": {"columns": "i"},
                "drive": {"torque_constant": tuple(1.09 * TYPE), **drive},
            }
            arrays = {"t": time, "q": made.position, "i": made.torque / TYPE}
            archive_of(folder / f"{name}_{kind}.mcap", made.urdf, columns, LAW, **arrays)
    return folder


class TestTorqueScale:
    """Imported torques have a scale of a data sheet unless the map or the cell states another."""

    def weighed(self, folder: Path, kind: str) -> dict[str, Any]:
        status, text = run(folder, f"empty_{kind}.mcap", "--loaded", f"full_{kind}.mcap", "--json")
        assert status == 0
        document: dict[str, Any] = json.loads(text)
        return document

    def test_the_interval_says_what_it_assumes(self, wrong: Path) -> None:
        document = self.weighed(wrong, "assumed")
        assert document["torque_uncertainty"]["std"] == [0.03] * 6
        low, high = document["figures"]["mass"]["interval"]
        # Two joints of independent scale bear the weight, so that it is known to 2 to 3 %.
        assert 0.05 < (high - low) / document["figures"]["mass"]["value"] < 0.13
        text = run(wrong, "empty_assumed.mcap", "--loaded", "full_assumed.mcap")[1]
        assert "assuming torque constants to 3 %" in text

    def test_a_stated_uncertainty_replaces_it(self, wrong: Path) -> None:
        stated, exact = (self.weighed(wrong, kind)["figures"] for kind in ("stated", "exact"))
        low, high = stated["mass"]["interval"]
        assert low < MASS < high
        low, high = exact["mass"]["interval"]
        assert (high - low) / exact["mass"]["value"] < 0.02

    def test_a_failed_check_prints_a_command_that_works(self, wrong: Path) -> None:
        """The command is typed, and finds the constants."""
        status, text = run(
            wrong, "empty_assumed.mcap", "--loaded", "full_assumed.mcap", "--check", "mass=4"
        )
        assert status == 5
        text = text.replace("\\\n", "")  # as a shell does
        (line,) = [line for line in text.splitlines() if "hil torque-constants" in line]
        program, *arguments = shlex.split(line[line.index("hil torque-constants") :])
        assert program == "hil"
        result = CliRunner().invoke(app, [*arguments, "--quiet"])
        assert result.exit_code == 0, result.output
        table = tomllib.loads(result.output)
        assert table["torque_constant"] == near(TYPE, rel=0.03)
        assert np.all(np.array(table["torque_uncertainty"]) < 0.02)
        Drive(**table)

    def test_torques_without_currents_get_the_scale_to_correct(self, folder: Path) -> None:
        status, text = run(folder, "empty.mcap", "--loaded", "full.mcap", "--check", "mass=5")
        assert status == 5
        assert "hil torque-constants" not in text
        assert "scale of [torque] in the column map" in " ".join(text.split())


class TestRefused:
    def test_loads_mounted_differently_are_both_named(self, folder: Path, tmp_path: Path) -> None:
        """Turned by 180°, their mean centre is on the axis."""
        time = np.arange(0.0, 12.0, 8e-3)
        load = pin.Inertia(MASS, CENTRE * [-1.0, -1.0, 1.0], TENSOR)
        turned = archived(
            tmp_path / "turned.mcap", simulate("ur5_robot.urdf", time, seed=3, load=load)
        )
        bare = folder / "empty.mcap"
        full = folder / "full.mcap"
        with pytest.raises(InputError, match=r"contradict.*full\.mcap.*turned\.mcap.*mm") as error:
            find_payload([bare], [full, turned], Silent())
        command = shlex.split(str(error.value.remedy).split("itself: ")[1])
        assert command[:2] == ["hil", "payload"]
        assert CliRunner().invoke(app, command[1:]).exit_code == 0

    def test_equal_loads_are_no_contradiction(self, folder: Path, tmp_path: Path) -> None:
        again = record(tmp_path, "again.mcap", MASS, 4)
        weighed = find_payload([folder / "empty.mcap"], [folder / "full.mcap", again], Silent())
        assert weighed.body.mass == pytest.approx(MASS, rel=0.01)

    def test_a_bare_recording_with_a_tool_is_named(self, folder: Path, tmp_path: Path) -> None:
        tool = record(tmp_path, "tool.mcap", 1.5, 5)
        with pytest.raises(
            InputError, match=r"bare recordings contradict.*tool\.mcap carries 1\.(49|50?) kg"
        ):
            find_payload([folder / "empty.mcap", tool], [folder / "full.mcap"], Silent())

    def test_a_body_beyond_the_arm_s_reach_is_refused(self, tmp_path: Path) -> None:
        """3 m behind a flange of an arm of 0.9 m."""
        bare = record(tmp_path, "empty.mcap", 0.0, 1)
        time = np.arange(0.0, 12.0, 8e-3)
        far = pin.Inertia(0.5, np.array([0.0, 0.0, 3.0]), TENSOR)
        full = archived(tmp_path / "full.mcap", simulate("ur5_robot.urdf", time, seed=2, load=far))
        with pytest.raises(InputError, match=r"cannot hang on this arm.* 3\.\d m .* m long"):
            find_payload([bare], [full], Silent())


class TestMounting:
    def test_an_arm_on_the_wall_gets_no_settings(self, tmp_path: Path) -> None:
        time = np.arange(0.0, 12.0, 8e-3)
        for seed, (name, load) in enumerate(
            {"empty": None, "full": pin.Inertia(MASS, CENTRE, TENSOR)}.items(), 1
        ):
            made = simulate("ur5_robot.urdf", time, seed=seed, load=load, gravity=WALL)
            archived(tmp_path / f"{name}.mcap", made)
        status, text = run(tmp_path, "empty.mcap", "--loaded", "full.mcap", "--json")
        document = json.loads(text)
        assert status == 5
        assert "--gravity X Y Z" in document["mounting"]
        assert document["controllers"] == {}

    def test_a_right_one_is_not_doubted(self, printed: dict[str, object]) -> None:
        assert printed["mounting"] is None


def test_an_inertia_that_is_not_determined_is_not_typed_in(tmp_path: Path) -> None:
    """In slow motion only the weight acts; a zero would be taken for a value."""
    time = np.arange(0.0, 60.0, 2e-2)
    load = pin.Inertia(MASS, CENTRE, TENSOR)
    for seed, (name, body) in enumerate({"empty": None, "full": load}.items(), 1):
        slow = simulate("ur5_robot.urdf", time, seed=seed, pace=0.03, load=body)
        noise = 0.1 * np.random.default_rng(seed).standard_normal(slow.torque.shape)  # N·m
        archived(tmp_path / f"{name}.mcap", replace(slow, torque=slow.torque + noise))
    status, text = run(tmp_path, "empty.mcap", "--loaded", "full.mcap", "--json")
    document = json.loads(text)
    assert status == 0
    assert document["figures"]["Ixx"]["value"] is None
    for typed in document["controllers"].values():
        commands_only = [
            line for line in typed.splitlines() if not line.startswith(("#", "//", "--", ";", "!"))
        ]
        assert not any("INERTIA" in line or "0.00000" in line for line in commands_only)
        assert messages.ENTER_THE_MAKERS in typed
    assert "set_target_payload(" in document["controllers"]["UR"]


def gains(folder: Path, *arguments: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(
        run(folder, *arguments, "--json", command="torque-constants")[1]
    )
    return document


def test_the_constants_lie_in_their_intervals(currents: Path) -> None:
    document = gains(currents, "empty.mcap", *BOTH)
    assert document["side"] == "motor"
    assert document["payload_kg"] == {"empty.mcap": None, "full.mcap": 4.0}
    determined = 0
    for motor, truth in zip(document["motors"], CONSTANTS, strict=True):
        if motor["not_determined"] is None:
            determined += 1
            # Smoothing leaves a bias of half a percent.
            error = abs(motor["torque_constant"] - truth)
            assert error < 2.0 * motor["half_interval"] + 0.005 * truth
            assert motor["half_interval"] < 0.1 * truth
    assert determined >= 5


def test_a_load_without_centre_is_assumed_at_the_flange_and_said(currents: Path) -> None:
    assert gains(currents, "empty.mcap", *BOTH)["assumed"] is None
    assert "--centre" in gains(currents, "empty.mcap", *BOTH[:4])["assumed"]
    text = run(currents, "empty.mcap", *BOTH[:4], "--quiet", command="torque-constants")[1]
    assert messages.LOAD_AT_ORIGIN in text


def test_the_output_is_an_entry_of_the_column_map(currents: Path) -> None:
    status, text = run(currents, "empty.mcap", *BOTH, "--quiet", command="torque-constants")
    pasted = tomllib.loads(text)["torque_constant"]
    assert (len(pasted) == len(CONSTANTS)) == (status == 0)
    assert "# shoulder_lift_joint ±" in text


def test_a_vertical_axis_in_slow_motion_has_no_constant(tmp_path: Path) -> None:
    """The weight of the payload does not load it."""
    time = np.arange(0.0, 150.0, 2e-2)
    load = pin.Inertia(MASS, np.array(CENTRE), np.zeros((3, 3)))
    for seed, (name, body) in enumerate({"empty": None, "full": load}.items()):
        slow = simulate("ur5_robot.urdf", time, seed=seed, pace=0.03, load=body)
        noise = 0.1 * np.random.default_rng(seed).standard_normal(slow.torque.shape)  # N·m
        archive_of_currents(tmp_path, name, replace(slow, torque=slow.torque + noise))
    status, text = run(tmp_path, "empty.mcap", *BOTH, "-q", command="torque-constants")
    assert status == 5
    assert '"not determined", # shoulder_pan_joint: ' in text
    assert "nan" not in text
    assert "shoulder_lift_joint ±" in text
    entries = tomllib.loads(text)
    pasted = entries["torque_constant"]
    assert len(pasted) == len(CONSTANTS)
    assert entries["torque_uncertainty"][0] == "not determined"
    with pytest.raises(ValidationError, match="torque_constant"):
        Drive(torque_constant=pasted)


@pytest.mark.parametrize(
    ("command", "arguments", "sentence"),
    [
        ("payload", (), "give both: hil payload BARE"),
        ("payload", (*BOTH[:2], "--check", "mass"), "'mass' is not NAME=NUMBER"),
        ("torque-constants", BOTH[:2], "--mass: the payload needs a mass above 0"),
        ("torque-constants", ("--mass", "4"), "has no recording with this payload"),
        ("torque-constants", (*BOTH[:4], "--centre", "1,2"), "--centre: '1,2' is not 3 numbers"),
        ("torque-constants", (), r"without a known payload.*--loaded ARCHIVE"),
    ],
)
def test_incomplete_arguments_are_refused(
    currents: Path, command: str, arguments: tuple[str, ...], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        run(currents, "empty.mcap", *arguments, command=command)


def test_archives_of_a_folder_are_used(currents: Path, tmp_path: Path) -> None:
    """One of the same name as another archive is listed by its path."""
    with pytest.raises(InputError, match="contains no complete archive; give archives"):
        gains(currents, str(tmp_path))
    (tmp_path / "empty.mcap").symlink_to(currents / "empty.mcap")
    loads = gains(currents, str(tmp_path), *BOTH)["payload_kg"]
    assert loads == {"empty.mcap": None, "full.mcap": 4.0}
    (tmp_path / "empty.mcap").unlink()
    (tmp_path / "empty.mcap").symlink_to(currents / "full.mcap")
    loads = gains(currents, "empty.mcap", "--loaded", str(tmp_path), *BOTH[2:])["payload_kg"]
    assert sorted(loads.values(), key=bool) == [None, 4.0]


@pytest.mark.long
def test_gravity_of_a_slow_real_arm_points_down(shared_data: Path, tmp_path: Path) -> None:
    """Stated to be on a wall, it stands upright; pushed upwards by bodies it would fit alike.

    Without a map the import would see it.
    """
    logs = [shared_data / "lwr4" / f"measurements_{number}.npz" for number in (1, 2)]
    stated = ["--urdf", str(shared_data / "lwr4/kuka_lwr4.urdf"), "--gravity", "9.81", "0", "0"]
    stated += ["--map", str(shared_data / "lwr4/map.toml")]
    archives = [str(tmp_path / f"{log.stem}.mcap") for log in logs]
    for log, archive in zip(logs, archives, strict=True):
        line = ["import", "log", str(log), *stated, "-o", archive]
        assert CliRunner().invoke(app, line).exit_code == 0
    result = CliRunner().invoke(app, ["payload", archives[0], "--loaded", archives[1]])
    said = re.search(r"with gravity \((.*?)\) m/s² in base axes", str(result.exception))
    assert said is not None, result.exception
    assert float(said[1].split(", ")[2]) == pytest.approx(-9.81, abs=0.1)
