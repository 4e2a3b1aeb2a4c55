"""What a controller says in words on its primary interface: errors of programs, and stops.

Layout: Universal Robots, "Remote Control Via TCP/IP", robot messages of the primary interface: a
package of type 20 has a time stamp, a source and a type of message; texts end with the package.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

PACKAGE: Final = struct.Struct(">IB")
_MESSAGE_PACKAGE: Final = 20
_CONTENT: Final = struct.Struct(">QbB")
MAX_PACKAGE_BYTES: Final = 1 << 20
"""Bytes of a package; longer ones are not of this interface."""
_KEY_MESSAGE: Final = 7
_ERROR_MESSAGE: Final = 6
_EXCEPTION_MESSAGE: Final = 10
_MIN_REPORTED_LEVEL: Final = 2
"""Levels of an error code from which it is reported: 0 and 1 are information."""


class MessageReader:
    """Texts of a stream that arrives in pieces of any size; states of the robot are skipped."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[str]:
        """Return the texts that these bytes complete."""
        self._rest += data
        return [text for kind, content in self._packages() if kind == _MESSAGE_PACKAGE
                if (text := message_text(content))]  # fmt: skip

    def _packages(self) -> Iterator[tuple[int, bytes]]:
        while len(self._rest) >= PACKAGE.size:
            length, kind = PACKAGE.unpack_from(self._rest)
            if not PACKAGE.size <= length <= MAX_PACKAGE_BYTES:
                self._rest.clear()  # no primary interface: what follows means nothing
                return
            if len(self._rest) < length:
                return
            content = bytes(self._rest[PACKAGE.size : length])
            del self._rest[:length]
            yield kind, content


def message_text(content: bytes) -> str:
    """Return the text of a message (without the header of its package), "" for none of interest."""
    if len(content) < _CONTENT.size:
        return ""
    _, _, kind = _CONTENT.unpack_from(content)
    body = content[_CONTENT.size :]
    if kind == _EXCEPTION_MESSAGE and len(body) > 8:
        line, column = struct.unpack_from(">ii", body)
        return f"line {line}, column {column} of the program: {_decoded(body[8:])}"
    if kind == _ERROR_MESSAGE and len(body) >= 20:
        code, argument, level = struct.unpack_from(">iii", body)
        if level < _MIN_REPORTED_LEVEL:
            return ""
        text = _decoded(body[20:])
        return f"C{code}A{argument}{': ' if text else ''}{text}"
    if kind == _KEY_MESSAGE and len(body) > 9:
        code, argument, title = struct.unpack_from(">iiB", body)
        text = _decoded(body[9 + title :])
        return f"{_decoded(body[9 : 9 + title])}: {text}" if text else ""
    return ""


def _decoded(text: bytes) -> str:
    return text.decode("utf-8", "replace").strip("\0\n ")
