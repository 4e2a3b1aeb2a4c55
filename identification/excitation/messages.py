"""Sentences about violated constraints of a motion."""

from __future__ import annotations

from typing import Final

from identification.excitation.violation import (
    CloseBodies,
    JointQuantity,
    Kind,
    LoadedDrive,
    Remedy,
    Subject,
    UsableShare,
    Violation,
    WholeMotion,
)
from identification.text import percentage

_UNITS: Final[dict[Kind, str]] = {
    "planning": "",
    "joint limit": "",
    "duration": " s",
    "collision": " m",
    "torque": " N·m",
    "current": " A",
}


def subject_text(subject: Subject) -> str:
    """Return what violates a constraint."""
    match subject:
        case JointQuantity(quantity, joint, end):
            return f"{quantity} of joint {joint}" + (f" at the {end}" if end else "")
        case LoadedDrive(_, name, is_motor):
            return f"motor of {name}" if is_motor else name
        case CloseBodies(first, second, at_home):
            return f"{first} and {second}" + (" at home" if at_home else "")
        case WholeMotion(problem):
            return f"the motion ({problem})" if problem else "the motion"


def violation_text(
    violation: Violation,
    joints: str | None = None,
    unit: str | None = None,
    subject: str | None = None,
) -> str:
    """Return a sentence about a violation.

    Args:
        violation: of a constraint.
        joints: positions of the joints as text, left out if empty; None: in radians.
        unit: of value and bound, with a space before it; None: SI.
        subject: what violates the constraint; None: as `subject_text`.
    """
    if joints is None:
        angles = ", ".join(f"{q:.3f}" for q in violation.posture)
        joints = f"({angles}) rad" if angles else ""
    unit = _UNITS[violation.kind] if unit is None else unit
    text = f"{violation.kind} of {subject or subject_text(violation.subject)}"
    if violation.kind != "planning":
        side = "least" if violation.value < violation.bound else "most"
        text += f": {violation.value:.4g}{unit}, must be at {side} {violation.bound:.4g}{unit}"
    text += "" if violation.time is None else f", at {violation.time:.3f} s"
    text += f", joints at {joints}" if joints else ""
    return text if violation.remedy is None else f"{text}; {_remedy_text(violation.remedy)}"


def _remedy_text(remedy: Remedy) -> str:
    match remedy:
        case UsableShare(share):
            return f"a motion may use {percentage(share)} of the motor's limit"
        case "set a ramp":
            return "a sum of sines without a ramp starts and ends at speed; set a ramp"
        case "rest at both ends":
            return "a motion must start and end at rest"
