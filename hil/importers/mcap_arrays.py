"""The numbers in an MCAP file as named arrays, for a column map to choose from.

Of each topic of ROS 2 messages: every number and every array of numbers, by the path of its field,
and its time. Messages of a topic must be alike in names and lengths, as joint states and motor
currents are; their layout is then found once, in the first message, and all are read as columns.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive.cdr import ENCAPSULATION, LayoutBuilder, LayoutError, MessageLayout
from hil.errors import SourceError
from hil.importers import mcap_messages
from hil.importers.mcap_messages import Topic

STAMP = "stamp"
"""Name of the time of a topic's messages [ns]: that of their header, or else the file's."""

MOST_BYTES: Final = 4 << 30
"""Of messages that become arrays, all topics together."""

_SIZES = {
    "bool": 1, "byte": 1, "char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2,
    "int32": 4, "uint32": 4, "float32": 4, "int64": 8, "uint64": 8, "float64": 8,
}  # fmt: skip
_FIELD = re.compile(r"(?P<type>[\w/]+)(?P<bound><=\d+)?(\[(?P<count>[^\]]*)\])?\s+(?P<name>\w+)$")
_CONSTANT = re.compile(r"^\s*\w+(\[[^\]]*\])?\s+\w+\s*=")
_SEPARATOR = re.compile(r"^=+\n", re.MULTILINE)
_LARGEST = 4096  # elements; what is larger is an image or a cloud of points
_BATCH = 10_000  # messages
_MOST_PLACES = 10_000  # in one message where a type is laid out
_DEEPEST = 32  # types within types
_LONGEST_COUNT = 9  # digits


@dataclass(frozen=True)
class _Field:
    """One line of a definition: `count` None for a single value, -1 for a sequence."""

    kind: str
    name: str
    count: int | None


class VaryingError(LayoutError):
    """Messages of a topic that are not alike."""


def read_mcap(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays by ``topic/field``, such as ``/joint_states/position`` (m, n).

    Raises:
        SourceError: the file cannot be read.
        SourceError: it holds no topic that can be read so; the text says why for each.
    """
    known = mcap_messages.topics(path)
    topics = {name: _Reader(topic) for name, topic in known.items() if topic.is_ros2}
    kept = 0
    for name, stamp, data in mcap_messages.messages(path, list(topics)):
        kept += len(data) if topics[name].add(stamp, data) else 0
        if kept > MOST_BYTES:
            raise SourceError(
                path,
                f"holds more than {MOST_BYTES} bytes of numbers: too large to be read at once",
                remedy="cut it, or leave out topics (`mcap filter`)",
            )
    refused = {name: f"{t} is not ROS 2" for name, t in known.items() if not t.is_ros2}
    arrays: dict[str, NDArray[Any]] = {}
    for name, reader in topics.items():
        try:
            columns = reader.finished()
        except LayoutError as error:
            refused[name] = str(error)
            continue
        arrays |= {f"{name}/{field}": column for field, column in columns.items()}
    if not arrays:
        reasons = "; ".join(f"{name}: {why}" for name, why in refused.items()) or "it has no topic"
        raise SourceError(
            path,
            f"has no topic whose messages can be read as columns ({reasons})",
            remedy="record joint states and currents as ROS 2 messages of constant size",
        )
    return arrays


class _Reader:
    """Collects the messages of one topic, joined in batches."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._layout: MessageLayout | None = None
        self._refusal: LayoutError | None = None
        self._stamps: list[int] = []
        self._batch: list[bytes] = []
        self._parts: list[dict[str, NDArray[Any]]] = []

    def add(self, stamp: int, data: bytes) -> bool:
        """Take the next message; whether it is kept."""
        if self._refusal is None and self._layout is None:
            self._begin(data)
        if self._refusal is not None:
            return False
        self._stamps.append(stamp)
        self._batch.append(data)
        if len(self._batch) >= _BATCH:
            self._take_batch()
        return True

    def finished(self) -> dict[str, NDArray[Any]]:
        """All columns; none of a topic without messages.

        Raises:
            LayoutError: they cannot be read as columns.
        """
        self._take_batch()
        if self._refusal is not None:
            raise self._refusal
        if not self._parts:
            return {}
        columns = {name: np.concatenate([part[name] for part in self._parts]) for name in
                   self._parts[0]}  # fmt: skip
        log_times = np.array(self._stamps, np.int64)
        return {STAMP: _stamps(columns, log_times), **columns}

    def _begin(self, data: bytes) -> None:
        try:
            definition = self._topic.definition.decode(errors="replace")
            self._layout = layout_of(self._topic.kind, definition, data)
        except LayoutError as error:
            self._refusal = error

    def _take_batch(self) -> None:
        batch, self._batch = self._batch, []
        if not batch or self._refusal is not None:
            return
        try:
            self._parts.append(self._columns(batch))
        except LayoutError as error:
            self._refusal, self._parts = error, []

    def _columns(self, batch: list[bytes]) -> dict[str, NDArray[Any]]:
        assert self._layout is not None
        size = self._layout.size
        # A writer may pad the end of a message to whole words.
        if any(len(message) - size not in range(4) for message in batch):
            raise VaryingError("its messages differ in length")
        joined = np.frombuffer(b"".join(message[:size] for message in batch), np.uint8)
        messages = joined.reshape(len(batch), size)
        if not self._layout.is_kept_by(messages):
            raise VaryingError("its messages differ in names or lengths of arrays")
        rows = messages.view(self._layout.dtype)[:, 0]
        return {name: rows[name].copy() for name in self._layout.dtype.names or ()}


def _stamps(columns: dict[str, NDArray[Any]], log_times: NDArray[np.int64]) -> NDArray[np.int64]:
    """The times in the headers, unless there are none or all are empty."""
    seconds, rest = (columns.pop(f"header/stamp/{part}", None) for part in ("sec", "nanosec"))
    if seconds is None or rest is None or not (seconds.any() or rest.any()):
        return log_times
    return np.asarray(seconds.astype(np.int64) * 10**9 + rest)


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
        raise LayoutError("its messages are not plain little-endian CDR")
    walk = _Walk(_types(kind, definition), message)
    walk.fields(_short(kind), "")
    return walk.builder.build()


class _Walk:
    """Goes through one message along its definition, and lays out what it meets."""

    def __init__(self, types: Mapping[str, tuple[_Field, ...]], message: bytes) -> None:
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
        for field in self._types[kind]:
            self._field(field, path + field.name, depth)

    def _field(self, field: _Field, path: str, depth: int) -> None:
        count = self._count() if field.count == -1 else field.count
        if field.kind in _SIZES:
            if count is not None and count > _LARGEST:
                raise LayoutError(f"{path} has {count} elements")
            if count != 0:
                self._check_left(_SIZES[field.kind] * (count or 1))
                self.builder.variable(path, field.kind, count)
            return
        for index in range(1 if count is None else count):
            place = path if count is None else f"{path}/{index}"
            if field.kind in ("string", "wstring"):
                self._string(field.kind, place)
            else:
                self.fields(_short(field.kind), f"{place}/", depth + 1)

    def _count(self) -> int:
        count = self._number()
        self.builder.count(count)
        return count

    def _string(self, kind: str, path: str) -> None:
        if kind == "wstring":
            raise LayoutError(f"{path} is a wstring")
        length = self._number()
        start = self.builder.size + -(self.builder.size - len(ENCAPSULATION)) % 4 + 4
        text = self._message[start : start + length]
        if len(text) < length or not text.endswith(b"\0"):
            raise LayoutError(f"{path} does not fit into the message")
        try:
            self.builder.string(text[:-1].decode())
        except UnicodeDecodeError as error:
            raise LayoutError(f"{path} is not UTF-8") from error

    def _number(self) -> int:
        """The length that stands at the next place for one."""
        at = self.builder.size + -(self.builder.size - len(ENCAPSULATION)) % 4
        self._check_left(4)
        return int.from_bytes(self._message[at : at + 4], "little")

    def _check_left(self, size: int) -> None:
        if self.builder.size + size > len(self._message):
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
        if kind not in _SIZES and kind not in ("string", "wstring") and "/" not in kind:
            kind = f"{package}/{kind}"
        fixed = int(count[:_LONGEST_COUNT]) if count is not None and count.isdecimal() else -1
        yield _Field(kind, match["name"], None if count is None else fixed)
