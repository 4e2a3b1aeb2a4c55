"""Logs with the same columns: what these mean is inferred once, from the first of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.base.progress import Silent
from hil.identified.staging import Staging, staged
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look.result import ChangedReading
from tests.hil.importers.moving_log import URDF
from tests.hil.simulated_logs import write_log, write_moving_log
from tests.tiers import quick_ones

COLUMNS = ["t", "q{}", "v{}", "tau{}"]
EXCHANGED = [1, 0, 2]  # torques in another order than the joints


def moving(path: Path, *, seed: int, exchanged: bool, names: list[str] = COLUMNS) -> Path:
    """A log of the arm, perhaps with the torques of two joints exchanged."""
    table = np.loadtxt(write_moving_log(path, URDF, seed=seed), delimiter=",", skiprows=1)
    time, position, velocity, torque = np.split(table, [1, 4, 7], axis=1)
    if exchanged:
        torque = torque[:, EXCHANGED]
    return write_log(path, names, time[:, 0], position, velocity, torque)


def read(fitted: list[Path], predicted: list[Path], folder: Path) -> Staging:
    urdf = folder / "three.urdf"
    urdf.write_text(URDF)
    robot = Robot.from_urdf(urdf)
    with staged(fitted, predicted, lambda _: robot, ImportOptions(), Silent()) as staging:
        return staging


def changes(staging: Staging) -> dict[str, list[ChangedReading]]:
    return {
        staging.sources[place].name: [
            found for found in recording.concluded if isinstance(found, ChangedReading)
        ]
        for place, recording in staging.recordings.items()
    }


@pytest.mark.parametrize("exchanged", quick_ones([False], [False, True]))
def test_what_is_held_out_is_read_as_what_is_fitted(tmp_path: Path, exchanged: bool) -> None:
    """Even if it is in the other order: the verdict says so, and no error is hidden."""
    first = moving(tmp_path / "a.csv", seed=0, exchanged=True)
    second = moving(tmp_path / "b.csv", seed=1, exchanged=exchanged)
    staging = read([first], [second], tmp_path)
    found = changes(staging)
    assert [change.row.aspect for change in found["a.csv"]] == ["order"]
    assert [(change.row, change.source) for change in found["b.csv"]] == [
        (found["a.csv"][0].row, "a.csv")
    ]
    maps = {recording.map_text for recording in staging.recordings.values()}
    assert len(maps) == 1


def test_a_held_out_log_alone_changes_nothing(tmp_path: Path) -> None:
    first = moving(tmp_path / "a.csv", seed=0, exchanged=False)
    second = moving(tmp_path / "b.csv", seed=1, exchanged=True)
    assert changes(read([first], [second], tmp_path)) == {"a.csv": [], "b.csv": []}


@pytest.mark.long
def test_logs_of_other_columns_are_examined_alone(tmp_path: Path) -> None:
    first = moving(tmp_path / "a.csv", seed=0, exchanged=False)
    others = ["t", "pos{}", "vel{}", "torque{}"]
    second = moving(tmp_path / "b.csv", seed=1, exchanged=True, names=others)
    found = changes(read([first], [second], tmp_path))
    assert [(change.row.aspect, change.source) for change in found["b.csv"]] == [("order", "")]
