"""What a person is told whose log does not fit the robot or the map."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.cli import app
from hil.errors import InputError, SourceError
from tests.hil.test_importers_rosbag2 import STATE, bag, state

URDF = Path(__file__).parents[1] / "identification" / "two_link.urdf"


def write_log(path: Path, header: str, columns: int) -> Path:
    time = np.arange(200) / 100.0
    rows = np.column_stack([time, *(np.sin(time * (k + 1)) for k in range(columns))])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    path.write_text("\n".join([header, *lines]))
    return path


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
        log = write_log(tmp_path / "log.csv", "t,q1,tau1", 2)
        text = log.read_text().splitlines()
        messages = [
            state(round(float(line.split(",")[0]) * 1e9) + 1, [float(line.split(",")[1])],
                  names=["elbow"], effort=[1.0])
            for line in text[1:]
        ]  # fmt: skip
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
