"""Places of archives: paths on this PC, and URLs of any protocol that fsspec opens."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

from hil.archive.header import SUFFIX
from hil.base.errors import ArchiveError, InputError
from hil.base.files import json_digest

_VALIDATORS: Final = ("ETag", "Content-MD5", "Digest", "Last-Modified", "created", "mtime", "etag")
"""Entries of a file's description that change with its content."""


class Stamp(NamedTuple):
    """What shows whether a file has changed."""

    text: str  #: "" if the server states nothing that changes with the content
    changed: int = 0  #: time of the last change [ns], 0 where the text shows every change


def is_url(place: str) -> bool:
    """Return whether a place is a URL, not a path."""
    return "://" in place


def name_of(location: str) -> str:
    """Return the file name of a path or URL."""
    path = urlsplit(location).path if is_url(location) else location
    return path.rsplit("/", 1)[-1]


def folder_of(location: str) -> str:
    """Return the folder of a path or URL."""
    return location.rsplit("/", 1)[0]


def stamp_of(location: str) -> Stamp:
    """Return the stamp of a file, or raise an `ArchiveError`."""
    if is_url(location):
        filesystem, path = _filesystem(location)
        with _access(location):
            description = filesystem.info(path)
        shown = [str(description[name]) for name in _VALIDATORS if description.get(name)]
        text = json_digest([description.get("size"), *shown]) if shown else ""
        return Stamp(text)
    try:
        status = Path(location).stat()
    except OSError as error:
        raise ArchiveError(location, f"cannot be read: {error.strerror}") from error
    times = status.st_mtime_ns, status.st_ctime_ns
    return Stamp(f"{status.st_size} {times[0]} {times[1]} {status.st_ino}", max(times))


@contextmanager
def as_file(location: str) -> Iterator[Path]:
    """Provide an archive as a file of this PC: a path itself, or a temporary copy of a URL.

    Errors about the copy name the URL.

    Raises:
        ArchiveError: the URL cannot be read.
    """
    if not is_url(location):
        yield Path(location)
        return
    filesystem, path = _filesystem(location)
    with TemporaryDirectory(prefix="hil-") as folder:
        copy = Path(folder, name_of(location))
        with _access(location):
            filesystem.get_file(path, os.fspath(copy))
        try:
            yield copy
        except InputError as error:
            remedy = error.remedy.replace(str(copy), location)
            raise ArchiveError(location, error.problem, field=error.field, remedy=remedy) from error


def archives_at(url: str) -> list[str]:
    """Return the URLs of the archives at or below a URL.

    Raises:
        InputError: it does not exist, cannot be reached, or its protocol cannot be used.
    """
    filesystem, path = _filesystem(url)
    if name_of(url).endswith(SUFFIX):
        stamp_of(url)
        return [url]
    with _access(url):
        paths = filesystem.find(path)
        if not paths:
            filesystem.info(path)  # raises an error if there is no folder either
    root = str(filesystem.unstrip_protocol(path)).rstrip("/") + "/"
    places = [str(filesystem.unstrip_protocol(inside)) for inside in paths]
    return [
        place
        for place in places
        if name_of(place).endswith(SUFFIX) and place.startswith(root) and _stays_below(place)
    ]


def _stays_below(place: str) -> bool:
    """Return whether a URL of a listing leads nowhere else: `::` would chain another protocol."""
    return "::" not in place and ".." not in place.split("/")


def text_at(url: str) -> str | None:
    """Return the text of a small file at a URL, or None.

    Raises:
        ArchiveError: it cannot be read.
    """
    filesystem, path = _filesystem(url)
    with _access(url):
        if not filesystem.exists(path):
            return None
        return bytes(filesystem.cat_file(path)).decode("utf-8", "replace")


def _filesystem(url: str) -> tuple[Any, str]:
    """Return fsspec's file system of a URL, and the path in it."""
    from fsspec.core import url_to_fs  # slow to import, and needed for URLs only

    try:
        filesystem, path = url_to_fs(url)
    except ImportError as error:
        raise InputError(url, f"cannot be opened ({error})", remedy="install that") from error
    except ValueError as error:
        remedy = "give a folder, or a URL that fsspec opens, such as https:// or s3://"
        raise InputError(url, f"cannot be opened ({error})", remedy=remedy) from error
    return filesystem, path


@contextmanager
def _access(url: str) -> Iterator[None]:
    """Convert the errors of a server, of whatever class, to `ArchiveError`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        cause = error.__cause__ or error
        status = getattr(cause, "status", None)
        if status is not None:
            problem = f"the server answers {status} ({getattr(cause, 'message', '')})"
        elif isinstance(cause, FileNotFoundError):
            problem = "does not exist"
        else:
            problem = f"cannot be read: {cause or type(cause).__name__}"
        remedy = "check the URL, and whether this PC may read it"
        raise ArchiveError(url, problem, remedy=remedy) from error
