"""Errors of single motions, and refusals in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from drivers.errors import Check, GuardError, RefusalError
from drivers.events import Refused
from hil.base.errors import ExecutionError, OperatorStopError, UnsafeError
from hil.base.terminal_text import with_joint_names
from hil.cell import AngleFrame, Cell
from identification.signals.position_steps import PositionJump

from .messages import slip_words


class MotionRefusedError(UnsafeError):
    """A motion failed its check and was not sent."""

    def __init__(self, motion: str, problem: str, remedy: str) -> None:
        super().__init__(f"{motion} was not sent: {problem}; {remedy}.")


class MotionFailedError(ExecutionError):
    """A motion ended otherwise than planned; what was recorded is archived.

    Args:
        motion: its name.
        outcome: "stopped", "refused" by this PC, or "lost".
        reason: why, as a clause.
        archive: name of its archive, or None.
        refused: the refusal, if this PC refused it.

    Attributes:
        outcome: "stopped", "refused" by this PC, or "lost".
        sentence: motion, archive, outcome and reason.
        archived: it, and that everything recorded is archived.
        refused: the refusal, with its error and the last records before it; else None.
    """

    def __init__(
        self,
        motion: str,
        outcome: str,
        reason: str,
        archive: str | None = None,
        refused: Refused | None = None,
    ) -> None:
        self.outcome = outcome
        self.reason = reason
        self.refused = refused
        which = motion if archive is None else f"{motion} ({archive})"
        how = reason if reason.startswith(outcome) else f"{outcome}: {reason}"
        self.sentence = f"{which} was {how}"
        self.archived = f"{self.sentence}; everything recorded is archived"
        remedy = "run the campaign again to continue"
        if refused is not None:
            remedy = refused.error.remedy
        elif outcome == "lost":  # by an emergency stop, too
            remedy = f"find the cause and check the arm, then {remedy}"
        super().__init__(f"{self.archived}; {remedy}.")


class SlippedError(MotionFailedError):
    """A motion in which a measured position slipped: the arm is not where its encoders say."""

    def __init__(self, motion: str, slip: PositionJump, archive: str) -> None:
        super().__init__(motion, "rejected", slip_words(slip), archive)
        self.slip = slip
        remedy = (
            "it is not used, and nothing else was moved. Check encoder, coupling, belt and "
            "brake of that joint, and its position at a known mark, before the arm moves again"
        )
        self.args = (f"{self.archived}; {remedy}.",)


def stopped(fault: Exception, again: str) -> OperatorStopError:
    """Return the error of a run that its operator stopped; `again` is how it is resumed."""
    what = fault.archived if isinstance(fault, MotionFailedError) else str(fault)
    return OperatorStopError(f"{what.rstrip('.')}; {again}")


_SET_BY: Final[Mapping[Check, str]] = {
    Check.POSITION: "[limits] lower_deg and upper_deg",
    Check.VELOCITY: "[limits] velocity_deg",
    Check.ACCELERATION: "[limits] acceleration_deg and its factor in [bounds]",
    Check.JERK: "[limits] jerk_deg and its factor in [bounds]",
    Check.STATED_VELOCITY: "[limits] acceleration_deg and its factor in [bounds], times a cycle",
    Check.FOLLOWING_ERROR: "[drive_train] following_error, or the controller where it is narrower",
    Check.CURRENT: "[drive_train] current_limit, or the controller where it is narrower",
}
"""What in the cell file sets the bound of a check."""


def refusal_text(cell: Cell, error: RefusalError) -> str:
    """Return a refusal with the joint's name, degrees, and what in the cell file sets the bound."""
    if not isinstance(error, GuardError):
        return with_joint_names(str(error), cell.joint_names)
    joint = error.joint
    check = error.check
    unit = error.unit
    name = cell.joint_names[joint]
    cycle = f"(cycle {error.cycle})"
    if check is Check.FINITE:
        return f"{name} is {error.value}, not a finite number {cycle}"
    value = error.value
    bound = error.bound
    if unit.startswith("rad"):
        value = math.degrees(value)
        bound = math.degrees(bound)
        unit = unit.replace("rad", "°")
    if check is Check.POSITION:
        frame = AngleFrame.of(cell)
        sign = frame.sign[joint]
        offset = math.degrees(frame.offset[joint])
        value = sign * value + offset
        bound = sign * bound + offset
    source = f", set by {_SET_BY[check]}" if check in _SET_BY else ""
    # The guard allows a millionth more than the cell file, for rounding.
    allowed = f"allowed is {bound:.6g} {unit}{source}"
    return f"{check.quantity} of {name} is {value:.9g} {unit}; {allowed} {cycle}"
