"""CDR messages of constant size as numpy structures.

A ROS 2 message in CDR begins with four bytes of encapsulation; every primitive is aligned to its
own size, counted from after those four bytes. Where names and array lengths are constant, all
messages of a channel have the same layout: encoding fills a structured array, decoding is a view.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.void]

ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR without parameter list, little endian
MAX_MESSAGE_BYTES: Final = 1 << 20
"""Bytes; own messages have at most some 10 000. A layout takes memory in proportion."""

_PRIMITIVES = {
    **dict.fromkeys(("bool", "byte", "char"), np.dtype("u1")),
    **{f"int{8 * size}": np.dtype(f"<i{size}") for size in (1, 2, 4, 8)},
    **{f"uint{8 * size}": np.dtype(f"<u{size}") for size in (1, 2, 4, 8)},
    **{f"float{8 * size}": np.dtype(f"<f{size}") for size in (4, 8)},
}
_FIELD = re.compile(r"(?P<type>[\w/]+)(<=\d+)?(\[(?P<count>[^\]]*)\])?\s+(?P<name>\w+)$")
_CONSTANT = re.compile(r"^\s*\w+(\[[^\]]*\])?\s+\w+\s*=")
_SEPARATOR = re.compile(r"^=+\n", re.MULTILINE)
_MAX_ELEMENTS = 4096  # elements; what is larger is an image or a cloud of points
_MAX_COUNT_DIGITS = 9  # digits
_HEADERS = ("std_msgs/Header", "std_msgs/msg/Header", "Header")


class LayoutError(ValueError):
    """A message without constant layout."""


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """Byte layout of a message.

    Attributes:
        dtype: the fields that change from message to message, of the length of a message.
        template: a message with every constant byte in place.
        constant: the bytes that are the same in every message, without padding.
    """

    dtype: np.dtype[np.void]
    template: bytes
    constant: tuple[slice, ...]

    @property
    def size(self) -> int:
        """Length of a message in bytes."""
        return len(self.template)

    def rows(self, count: int) -> Rows:
        """Return messages with the constant bytes in place, to be filled column by column."""
        return np.frombuffer(bytearray(self.template * count), dtype=self.dtype)

    def matches(self, messages: NDArray[np.uint8]) -> bool:
        """Return whether messages (k, size) have the size and constant bytes of the template."""
        expected = np.frombuffer(self.template, np.uint8)
        return messages.shape[1] == self.size and all(
            (messages[:, part] == expected[part]).all() for part in self.constant
        )


class LayoutBuilder:
    """Builds a layout field by field; a message that is too long raises `LayoutError`."""

    def __init__(self) -> None:
        self._template = bytearray(ENCAPSULATION)
        self._constant = [slice(0, len(ENCAPSULATION))]
        self._fields: list[tuple[str, Any, int]] = []

    def next_place(self, size: int) -> int:
        """Return where a number of `size` bytes would begin."""
        return len(self._template) + -(len(self._template) - len(ENCAPSULATION)) % size

    def variable(self, name: str, primitive: str, count: int | None = None) -> None:
        """Add a number, or an array of `count` numbers, that changes with each message."""
        item = _PRIMITIVES[primitive]
        size = item.itemsize * (1 if count is None else count)
        offset = self._extend(item.itemsize, size)
        self._fields.append((name, item if count is None else (item, (count,)), offset))

    def count(self, value: int) -> None:
        """Add the constant length of a sequence."""
        self._fix(4, value.to_bytes(4, "little"))

    def string(self, value: str) -> None:
        """Add a constant string."""
        data = value.encode() + b"\0"
        self.count(len(data))
        self._fix(1, data)

    def sequence(self, name: str, primitive: str, count: int) -> None:
        """Add a sequence of constant length; one of length zero has no column."""
        self.count(count)
        if count:
            self.variable(name, primitive, count)

    def build(self) -> MessageLayout:
        """Return the layout of the fields added so far; `LayoutError` if two have one name."""
        names, formats, offsets = ([field[k] for field in self._fields] for k in range(3))
        if len(set(names)) != len(names):
            raise LayoutError("two of its fields have the same name")
        size = len(self._template)
        fields: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
        return MessageLayout(np.dtype(fields), bytes(self._template), tuple(self._constant))

    def _extend(self, alignment: int, size: int) -> int:
        offset = self.next_place(alignment)
        if offset + size > MAX_MESSAGE_BYTES:
            raise LayoutError(f"its messages are longer than {MAX_MESSAGE_BYTES} bytes")
        self._template += bytes(offset + size - len(self._template))
        return offset

    def _fix(self, alignment: int, data: bytes) -> None:
        part = slice(self._extend(alignment, len(data)), len(self._template))
        self._template[part] = data
        last = self._constant[-1]
        if last.stop == part.start:
            self._constant[-1] = slice(last.start, part.stop)
        else:
            self._constant.append(part)


@lru_cache(maxsize=64)
def joint_state_layout(
    names: tuple[str, ...], *, position: int, velocity: int, effort: int
) -> MessageLayout:
    """Return the layout of sensor_msgs/JointState.

    Args:
        names: of the joints.
        position: length of its array.
        velocity: likewise.
        effort: likewise.
    """
    builder = LayoutBuilder()
    builder.variable("sec", "int32")
    builder.variable("nanosec", "uint32")
    builder.string("")
    builder.count(len(names))
    for name in names:
        builder.string(name)
    for quantity, count in (("position", position), ("velocity", velocity), ("effort", effort)):
        builder.sequence(quantity, "float64", count)
    return builder.build()


@lru_cache(maxsize=64)
def fixed_layout(definition: str) -> MessageLayout:
    """Return the layout of messages of numbers and fixed arrays, with or without a header.

    `definition` is ros2msg text; of a header only the stamp is read, as fields ``sec`` and
    ``nanosec``, and its text is empty. `LayoutError` where the size of a field depends on the
    message, or its type is no number.
    """
    builder = LayoutBuilder()
    fields_text = _SEPARATOR.split(definition)[0]
    for line in (line.partition("#")[0].strip() for line in fields_text.splitlines()):
        if not line or _CONSTANT.match(line):
            continue
        match = _FIELD.match(" ".join(line.split()[:2]))  # a default value may follow the name
        if match is None:
            raise LayoutError(f"its definition has the line {line!r}")
        kind = match["type"]
        count = match["count"]
        if kind in _HEADERS and count is None:
            builder.variable("sec", "int32")
            builder.variable("nanosec", "uint32")
            builder.string("")
        elif kind not in _PRIMITIVES:
            raise LayoutError(f"{match['name']} is of type {kind}, not a number")
        elif count is None:
            builder.variable(match["name"], kind)
        elif not count.isdecimal() or len(count) > _MAX_COUNT_DIGITS or int(count) > _MAX_ELEMENTS:
            raise LayoutError(f"{match['name']} is not of constant size, or too large")
        elif int(count):
            builder.variable(match["name"], kind, int(count))
    return builder.build()
