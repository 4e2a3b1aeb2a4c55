"""Untrusted files in a folder: read only if they are files, and of a size.

A pipe without a writer is waited for without end, and a device has none. What is refused is an
`OSError` whose `strerror` says why, so that whoever reads has one kind of trouble to name.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import tomllib
from datetime import UTC, datetime
from io import BufferedReader
from pathlib import Path
from typing import Any, Final

from hil.errors import InputError

_FIRST: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LAST: Final = datetime(2200, 1, 1, tzinfo=UTC)
"""Of the years that calendars, time zones and figures agree on."""


def parse_time(when: str) -> datetime | None:
    """The moment of an ISO 8601 text, in UTC; None where it is none, or no robot's."""
    try:
        at = datetime.fromisoformat(when)
        at = (at if at.tzinfo else at.replace(tzinfo=UTC)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
    return at if _FIRST <= at < _LAST else None


LARGEST_PORT: Final = 65535
_MOST_DIGITS: Final = 18
"""So that 64 bits hold it, and Python reads it at all."""


def parse_count(text: str | None) -> int | None:
    """A number of 0 or more; None where the text is none, or longer than anything is counted."""
    if text is None or not (text.isascii() and text.isdecimal()) or len(text) > _MOST_DIGITS:
        return None
    return int(text)


def parse_port(text: str) -> int | None:
    """The number of a UDP or TCP port, 1 to 65535; None where the text is none."""
    port = parse_count(text)
    return port if port is not None and 0 < port <= LARGEST_PORT else None


LONGEST_TEXT: Final = 1 << 28
"""Bytes of the longest text that is read as a whole; the largest of ours has a hundredth of it."""
_DEEPEST: Final = 32
"""Tables and lists in one another; ours have four."""
_NO_FILE: Final = "it is a pipe or a device, no file"
_ABSENT: Final = frozenset(
    {
        *(errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENXIO),
        errno.EINVAL,  # a pipe or a device, or no path
    }
)


def open_file(path: Path) -> BufferedReader:
    """A file of bytes, to be read.

    Raises:
        OSError: there is none, or it is a folder, a pipe or a device.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except ValueError as error:  # a zero byte in its name
        raise OSError(errno.EINVAL, f"it is no path: {error}", str(path)) from error
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, _NO_FILE, str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_text(path: Path, longest: int = LONGEST_TEXT) -> str:
    """A text file as a whole, any line ends as one.

    Raises:
        OSError: as `open_file`; or it has more bytes than `longest`.
        UnicodeDecodeError: it is no UTF-8.
    """
    with open_file(path) as stream:
        if os.fstat(stream.fileno()).st_size > longest:
            raise OSError(errno.EFBIG, f"it has more than {longest} bytes", str(path))
        text = stream.read().decode("utf-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_not_a_file(trouble: OSError) -> bool:
    """Return whether the error says that there is no regular file, not that reading failed."""
    return trouble.errno in _ABSENT


def path_exists(path: Path) -> bool:
    """Whether anything lies there: a link that leads nowhere does, and is no absent file."""
    return path.is_symlink() or path.exists()


def _remedy(trouble: OSError | UnicodeDecodeError, otherwise: str) -> str:
    """What a person can do who named what `read_text` refuses."""
    if isinstance(trouble, UnicodeDecodeError):
        return "save it as UTF-8"
    return "write it to a file first, and name that" if trouble.strerror == _NO_FILE else otherwise


def read_input(path: Path, otherwise: str = "name another file") -> str:
    """The text of a file that a person named.

    Raises:
        InputError: it cannot be read; the remedy is `otherwise` unless the reason suggests one.
    """
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            path, f"cannot be read ({why})", remedy=_remedy(error, otherwise)
        ) from error


def parse_json(text: str | bytes) -> Any:
    """What a JSON text holds.

    Raises:
        ValueError: it is no JSON, or nested deeper than anybody reads.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def parse_toml(text: str) -> dict[str, Any]:
    """What a TOML text holds.

    Raises:
        ValueError: it is no TOML, or nested deeper than anybody reads.
    """
    try:
        found = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    level: list[Any] = [found]
    for _ in range(_DEEPEST):  # dotted keys nest without end, and the parser does not mind
        level = [
            inner
            for table in level
            for inner in (table.values() if isinstance(table, dict) else table)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return found
    raise ValueError("it is nested too deep")
