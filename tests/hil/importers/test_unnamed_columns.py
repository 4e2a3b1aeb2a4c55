"""Columns without names, several times, names of errors: what is proposed works when typed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.archive import Archive, open_archive
from hil.base.errors import HilError
from hil.cli import app
from hil.importers.unnamed_columns import ColumnBlocks, blocks_of, roughness
from tests.hil.importers.moving_log import COUNT, POSITION, SLOPE, TIME, TORQUE, URDF

Floats = NDArray[np.float64]
FINGER = (
    "<link name='l{0}'><inertial><mass value='0.1'/><origin xyz='0 0 0'/>"
    "<inertia ixx='0.0001' iyy='0.0001' izz='0.0002' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    "<joint name='{0}' type='prismatic'><parent link='lankle'/><child link='l{0}'/>"
    "<axis xyz='0 1 0'/><limit lower='0' upper='0.04' effort='9' velocity='1'/></joint>"
)
WITH_FINGERS = URDF.replace(
    "</robot>", "".join(map(FINGER.format, ("finger_left", "finger_right"))) + "</robot>"
)
OPTION = re.compile(r"--columns (?:'[^']*'|\w+=\w+)|--sample-rate HZ")


@pytest.fixture(params=[URDF, WITH_FINGERS], ids=["arm", "arm with a gripper"])
def urdf(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    path = tmp_path / "three.urdf"
    path.write_text(request.param)
    return path


def write(path: Path, *columns: Floats, names: str = "") -> Path:
    rows = [",".join(map(repr, row)) for row in np.column_stack(columns).tolist()]
    path.write_text("\n".join([*([names] if names else []), *rows]) + "\n")
    return path


def refusal(source: Path, urdf: Path, *options: object) -> str:
    """The refusal of an import, else ""."""
    output = source.with_name("out.mcap")
    line = ["import", "log", source, "--urdf", urdf, "--force", "-o", output, *options]
    result = CliRunner().invoke(app, [*map(str, line)])
    assert result.exit_code == 0 or isinstance(result.exception, HilError), result
    return "" if result.exit_code == 0 else str(result.exception)


def proposed(refused: str) -> list[str]:
    """The options that a refusal prints, as typed."""
    words = [word for option in OPTION.findall(refused) for word in shlex.split(option)]
    return [word.replace("HZ", "250") for word in words]


def read(source: Path) -> Archive:
    return open_archive(source.with_name("out.mcap"))


NAMELESS = {
    "time, positions, torques": (TIME, POSITION, TORQUE),
    "positions, torques": (POSITION, TORQUE),
    "time, positions, velocities, torques": (TIME, POSITION, SLOPE, TORQUE),
}


@pytest.mark.parametrize("kind", NAMELESS)
def test_columns_without_names(tmp_path: Path, urdf: Path, kind: str) -> None:
    """The options fit the number of columns; joints of a gripper are fixed."""
    columns = NAMELESS[kind]
    source = write(tmp_path / "log.csv", *columns)
    options = proposed(refusal(source, urdf))
    assert refusal(source, urdf, *options) == ""
    imported = read(source).columns
    assert np.array_equal(imported["position"], POSITION)
    assert np.array_equal(imported["torque"], TORQUE)
    assert ("velocity" in imported) == (len(columns) == 4)
    assert np.ptp(imported["stamp"]) == pytest.approx(1e9 * np.ptp(TIME), abs=2)


def test_no_columns_are_proposed_that_are_not_there(tmp_path: Path, urdf: Path) -> None:
    source = write(tmp_path / "log.csv", TIME, POSITION, TORQUE[:, :2])
    refused = refusal(source, urdf)
    numbers = {
        int(number) for text in OPTION.findall(refused) for number in re.findall(r"\d+", text)
    }
    assert numbers <= set(range(6))


def test_blocks_of_a_table() -> None:
    table = np.column_stack([TIME, POSITION, SLOPE, TORQUE])
    assert blocks_of(table, (3,)) == ColumnBlocks(0, (1, 2, 3), (4, 5, 6), (7, 8, 9))
    assert blocks_of(table[:, 1:], (5, 3)) == ColumnBlocks(None, (0, 1, 2), (3, 4, 5), (6, 7, 8))
    assert blocks_of(table[:, :7], (3,)) == ColumnBlocks(0, (1, 2, 3), (4, 5, 6), None)
    assert blocks_of(table, (7,)) is None
    assert blocks_of(table[:, :1], (3,)) is None


def arrival(seed: int = 0) -> Floats:
    """Times at which rows arrive: each late, none before the one before it."""
    late = np.random.default_rng(seed).uniform(0.0, 0.8, COUNT)
    return TIME + late * TIME[1]


class TestSeveralTimes:
    NAMES = "host_stamp,robot_time,q1,q2,q3,tau1,tau2,tau3"

    @pytest.fixture
    def arm(self, tmp_path: Path) -> Path:
        path = tmp_path / "three.urdf"
        path.write_text(URDF)
        return path

    def test_the_one_that_fits_the_motion_comes_first(self, tmp_path: Path, arm: Path) -> None:
        source = write(tmp_path / "log.csv", arrival(), TIME, POSITION, TORQUE, names=self.NAMES)
        refused = refusal(source, arm)
        assert "; robot_time fits the motion" in refused
        first, other = OPTION.findall(refused)
        assert (first, other) == ("--columns 'time=robot_time'", "--columns 'time=host_stamp'")
        assert refusal(source, arm, *shlex.split(first)) == ""
        assert np.ptp(read(source).columns["stamp"]) == pytest.approx(1e9 * np.ptp(TIME), abs=2)

    def test_of_two_even_ones_none_is_preferred(self, tmp_path: Path, arm: Path) -> None:
        both = (5.0 + 1.001 * TIME, TIME)
        source = write(tmp_path / "log.csv", *both, POSITION, TORQUE, names=self.NAMES)
        assert "fits the motion" not in refusal(source, arm)

    def test_positions_are_smooth_in_their_time(self) -> None:
        right = roughness(TIME, POSITION)
        late = roughness(arrival(), POSITION)
        assert right is not None and late is not None
        assert late > 10.0 * right
        assert roughness(TIME[::-1], POSITION) is None
        assert roughness(TIME, 0.0 * POSITION) is None
        assert roughness(TIME[:3], POSITION[:3]) is None


def test_errors_of_positions_are_not_proposed_as_positions(tmp_path: Path, urdf: Path) -> None:
    names = ",".join(["t", *(f"{n}{k}" for n in ("error_", "a", "tau") for k in (1, 2, 3))])
    source = write(tmp_path / "log.csv", TIME, 0.01 * SLOPE, POSITION, TORQUE, names=names)
    options = proposed(refusal(source, urdf))
    assert options == ["--columns", "position=a{}"]
    assert refusal(source, urdf, *options) == ""
    assert np.array_equal(read(source).columns["position"], POSITION)
