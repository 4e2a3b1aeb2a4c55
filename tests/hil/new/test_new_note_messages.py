"""Notes of a new cell file: each has words with its figures."""

from __future__ import annotations

from typing import get_args

import pytest

from hil.cell.arms import Links
from hil.new import notes
from hil.new.messages import note_lines
from hil.new.notes import CellNote, PlainNote
from identification.excitation.collision import ClosePair, PairExceptions

PAIRS = PairExceptions((ClosePair("base", "link1", 0.0, 0.001),))
WORDS: dict[CellNote, str] = {
    PlainNote.GEOMETRY_OF_TABLE: "the geometry of the DH parameters only: no masses, no limits",
    PlainNote.GEOMETRY_OF_ARM: "the calibrated geometry that the arm states: no masses",
    notes.FixedOutside(Links(tip="left_wrist"), ("head", "right_w2")): (
        "fixed, as they do not lie between the root and left_wrist: head, right_w2"
    ),
    notes.FixedPrismatic("lift", 0.1): "lift is prismatic, and fixed at 0.1 m in the cell's copy",
    notes.FixedMimic("finger", "thumb", 0.2): (
        "finger follows thumb (<mimic>), which the model does not support: it is fixed at 0.2 rad"
    ),
    notes.LiftingJoints(("lift",)): "lift slides along gravity",
    notes.LiftingJoints(("lift", "tower")): "--fix lift --fix tower writes them for the other",
    notes.GripperJoints(("left_finger",), "arm"): (
        "left_finger looks like a joint of a gripper or hand by name: fix what is not identified"
        " (--fix left_finger), or give the last link of the arm (--tip arm)"
    ),
    notes.GripperJoints(tuple(f"f{k}" for k in range(99)), None): (
        "others look like joints of a gripper or hand by name: give the last link of the arm"
        " (--tip LINK)"
    ),
    notes.SeveralBranches(("head", "left_wrist")): (
        "the joints form 2 branches, with the last moving links head, left_wrist: choose one arm"
    ),
    PlainNote.NO_COLLISION_SHAPES: "`hil design --show-settings gradient`",
    notes.HomeNotChecked("no mesh"): "was not checked for collisions: no mesh",
    notes.CollisionExceptions(PAIRS): "base and link1 (0.000 to 0.001 m)",
    notes.ShapesNotFound(("tool",)): "the collision shapes of tool were not found",
    PlainNote.NO_FLOOR: "no posture tried is clear of a floor at 0 m",
    PlainNote.EVERY_POSTURE_IN_CONTACT: "correct campaign.home_deg",
    notes.UnsupportedCycle(4): "the cycle of the controller is 4 ms; supported are 1 and 2",
    notes.ClosedAxes((2, 5), 1): "axes 2, 5 of arm 1 are not open in the controller",
    notes.FromSimulation("a.mcap"): "a.mcap was recorded from a simulated controller",
    notes.NotAsked("port 30001 is closed"): "not asked: port 30001 is closed",
    PlainNote.UNKNOWN_TORQUE_CONSTANTS: "hold the arm still",
    PlainNote.TORQUE_CONSTANTS_OF_ARM: "uncertain by 10 %: weigh a known payload",
    notes.PayloadWithoutFrame(2.5): "set to a payload of 2.5 kg, and the URDF has no link",
}


@pytest.mark.parametrize(("note", "words"), WORDS.items(), ids=list(WORDS.values()))
def test_each_note_has_words(note: CellNote, words: str) -> None:
    (line,) = note_lines([note])
    assert words in line


def test_the_table_has_every_note() -> None:
    assert {type(note) for note in WORDS} == {*get_args(CellNote)}
    assert WORDS.keys() >= {*PlainNote}
