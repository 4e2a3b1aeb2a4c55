"""Notes of a new cell file in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final, assert_never

from drivers.ur.torque_constants import RELATIVE_UNCERTAINTY
from hil.cell.arms import MAX_NAMES
from hil.cell.cell import FLANGES
from identification.excitation.collision_messages import unchecked_text
from identification.text import percentage

from . import notes
from .found_shapes import MIN_FRAME_HEIGHT
from .notes import CellNote, PlainNote

_WORDS: Final[Mapping[PlainNote, str]] = {
    PlainNote.GEOMETRY_OF_TABLE: (
        "the URDF contains the geometry of the DH parameters only: no masses, no limits"
    ),
    PlainNote.GEOMETRY_OF_ARM: (
        "the URDF contains the calibrated geometry that the arm states: no masses; one with masses"
        " (--urdf) gives the estimate a prior"
    ),
    PlainNote.NO_COLLISION_SHAPES: (
        "the URDF has no <collision> shapes: add some (boxes, cylinders or spheres). Without them"
        " only a design works, with collision = false in the settings that `hil design"
        " --show-settings gradient` prints"
    ),
    PlainNote.NO_FLOOR: "no posture tried is clear of a floor at 0 m: no floor is assumed",
    PlainNote.EVERY_POSTURE_IN_CONTACT: (
        "every posture tried is in contact: correct campaign.home_deg"
    ),
    PlainNote.UNKNOWN_TORQUE_CONSTANTS: (
        "the torque constants of some joints are unknown: hold the arm still in a posture in which"
        " gravity loads every joint but the first, and run this command again"
    ),
    PlainNote.TORQUE_CONSTANTS_OF_ARM: (
        "the torque constants come from the arm's own model, uncertain by"
        f" {percentage(RELATIVE_UNCERTAINTY)}: weigh a known payload (`hil torque-constants`), then"
        " correct torque_uncertainty"
    ),
}


def note_lines(of_cell: Iterable[CellNote]) -> list[str]:
    """Return a sentence for each note, without full stop."""
    return [*map(_note_words, of_cell)]


def _note_words(note: CellNote) -> str:
    match note:
        case PlainNote():
            return _WORDS[note]
        case notes.FixedOutside() | notes.FixedPrismatic() | notes.FixedMimic():
            return _fixed_words(note)
        case notes.LiftingJoints() | notes.GripperJoints() | notes.SeveralBranches():
            return _joints_words(note)
        case notes.HomeNotChecked() | notes.CollisionExceptions() | notes.ShapesNotFound():
            return _collision_words(note)
        case notes.UnsupportedCycle() | notes.ClosedAxes() | notes.FromSimulation():
            return _controller_words(note)
        case notes.NotAsked() | notes.PayloadWithoutFrame():
            return _arm_words(note)
        case never:
            assert_never(never)


def _fixed_words(note: notes.FixedOutside | notes.FixedPrismatic | notes.FixedMimic) -> str:
    match note:
        case notes.FixedOutside(links, joints):
            return f"fixed, as they do not lie between {links}: {', '.join(joints)}"
        case notes.FixedPrismatic(joint, position):
            return (
                f"{joint} is prismatic, and fixed at {position:g} m in the cell's copy of the"
                f" URDF; --fix {joint}=… for another position"
            )
        case notes.FixedMimic(joint, leader, position):
            return (
                f"{joint} follows {leader} (<mimic>), which the model does not support: it is"
                f" fixed at {position:g} rad in the cell's copy of the URDF, --fix {joint}=… for"
                " another position. If it belongs to a linkage that supports the arm, the model"
                " is wrong"
            )


def _joints_words(note: notes.LiftingJoints | notes.GripperJoints | notes.SeveralBranches) -> str:
    match note:
        case notes.LiftingJoints(joints):
            slides = "slides" if len(joints) == 1 else "slide"
            return (
                f"{', '.join(joints)} {slides} along gravity: its weight and the offset of its"
                " friction are estimated together, from recordings (`hil import log --cell`). The"
                " cell has no tables for motion, which are in degrees;"
                f" {_fixing(joints)} writes them for the other joints"
            )
        case notes.GripperJoints(joints, tip):
            looks = "looks like a joint" if len(joints) == 1 else "look like joints"
            few = len(joints) <= MAX_NAMES
            others = "" if few else f" and {len(joints) - MAX_NAMES} others"
            fix = f"fix what is not identified ({_fixing(joints)}), or " if few else ""
            return (
                f"{', '.join(joints[:MAX_NAMES])}{others} {looks} of a gripper or hand by name:"
                f" {fix}give the last link of the arm (--tip {tip or 'LINK'})"
            )
        case notes.SeveralBranches(ends):
            return (
                f"the joints form {len(ends)} branches, with the last moving links "
                f"{', '.join(ends[:MAX_NAMES])}: choose one arm with --base LINK --tip LINK"
            )


def _collision_words(
    note: notes.HomeNotChecked | notes.CollisionExceptions | notes.ShapesNotFound,
) -> str:
    match note:
        case notes.HomeNotChecked(problem):
            return f"campaign.home_deg was not checked for collisions: {problem}"
        case notes.CollisionExceptions(exceptions):
            return unchecked_text(exceptions) or ""
        case notes.ShapesNotFound(links):
            return (
                f"the collision shapes of {', '.join(links)} were not found: in campaign.home_deg"
                f" their frames are {MIN_FRAME_HEIGHT * 100:g} cm off the floor, and nothing else"
                " about them was checked"
            )


def _controller_words(
    note: notes.UnsupportedCycle | notes.ClosedAxes | notes.FromSimulation,
) -> str:
    match note:
        case notes.UnsupportedCycle(milliseconds):
            return f"the cycle of the controller is {milliseconds} ms; supported are 1 and 2"
        case notes.ClosedAxes(axes, arm):
            return (
                f"axes {', '.join(map(str, axes))} of arm {arm} are not open in the controller; a"
                " campaign needs all axes of the arm"
            )
        case notes.FromSimulation(archive):
            return f"{archive} was recorded from a simulated controller"


def _arm_words(note: notes.NotAsked | notes.PayloadWithoutFrame) -> str:
    match note:
        case notes.NotAsked(problem):
            return f"not asked: {problem}"
        case notes.PayloadWithoutFrame(mass):
            return (
                f"the controller is set to a payload of {mass:g} kg, and the URDF has no link "
                f"{' or '.join(FLANGES)} for its frame: add [robot.payload]"
            )


def _fixing(joints: tuple[str, ...]) -> str:
    return " ".join(f"--fix {joint}" for joint in joints)
