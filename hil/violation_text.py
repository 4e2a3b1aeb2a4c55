"""What a motion breaks, in the words and angles of the person at the cell."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Final

import numpy as np

from hil.cell import AngleFrame
from identification.excitation import CollisionChecker, Violation

_JOINT_LIMIT: Final = re.compile(r"(position|velocity|acceleration|jerk) of joint (\d+)(.*)")
_UNITS: Final = {
    "position": " deg",
    "velocity": " deg/s",
    "acceleration": " deg/s²",
    "jerk": " deg/s³",
}
# A distance that changes by less than this [m] is one that no motion changes.
_UNCHANGED: Final = 0.01


def violation_text(violation: Violation, frame: AngleFrame) -> str:
    """A violation in degrees, and in the angles in which the cell's limits are written."""
    joints = frame.text_of_angles(violation.posture) if violation.posture else ""
    limit = _JOINT_LIMIT.fullmatch(violation.subject) if violation.kind == "joint limit" else None
    if limit is None:
        return violation.sentence(joints)
    quantity, joint, where = limit[1], int(limit[2]), limit[3]
    # Of a rate it is the size, which is the same in any frame.
    sign, zero = (frame.sign[joint], frame.offset[joint]) if quantity == "position" else (1.0, 0.0)
    value, bound = (
        float(np.degrees(sign * number + zero)) for number in (violation.value, violation.bound)
    )
    shown = replace(
        violation, subject=f"{quantity} of J{joint + 1}{where}", value=value, bound=bound
    )
    return shown.sentence(joints, _UNITS[quantity])


def always_so(violation: Violation, checker: CollisionChecker) -> str | None:
    """What is to be done about a pair that no posture brings apart; None where a motion may."""
    if violation.kind != "collision":
        return None
    pairs = [pair for pair in checker.pairs if " and ".join(pair) == violation.subject]
    if not pairs:
        return None
    nearest, farthest = checker.spread(*pairs[0])
    if farthest - nearest > _UNCHANGED:
        return None
    found = f"{violation.subject} are {nearest:.3f} to {farthest:.3f} m apart in any posture"
    if nearest >= violation.bound:
        return f"{found}, closer to contact than can be resolved; narrow [workspace] margin"
    if nearest > 0.0:
        return f"{found}; [workspace] margin must be below that"
    return f"{found}: they overlap; correct their collision shapes in the URDF"
