"""Second reader of archives: records by the `mcap` library, messages from the published layout.

Messages are CDR, laid out as in `docs/archive-format.md`.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from numpy.typing import NDArray

_MESSAGE: Final = struct.Struct("<BQHIQQ")
_CHANNEL_OP = 4
_MESSAGE_OP = 5
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
    archived = Archived(path)
    reading = _Reading(archived)
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
                reading.read(record)
        archived.whole = True
    except (McapError, struct.error, ValueError, zstandard.ZstdError) as error:
        archived.problem = f"{type(error).__name__}: {error}"
    reading.finish()
    return archived


class _Reading:
    def __init__(self, archived: Archived) -> None:
        self._found = archived
        self._topics: dict[int, str] = {}
        self._parts: dict[str, list[bytes]] = {}
        self._stamps: list[int] = []
        self._sequences: list[int] = []

    def read(self, record: McapRecord) -> None:
        """Read one record of the data section, or of the summary, which repeats some."""
        if isinstance(record, Chunk):
            content, size = get_chunk_data_stream(record, validate_crc=True)
            self._messages(content.read(size))
            self._found.chunks += 1
        elif isinstance(record, Metadata):
            self._metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._found.attachments[record.name] = record.data
        elif isinstance(record, Channel):
            self._topics[record.id] = record.topic

    def _metadata(self, name: str, entries: dict[str, str]) -> None:
        sealed = {key: value for key, value in entries.items() if key != "checksum"}
        text = json.dumps(sealed, sort_keys=True, separators=(",", ":"))
        if entries.get("checksum") != f"{zlib.crc32(text.encode()):08x}":
            raise ValueError(f"metadata {name} fail their checksum")
        if name == "hil":
            self._found.metadata = entries
        elif name == "hil.outcome":
            self._found.outcome = entries

    def _messages(self, content: bytes) -> None:
        """Divide a chunk into messages: the library takes a hundred times as long."""
        at = 0
        parts = self._parts
        while at < len(content):
            opcode, length, channel, sequence, stamp, _ = _MESSAGE.unpack_from(content, at)
            if opcode == _MESSAGE_OP:
                topic = self._topics[channel]
                parts.setdefault(topic, []).append(content[at + 31 : at + 9 + length])
                if topic == "/hil/cycle":
                    self._stamps.append(stamp)
                    self._sequences.append(sequence)
            elif opcode == _CHANNEL_OP:
                stream = ReadDataStream(io.BytesIO(content[at + 9 : at + 9 + length]))
                self.read(Channel.read(stream))
            at += 9 + length

    def finish(self) -> None:
        """Convert the collected messages to columns."""
        archived = self._found
        parts = self._parts
        archived.events = [_event(message) for message in parts.get("/hil/events", ())]
        names = json.loads((archived.metadata or {}).get("joint_names", "[]"))
        cycles = parts.get("/hil/cycle", ())
        if not (cycles and names):
            return
        archived.cycles = np.frombuffer(b"".join(cycles), cycle_layout(len(names)))
        archived.stamps = np.array(self._stamps, np.int64)
        archived.sequences = np.array(self._sequences, np.int64)
        archived.states = _joint_states(parts.get("/joint_states", ()), names, 3)
        archived.commanded = _joint_states(parts.get("/joint_states_commanded", ()), names, 2)


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
