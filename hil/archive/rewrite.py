"""Writes a whole archive anew beside its place, and puts it there once it has been read back."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, BinaryIO

from hil.archive.file_writer import sync_folder
from hil.archive.reader import open_archive
from hil.errors import ArchiveError, ArchiveWriteError

_NAMED = 40  # characters that the temporary file takes over of the name


def write_anew(source: Path, target: Path, fill: Callable[[BinaryIO, IO[bytes]], None]) -> None:
    """Make an archive of another one; `target` is at any moment what it was, or whole.

    File and folder are on the disk when this returns, and the file has the mode of its source.

    Args:
        source: the archive to make it of.
        target: the file to write or to replace, which may be the source.
        fill: writes the content, given the source and the new file.

    Raises:
        ArchiveWriteError: the disk refuses.
        ArchiveError: what was written cannot be read back; it is thrown away.
    """
    try:
        with source.open("rb") as stream, _beside(target) as output:
            os.fchmod(output.fileno(), stat.S_IMODE(os.fstat(stream.fileno()).st_mode))
            fill(stream, output)
            output.flush()
            os.fsync(output.fileno())
            back = open_archive(output.name, fields=())
            if not back.complete:
                raise ArchiveError(
                    source,
                    f"cannot be written anew: {back.damage}",
                    remedy="it is as it was, and what opens of it can be read: restore it from a "
                    "copy, or record again",
                )
            Path(output.name).replace(target)
        sync_folder(target.parent)
    except OSError as error:
        raise ArchiveWriteError(
            target,
            f"cannot be written: {error.strerror}",
            remedy="what was there is as it was: make room or make its folder writable, "
            "and do it again",
        ) from error


@contextlib.contextmanager
def _beside(target: Path) -> Iterator[IO[bytes]]:
    """A new file in the folder of another, of a name that nobody else has or can foresee."""
    with NamedTemporaryFile(
        dir=target.parent, prefix=f".{target.name[:_NAMED]}.", suffix=".part", delete=False
    ) as output:
        try:
            yield output
        finally:
            with contextlib.suppress(FileNotFoundError):
                Path(output.name).unlink()
