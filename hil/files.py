"""Folders and files that a command leaves behind."""

from __future__ import annotations

import os
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


def write_atomically(path: Path, text: str) -> None:
    """Replace `path` by `text`: a crash leaves the old or the new file, never half of one."""
    temporary = path.with_suffix(path.suffix + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
