"""Folders and files that a command leaves behind."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from hil.errors import InputError


def make_folder(path: Path) -> None:
    """Make a folder and its parents, if it is not there.

    Raises:
        InputError: it cannot be made, or not be written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            path, f"cannot be made a folder ({error.strerror})", remedy="name another one"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(path, "cannot be written to", remedy="name another folder")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content`: a crash leaves the old or the new file, never half of one."""
    temporary = path.with_suffix(path.suffix + ".tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(path: Path) -> None:
    """Have the names in a folder outlive a loss of power, where its file system can do that."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
