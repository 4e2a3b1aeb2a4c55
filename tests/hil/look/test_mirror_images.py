"""Logs of arms that are mirror images of themselves: no sign of their joints is certain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import look_at
from hil.look.messages import choice_text
from hil.look.readings import Changes, ColumnOrder, Fact, MapEntries
from hil.look.result import Look
from identification.hypotheses.joint_changes import Change
from tests.hil.simulated_logs import simulate, write_log
from tests.jointed_arms import jointed_arm

pytestmark = pytest.mark.long
TIME = np.arange(0.0, 16.0, 0.01)


def look(
    folder: Path, axes: str, torque: tuple[int, ...] = (), position: tuple[int, ...] = ()
) -> Look:
    """A log with torques and positions of joints negated."""
    urdf = folder / "arm.urdf"
    urdf.write_text(jointed_arm(axes))
    simulated = simulate(urdf, TIME, seed=4, pace=1.5)
    measured = [simulated.position.copy(), simulated.torque.copy()]
    for values, joints in zip(measured, (position, torque), strict=True):
        values[:, joints] *= -1.0
    log = write_log(folder / "log.csv", ["t", "q{}", "tau{}"], TIME, *measured)
    return look_at(log, lambda _: Robot.from_urdf(urdf), ImportOptions())


def signs(found: Look) -> dict[Change, Certainty]:
    return {
        each.change: row.certainty
        for row in found.rows
        if row.aspect == "signs" and isinstance(row.reading, Changes)
        for each in row.reading.changes
    }


@pytest.mark.parametrize(
    ("axes", "negated"), [("zyyy", {"torque": (1, 2)}), ("yyy", {"position": (0, 1)})]
)
def test_signs_of_joints_in_a_plane_are_asked(
    tmp_path: Path, axes: str, negated: dict[str, tuple[int, ...]]
) -> None:
    """They are found, each once, and the mirror image that explains the torque alike is named."""
    found = look(tmp_path, axes, **negated)
    ((kind, joints),) = negated.items()
    meaning = "torque sign" if kind == "torque" else "position sign"
    planted = {Change(meaning, (joint,)) for joint in joints}  # type: ignore[arg-type]
    choices = next(each for each in found.questions if each[0].aspect == "signs")
    texts = [
        {each.change for each in choice.reading.changes}
        for choice in choices
        if isinstance(choice.reading, Changes)
    ]
    assert planted in texts
    assert set(signs(found).values()) == {Certainty.UNDETERMINED}
    assert {each.joints for each in signs(found)} <= {(joint,) for joint in range(len(axes))}
    assert all(isinstance(choice.setting, MapEntries) for choice in choices)
    assert "negated" in choice_text(choices[1])


@pytest.mark.parametrize("axes", ["zyyy", "yyy"])
def test_signs_as_recorded_are_not_certain(tmp_path: Path, axes: str) -> None:
    """With position and torque of all joints of the plane negated the arm moves alike."""
    joints = tuple(np.flatnonzero(np.array(list(axes)) == "y").tolist())
    found = look(tmp_path, axes, joints, joints)
    (row,) = [row for row in found.rows if row.aspect == "signs"]
    assert row.reading is Fact.SIGNS_OF_URDF
    assert row.certainty is Certainty.LIKELY
    assert found.questions == ()


def test_three_torques_negated_at_once_are_found(tmp_path: Path) -> None:
    """One after the other leads to another order of the joints."""
    found = look(tmp_path, "zyyyx", (1, 2, 3))
    assert {*signs(found)} == {Change("torque sign", (joint,)) for joint in (1, 2, 3)}
    assert not any(isinstance(row.reading, ColumnOrder) for row in found.rows)
