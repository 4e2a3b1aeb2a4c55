"""Events of an archive: what happened, when, in words and in data.

Each is a message rcl_interfaces/Log; these differ in length and are encoded one by one.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final, Self

import numpy as np

from hil.archive.cdr import ENCAPSULATION, LayoutError
from hil.reading import json_of


class Level(IntEnum):
    """Severity, with the numbers of rcl_interfaces/Log."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


@dataclass(frozen=True)
class ArchivedEvent:
    """Something that happened during the recorded interval.

    Attributes:
        time: seconds since the controller's initialisation.
        name: kind of event, such as ``MotionEnded``.
        text: one line for a person.
        level: severity.
        data: the same for a program: numbers, strings, lists and mappings.
    """

    time: float
    name: str
    text: str
    level: Level = Level.INFO
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stamp(self) -> int:
        """The time in nanoseconds, zero where it is none."""
        return max(0, round(self.time * 1e9)) if math.isfinite(self.time) else 0

    def encode(self, stamp: int | None = None) -> bytes:
        """The CDR bytes: the line of text and, if there are data, one of JSON.

        Args:
            stamp: another one than its own [ns].
        """
        lines = [" ".join(self.text.split())]
        if self.data:
            lines.append(json.dumps(_document(self.data), sort_keys=True, allow_nan=False))
        times = divmod(self.stamp if stamp is None else stamp, 10**9)
        message = bytearray(ENCAPSULATION + struct.pack("<iIB", *times, self.level))
        for text in (self.name, "\n".join(lines), "", ""):  # file and function stay empty
            message += bytes(-len(message) % 4)
            encoded = text.encode() + b"\0"
            message += struct.pack("<I", len(encoded)) + encoded
        return bytes(message + bytes(-len(message) % 4) + struct.pack("<I", 0))

    @classmethod
    def decode(cls, message: bytes) -> Self:
        """Read the CDR bytes; a second line that is no JSON object stays text.

        Raises:
            LayoutError: they are no log message.
        """
        if message[: len(ENCAPSULATION)] != ENCAPSULATION:
            raise LayoutError("the message is not little-endian CDR")
        try:
            seconds, nanoseconds, level = struct.unpack_from("<iIB", message, len(ENCAPSULATION))
            name, end = _string(message, _NAME_AT)
            whole, _ = _string(message, end)
        except struct.error as error:
            raise LayoutError("the message ends before its last field") from error
        except UnicodeDecodeError as error:
            raise LayoutError("a string is not UTF-8") from error
        text, _, second = whole.partition("\n")
        data: Any = None
        if second:
            with suppress(ValueError):
                data = json_of(second)
        if not isinstance(data, dict):
            text, data = whole, {}
        known = max((one for one in Level if one <= level), default=Level.DEBUG)
        return cls((seconds * 10**9 + nanoseconds) * 1e-9, name, text, known, data)


_NAME_AT: Final = 16  # bytes from the beginning of a message


def _string(message: bytes, at: int) -> tuple[str, int]:
    """The string at a place, and where the next one begins."""
    (length,) = struct.unpack_from("<I", message, at)
    end = at + 4 + length
    if not length or end > len(message):
        raise LayoutError(f"a string of {length} bytes does not fit into the message")
    return message[at + 4 : end - 1].decode(), end + -end % 4


def _document(value: Any) -> Any:
    """Reduce to what JSON knows. A number that is not finite becomes null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _document(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_document(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return str(value)
