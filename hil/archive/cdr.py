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
from collections.abc import Iterator, Mapping, Sequence
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
_FIELD = re.compile(r"(?P<type>[\w/]+)(?P<bound><=\d+)?(\[(?P<count>[^\]]*)\])?\s+(?P<name>\w+)$")
_CONSTANT = re.compile(r"^\s*\w+(\[[^\]]*\])?\s+\w+\s*=")
_SEPARATOR = re.compile(r"^=+\n", re.MULTILINE)
_LARGEST = 4096  # elements; what is larger is an image or a cloud of points
_MOST_PLACES = 10_000  # in one message where a type is laid out
_DEEPEST = 32  # types within types
_LONGEST_COUNT = 9  # digits


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

    def header(self) -> None:
        """Place a std_msgs/Header without frame."""
        self.variable("sec", "int32")
        self.variable("nanosec", "uint32")
        self.string("")

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
    """Lay out messages of numbers and fixed arrays, with or without a header, by their definition.

    The stamp of the header has the fields ``sec`` and ``nanosec``.

    Raises:
        LayoutError: the size of a field depends on the message, or one is of no known type.
    """
    walk = _Walk(_types("", definition), None)
    walk.fields("", "")
    layout = walk.builder.build()
    names = layout.dtype.names or ()
    layout.dtype.names = tuple(name.removeprefix("header/stamp/") for name in names)
    return layout


@dataclass(frozen=True)
class _Field:
    """One line of a definition: `count` None for a single value, -1 for a sequence."""

    kind: str
    name: str
    count: int | None


def layout_of(kind: str, definition: str, message: bytes) -> MessageLayout:
    """The layout of messages like this one, fields named by their paths.

    Args:
        kind: name of the type.
        definition: its ros2msg text with all dependencies.
        message: in plain little-endian CDR.

    Raises:
        LayoutError: the definition cannot be understood, or the message does not keep it.
    """
    if message[:4] != ENCAPSULATION:
        raise LayoutError("its messages are not little-endian CDR")
    walk = _Walk(_types(kind, definition), message)
    walk.fields(_short(kind), "")
    return walk.builder.build()


class _Walk:
    """Goes through one message along its definition, and lays out what it meets.

    Without a message, strings are empty, and there must be no sequence.
    """

    def __init__(self, types: Mapping[str, tuple[_Field, ...]], message: bytes | None) -> None:
        self.builder = LayoutBuilder()
        self._types = types
        self._message = message
        self._places = 0

    def fields(self, kind: str, path: str, depth: int = 0) -> None:
        """Lay out the fields of a type; types may hold themselves, or nothing."""
        if kind not in self._types:
            raise LayoutError(f"its definition lacks {kind}")
        self._places += 1
        if depth > _DEEPEST or self._places > _MOST_PLACES:
            raise LayoutError(f"its definition nests {kind} too deep or too often")
        for one in self._types[kind]:
            self._field(one, path + one.name, depth)

    def _field(self, field: _Field, path: str, depth: int) -> None:
        count = self._count() if field.count == -1 else field.count
        if field.kind in _PRIMITIVES:
            if count is not None and count > _LARGEST:
                raise LayoutError(f"{path} has {count} elements")
            if count != 0:
                self._check_left(np.dtype(_PRIMITIVES[field.kind]).itemsize * (count or 1))
                self.builder.variable(path, field.kind, count)
            return
        for index in range(1 if count is None else count):
            place = path if count is None else f"{path}/{index}"
            if field.kind in ("string", "wstring"):
                self._string(field.kind, place)
            else:
                self.fields(_short(field.kind), f"{place}/", depth + 1)

    def _count(self) -> int:
        if self._message is None:
            raise LayoutError("a sequence is not of constant size")
        count = self._number(self._message)
        self.builder.count(count)
        return count

    def _string(self, kind: str, path: str) -> None:
        if kind == "wstring":
            raise LayoutError(f"{path} is a wstring")
        if self._message is None:
            self.builder.string("")
            return
        length = self._number(self._message)
        start = self.builder.size + -(self.builder.size - len(ENCAPSULATION)) % 4 + 4
        text = self._message[start : start + length]
        if len(text) < length or not text.endswith(b"\0"):
            raise LayoutError(f"{path} does not fit into the message")
        try:
            self.builder.string(text[:-1].decode())
        except UnicodeDecodeError as error:
            raise LayoutError(f"{path} is not UTF-8") from error

    def _number(self, message: bytes) -> int:
        """The length that stands at the next place for one."""
        at = self.builder.size + -(self.builder.size - len(ENCAPSULATION)) % 4
        self._check_left(4)
        return int.from_bytes(message[at : at + 4], "little")

    def _check_left(self, size: int) -> None:
        if self._message is not None and self.builder.size + size > len(self._message):
            raise LayoutError("its messages end before their last field")


def _short(kind: str) -> str:
    """``package/Type`` without ``msg``."""
    return kind.replace("/msg/", "/")


@lru_cache(maxsize=64)
def _types(kind: str, definition: str) -> dict[str, tuple[_Field, ...]]:
    """Fields by type, of a definition with its dependencies."""
    own, *others = _SEPARATOR.split(definition)
    package = _short(kind).partition("/")[0]
    types = {_short(kind): tuple(_fields(own, package))}
    for part in others:
        head, _, text = part.partition("\n")
        name = _short(head.removeprefix("MSG:").strip())
        types[name] = tuple(_fields(text, name.partition("/")[0]))
    return types


def _fields(text: str, package: str) -> Iterator[_Field]:
    for line in text.splitlines():
        stated = line.partition("#")[0].strip()
        if not stated or _CONSTANT.match(stated):
            continue
        # A default value may follow the name.
        match = _FIELD.match(" ".join(stated.split()[:2]))
        if match is None:
            raise LayoutError(f"its definition has the line {stated!r}")
        kind, count = match["type"], match["count"]
        if kind in ("time", "duration"):
            raise LayoutError("its definition is that of ROS 1")
        if kind not in _PRIMITIVES and kind not in ("string", "wstring") and "/" not in kind:
            kind = f"{package}/{kind}"
        fixed = int(count[:_LONGEST_COUNT]) if count is not None and count.isdecimal() else -1
        yield _Field(kind, match["name"], None if count is None else fixed)


def joint_state_layout(
    names: Sequence[str], *, position: int, velocity: int, effort: int
) -> MessageLayout:
    """Lay out a sensor_msgs/JointState with these names and lengths of its arrays."""
    builder = LayoutBuilder()
    builder.header()
    builder.count(len(names))
    for name in names:
        builder.string(name)
    builder.sequence("position", "float64", position)
    builder.sequence("velocity", "float64", velocity)
    builder.sequence("effort", "float64", effort)
    return builder.build()
