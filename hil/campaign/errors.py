"""Errors of a campaign."""

from __future__ import annotations

from pathlib import Path

from hil.errors import ControllerFault, InputError, UnsafeError


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
    """A motion ended otherwise than planned; what was recorded is archived."""

    def __init__(self, motion: str, outcome: str, reason: str) -> None:
        self.motion, self.outcome, self.reason = motion, outcome, reason
        super().__init__(
            f"{motion} ended {outcome}: {reason}; "
            "everything recorded is archived, run the campaign again to continue."
        )
