"""Errors of a campaign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive.commands import Failed
from hil.errors import ArchiveWriteError, ControllerFault, InputError, UnsafeError


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
    """A campaign that was never rehearsed is not run on a controller that may be real."""

    def __init__(self) -> None:
        super().__init__(
            "this campaign was not rehearsed, and its link leads out of this computer; "
            "only a simulated controller on this computer (127.0.0.1) is driven without a rehearsal"
        )


def write_error(failed: Failed) -> ArchiveWriteError:
    """What is raised where the archive process cannot write."""
    return ArchiveWriteError(failed.path or None, failed.problem, remedy=failed.remedy)
