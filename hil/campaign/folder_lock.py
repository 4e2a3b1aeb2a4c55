"""One run at a time in a campaign folder; a run that dies lets go of it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from hil.io import is_locked
from hil.io import locked as locked_file

from .errors import CampaignFolderError

LOCK: Final = "campaign.lock"
LOCK_PATIENCE: Final = 0.5
"""s to wait for a lock: whoever looks whether somebody is at work holds it for a moment."""


def locked(root: Path) -> AbstractContextManager[None]:
    """Keep every other run out of a folder.

    Raises, when entered:
        CampaignFolderError: another run is at work on it, or the disk refuses.
    """

    def refusal(error: OSError) -> CampaignFolderError:
        if isinstance(error, BlockingIOError):
            return CampaignFolderError(
                root, "another run is at work on it", "wait for its end, or stop it"
            )
        problem = f"{LOCK} cannot be written ({error.strerror})"
        return CampaignFolderError(root, problem, "make it a writable file")

    return locked_file(root / LOCK, refusal, patience=LOCK_PATIENCE)


def busy(root: Path) -> bool:
    """Whether a run is at work on a folder at this moment."""
    return is_locked(root / LOCK)
