"""Check of an archive by the rules that readers and repairs follow, and its overview."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import Any

from hil.archive.header import (
    FORMAT_VERSION,
    KIND_NAMES,
    KINDS,
    REJECTED,
    ArchiveName,
    ArchiveOutcome,
    is_supported,
    motion_name,
)
from hil.archive.reader import Archive, open_archive, scan_archive, scan_file
from hil.archive.repair import is_intact
from hil.archive.scan import Scan
from hil.base.errors import InputError

OUTCOMES = ("completed", REJECTED, "stopped", "refused", "lost", "void", "interrupted", "unknown")


@dataclass(frozen=True)
class ArchiveCheck:
    """Result of a check: a sentence for each fault; samples that can be read.

    `repaired` is whether the outcome states a repair with loss.
    """

    path: Path
    version: str
    faults: tuple[str, ...]
    samples: int
    repaired: bool

    @property
    def conforms(self) -> bool:
        """Whether the file has no fault."""
        return not self.faults


def check_archive(path: str | PathLike[str]) -> ArchiveCheck:
    """Check whether all of a file can be used; ArchiveError if it is no archive or unreadable."""
    path = Path(path)
    scan = scan_file(path, all_channels=True)
    if scan.metadata is None:
        open_archive(path, fields=())  # raises with the reason
    faults = [*_entry_faults(path, scan)]
    if scan.header is not None:
        faults += scan.faults
    if not faults and not is_intact(path, scan):
        faults.append("the message indexes or the summary do not fit the content")
    return ArchiveCheck(
        path=path,
        version=(scan.metadata or {}).get("format_version", ""),
        faults=tuple(faults),
        samples=scan.samples,
        repaired=scan.outcome is not None and scan.outcome.repaired,
    )


def _entry_faults(path: Path, scan: Scan) -> Iterator[str]:
    """Yield the faults of the entries of header and outcome."""
    entries = scan.metadata or {}
    if not is_supported(entries):
        yield f"format_version is {entries.get('format_version')!r}, known is '{FORMAT_VERSION}'"
        return
    kind = entries.get("kind", "")
    if kind not in KINDS:
        yield f"kind is {kind!r}, not one of {', '.join(KINDS)}"
    if scan.header_error is not None:
        problems = scan.header_error.problems.items()
        yield from (f"{name} {problem}" for name, problem in problems)
    if "period" not in entries and kind != "imported":
        yield "period is missing"
    name = ArchiveName.parse(path)
    for key, value in (name.metadata() if name else {}).items():
        if entries.get(key) != value:
            yield f"{key} is {entries.get(key)!r}, but {value!r} in the file name"
    if scan.outcome is not None and scan.outcome.outcome not in OUTCOMES:
        yield f"outcome is {scan.outcome.outcome!r}, not one of {', '.join(OUTCOMES)}"


def archive_files(paths: Sequence[Path]) -> list[Path]:
    """Return files, and all archives of folders; of a campaign the ones in its `archives`.

    Raises:
        InputError: a folder has none.
    """
    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        inside = sorted(path.glob("*.mcap")) or sorted(path.glob("archives/*.mcap"))
        if not inside:
            problem = "has no archive (*.mcap) in it, and none in its folder archives"
            raise InputError(path, problem, remedy="give an archive, or a folder of them")
        files += inside
    return files


_MAX_SHOWN_EVENTS = 20
_SHOWN_ELSEWHERE = frozenset(
    (
        "kind", "index", "attempt", "joint_names", "period", "attachments", "outcome", "reason",
        "recorded_at",
    )
)  # fmt: skip
_DATES = range(946_684_800, 4_102_444_800)
"""Seconds since 1970 of the years 2000 to 2100; other clocks do not count the time of day."""


@dataclass(frozen=True)
class Overview:
    """Overview of an archive, as `hil archive info` prints it; times in s, sizes in bytes.

    Attributes:
        recorded: time of day of the recording, ISO 8601; None if it is not known.
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
    recorded: str | None
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
    archive, scan = scan_archive(path, all_channels=True)
    header = archive.header
    stamp = archive.columns["stamp"]
    outcome = archive.outcome or ArchiveOutcome(outcome="missing")
    entries = {**header.entries, **{f"outcome.{k}": text for k, text in outcome.entries.items()}}
    title = KIND_NAMES.get(header.kind, header.kind)
    duration = 0.0
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
        recorded=recording_date(archive),
        title=title,
        outcome=f"{outcome.outcome}: {outcome.reason}" if outcome.reason else outcome.outcome,
        lost="; ".join([*(f"{k} {n}" for k, n in counts.items() if n), *outcome.losses]),
        samples=archive.n_samples,
        duration=duration,
        period=archive.period,
        joint_names=archive.joint_names,
        size=scan.size,
        per_minute=scan.size / duration * 60.0 if duration else None,
        chunks=scan.chunks,
        channels=tuple(
            (topic, getattr(scan.parser.schema(topic), "name", ""), count)
            for topic, count in sorted(scan.counts.items())
        ),
        attachments={name: len(data) for name, data in archive.attachments.items()},
        metadata={
            key: text
            for key, text in entries.items()
            if key.removeprefix("outcome.") not in _SHOWN_ELSEWHERE
        },
        events=tuple(
            (event.time, event.name, event.text) for event in archive.events[:_MAX_SHOWN_EVENTS]
        ),
        damage=archive.damage,
    )


def recording_date(archive: Archive) -> str | None:
    """Return the date of a recording, ISO 8601; None if neither header nor clock have it.

    Clocks of imported recordings that count from 1970 have it.
    """
    header = archive.header
    stamp = archive.columns["stamp"]
    if header.recorded_at is not None or header.kind != "imported":
        return header.recorded_at
    try:
        origin = int(header.entries.get("clock_origin_ns", "0"))
    except ValueError:
        return None
    seconds = (origin + int(stamp[0])) // 10**9 if len(stamp) else 0
    return datetime.fromtimestamp(seconds, UTC).isoformat() if seconds in _DATES else None
