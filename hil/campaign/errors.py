"""Errors of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from hil.base.errors import HilError, UnsafeError
from hil.base.exit_status import ExitStatus
from hil.base.terminal_text import plural


class NotRehearsedError(UnsafeError):
    """A plan that did not pass its rehearsal."""

    def __init__(self, campaign: Path, problem: str, remedy: str) -> None:
        super().__init__(f"{campaign} {problem}; {remedy}.")


class DryRunError(UnsafeError):
    """A plan whose dry run is not accepted."""

    def __init__(self, campaign: Path, problem: str, remedy: str) -> None:
        super().__init__(f"{campaign}: its dry run {problem}; {remedy}.")


class AgainstGravityError(DryRunError):
    """A dry run with torques against gravity of the model; `joints` must be accepted by name.

    Args:
        campaign: its folder.
        joints: that must be accepted by name.
        problem: what the torques contradict.
        correct: what to do if the cell is wrong.
        command: that continues the run.
    """

    def __init__(
        self, campaign: Path, joints: Sequence[str], problem: str, correct: str, command: str
    ) -> None:
        self.joints = tuple(joints)
        names = " ".join(f"--accept-torque {joint}" for joint in joints)
        super().__init__(
            campaign,
            f"was done, but is not accepted ({', '.join(joints)}: {problem})",
            f"{correct}, or, if you know that the arm is right and the model is not, run "
            f"`{command} --accept-dry-run {names}`",
        )


class RepetitionsRejectedError(HilError):
    """A motion that failed its quality check in each attempt, for these reasons.

    `cause` is a sentence on another likely cause.
    """

    exit_code: ClassVar[int] = ExitStatus.NEGATIVE_RESULT

    def __init__(self, motion: str, reasons: Sequence[str], cause: str = "") -> None:
        self.motion = motion
        self.reasons = tuple(reasons)
        super().__init__(
            f"{motion} was rejected {plural(len(reasons), 'time')}, the last time because "
            f"{reasons[-1]}; all attempts are archived with their reasons. Check the arm: payload, "
            "tool, cables, belts, brakes, obstacles. Remove the cause and run the campaign again, "
            f"or begin a new one if the arm stays as it is. {cause}".rstrip()
        )
