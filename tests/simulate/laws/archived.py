"""Second reader of archives, from the published formats of container, chunks and messages.

The container is MCAP, messages are CDR, laid out as in `docs/archive-format.md`. The `mcap` library
reads one file of each campaign in `archives`; it takes a hundred times as long.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

MAGIC: Final = b"\x89MCAP0\r\n"
_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_CHUNK: Final = struct.Struct("<QQQI")
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _ATTACHMENT, _METADATA = (2, 3, 4, 5, 6, 9, 12)
_ARRAYS: Final = (
    *("target_position", "target_velocity", "position", "velocity", "torque", "target_current"),
    *("model_current", "diagonal_inertia", "extra3", "commanded_position", "commanded_velocity"),
)


@dataclass(frozen=True)
class LoggedEvent:
    """One message of `/hil/events`: time [ns], kind and text."""

    stamp: int
    name: str
    text: str


@dataclass(eq=False)
class Archived:
    """Content of an archive up to its last complete chunk.

    Attributes:
        whole: it has a footer, and nothing before it is damaged.
        problem: error that ended the reading; "" for none.
        metadata, outcome: of the records `hil` and `hil.outcome`.
        cycles: (k,) rows of `/hil/cycle`, with log times `stamps` [ns] and numbers `sequences`.
        states, commanded: (k, 3 n) and (k, 2 n) of the two JointState channels, in their order.
        chunks: number of complete chunks.
    """

    path: Path
    whole: bool = False
    problem: str = ""
    metadata: dict[str, str] | None = None
    outcome: dict[str, str] | None = None
    attachments: dict[str, bytes] = field(default_factory=dict)
    cycles: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, cycle_layout(1)))
    stamps: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    sequences: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    states: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    commanded: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    events: list[LoggedEvent] = field(default_factory=list)
    chunks: int = 0

    @property
    def ended(self) -> str:
        """Stated outcome; "" for none."""
        return (self.outcome or {}).get("outcome", "")


def cycle_layout(n: int) -> np.dtype[np.void]:
    """Return the layout of a message of `/hil/cycle` of n joints, encapsulation included."""
    names: list[str] = ["sec", "nanosec", "cycle", "arrival"]
    formats: list[Any] = ["<i4", "<u4", "<i8", "<f8"]
    offsets = [4, 8, 20, 28]  # an empty frame_id and padding lie between
    at = 36
    for name in _ARRAYS:
        names.append(name)
        formats.append(("<f8", (n,)))
        offsets.append(at)
        at += 8 * n
    for name, kind, size in (
        ("mode", ("<i4", (n,)), 4 * n),
        ("number", "<i4", 4),
        ("gap", "<i4", 4),
        ("interval", "<i4", 4),
        ("state", "u1", 1),
        ("status", "u1", 1),
        ("age", ("<u2", (8,)), 16),
    ):
        names.append(name)
        formats.append(kind)
        offsets.append(at)
        at += size
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})


def read(path: Path) -> Archived:
    """Read a file as far as it is complete; cached until the file changes."""
    stat = path.stat()
    return _read(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=24)
def _read(path: Path, _changed: int, _size: int) -> Archived:
    found = Archived(path)
    reading = _Reading(found)
    data = path.read_bytes()
    try:
        for opcode, body in _records(data):
            reading.read(opcode, body)
            if opcode == _FOOTER:
                found.whole = True
                break
    except (
        _DamagedError,
        struct.error,
        ValueError,
        UnicodeDecodeError,
        zstandard.ZstdError,
    ) as error:
        found.problem = f"{type(error).__name__}: {error}"
    if found.whole and not data.endswith(MAGIC):
        found.whole, found.problem = False, "no magic at the end"
    reading.finish()
    return found


class _DamagedError(ValueError):
    """The file ends, or is damaged, here."""


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    if data[:8] != MAGIC:
        raise _DamagedError("no magic at the beginning")
    view, at = memoryview(data), 8
    while at < len(data):
        if at + 9 > len(data):
            raise _DamagedError("a record begins and its length is missing")
        opcode, length = _RECORD.unpack_from(data, at)
        if at + 9 + length > len(data):
            raise _DamagedError(f"{at + 9 + length - len(data)} bytes of a record are missing")
        yield opcode, view[at + 9 : at + 9 + length]
        at += 9 + length
    raise _DamagedError("no footer")


def _string(body: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    return bytes(body[at + 4 : at + 4 + length]).decode(), at + 4 + length


class _Reading:
    def __init__(self, found: Archived) -> None:
        self._found = found
        self._topics: dict[int, str] = {}
        self._parts: dict[str, list[bytes]] = {}
        self._stamps: list[int] = []
        self._sequences: list[int] = []

    def read(self, opcode: int, body: memoryview) -> None:
        """Read one record of the data section, or of the summary, which repeats some."""
        if opcode == _CHUNK_OP:
            self._chunk(body)
        elif opcode == _METADATA:
            self._metadata(body)
        elif opcode == _ATTACHMENT:
            self._attachment(body)
        elif opcode == _CHANNEL:
            self._channel(body)

    def _metadata(self, body: memoryview) -> None:
        name, at = _string(body, 0)
        (size,) = struct.unpack_from("<I", body, at)
        at, end, entries = at + 4, at + 4 + size, {}
        while at < end:
            key, at = _string(body, at)
            entries[key], at = _string(body, at)
        rest = {key: value for key, value in entries.items() if key != "checksum"}
        text = json.dumps(rest, sort_keys=True, separators=(",", ":"))
        if entries.get("checksum") != f"{zlib.crc32(text.encode()):08x}":
            raise _DamagedError(f"metadata {name} fail their checksum")
        if name == "hil":
            self._found.metadata = entries
        elif name == "hil.outcome":
            self._found.outcome = entries

    def _attachment(self, body: memoryview) -> None:
        name, at = _string(body, 16)
        _, at = _string(body, at)
        (size,) = struct.unpack_from("<Q", body, at)
        content = bytes(body[at + 8 : at + 8 + size])
        (crc,) = struct.unpack_from("<I", body, at + 8 + size)
        if crc and crc != zlib.crc32(body[:-4]):
            raise _DamagedError(f"attachment {name} fails its checksum")
        self._found.attachments[name] = content

    def _channel(self, body: memoryview) -> None:
        number = int.from_bytes(body[:2], "little")
        self._topics[number], _ = _string(body, 4)

    def _chunk(self, body: memoryview) -> None:
        _, _, size, crc = _CHUNK.unpack_from(body)
        compression, at = _string(body, _CHUNK.size)
        (packed,) = struct.unpack_from("<Q", body, at)
        content = bytes(body[at + 8 : at + 8 + packed])
        if compression == "zstd":
            content = zstandard.decompress(content, size)
        elif compression:
            raise _DamagedError(f"a chunk compressed by {compression}")
        if not crc or crc != zlib.crc32(content) or len(content) != size:
            raise _DamagedError("a chunk fails its checksum")
        self._messages(content)
        self._found.chunks += 1

    def _messages(self, content: bytes) -> None:
        at, topics, parts = 0, self._topics, self._parts
        while at < len(content):
            if content[at] == _MESSAGE_OP:
                _, length, channel, sequence, stamp, _ = _MESSAGE.unpack_from(content, at)
                topic = topics[channel]
                parts.setdefault(topic, []).append(content[at + 31 : at + 9 + length])
                if topic == "/hil/cycle":
                    self._stamps.append(stamp)
                    self._sequences.append(sequence)
            else:
                opcode, length = _RECORD.unpack_from(content, at)
                if opcode == _CHANNEL:
                    self._channel(memoryview(content)[at + 9 : at + 9 + length])
            at += 9 + length

    def finish(self) -> None:
        """Convert the collected messages to columns."""
        found, parts = self._found, self._parts
        found.events = [_event(one) for one in parts.get("/hil/events", ())]
        names = json.loads((found.metadata or {}).get("joint_names", "[]"))
        cycles = parts.get("/hil/cycle", ())
        if not (cycles and names):
            return
        found.cycles = np.frombuffer(b"".join(cycles), cycle_layout(len(names)))
        found.stamps = np.array(self._stamps, np.int64)
        found.sequences = np.array(self._sequences, np.int64)
        found.states = _joint_states(parts.get("/joint_states", ()), names, 3)
        found.commanded = _joint_states(parts.get("/joint_states_commanded", ()), names, 2)


def _event(message: bytes) -> LoggedEvent:
    seconds, nanoseconds, _ = struct.unpack_from("<iIB", message, 4)
    name, at = _cdr_string(message, 16)
    text, _ = _cdr_string(message, at)
    return LoggedEvent(seconds * 10**9 + nanoseconds, name, text)


def _cdr_string(message: bytes, at: int) -> tuple[str, int]:
    at += -at % 4  # the encapsulation is four bytes long
    (length,) = struct.unpack_from("<I", message, at)
    return message[at + 4 : at + 3 + length].decode(), at + 4 + length


def _joint_states(
    messages: list[bytes] | tuple[bytes, ...], names: list[str], arrays: int
) -> NDArray[np.float64]:
    """Position, velocity and, with three arrays, effort: (k, arrays * n)."""
    if not messages:
        return np.zeros((0, arrays * len(names)))
    n, at = len(names), 20  # sec, nanosec, an empty frame_id, padding; then the count of names
    at += 4
    for name in names:
        at += -at % 4 + 4 + len(name.encode()) + 1
    rows: NDArray[np.uint8] = np.frombuffer(b"".join(messages), np.uint8)
    rows = rows.reshape(len(messages), -1)
    columns = []
    for _ in range(arrays):
        at += -at % 4 + 4
        at += -(at - 4) % 8
        columns.append(np.ascontiguousarray(rows[:, at : at + 8 * n]).view("<f8"))
        at += 8 * n
    return np.concatenate(columns, axis=1)
