"""Events of an archive: messages rcl_interfaces/Log, encoded one by one."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Self

import numpy as np

from hil.archive.cdr import ENCAPSULATION, LayoutError
from hil.reading import parse_json

_HEAD = struct.Struct("<iIB")  # seconds, nanoseconds, level


class Level(IntEnum):
    """Severity, with the numbers of rcl_interfaces/Log."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


@dataclass(frozen=True)
class ArchivedEvent:
    """An event of the recorded interval.

    `time` [s] since the controller's initialisation, kind of event such as ``MotionEnded``, one
    line of text, and machine-readable data: numbers, strings, lists and mappings.
    """

    time: float
    name: str
    text: str
    level: Level = Level.INFO
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stamp(self) -> int:
        """The time in ns, zero if it is not finite or negative."""
        return max(0, round(self.time * 1e9)) if math.isfinite(self.time) else 0

    def encode(self, stamp: int | None = None) -> bytes:
        """Return the CDR bytes: the line of text and, if there are data, one of JSON.

        `stamp` [ns] replaces `self.stamp`.
        """
        lines = [" ".join(self.text.split())]
        if self.data:
            lines.append(json.dumps(_document(self.data), sort_keys=True, allow_nan=False))
        times = divmod(self.stamp if stamp is None else stamp, 10**9)
        message = bytearray(ENCAPSULATION + _HEAD.pack(*times, self.level))
        for text in (self.name, "\n".join(lines), "", ""):  # file and function stay empty
            encoded = text.encode() + b"\0"
            message += bytes(-len(message) % 4) + struct.pack("<I", len(encoded)) + encoded
        return bytes(message + bytes(-len(message) % 4 + 4))  # the line number stays 0

    @classmethod
    def decode(cls, message: bytes) -> Self:
        """Decode a log message, else `LayoutError`; a second line that is no JSON is text."""
        if message[: len(ENCAPSULATION)] != ENCAPSULATION:
            raise LayoutError("the message is not little-endian CDR")
        try:
            seconds, nanoseconds, level = _HEAD.unpack_from(message, len(ENCAPSULATION))
            end, texts = len(ENCAPSULATION) + _HEAD.size, []
            for _ in ("name", "text"):
                start = end + -end % 4 + 4
                end = start + int(struct.unpack_from("<I", message, start - 4)[0])
                if end == start or end > len(message):
                    raise LayoutError("a string does not fit into the message")
                texts.append(message[start : end - 1].decode())
        except struct.error as error:
            raise LayoutError("the message ends before its last field") from error
        except UnicodeDecodeError as error:
            raise LayoutError("a string is not UTF-8") from error
        name, whole = texts
        text, _, second = whole.partition("\n")
        data: Any = None
        with suppress(ValueError):
            data = parse_json(second)
        if not isinstance(data, dict):
            text, data = whole, {}
        known = max((one for one in Level if one <= level), default=Level.DEBUG)
        return cls((seconds * 10**9 + nanoseconds) * 1e-9, name, text, known, data)


def _document(value: Any) -> Any:
    """Convert to JSON types; numbers that are not finite become null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _document(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_document(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int) else str(value)
