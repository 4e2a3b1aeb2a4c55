"""Says whether a file keeps the archive profile, aspect by aspect.

`docs/archive-format.md` is the profile in words; each rule here is one of its sentences. The check
is of the file alone: whether the motion in it is any good is not asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from mcap.records import Channel, Schema

from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, Rows
from hil.archive.chunk import KnownChannels, Messages
from hil.archive.container import Record
from hil.archive.events import ArchivedEvent
from hil.archive.header import (
    CHUNKS,
    FORMAT_VERSION,
    KINDS,
    METADATA,
    REJECTED,
    ArchiveHeader,
    ArchiveName,
    ArchiveOutcome,
    HeaderError,
    is_known,
)
from hil.archive.repair import is_indexed
from hil.archive.survey import Survey, survey
from hil.errors import NotAnArchiveError

Fault = tuple[str, str]

_CHUNK_NS = 100_000_000
_STATES = {
    schema.MEASURED: {"position": "position", "velocity": "velocity", "effort": "torque"},
    schema.COMMANDED: {"position": "commanded_position", "velocity": "commanded_velocity"},
}
"""Which columns of the cycles each channel repeats; targets stand for commands that are NaN."""


_CYCLE_FIELDS = (
    "cycle",
    "gap",
    *(column for state in _STATES.values() for column in state.values()),
)
_ADDED_LATER = 1  # fields at the end of the cycle that the first archives do not have


class _Checker:
    """Checks chunks that stand, one after the other; then the rest.

    Attributes:
        faults: aspect of the profile, and what is wrong.
    """

    def __init__(self) -> None:
        self.faults: list[Fault] = []
        self._joints: tuple[str, ...] = ()
        self._period_ns: float | None = None
        self._known = KnownChannels()
        self._layouts: dict[str, MessageLayout | None] = {}
        self._gaps = 0

    def visit(self, found: Survey, record: Record, messages: Mapping[str, Messages]) -> None:
        """Check the next chunk."""
        if found.header is not None:
            self._joints, period = found.header.joint_names, found.header.period
            self._period_ns = None if period is None else period * 1e9
            self._known = found.parser.known
            self.faults += self._chunk(record, messages)

    def finish(self, found: Survey) -> None:
        """Check channels and outcome."""
        header, outcome = found.header, found.outcome
        if header is None or not found.pieces:
            return
        imported = header.kind == "imported"
        if self._known.channels:
            self.faults += self._channels(imported=imported)
        if imported or outcome is None or outcome.repaired or found.losses:
            return
        if "lost_packets" in outcome.record and outcome.lost_packets != self._gaps:
            stated = outcome.record["lost_packets"]
            text = f"lost_packets is {stated}, the cycles lack {self._gaps}"
            self.faults.append(("outcome", text))

    def _channels(self, *, imported: bool) -> Iterator[Fault]:
        """Check topics, types and encodings."""
        channels = {channel.topic: channel for channel in self._known.channels.values()}
        needed = {schema.MEASURED, schema.EVENTS}
        if not imported:
            needed |= {schema.CYCLE, schema.COMMANDED}
        for topic in sorted(needed - channels.keys()):
            yield "channels", f"there is no {topic}"
        for topic in sorted(channels):
            yield from self._channel(channels[topic])

    def _channel(self, channel: Channel) -> Iterator[Fault]:
        expected = schema.profile(len(self._joints)).get(channel.topic)
        if expected is None:
            return  # a later version may add channels
        if (encoding := channel.message_encoding) != "cdr":
            yield "channels", f"{channel.topic} is encoded as {encoding!r}, not 'cdr'"
        found = self._known.schemas.get(channel.schema_id)
        if found is None:
            yield "schemas", f"{channel.topic} has none"
            return
        if found.name != expected.schema:
            yield "channels", f"{channel.topic} is of type {found.name}, not {expected.schema}"
        if found.encoding != "ros2msg":
            yield "schemas", f"that of {channel.topic} is {found.encoding!r}, not 'ros2msg'"
        if not _extends(_text(found), expected.definition, fixed=channel.topic != schema.CYCLE):
            yield "schemas", f"that of {channel.topic} is not the text of the profile"

    def _chunk(self, record: Record, found: Mapping[str, Messages]) -> Iterator[Fault]:
        place = f"the chunk at byte {record.offset}"
        compression = container.chunk(record).compression
        if compression != "zstd":
            yield "chunks", f"{place} is compressed with {compression or 'nothing'}, not zstd"
        found = {topic: messages for topic, messages in found.items() if topic not in schema.ONCE}
        if not all(_logged_in_time(messages) for messages in found.values()):
            yield "times", f"{place} has messages logged at another time than their stamp"
        rows: dict[str, Rows] = {}
        for topic, messages in found.items():
            if topic == schema.EVENTS:
                yield from _events(messages, place)
                continue
            laid_out = self._rows(topic, messages)
            if laid_out is None:
                yield "sizes", f"{place} has messages of {topic} unlike its others"
            else:
                rows[topic] = laid_out
        if schema.CYCLE in rows and set(_CYCLE_FIELDS) <= set(rows[schema.CYCLE].dtype.names or ()):
            yield from self._cycles(found, rows, place)

    def _rows(self, topic: str, messages: Messages) -> Rows | None:
        """The messages as a structured array; None where one has another layout."""
        if topic not in self._layouts:
            self._layouts[topic] = self._layout(topic, messages)
        layout = self._layouts[topic]
        data = messages.matrix(layout.size) if layout else None
        if layout is None or data is None or not layout.holds_in(data):
            return None
        return np.ascontiguousarray(data).view(layout.dtype)[:, 0]

    def _layout(self, topic: str, messages: Messages) -> MessageLayout | None:
        try:
            return schema.message_layout(
                topic, self._joints, self._known.schema(topic), messages.first()
            )
        except LayoutError:
            return None

    def _cycles(
        self, found: Mapping[str, Messages], rows: Mapping[str, Rows], place: str
    ) -> Iterator[Fault]:
        """Check the cycles of a chunk, and the channels that repeat them."""
        cycles = rows[schema.CYCLE]
        number, stamp = cycles["cycle"], found[schema.CYCLE].stamps
        if self._period_ns is not None:
            if not np.array_equal(stamp, np.rint(number * self._period_ns)):
                yield "times", f"{place} has cycles whose stamp is not cycle times period"
            if (int(number[-1]) - int(number[0])) * self._period_ns >= max(
                _CHUNK_NS, self._period_ns
            ):
                yield "chunks", f"{place} spans more than 100 ms"
        self._gaps += int(cycles["gap"].sum())
        for topic, columns in _STATES.items():
            if topic not in rows:
                continue
            same = np.array_equal(found[topic].stamps, stamp)
            if not (same and _repeats(rows[topic], cycles, columns)):
                yield "joint_states", f"{place} has messages of {topic} unlike its cycles"


def _logged_in_time(messages: Messages) -> bool:
    """Whether log and publish times are the stamps in the messages."""
    stamps, logged = messages.stamps, messages.of_heads("log_time")
    published = messages.of_heads("publish_time")
    return np.array_equal(logged, published) and np.array_equal(logged, stamps)


def _text(record: Schema) -> str:
    return record.data.decode(errors="replace")


def _extends(text: str, profile: str, *, fixed: bool) -> bool:
    """Whether a text is that of the profile, or has its fields up to those added at the end."""
    if text == profile:
        return True
    ours, theirs = _fields(profile), _fields(text)
    shorter = min(len(ours), len(theirs))
    enough = shorter >= len(ours) - _ADDED_LATER
    return not fixed and enough and ours[:shorter] == theirs[:shorter]


def _fields(text: str) -> list[str]:
    lines = (line.partition("#")[0].split() for line in text.partition("=" * 80)[0].splitlines())
    return [" ".join(words) for words in lines if words]


def _events(messages: Messages, place: str) -> Iterator[Fault]:
    try:
        for message in messages.all():
            ArchivedEvent.decode(message)
    except LayoutError as error:
        yield "sizes", f"{place} has an event that cannot be read: {error}"


def _repeats(state: Rows, cycles: Rows, columns: Mapping[str, str]) -> bool:
    if {*(state.dtype.names or ())} != {"sec", "nanosec", *columns}:
        return False
    for word, name in columns.items():
        repeated, column = state[word], cycles[name]
        if name.startswith("commanded"):  # NaN in archives that show no target in its place
            column = np.where(np.isnan(repeated), column, schema.set_points(cycles, word))
        if repeated.tobytes() != column.tobytes():
            return False
    return True


ASPECTS = {
    "container": "MCAP records in order, header of profile ros2 by hil",
    "metadata": "record hil: version, kind, joints, period; its checksum",
    "attachments": "those that the metadata name; their checksums",
    "schemas": "texts of the messages",
    "channels": "topics, types and encodings",
    "chunks": "zstd, one per 100 ms; their checksums",
    "sizes": "messages of a channel have one layout",
    "sequence": "messages are counted from 0 without a hole",
    "times": "log time, publish time and stamp agree; cycles grow",
    "joint_states": "repeat the columns of the cycles",
    "outcome": "record hil.outcome: word and counts; its checksum",
    "index": "message indexes, statistics and summary fit the data",
}
"""What is checked, and of what it consists."""

OUTCOMES = ("completed", REJECTED, "stopped", "refused", "lost", "void", "interrupted", "unknown")
_MOST = 5  # faults of one aspect that are listed


@dataclass(frozen=True)
class Check:
    """Whether a file keeps the profile.

    Attributes:
        path: the file.
        version: of the profile, as the file says.
        faults: what is wrong, by aspect; an aspect without entry is sound.
        samples: samples that can be read.
        repaired: whether the file says that it was repaired.
    """

    path: Path
    version: str
    faults: Mapping[str, tuple[str, ...]]
    samples: int
    repaired: bool

    @property
    def keeps(self) -> bool:
        """Whether all aspects of the profile are sound."""
        return not self.faults


def check_archive(path: str | PathLike[str]) -> Check:
    """Check a file.

    Raises:
        NotAnArchiveError: it is of another kind.
        ArchiveError: it cannot be read.
    """
    path = Path(path)
    checker = _Checker()
    found = survey(path, checker.visit)
    checker.finish(found)
    faults: dict[str, list[str]] = {}
    for fault in found.faults:
        faults.setdefault(fault.aspect, []).append(fault.text)
    if not faults and found.header is not None and not is_indexed(found):
        faults["index"] = ["the message indexes or the index at the end do not fit what is there"]
    if found.metadata is None:
        if not any(repr(METADATA) in text for text in faults.get("metadata", ())):
            raise _another_kind(found)
        described = ["without the record hil the rest cannot be checked"]
    else:
        described = _description_faults(path, found.metadata)
    faults.setdefault("metadata", []).extend(described)
    if found.outcome is not None:
        faults.setdefault("outcome", []).extend(_outcome_faults(found.outcome))
    if not described and found.pieces:
        for aspect, text in checker.faults:
            faults.setdefault(aspect, []).append(text)
    return Check(
        path=path,
        version=(found.metadata or {}).get("format_version", "unknown"),
        faults={aspect: _shortened(faults[aspect]) for aspect in ASPECTS if faults.get(aspect)},
        samples=found.samples,
        repaired=found.outcome is not None and found.outcome.repaired,
    )


def _another_kind(found: Survey) -> NotAnArchiveError:
    if found.size == 0:
        return NotAnArchiveError(found.path, "is empty")
    if found.written_by is None:
        return NotAnArchiveError(found.path, "is not an MCAP file")
    profile, library = found.written_by
    return NotAnArchiveError(
        found.path,
        f"is an MCAP file of profile {profile!r} written by {library!r}, but not an archive of hil",
        remedy="import it first",
    )


def _shortened(texts: list[str]) -> tuple[str, ...]:
    unique = list(dict.fromkeys(texts))
    more = len(unique) - _MOST
    return tuple([*unique[:_MOST], f"and {more} more of the kind"] if more > 0 else unique)


def _description_faults(path: Path, entries: Mapping[str, str]) -> list[str]:
    """What is wrong with the ``hil`` record."""
    if not is_known(entries):
        return [f"format_version is {entries.get('format_version')!r}, known is '{FORMAT_VERSION}'"]
    faults = []
    kind = entries.get("kind", "")
    if kind not in KINDS:
        faults.append(f"kind is {kind!r}, not one of {', '.join(KINDS)}")
    try:
        ArchiveHeader.of(entries)
    except HeaderError as error:
        faults += [f"{name} {problem}" for name, problem in error.problems.items()]
    if "period" not in entries and kind != "imported":
        faults.append("period is missing")
    name = ArchiveName.parse(path)
    for key, value in (name.metadata() if name else {}).items():
        if entries.get(key) != value:
            faults.append(f"{key} is {entries.get(key)!r}, but the file name says {value!r}")
    return faults


def _outcome_faults(outcome: ArchiveOutcome) -> list[str]:
    """What is wrong with the ``hil.outcome`` record, but for its counts."""
    if outcome.outcome not in OUTCOMES:
        return [f"outcome is {outcome.outcome!r}, not one of {', '.join(OUTCOMES)}"]
    if CHUNKS in outcome.record and outcome.chunks is None:
        return [f"{CHUNKS} is no list of checksums"]
    return []
