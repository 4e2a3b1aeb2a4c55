"""Reading of untrusted files: regular ones of limited size. A pipe or a device could block."""

from __future__ import annotations

import codecs
import errno
import gzip
import json
import os
import re
import stat
import tomllib
import zlib
from datetime import UTC, datetime
from difflib import get_close_matches
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any, Final

from hil.base.errors import InputError

_EARLIEST_TIME: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LATEST_TIME: Final = datetime(2200, 1, 1, tzinfo=UTC)
MAX_PORT: Final = 65535
_MAX_INTEGER_DIGITS: Final = 18  # of a number that fits into 64 bits
MAX_TEXT_BYTES: Final = 1 << 28  # bytes of the longest text that is read
_MAX_NESTING_DEPTH: Final = 32  # nesting of tables and lists
_MARKS: Final = {  # marks of UTF-32 begin like marks of UTF-16
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_DECLARATION: Final = re.compile(r"^(<\?xml[^>]*?encoding\s*=\s*[\"'])([\w.-]+)([\"'])")
_DECLARED: Final = re.compile(_DECLARATION.pattern.encode())
_PROBE_BYTES: Final = 1000  # bytes
_BLOCK_BYTES: Final = 1 << 20  # bytes
GZIP: Final = b"\x1f\x8b"
"""First bytes of what gzip compressed."""
_NO_FILE: Final = "it is a pipe or a device, not a file"
_ABSENT_ERRNOS: Final = frozenset(
    {
        *(errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENXIO),
        errno.EINVAL,  # a pipe or a device, or no path
    }
)


class CompressionError(OSError):
    """A compressed file that is cut off or damaged."""


def parse_time(when: str) -> datetime | None:
    """Return the time of an ISO 8601 text in UTC; None where it is invalid or out of range."""
    try:
        at = datetime.fromisoformat(when)
        at = (at if at.tzinfo else at.replace(tzinfo=UTC)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
    return at if _EARLIEST_TIME <= at < _LATEST_TIME else None


def parse_count(text: str | None) -> int | None:
    """Return a number of 0 or more; None where the text is none, or too long."""
    if text is None or not (text.isascii() and text.isdecimal()) or len(text) > _MAX_INTEGER_DIGITS:
        return None
    return int(text)


def parse_port(text: str) -> int | None:
    """Return the number of a UDP or TCP port, 1 to 65535; None where the text is none."""
    port = parse_count(text)
    return port if port is not None and 0 < port <= MAX_PORT else None


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading bytes, or raise OSError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except ValueError as error:  # a zero byte in its name
        raise OSError(errno.EINVAL, f"it is not a path: {error}", str(path)) from error
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


def read_text(
    path: Path,
    longest: int = MAX_TEXT_BYTES,
    *,
    encoding: str | None = None,
    or_latin: bool = False,
) -> str:
    """Return the text of a file, compressed by gzip or not, with line feeds as line ends.

    Args:
        path: of the file.
        longest: bytes of the text.
        encoding: by default that of its byte-order mark, or UTF-8; where it cannot be, that of its
            XML declaration.
        or_latin: or Windows-1252 or UTF-16 then.

    Raises:
        OSError: as `open_file`, more bytes than `longest`, or damaged by compression.
        UnicodeDecodeError: it is in none of these encodings.
        LookupError: there is no such encoding.
    """
    data = read_bytes(path, longest)
    return _decoded(data, encoding, or_latin=or_latin).replace("\r\n", "\n").replace("\r", "\n")


def read_bytes(path: Path, longest: int = MAX_TEXT_BYTES) -> bytes:
    """Return the bytes of a file, without their compression by gzip.

    OSError: as `open_file`, more than `longest`, or compressed bytes that are cut off or damaged.
    """
    too_large = OSError(errno.EFBIG, f"it has more than {longest} bytes", str(path))
    with open_file(path) as stream:
        if os.fstat(stream.fileno()).st_size > longest:
            raise too_large
        if not stream.peek(len(GZIP)).startswith(GZIP):
            return stream.read()
        data = bytearray()
        try:
            with gzip.GzipFile(fileobj=stream) as unpacked:
                while block := unpacked.read(_BLOCK_BYTES):
                    data += block
                    if len(data) > longest:
                        raise too_large
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            problem = f"its compressed bytes are cut off or damaged: {error}"
            raise CompressionError(errno.EIO, problem, str(path)) from error
    return bytes(data)


def _decoded(data: bytes, encoding: str | None, *, or_latin: bool) -> str:
    """Return the text of bytes without its byte-order mark; see `read_text`."""
    if encoding is not None:
        return data.decode(encoding).removeprefix("\ufeff")
    for mark, name in _MARKS.items():
        if data.startswith(mark):
            return _declared_utf_8(data.decode(name))
    if or_latin and b"\0" in data[:_PROBE_BYTES]:  # UTF-16 without its mark
        return data.decode("utf-16-le" if data[1:2] == b"\0" else "utf-16-be")
    declaration = _DECLARED.match(data)
    try:
        return data.decode("utf-8")  # whatever it declares
    except UnicodeDecodeError as error:
        if declaration:
            try:
                return _declared_utf_8(data.decode(declaration[2].decode()))
            except LookupError:
                raise error from None
        if not or_latin:
            raise
    return data.decode("cp1252")


def encoding_by_start(start: bytes) -> str:
    """Return the encoding of a long text by its first bytes, as `read_text` finds it `or_latin`."""
    for mark, name in _MARKS.items():
        if start.startswith(mark):
            return name
    if b"\0" in start[:_PROBE_BYTES]:
        return "utf-16-le" if start[1:2] == b"\0" else "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _declared_utf_8(text: str) -> str:
    """Return an XML text whose declaration names the encoding in which it is stored from now on."""
    return _DECLARATION.sub(r"\1UTF-8\3", text, count=1)


def is_not_a_file(error: OSError) -> bool:
    """Return whether there is no regular file, and not a failure of reading."""
    return error.errno in _ABSENT_ERRNOS


def path_exists(path: Path) -> bool:
    """Return whether anything has this path, also a broken link."""
    return path.is_symlink() or path.exists()


_MAX_SIBLINGS = 10_000
_MISTYPED = 0.75
"""Similarity of a folder's name that may be a slip: one wrong letter of four."""


def similar_path(path: Path) -> Path | None:
    """Return the existing path with the most similar name in the same folder, or None.

    Where the folder itself is missing, that is the path in the folder most like it.
    """
    if path_exists(path) or path.name in ("", ".."):
        return None
    folder = path.parent
    if not folder.is_dir():
        similar = similar_path(folder)
        if similar is None or not similar.is_dir():
            return None
        if path_exists(similar / path.name):
            return similar / path.name
        return similar if get_close_matches(folder.name, [similar.name], 1, _MISTYPED) else None
    try:
        names = [entry.name for entry in islice(folder.iterdir(), _MAX_SIBLINGS)]
    except OSError:
        return None
    matches = get_close_matches(path.name, names)
    # Of log.txt, log.csv rather than the folder log.
    matches.sort(key=lambda name: bool(Path(name).suffix) is not bool(path.suffix))
    # Names with a common suffix alone are not alike.
    for name in matches:
        if get_close_matches(path.stem, [Path(name).stem]):
            return folder / name
    return None


def remedy_for_missing(path: Path, otherwise: str) -> str:
    """Return the remedy for a path that is not there: a similar one, or `otherwise`."""
    similar = similar_path(path)
    if similar is not None:
        return f"there is {similar}"
    if not path_exists(path) and not path_exists(path.parent):
        return f"there is no folder {path.parent}; {otherwise}"
    return otherwise


def read_input(path: Path, otherwise: str = "choose another file") -> str:
    """Return the text of a file named by the user, or raise InputError."""
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = str(error) if isinstance(error, UnicodeDecodeError) else error.strerror
        if isinstance(error, UnicodeDecodeError):
            otherwise = "save it as UTF-8"
        elif reason == _NO_FILE:
            otherwise = "write it to a file first, and give that"
        elif isinstance(error, FileNotFoundError):
            otherwise = remedy_for_missing(path, otherwise)
        raise InputError(path, f"cannot be read ({reason})", remedy=otherwise) from error


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; ValueError if it is invalid, or nested too deep."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text; ValueError if it is invalid, or nested too deep."""
    try:
        document = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    level: list[Any] = [document]
    for _ in range(_MAX_NESTING_DEPTH):  # the parser does not limit dotted keys
        level = [
            inner
            for table in level
            for inner in (table.values() if isinstance(table, dict) else table)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return document
    raise ValueError("it is nested too deeply")
