"""What ends a run is an error of the project that names what happened, where, and the remedy."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from hil.base.errors import HilError

ALLOWED: Final = frozenset(
    (
        "ControllerError",  # the drive is off, or the init packet does not match the cell
        "MotionFailedError",  # the guard, the link or a stop ended a motion
        "MotionRefusedError",  # the path from the present position is not free: jog the arm
        "RepetitionsRejectedError",  # contact, slip, or a changed arm
        "DryRunError",  # the dry run is not accepted
        "AgainstGravityError",  # a torque is not accepted
        "OperatorStopError",  # stopped by the operator
        "ArchiveWriteError",  # the disk is full or broken
        "CampaignFolderError",  # the folder cannot be written
        "OutputError",  # results cannot be written
    )
)
"""Errors of `docs/campaign.md`, which may end a run."""
OF_DISKS: Final = ("Input/output", "quota exceeded", "No space left", "Read-only file system")
"""Causes that a system states, one of which is in an error of a disk."""
REMEDIES: Final = ("make room", "another folder", "record again", "writable")


def allowed(error: BaseException) -> Iterator[str]:
    """An error that ends a run is one of the documented ones."""
    name = type(error).__name__
    if not isinstance(error, HilError) or name not in ALLOWED:
        yield f"ended with {name}: {error}"


def names_one(what: str, text: str, names: Collection[str]) -> Iterator[str]:
    """A sentence names one of these: a process, a cause, a remedy."""
    if not any(name in text for name in names):
        yield f"{what}, and it was reported: {text}"


def of_disk(error: HilError, folder: Path) -> Iterator[str]:
    """An error of a disk has a documented exit code, and names the folder, cause and remedy."""
    text = str(error)
    if error.exit_code not in (1, 2, 4):
        yield f"the exit code of a disk that fails is {error.exit_code}"
    yield from names_one(f"{folder.name} could not be written", text, (folder.name,))
    yield from names_one("a disk failed with a cause", text, OF_DISKS)
    yield from names_one("a disk failed, which has remedies", text, REMEDIES)
