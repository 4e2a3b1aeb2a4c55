"""What an archive holds, for a person to read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from hil.archive import container, foreign_json
from hil.archive.names import WORDS, motion_name
from hil.archive.reader import Archive, open_archive
from hil.archive.survey import survey
from hil.whole_number import whole_number

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
        title=_title(archive.metadata),
        outcome=_outcome(archive),
        lost=_lost(archive.outcome or {}),
        samples=archive.n_samples,
        duration=duration,
        period=archive.period,
        joint_names=archive.joint_names,
        size=found.size,
        per_minute=found.size / duration * 60.0 if duration else None,
        chunks=sum(piece.opcode == container.CHUNK for piece in found.pieces),
        channels=tuple(
            (topic, found.types.get(topic, ""), count)
            for topic, count in sorted(found.counts.items())
        ),
        attachments={name: len(data) for name, data in archive.attachments.items()},
        metadata=_further(archive),
        events=tuple(
            (event.time, event.name, event.text) for event in archive.events[:_MOST_EVENTS]
        ),
        damage=None if archive.damage is None else str(archive.damage),
    )


def _title(metadata: Mapping[str, str]) -> str:
    kind, index = metadata["kind"], whole_number(metadata.get("index"))
    if index is None:
        return WORDS.get(kind, kind)
    return f"{motion_name(kind, index)}, attempt {metadata.get('attempt', '1')}"


def _outcome(archive: Archive) -> str:
    outcome = archive.outcome
    if outcome is None:
        return "missing"
    word, reason = outcome.get("outcome", "missing"), outcome.get("reason", "")
    repaired = ", repaired with loss" if "repaired" in outcome else ""
    return f"{word}: {reason}{repaired}" if reason else f"{word}{repaired}"


def _lost(outcome: Mapping[str, str]) -> str:
    counted = ("lost_packets", "records_lost", "events_lost", "repaired.samples_lost")
    words = [
        f"{key.removeprefix('repaired.').replace('_', ' ')} {outcome[key]}"
        for key in counted
        if outcome.get(key, "0") != "0"
    ]
    if "repaired.losses" in outcome:
        words += foreign_json.names(outcome["repaired.losses"]) or ()
    return "; ".join(words)


def _further(archive: Archive) -> dict[str, str]:
    entries = {key: value for key, value in archive.metadata.items() if key not in _SHOWN_ELSEWHERE}
    entries |= {
        f"outcome.{key}": value
        for key, value in (archive.outcome or {}).items()
        if key not in _SHOWN_ELSEWHERE
    }
    return entries
