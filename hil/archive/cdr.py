"""CDR messages of constant size as numpy structures.

ROS 2 messages in CDR begin with four bytes of encapsulation; every primitive is then aligned to its
own size, counted from after those four bytes. Where names and array lengths never change, all
messages of a channel have the same bytes at the same places, so a message is one element of a
structured array: encoding fills its columns, decoding is a view. A JointState holds names and
sequences, but they stay the same over a recording, so it has a constant layout all the same.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.void]

ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little endian

_PRIMITIVES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
_LONGEST_COUNT = 9  # digits
_FIELD = re.compile(r"(?P<type>[\w/]+)(\[(?P<count>\d+)\])?\s+(?P<name>\w+)")


LARGEST_MESSAGE: Final = 1 << 20
"""Bytes; the longest of ours has some ten thousand. A layout takes memory in proportion."""


class LayoutError(ValueError):
    """A message whose bytes cannot be laid out once and for all."""


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """Where the fields of a message lie.

    Attributes:
        dtype: the fields that change from message to message; the structure is as long as a
            message.
        template: one message with every constant byte in place.
        constant: shape (size,) bool, the bytes that are the same in every message (padding is not
            among them: writers may leave anything there).
    """

    dtype: np.dtype[np.void]
    template: bytes
    constant: NDArray[np.bool_]

    @property
    def size(self) -> int:
        """Length of a message in bytes."""
        return len(self.template)

    def rows(self, count: int) -> Rows:
        """So many messages with the constant bytes in place, to be filled column by column."""
        return np.frombuffer(bytearray(self.template * count), dtype=self.dtype)

    def holds_in(self, messages: NDArray[np.uint8]) -> bool:
        """Whether the constant bytes of messages, shape (k, size), are those of the template."""
        expected = np.frombuffer(self.template, np.uint8)
        return all((messages[:, run] == expected[run]).all() for run in self._constant_runs)

    @cached_property
    def _constant_runs(self) -> list[slice]:
        """The constant bytes as slices."""
        edges = np.flatnonzero(np.diff(self.constant.astype(np.int8), prepend=0, append=0))
        return [slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


class LayoutBuilder:
    """Lays out a message field by field; what becomes too long is a `LayoutError`."""

    def __init__(self) -> None:
        self._template = bytearray(ENCAPSULATION)
        self._constant = [True] * len(ENCAPSULATION)
        self._names: list[str] = []
        self._formats: list[Any] = []
        self._offsets: list[int] = []

    @property
    def size(self) -> int:
        """Bytes laid out so far."""
        return len(self._template)

    def _align(self, size: int) -> None:
        padding = -(len(self._template) - len(ENCAPSULATION)) % size
        self._extend(bytes(padding), constant=False)

    def _extend(self, data: bytes, *, constant: bool) -> None:
        self._template += data
        self._constant += [constant] * len(data)

    def _check_room(self, size: int) -> None:
        if self.size + size > LARGEST_MESSAGE:
            raise LayoutError(f"its messages are longer than {LARGEST_MESSAGE} bytes")

    def variable(self, name: str, primitive: str, count: int | None = None) -> None:
        """Place a number, or an array of `count` numbers, that changes with each message."""
        item = np.dtype(_PRIMITIVES[primitive])
        self._check_room(item.itemsize * (count or 1))
        self._align(item.itemsize)
        self._names.append(name)
        self._formats.append(item if count is None else (item, (count,)))
        self._offsets.append(len(self._template))
        self._extend(bytes(item.itemsize * (1 if count is None else count)), constant=False)

    def count(self, value: int) -> None:
        """Place the constant length of a sequence."""
        self._align(4)
        self._extend(struct.pack("<I", value), constant=True)

    def string(self, value: str) -> None:
        """Place a constant string."""
        data = value.encode() + b"\0"
        self._check_room(len(data))
        self.count(len(data))
        self._extend(data, constant=True)

    def sequence(self, name: str, primitive: str, count: int) -> None:
        """Place a sequence of constant length; one of length zero has no column."""
        self.count(count)
        if count:
            self.variable(name, primitive, count)

    def header(self, frame: str = "") -> None:
        """Place a std_msgs/Header with constant frame."""
        self.variable("sec", "int32")
        self.variable("nanosec", "uint32")
        self.string(frame)

    def build(self) -> MessageLayout:
        """The layout of the fields placed so far.

        Raises:
            LayoutError: two fields have one name.
        """
        if len(set(self._names)) != len(self._names):
            raise LayoutError("two of its fields have one name")
        dtype = np.dtype(
            {
                "names": self._names,
                "formats": self._formats,
                "offsets": self._offsets,
                "itemsize": len(self._template),
            }
        )
        return MessageLayout(dtype, bytes(self._template), np.array(self._constant))


@lru_cache(maxsize=64)
def fixed_layout(definition: str) -> MessageLayout:
    """Lay out a ros2msg definition of numbers and fixed arrays, with or without a header.

    Raises:
        LayoutError: a field of other type, whose size depends on the message, or too many.
    """
    builder = LayoutBuilder()
    for line in definition.partition("=" * 80)[0].splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        match = _FIELD.fullmatch(text)
        if match is None:
            raise LayoutError(f"{text!r} is not a field of constant size")
        if match["type"] == "std_msgs/Header":
            builder.header()
        elif match["type"] in _PRIMITIVES:
            count = match["count"]
            if count is not None and len(count) > _LONGEST_COUNT:
                raise LayoutError(f"{match['name']} has too many elements")
            builder.variable(match["name"], match["type"], None if count is None else int(count))
        else:
            raise LayoutError(f"{match['type']!r} is not a type of constant size")
    return builder.build()


def joint_state_layout(
    names: Sequence[str], *, position: int, velocity: int, effort: int, frame: str = ""
) -> MessageLayout:
    """Lay out a sensor_msgs/JointState with these names and lengths of its arrays."""
    builder = LayoutBuilder()
    builder.header(frame)
    builder.count(len(names))
    for name in names:
        builder.string(name)
    builder.sequence("position", "float64", position)
    builder.sequence("velocity", "float64", velocity)
    builder.sequence("effort", "float64", effort)
    return builder.build()
