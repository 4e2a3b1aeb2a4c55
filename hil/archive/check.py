"""Conformance of an archive with the profile of `docs/archive-format.md`; its overview."""

from __future__ import annotations

from collections.abc import Mapping
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
    CHUNKS,
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

ASPECTS = {
    "container": "MCAP records in order, header of profile ros2 by hil",
    "metadata": "record hil: version, kind, joints, period; its checksum",
    "attachments": "those named in the metadata; their checksums",
    "schemas": "texts of the messages",
    "channels": "topics, types and encodings",
    "chunks": "zstd, one per 100 ms; their checksums",
    "sizes": "messages of a channel have one layout",
    "sequence": "messages are numbered from 0 without a gap",
    "times": "log time, publish time and stamp agree; cycles increase",
    "joint_states": "repeat the columns of the cycles",
    "outcome": "record hil.outcome: outcome and counts; its checksum",
    "index": "message indexes, statistics and summary fit the data",
}
"""Aspects that are checked."""

OUTCOMES = ("completed", REJECTED, "stopped", "refused", "lost", "void", "interrupted", "unknown")

_CHUNK_NS = 100_000_000
_STATES = {
    schema.MEASURED: {"position": "position", "velocity": "velocity", "effort": "torque"},
    schema.COMMANDED: {"position": "commanded_position", "velocity": "commanded_velocity"},
}
"""Columns of the cycles that each channel repeats; targets replace commands that are NaN."""
_CYCLE_FIELDS = {"cycle", "gap"}.union(*(columns.values() for columns in _STATES.values()))
_MOST = 5  # faults of one aspect that are shown


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
    found, add = scan_file(path, checker.visit), checker.add
    outcome = found.outcome
    if not found.faults and found.header is not None and not has_valid_index(path, found):
        add("index", "the message indexes or the summary do not fit the content")
    if found.metadata is None:
        if not any(fault.aspect == "metadata" for fault in found.faults):
            open_archive(path, fields=())  # raises with the reason
        add("metadata", "without the record hil the rest cannot be checked")
    else:
        for text in _description_faults(path, found.metadata):
            add("metadata", text)
    if outcome is not None and outcome.outcome not in OUTCOMES:
        add("outcome", f"outcome is {outcome.outcome!r}, not one of {', '.join(OUTCOMES)}")
    if outcome is not None and CHUNKS in outcome.record and outcome.chunks is None:
        add("outcome", f"{CHUNKS} is not a list of checksums")
    if found.header is not None and found.pieces:
        checker.finish(found)
    texts: dict[str, list[str]] = {aspect: [] for aspect in ASPECTS}
    for aspect, text in [*((one.aspect, one.text) for one in found.faults), *checker.faults]:
        texts[aspect].append(text)
    return Check(
        path=path,
        version=(found.metadata or {}).get("format_version", "unknown"),
        faults={aspect: _shortened(found) for aspect, found in texts.items() if found},
        samples=found.samples,
        repaired=outcome is not None and outcome.repaired,
    )


def _shortened(texts: list[str]) -> tuple[str, ...]:
    unique = list(dict.fromkeys(texts))
    more = len(unique) - _MOST
    return tuple([*unique[:_MOST], f"and {more} more"] if more > 0 else unique)


def _description_faults(path: Path, entries: Mapping[str, str]) -> list[str]:
    """Return the faults of the ``hil`` record."""
    if not is_supported(entries):
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
            faults.append(f"{key} is {entries.get(key)!r}, but {value!r} in the file name")
    return faults


class _Checker:
    """Checks of valid chunks, then of the rest; collects aspect and sentence of each fault."""

    def __init__(self) -> None:
        self.faults: list[tuple[str, str]] = []
        self._layouts: dict[str, MessageLayout | None] = {}
        self._gaps = 0

    def add(self, aspect: str, text: str) -> None:
        """Add a fault."""
        self.faults.append((aspect, text))

    def visit(self, found: Scan, messages: Mapping[str, Messages], offset: int) -> None:
        """Check the next chunk."""
        if found.header is None:
            return
        place = f"the chunk at byte {offset}"
        compression = container.parse_chunk(found.record).compression
        if compression != "zstd":
            self.add("chunks", f"{place} is compressed with {compression or 'nothing'}, not zstd")
        rows: dict[str, Rows] = {}
        for topic, of_topic in messages.items():
            if topic in schema.ONCE:
                continue
            times = of_topic.of_heads("log_time"), of_topic.of_heads("publish_time")
            if not all(np.array_equal(time, of_topic.stamps) for time in times):
                self.add("times", f"{place} has messages logged at another time than their stamp")
            try:
                if topic == schema.EVENTS:
                    for message in of_topic.all():
                        ArchivedEvent.decode(message)
                else:
                    rows[topic] = self._rows(found, topic, of_topic)
            except LayoutError as error:
                self.add("sizes", f"{place} has messages of {topic}: {error}")
        if schema.CYCLE in rows and set(rows[schema.CYCLE].dtype.names or ()) >= _CYCLE_FIELDS:
            self._check_cycles(found.header.period, messages, rows, place)

    def finish(self, found: Scan) -> None:
        """Check channels and outcome."""
        header, outcome, parser = found.header, found.outcome, found.parser
        assert header is not None
        imported = header.kind == "imported"
        if parser.channels:
            cycles = () if imported else (schema.CYCLE, schema.COMMANDED)
            for topic in sorted({schema.MEASURED, schema.EVENTS, *cycles} - parser.topics):
                self.add("channels", f"there is no {topic}")
            for channel in parser.channels.values():
                self._check_channel(channel, parser, len(header.joint_names))
        if imported or outcome is None or outcome.repaired or found.losses:
            return
        if "lost_packets" in outcome.record and outcome.lost_packets != self._gaps:
            stated = outcome.record["lost_packets"]
            self.add("outcome", f"lost_packets is {stated}, the cycles lack {self._gaps}")

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
                self.add(aspect, f"{topic}: {what} is {is_now!r}, not {must_be!r}")
        text = found.data.decode(errors="replace")
        same = text == profile.definition
        if topic == schema.CYCLE and not same:  # fields may be added at its end, as age was
            expected, recorded = _fields(profile.definition), _fields(text)
            same = recorded[: len(expected)] in (expected, expected[:-1])
        if not same:
            self.add("schemas", f"that of {topic} is not the text of the profile")

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
                self.add("times", f"{place} has cycles whose stamp is not cycle times period")
            if (int(number[-1]) - int(number[0])) * period_ns >= max(_CHUNK_NS, period_ns):
                self.add("chunks", f"{place} spans more than 100 ms")
        self._gaps += int(cycles["gap"].sum())
        for topic in _STATES.keys() & rows.keys():
            same = np.array_equal(found[topic].stamps, stamp)
            if not (same and _repeats(rows[topic], cycles, _STATES[topic])):
                self.add("joint_states", f"{place} has messages of {topic} unlike its cycles")


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
    header, outcome, stamp = archive.header, archive.outcome, archive.columns["stamp"]
    ended, lost = _ended(outcome)
    further = {
        **header.entries,
        **{f"outcome.{key}": text for key, text in (outcome.entries if outcome else {}).items()},
    }
    title, duration = KIND_NAMES.get(header.kind, header.kind), 0.0
    if header.index is not None:
        attempt = 1 if header.attempt is None else header.attempt
        title = f"{motion_name(header.kind, header.index)}, attempt {attempt}"
    if len(stamp):
        duration = float(stamp[-1] - stamp[0]) * 1e-9
    return Overview(
        path=archive.path,
        title=title,
        outcome=ended,
        lost=lost,
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
            for key, text in further.items()
            if key.removeprefix("outcome.") not in _SHOWN_ELSEWHERE
        },
        events=tuple((one.time, one.name, one.text) for one in archive.events[:_MOST_EVENTS]),
        damage=archive.damage,
    )


def _ended(outcome: ArchiveOutcome | None) -> tuple[str, str]:
    """Return sentences on how a recording ended, and on what was lost."""
    if outcome is None:
        return "missing", ""
    reason = f": {outcome.reason}" if outcome.reason else ""
    counts = {
        "lost packets": outcome.lost_packets,
        "records lost": outcome.records_lost,
        "events lost": outcome.events_lost,
        "samples lost": "unknown" if outcome.samples_lost is None else outcome.samples_lost,
    }
    lost = [f"{name} {count}" for name, count in counts.items() if count]
    repaired = ", repaired with loss" if outcome.repaired else ""
    return f"{outcome.outcome}{reason}{repaired}", "; ".join([*lost, *outcome.losses])
