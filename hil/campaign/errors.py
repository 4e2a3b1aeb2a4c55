"""Errors of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hil.archive.commands import Failed
from hil.errors import ArchiveWriteError, ControllerFault, HilError, InputError, UnsafeError


class CampaignFolderError(InputError):
    """The campaign folder is not what it should be."""

    def __init__(self, folder: Path, problem: str, remedy: str) -> None:
        super().__init__(folder, problem, remedy=remedy)


class MotionRefusedError(UnsafeError):
    """A motion failed its check and was not sent."""

    def __init__(self, motion: str, problem: str, remedy: str) -> None:
        self.motion = motion
        super().__init__(f"{motion} was not sent: {problem}; {remedy}.")


class MotionFailedError(ControllerFault):
    """A motion ended otherwise than planned; what was recorded is archived.

    Attributes:
        motion: which one.
        outcome: "stopped", "refused" or "lost".
        reason: in words.
        flight_recorder: (k,) of `drivers.cycle_dtype`, the last records up to the refusal; None
            where nothing was refused.
    """

    def __init__(
        self,
        motion: str,
        outcome: str,
        reason: str,
        flight_recorder: NDArray[np.void] | None = None,
    ) -> None:
        self.motion, self.outcome, self.reason = motion, outcome, reason
        self.flight_recorder = flight_recorder
        super().__init__(
            f"{motion} ended {outcome}: {reason}; "
            "everything recorded is archived, run the campaign again to continue."
        )


class NotRehearsedError(UnsafeError):
    """A plan that did not pass its rehearsal is not run."""

    def __init__(self, campaign: Path, problem: str, remedy: str) -> None:
        super().__init__(f"{campaign} {problem}; {remedy}.")


class DryRunError(UnsafeError):
    """A plan is not run at full speed before a person has accepted its slow dry run."""

    def __init__(self, campaign: Path, problem: str, remedy: str) -> None:
        super().__init__(f"{campaign}: its slow dry run {problem}; {remedy}.")


class AgainstGravityError(DryRunError):
    """A dry run whose torques contradict the model is accepted joint by joint, or not at all.

    Attributes:
        joints: whose torque runs against the model's gravity.
    """

    def __init__(self, campaign: Path, joints: Sequence[str], why: str) -> None:
        self.joints = tuple(joints)
        names = " ".join(f"--accept-torque {joint}" for joint in joints)
        super().__init__(
            campaign,
            f"was done, but is not accepted ({', '.join(joints)}: {why})",
            "correct the cell file and rehearse again, or, if you know that the arm is right and "
            f"the model is not, run `hil run {campaign} --accept-dry-run {names}`",
        )


class RepetitionsRejectedError(HilError):
    """A motion failed its quality check as often as it may be repeated.

    Attributes:
        motion: which one.
        reasons: of each attempt.
    """

    exit_code: ClassVar[int] = 5

    def __init__(self, motion: str, reasons: Sequence[str]) -> None:
        self.motion, self.reasons = motion, tuple(reasons)
        super().__init__(
            f"{motion} was of no use {len(self.reasons)} times, at last because "
            f"{self.reasons[-1]}; all attempts are archived with their reasons: find the cause, "
            "then run the campaign again to continue."
        )


def write_error(failed: Failed) -> ArchiveWriteError:
    """What is raised where the archive process cannot write."""
    return ArchiveWriteError(failed.path or None, failed.problem, remedy=failed.remedy)
