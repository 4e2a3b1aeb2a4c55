"""Conformance of an archive with the profile of `docs/archive-format.md`; its overview."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from hil.archive import container, schema
from hil.archive.cdr import LayoutError, MessageLayout, Rows
from hil.archive.chunk import ChunkParser, Messages
from hil.archive.events import ArchivedEvent
from hil.archive.header import (
    FORMAT_VERSION,
    KIND_NAMES,
    KINDS,
    REJECTED,
    ArchiveHeader,
    ArchiveName,
    ArchiveOutcome,
    HeaderError,
    is_supported,
    motion_name,
)
from hil.archive.reader import open_archive
from hil.archive.repair import has_valid_index, scan_file
from hil.archive.scan import Scan

ASPECTS = (
    *("container", "metadata", "attachments", "schemas", "channels", "chunks", "sizes"),
    *("sequence", "times", "joint_states", "outcome", "index"),
)
"""Aspects that are checked: rules of `docs/archive-format.md`."""

OUTCOMES = ("completed", REJECTED, "stopped", "refused", "lost", "void", "interrupted", "unknown")

_CHUNK_NS = 100_000_000
_STATES = {
    schema.MEASURED: {"position": "position", "velocity": "velocity", "effort": "torque"},
    schema.COMMANDED: {"position": "commanded_position", "velocity": "commanded_velocity"},
}
"""Columns of the cycles that each channel repeats; targets replace commands that are NaN."""
_CYCLE_FIELDS = {"cycle", "gap"}.union(*(columns.values() for columns in _STATES.values()))
_MOST = 5  # different faults of one aspect that are reported


@dataclass(frozen=True)
class Check:
    """Result of a check: faults by aspect, those that conform left out; samples that can be read.

    `repaired` is whether the outcome states a repair with loss.
    """

    path: Path
    version: str
    faults: Mapping[str, tuple[str, ...]]
    samples: int
    repaired: bool

    @property
    def conforms(self) -> bool:
        """Whether the file conforms in all aspects."""
        return not self.faults


def check_archive(path: str | PathLike[str]) -> Check:
    """Check whether a file conforms to the profile; ArchiveError if it cannot be read."""
    path = Path(path)
    checker = _Checker()
    found = scan_file(path, checker.check_chunk)
    for fault in found.faults:
        checker.faults[fault.aspect].append(fault.text)
    checker.finish(path, found)
    return Check(
        path=path,
        version=(found.metadata or {}).get("format_version", "unknown"),
        faults={
            aspect: tuple(dict.fromkeys(texts))[:_MOST]
            for aspect, texts in checker.faults.items()
            if texts
        },
        samples=found.samples,
        repaired=found.outcome is not None and found.outcome.repaired,
    )


def _metadata_faults(path: Path, entries: Mapping[str, str]) -> Iterator[str]:
    """Yield the faults of the ``hil`` record."""
    if not is_supported(entries):
        yield f"format_version is {entries.get('format_version')!r}, known is '{FORMAT_VERSION}'"
        return
    kind = entries.get("kind", "")
    if kind not in KINDS:
        yield f"kind is {kind!r}, not one of {', '.join(KINDS)}"
    try:
        ArchiveHeader.of(entries)
    except HeaderError as error:
        yield from (f"{name} {problem}" for name, problem in error.problems.items())
    if "period" not in entries and kind != "imported":
        yield "period is missing"
    name = ArchiveName.parse(path)
    for key, value in (name.metadata() if name else {}).items():
        if entries.get(key) != value:
            yield f"{key} is {entries.get(key)!r}, but {value!r} in the file name"


class _Checker:
    """Checks of valid chunks, then of the rest; `faults` are sentences by aspect."""

    def __init__(self) -> None:
        self.faults: dict[str, list[str]] = {aspect: [] for aspect in ASPECTS}
        self._layouts: dict[str, MessageLayout | None] = {}
        self._gaps = 0

    def check_chunk(self, found: Scan, messages: Mapping[str, Messages], offset: int) -> None:
        """Check the next chunk."""
        if found.header is None:
            return
        place = f"the chunk at byte {offset}"
        compression = container.parse_chunk(found.record).compression
        if compression != "zstd":
            self.faults["chunks"].append(f"{place} has the compression {compression!r}, not zstd")
        rows: dict[str, Rows] = {}
        for topic, of_topic in messages.items():
            if topic in schema.ONCE:
                continue
            times = of_topic.of_heads("log_time"), of_topic.of_heads("publish_time")
            if not all(np.array_equal(time, of_topic.stamps) for time in times):
                text = f"{place} has messages logged at another time than their stamp"
                self.faults["times"].append(text)
            try:
                if topic == schema.EVENTS:
                    for message in of_topic.all():
                        ArchivedEvent.decode(message)
                else:
                    rows[topic] = self._rows(found, topic, of_topic)
            except LayoutError as error:
                self.faults["sizes"].append(f"{place} has messages of {topic}: {error}")
        if schema.CYCLE in rows and set(rows[schema.CYCLE].dtype.names or ()) >= _CYCLE_FIELDS:
            self._check_cycles(found.header.period, messages, rows, place)

    def finish(self, path: Path, found: Scan) -> None:
        """Check metadata, index, channels and outcome, after all chunks."""
        header, outcome = found.header, found.outcome
        if found.metadata is None:
            if not self.faults["metadata"]:
                open_archive(path, fields=())  # raises with the reason
            self.faults["metadata"].append("without the record hil the rest cannot be checked")
        else:
            self.faults["metadata"] += _metadata_faults(path, found.metadata)
        if outcome is not None and outcome.outcome not in OUTCOMES:
            text = f"outcome is {outcome.outcome!r}, not one of {', '.join(OUTCOMES)}"
            self.faults["outcome"].append(text)
        if header is None:
            return
        if not found.faults and not has_valid_index(path, found):
            text = "the message indexes or the summary do not fit the content"
            self.faults["index"].append(text)
        imported, parser = header.kind == "imported", found.parser
        if parser.channels:
            cycles = () if imported else (schema.CYCLE, schema.COMMANDED)
            for topic in sorted({schema.MEASURED, schema.EVENTS, *cycles} - parser.topics):
                self.faults["channels"].append(f"there is no {topic}")
            for channel in parser.channels.values():
                self._check_channel(channel, parser, len(header.joint_names))
        if imported or outcome is None or outcome.repaired or found.losses:
            return
        if "lost_packets" in outcome.record and outcome.lost_packets != self._gaps:
            stated = outcome.record["lost_packets"]
            self.faults["outcome"].append(f"lost_packets is {stated}, the cycles lack {self._gaps}")

    def _check_channel(self, channel: Channel, parser: ChunkParser, n_joints: int) -> None:
        topic = channel.topic
        profile = schema.profile(n_joints).get(topic)
        if profile is None:
            return  # later versions may add channels
        found = parser.schemas.get(channel.schema_id) or Schema(0, b"", "", "")
        for aspect, what, is_now, must_be in (
            ("channels", "message encoding", channel.message_encoding, "cdr"),
            ("channels", "type", found.name, profile.schema),
            ("schemas", "encoding of the schema", found.encoding, "ros2msg"),
        ):
            if is_now != must_be:
                self.faults[aspect].append(f"{topic}: {what} is {is_now!r}, not {must_be!r}")
        text = found.data.decode(errors="replace")
        same = text == profile.definition
        if topic == schema.CYCLE and not same:  # fields may be added at its end, as age was
            expected, recorded = _fields(profile.definition), _fields(text)
            same = recorded[: len(expected)] in (expected, expected[:-1])
        if not same:
            self.faults["schemas"].append(f"that of {topic} is not the text of the profile")

    def _rows(self, found: Scan, topic: str, messages: Messages) -> Rows:
        """Return the messages as a structured array; LayoutError if one differs from the first."""
        assert found.header is not None
        if topic not in self._layouts:
            self._layouts[topic] = None
            record, first = found.parser.schema(topic), bytes(messages.data[0][0])
            names = found.header.joint_names
            self._layouts[topic] = schema.message_layout(topic, names, record, first)
        layout = self._layouts[topic]
        if layout is None or not all(map(layout.matches, messages.data)):
            raise LayoutError("their layout differs from the first")
        return np.concatenate(messages.data).view(layout.dtype)[:, 0]

    def _check_cycles(
        self,
        period: float | None,
        found: Mapping[str, Messages],
        rows: Mapping[str, Rows],
        place: str,
    ) -> None:
        """Check the cycles of a chunk, and the channels that repeat them."""
        cycles = rows[schema.CYCLE]
        number, stamp = cycles["cycle"], found[schema.CYCLE].stamps
        if period is not None:
            period_ns = period * 1e9
            if not np.array_equal(stamp, np.rint(number * period_ns)):
                text = f"{place} has cycles whose stamp is not cycle times period"
                self.faults["times"].append(text)
            if (int(number[-1]) - int(number[0])) * period_ns >= max(_CHUNK_NS, period_ns):
                self.faults["chunks"].append(f"{place} spans more than 100 ms")
        self._gaps += int(cycles["gap"].sum())
        for topic in _STATES.keys() & rows.keys():
            same = np.array_equal(found[topic].stamps, stamp)
            if not (same and _repeats(rows[topic], cycles, _STATES[topic])):
                text = f"{place} has messages of {topic} unlike its cycles"
                self.faults["joint_states"].append(text)


def _fields(text: str) -> list[str]:
    lines = (line.partition("#")[0].split() for line in text.partition("=" * 80)[0].splitlines())
    return [" ".join(words) for words in lines if words]


def _repeats(state: Rows, cycles: Rows, columns: Mapping[str, str]) -> bool:
    if {*(state.dtype.names or ())} != {"sec", "nanosec", *columns}:
        return False
    for field, name in columns.items():
        repeated, column = state[field], cycles[name]
        if name.startswith("commanded"):  # NaN in older archives, without the target
            column = np.where(np.isnan(repeated), column, schema.set_points(cycles, field))
        if repeated.tobytes() != column.tobytes():
            return False
    return True


_MOST_EVENTS = 20
_SHOWN_ELSEWHERE = frozenset(
    ("kind", "index", "attempt", "joint_names", "period", "attachments", "outcome", "reason")
)


@dataclass(frozen=True)
class Overview:
    """Overview of an archive, as `hil archive info` prints it; times in s, sizes in bytes.

    Attributes:
        title: kind, index and attempt.
        outcome, lost: how it ended and why; what the link or this PC lost, "" where nothing.
        duration: from the first to the last sample.
        per_minute: bytes for a minute of motion, None without samples.
        channels: topic, type and number of messages.
        metadata: entries that are not shown elsewhere.
        events: time, kind and text of the first ones.
        damage: what is wrong with the file, None where nothing.
    """

    path: Path
    title: str
    outcome: str
    lost: str
    samples: int
    duration: float
    period: float | None
    joint_names: tuple[str, ...]
    size: int
    per_minute: float | None
    chunks: int
    channels: tuple[tuple[str, str, int], ...]
    attachments: Mapping[str, int]
    metadata: Mapping[str, str]
    events: tuple[tuple[float, str, str], ...]
    damage: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return the overview for JSON."""
        entries = asdict(self)
        return {"file": str(entries.pop("path")), "archive": True, **entries}


def read_overview(path: str | PathLike[str]) -> Overview:
    """Return the overview of an archive; ArchiveError if it cannot be read."""
    archive, found = open_archive(path, fields=()), scan_file(Path(path))
    header, stamp = archive.header, archive.columns["stamp"]
    outcome = archive.outcome or ArchiveOutcome(outcome="missing")
    entries = {**header.entries, **{f"outcome.{k}": text for k, text in outcome.entries.items()}}
    title, duration = KIND_NAMES.get(header.kind, header.kind), 0.0
    if header.index is not None:
        title = f"{motion_name(header.kind, header.index)}, attempt {header.attempt or 1}"
    if len(stamp):
        duration = float(stamp[-1] - stamp[0]) * 1e-9
    counts = {
        "lost packets": outcome.lost_packets,
        "records lost": outcome.records_lost,
        "events lost": outcome.events_lost,
        "samples lost": "unknown" if outcome.samples_lost is None else outcome.samples_lost,
    }
    return Overview(
        path=archive.path,
        title=title,
        outcome=f"{outcome.outcome}: {outcome.reason}" if outcome.reason else outcome.outcome,
        lost="; ".join([*(f"{k} {n}" for k, n in counts.items() if n), *outcome.losses]),
        samples=archive.n_samples,
        duration=duration,
        period=archive.period,
        joint_names=archive.joint_names,
        size=found.size,
        per_minute=found.size / duration * 60.0 if duration else None,
        chunks=found.chunks,
        channels=tuple(
            (topic, getattr(found.parser.schema(topic), "name", ""), count)
            for topic, count in sorted(found.counts.items())
        ),
        attachments={name: len(data) for name, data in archive.attachments.items()},
        metadata={
            key: text
            for key, text in entries.items()
            if key.removeprefix("outcome.") not in _SHOWN_ELSEWHERE
        },
        events=tuple((one.time, one.name, one.text) for one in archive.events[:_MOST_EVENTS]),
        damage=archive.damage,
    )
