"""One run at a time in a campaign folder; a run that dies lets go of it."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from .errors import CampaignFolderError

LOCK: Final = "campaign.lock"
LOCK_PATIENCE: Final = 0.5
"""s to wait for a lock: whoever looks whether somebody is at work holds it for a moment."""
_LOCKING: Final = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""The folder may come from elsewhere: no link is followed, and no pipe waited for."""


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Keep every other run out of a folder.

    Raises:
        CampaignFolderError: another run is at work on it, or the disk refuses.
    """
    try:
        lock = os.open(root / LOCK, _LOCKING | os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise CampaignFolderError(
            root, f"{LOCK} cannot be written ({error.strerror})", "make it a writable file"
        ) from error
    if not _taken(lock, fcntl.LOCK_EX, LOCK_PATIENCE):
        os.close(lock)
        raise CampaignFolderError(
            root, "another run is at work on it", "wait for its end, or stop it"
        )
    try:
        yield
    finally:
        os.close(lock)


def busy(root: Path) -> bool:
    """Whether a run is at work on a folder at this moment."""
    try:
        lock = os.open(root / LOCK, _LOCKING | os.O_RDONLY)
    except OSError:  # nobody ever was, or it is not ours to look
        return False
    try:
        return not _taken(lock, fcntl.LOCK_SH, 0.0)
    finally:
        os.close(lock)


def _taken(lock: int, kind: int, patience: float) -> bool:
    """Whether a lock on an open file could be had within some time [s]."""
    deadline = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(lock, kind | fcntl.LOCK_NB)
            return True
        except OSError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.02)
