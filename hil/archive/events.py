"""Events of an archive: what happened, when, in words and in data."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from hil.archive.cdr import LogMessage
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

    def to_log(self) -> LogMessage:
        """The event as a log message: the line of text and, if there are data, one of JSON."""
        lines = [" ".join(self.text.split())]
        if self.data:
            lines.append(json.dumps(_document(self.data), sort_keys=True, allow_nan=False))
        return LogMessage(_nanoseconds(self.time), int(self.level), self.name, "\n".join(lines))

    @classmethod
    def from_log(cls, message: LogMessage) -> ArchivedEvent:
        """Read an event from a log message; a second line that is no JSON object stays text."""
        text, _, second = message.text.partition("\n")
        data: Any = None
        if second:
            with suppress(ValueError):
                data = json_of(second)
        if not isinstance(data, dict):
            text, data = message.text, {}
        level = max((known for known in Level if known <= message.level), default=Level.DEBUG)
        return cls(message.stamp * 1e-9, message.name, text, level, data)


def _nanoseconds(time: float) -> int:
    return max(0, round(time * 1e9)) if math.isfinite(time) else 0


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
