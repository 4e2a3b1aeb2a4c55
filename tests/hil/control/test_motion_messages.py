"""Why a motion must not be sent: each refusal has words with its figures."""

from __future__ import annotations

from typing import get_args

import pytest

from hil.cell import AngleFrame, Cell
from hil.control import motion_refusals as refusals
from hil.control.messages import fixed_words, refusal_words, slip_words
from hil.control.motion_refusals import FixedDistance, MotionRefusal, NarrowerLimit
from identification.excitation.violation import CloseBodies, LoadedDrive, Violation
from identification.signals.position_steps import PositionJump
from planner import NotSmooth
from tests import messages
from tests.hil.fast_cell import fast_cell

CURRENT = Violation("current", LoadedDrive(1, "elbow", is_motor=True), 5.2, 4.5, 0.25)
CONTACT = Violation("collision", CloseBodies("link1", "floor"), 0.01, 0.05, 0.5)
FIXED = FixedDistance("link1", "floor", 0.013, 0.014, 0.05)
WORDS: dict[MotionRefusal, tuple[str, ...]] = {
    refusals.OtherJointCount(5, 6): ("it is for 5 joints, the arm has 6",),
    refusals.TooLong(1e6): ("it lasts 1e+06 s; at most 600 s are allowed",),
    refusals.NoRamp(): (messages.GIVE_A_RAMP,),
    refusals.TooManySines(99): ("it has 99 sines for each joint; at most 20 are allowed",),
    refusals.NotFinite("jerk", 2): ("the jerk of joint 2 is not finite",),
    NotSmooth("velocity", 1, 0.5, 0.1): ("velocity", "0.5"),
    refusals.BrokenConstraint(CURRENT): (
        "current of motor of elbow: 5.2 A, must be at most 4.5 A, at 0.250 s",
    ),
    refusals.BrokenConstraint(CURRENT, narrower=NarrowerLimit(4.5, 9.0)): (
        "at most 4.5 A",
        "the controller limits that motor to 4.5 A, the cell file to 9 A: enter the",
    ),
    refusals.BrokenConstraint(CONTACT, FIXED): (
        "link1 and floor: 0.01 m, must be at least 0.05 m",
        "link1 and floor are 0.013 to 0.014 m apart in any posture",
    ),
}


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return fast_cell(tmp_path_factory.mktemp("cell"))


@pytest.mark.parametrize(
    ("refusal", "words"), WORDS.items(), ids=[words[-1] for words in WORDS.values()]
)
def test_each_refusal_has_words(refusal: MotionRefusal, words: tuple[str, ...], cell: Cell) -> None:
    text = refusal_words(refusal, AngleFrame.of(cell))
    assert all(part in text for part in words)


def test_the_table_has_every_refusal() -> None:
    assert {type(refusal) for refusal in WORDS} == {*get_args(MotionRefusal)}


@pytest.mark.parametrize(
    ("nearest", "remedy"),
    [
        (0.06, "too close to contact to be resolved; narrow [workspace] margin"),
        (0.013, "[workspace] margin must be below that"),
        (-0.1, "they overlap; correct their collision shapes in the URDF"),
    ],
)
def test_the_remedy_for_a_fixed_distance_depends_on_it(nearest: float, remedy: str) -> None:
    assert fixed_words(FixedDistance("a", "b", nearest, nearest, 0.05)).endswith(remedy)


def test_a_slip_has_joint_size_and_time() -> None:
    words = slip_words(PositionJump("", "elbow", 1.5, -0.01))
    assert "position of elbow slipped by 0.57° 1.50 s after the archive begins" in words
