"""Commanded positions in a file of their own, on the clock of the positions or on another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.base.errors import SourceError
from hil.importers.conclusions import ChannelMeaning, OtherClock
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportedRecording, ImportOptions, read_recording
from tests.hil.importers.lerobot_set import JOINTS, motion, write_urdf

Array = NDArray[np.float64]

RATE = 50.0
LAG = 0.08  # s by which positions follow
DURATION = 20.0


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    return write_urdf(tmp_path)


def table(path: Path, names: list[str], time: Array, values: Array) -> Path:
    rows = [",".join(f"{number:.6f}" for number in row) for row in np.column_stack([time, values])]
    path.write_text("\n".join([",".join(["timestamp", *names]), *rows]) + "\n")
    return path


def at(time: Array) -> Array:
    """Return a motion without period at times (m, 3) [rad]."""
    whole = np.arange(0.0, 40.0, 1.0 / RATE)
    position = motion(40.0, 0.0) * (0.5 + 0.5 * np.sin(0.11 * whole**1.5))[:, None]
    return np.column_stack([np.interp(time + 10.0, whole, column) for column in position.T])


def read(log: Path, commands: Path, urdf: Path) -> ImportedRecording:
    robot = Robot.from_urdf(urdf)
    return read_recording(log, lambda _: robot, ImportOptions(commands=commands))


def commanded(recording: ImportedRecording) -> tuple[Array, Array]:
    """Return times [s] and commands where they are known."""
    columns = recording.archive.columns
    values = np.asarray(columns["commanded_position"])
    known = np.isfinite(values).all(axis=1)
    stamp = 1e-9 * (columns["stamp"] - columns["stamp"][0])
    return stamp[known], values[known]


@pytest.fixture
def states(tmp_path: Path) -> Path:
    time = np.arange(0.0, DURATION, 1.0 / RATE)
    names = [f"q_{name}" for name in JOINTS]
    return table(tmp_path / "state.csv", names, time, at(time - LAG))


@pytest.mark.parametrize(
    "names", [list(JOINTS), [f"position_{k}" for k in (1, 2, 3)]], ids=["joints", "numbers"]
)
def test_commands_are_joined_by_their_times(
    tmp_path: Path, urdf: Path, states: Path, names: list[str]
) -> None:
    time = np.arange(0.3, DURATION, 1.0 / 31.0)
    commands = table(tmp_path / "control.csv", names, time, at(time))
    found, values = commanded(read(states, commands, urdf))
    assert found[0] == pytest.approx(0.3, abs=1.0 / RATE)
    np.testing.assert_allclose(values, at(found), atol=2e-3)


def test_commands_on_another_clock_are_moved_by_the_motion(
    tmp_path: Path, urdf: Path, states: Path
) -> None:
    time = np.arange(2.0, 17.0, 1.0 / 31.0)
    commands = table(tmp_path / "control.csv", list(JOINTS), time + 1.7e9, at(time))
    recording = read(states, commands, urdf)
    (moved,) = [each for each in recording.examined.found if isinstance(each, OtherClock)]
    # How late the positions follow is not known: the largest usual lag is assumed.
    assert moved.offset == pytest.approx(-1.7e9 + LAG - 0.15, abs=0.03)
    found, values = commanded(recording)
    np.testing.assert_allclose(values, at(found + 0.15 - LAG), atol=0.05)


@pytest.mark.parametrize(("late", "is_moved"), [(0.1, False), (-0.4, True), (1.7, True)])
def test_lags_of_no_servo_are_of_another_clock(
    tmp_path: Path, urdf: Path, states: Path, late: float, is_moved: bool
) -> None:
    """Their times overlap all the same."""
    time = np.arange(2.0, 17.0, 1.0 / 31.0)
    commands = table(tmp_path / "control.csv", list(JOINTS), time - late, at(time))
    recording = read(states, commands, urdf)
    moved = [each for each in recording.examined.found if isinstance(each, OtherClock)]
    assert bool(moved) is is_moved
    if is_moved:
        sample = 1.0 / 31.0 + 0.01  # of the commands, and of the grid on which both are compared
        assert moved[0].offset == pytest.approx(late + LAG - 0.15, abs=sample)


def test_commands_of_another_motion_are_not_moved(tmp_path: Path, urdf: Path, states: Path) -> None:
    time = np.arange(2.0, 17.0, 1.0 / 31.0)
    other = 0.1 * np.sign(np.sin(np.outer(time, [11.0, 7.3, 5.9])))
    commands = table(tmp_path / "control.csv", list(JOINTS), time, other)
    recording = read(states, commands, urdf)
    assert not [each for each in recording.examined.found if isinstance(each, OtherClock)]


def test_commands_need_times_and_all_joints(tmp_path: Path, urdf: Path, states: Path) -> None:
    time = np.arange(0.0, DURATION, 1.0 / RATE)
    two = table(tmp_path / "two.csv", ["a", "b"], time, at(time)[:, :2])
    with pytest.raises(SourceError, match="has no 3 channels") as refused:
        read(states, two, urdf)
    assert refused.value.remedy
    timeless = tmp_path / "timeless.csv"
    timeless.write_text("pan,lift,gripper\n0,0,0\n0.1,0,0\n")
    with pytest.raises(SourceError, match="needs one column of times"):
        read(states, timeless, urdf)


def test_names_of_lerobot_are_known(tmp_path: Path, urdf: Path) -> None:
    time = np.arange(0.0, DURATION, 1.0 / RATE)
    kinds = ("{}.pos", "action.{}.pos", "{}.load")
    names = [kind.format(name) for kind in kinds for name in JOINTS]
    load = np.round(100.0 * (at(time) - at(time - LAG)))
    values = np.column_stack([at(time - LAG), at(time), load])
    log = table(tmp_path / "teleop.csv", names, time, values)
    robot = Robot.from_urdf(urdf)
    recording = read_recording(log, lambda _: robot)
    meanings = {
        each.kind: each.channels for each in recording.concluded if isinstance(each, ChannelMeaning)
    }
    assert meanings["position"] == "pan.pos .. gripper.pos"
    assert meanings["commanded_position"] == "action.pan.pos .. action.gripper.pos"
    assert meanings["torque"] == "pan.load .. gripper.load"  # until its numbers are judged
    np.testing.assert_allclose(recording.archive.columns["commanded_position"], at(time), atol=1e-5)
