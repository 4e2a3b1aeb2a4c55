"""Motions of an arm in words: why they must not be sent, and slips of measured positions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final, assert_never

from drivers.init_check import float32_text
from hil.cell import AngleFrame
from identification.excitation import messages
from identification.excitation.violation import JointQuantity, Violation
from identification.signals.position_steps import PositionJump
from planner import NotSmooth

from .motion_refusals import (
    MAX_MOTION_SECONDS,
    MAX_SINES,
    BrokenConstraint,
    FixedDistance,
    Limit,
    LowerLimit,
    MotionRefusal,
    NarrowerLimit,
    NoRamp,
    NotFinite,
    OtherJointCount,
    TooLong,
    TooManySines,
)

_LIMIT_UNITS: Final[Mapping[Limit, str]] = {
    "current_limit": "A",
    "following_error": "motor revolutions",
}
_UNITS: Final = {
    "position": " deg",
    "velocity": " deg/s",
    "acceleration": " deg/s²",
    "jerk": " deg/s³",
}


def refusal_words(refusal: MotionRefusal, frame: AngleFrame) -> str:
    """Return why a motion must not be sent, with angles in a frame."""
    match refusal:
        case OtherJointCount(motion, arm):
            return f"it is for {motion} joints, the arm has {arm}"
        case TooLong(duration):
            return f"it lasts {duration:.6g} s; at most {MAX_MOTION_SECONDS:g} s are allowed"
        case NoRamp():
            return "its sines begin and end at full speed; give them a ramp"
        case TooManySines(count):
            return f"it has {count} sines for each joint; at most {MAX_SINES} are allowed"
        case NotFinite(quantity, joint):
            return f"the {quantity} of joint {joint} is not finite"
        case NotSmooth():
            return str(refusal)
        case BrokenConstraint(violation, fixed, narrower):
            text = violation_text(violation, frame)
            text += "" if narrower is None else f"; {_narrower_words(narrower)}"
            return text if fixed is None else f"{text}; {fixed_words(fixed)}"
        case never:
            assert_never(never)


def violation_text(violation: Violation, frame: AngleFrame) -> str:
    """Return a violation in degrees, in the frame of the cell's limits."""
    joints = frame.text_of_angles(violation.posture) if violation.posture else ""
    subject = violation.subject
    if not isinstance(subject, JointQuantity):
        return messages.violation_text(violation, joints)
    joint = subject.joint
    # The magnitude of a rate is the same in any frame.
    is_position = subject.quantity == "position"
    sign, zero = (frame.sign[joint], frame.offset[joint]) if is_position else (1.0, 0.0)
    value, bound = (
        math.degrees(sign * number + zero) for number in (violation.value, violation.bound)
    )
    shown = replace(violation, value=value, bound=bound)
    where = f" at the {subject.end}" if subject.end else ""
    name = f"{subject.quantity} of J{joint + 1}{where}"
    return messages.violation_text(shown, joints, _UNITS[subject.quantity], name)


def fixed_words(fixed: FixedDistance) -> str:
    """Return the distance of a pair that no posture parts, and what to do about it."""
    facts = (
        f"{fixed.first} and {fixed.second} are {fixed.nearest:.3f} to {fixed.farthest:.3f} m apart"
        " in any posture"
    )
    if fixed.nearest >= fixed.required:
        return f"{facts}, too close to contact to be resolved; narrow [workspace] margin"
    if fixed.nearest > 0.0:
        return f"{facts}; [workspace] margin must be below that"
    return f"{facts}: they overlap; correct their collision shapes in the URDF"


def slip_words(jump: PositionJump) -> str:
    """Return what slipped, by how much and when, as a clause."""
    return (
        f"the measured position of {jump.joint} slipped by {math.degrees(abs(jump.size)):.2g}°"
        f" {jump.time:.2f} s after the archive begins, which no motion of the arm explains"
    )


def lower_limit_words(lower: LowerLimit) -> str:
    """Return a limit of the controller that is below the cell's, with both."""
    unit = _LIMIT_UNITS[lower.limit]
    return (
        f"{lower.joint}: {float32_text(lower.controller)} {unit} in the controller,"
        f" {lower.cell:.9g} in the cell file"
    )


def _narrower_words(limit: NarrowerLimit) -> str:
    return (
        f"the controller limits that motor to {float32_text(limit.controller)} A, the cell file to"
        f" {limit.cell:.9g} A: enter the controller's value as [drive_train] current_limit"
    )
