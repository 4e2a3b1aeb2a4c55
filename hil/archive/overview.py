"""What an archive holds, for a person to read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from hil.archive.header import WORDS, ArchiveHeader, ArchiveOutcome, motion_name
from hil.archive.reader import Archive, open_archive
from hil.archive.repair import survey

_MOST_EVENTS = 20
_SHOWN_ELSEWHERE = frozenset(
    ("kind", "index", "attempt", "joint_names", "period", "attachments", "outcome", "reason")
)


@dataclass(frozen=True)
class Overview:
    """What an archive holds.

    Attributes:
        path: the file.
        title: kind, index and attempt.
        outcome: how it ended, and why.
        lost: what the link or this PC lost, "" where nothing.
        samples: how many can be read.
        duration: from the first to the last [s].
        period: cycle [s], None where it is not fixed.
        joint_names: in the order of the columns.
        size: of the file in bytes.
        per_minute: bytes for a minute of motion, None without samples.
        chunks: how many stand.
        channels: topic, type and number of messages.
        attachments: bytes by name.
        metadata: the other entries.
        events: time [s], kind and text of the first ones.
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
        """As JSON holds it."""
        entries = asdict(self)
        return {"file": str(entries.pop("path")), "archive": True, **entries}


def overview(path: str | PathLike[str]) -> Overview:
    """Look into an archive.

    Raises:
        NotAnArchiveError: another kind of file.
        ArchiveError: it cannot be read.
    """
    archive = open_archive(path, fields=())
    found = survey(path)
    stamp = archive.columns["stamp"]
    duration = float(stamp[-1] - stamp[0]) * 1e-9 if len(stamp) else 0.0
    return Overview(
        path=archive.path,
        title=_title(archive.header),
        outcome=_outcome(archive),
        lost="" if archive.outcome is None else _lost(archive.outcome),
        samples=archive.n_samples,
        duration=duration,
        period=archive.period,
        joint_names=archive.joint_names,
        size=found.size,
        per_minute=found.size / duration * 60.0 if duration else None,
        chunks=found.chunks,
        channels=tuple(
            (topic, getattr(found.parser.known.schema(topic), "name", ""), count)
            for topic, count in sorted(found.counts.items())
        ),
        attachments={name: len(data) for name, data in archive.attachments.items()},
        metadata=_further(archive),
        events=tuple(
            (event.time, event.name, event.text) for event in archive.events[:_MOST_EVENTS]
        ),
        damage=None if archive.damage is None else str(archive.damage),
    )


def _title(header: ArchiveHeader) -> str:
    if header.index is None:
        return WORDS.get(header.kind, header.kind)
    attempt = 1 if header.attempt is None else header.attempt
    return f"{motion_name(header.kind, header.index)}, attempt {attempt}"


def _outcome(archive: Archive) -> str:
    if archive.outcome is None:
        return "missing"
    word, reason = archive.outcome.outcome, archive.outcome.reason
    repaired = ", repaired with loss" if archive.outcome.repaired else ""
    return f"{word}: {reason}{repaired}" if reason else f"{word}{repaired}"


def _lost(outcome: ArchiveOutcome) -> str:
    counts = {
        "lost packets": outcome.lost_packets,
        "records lost": outcome.records_lost,
        "events lost": outcome.events_lost,
        "samples lost": "unknown" if outcome.samples_lost is None else outcome.samples_lost,
    }
    lost = [f"{name} {count}" for name, count in counts.items() if count]
    return "; ".join([*lost, *outcome.losses])


def _further(archive: Archive) -> dict[str, str]:
    entries = {
        key: value for key, value in archive.header.entries.items() if key not in _SHOWN_ELSEWHERE
    }
    outcome = {} if archive.outcome is None else archive.outcome.entries
    entries |= {
        f"outcome.{key}": value for key, value in outcome.items() if key not in _SHOWN_ELSEWHERE
    }
    return entries
