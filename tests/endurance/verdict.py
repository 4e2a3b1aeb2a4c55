"""Verdict on the journal of a long run: figures, faults, and warnings where it was too short."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.endurance.piece import Line, Piece
from tests.journal import entries
from tests.laws.evidence import Evidence
from tests.laws.table import broken


@dataclass
class Verdict:
    """Figures of each piece, faults, and warnings."""

    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    figures: list[Line] = field(default_factory=list)


def read_journal(path: Path) -> list[Piece]:
    """Return all pieces of a journal; none without the file.

    Raises:
        JournalError: it cannot be read, or has another line.
    """
    pieces: list[Piece] = []

    def add(line: Line) -> None:
        kind = line.pop("kind")
        if kind == "begin":
            pieces.append(Piece(line))
        else:
            last = pieces[-1]
            {"sample": last.samples, "campaign": last.campaigns, "end": last.ended}[kind].append(
                line
            )

    entries(path, add, "line of a long run's journal")
    return pieces


def judge(pieces: Sequence[Piece]) -> Verdict:
    """Return the verdict over all pieces of a journal."""
    verdict = Verdict()
    if not any(piece.campaigns for piece in pieces):
        verdict.faults.append("no campaign was run")
    for number, piece in enumerate(pieces, 1):
        verdict.figures.append(_figures(piece))
        violations = broken(Evidence(piece=piece))
        verdict.faults += [f"piece {number}: {violation.text}" for violation in violations]
        if not piece.is_long:
            verdict.warnings.append(f"piece {number}: too short to show growth")
        if not piece.ended:
            verdict.warnings.append(f"piece {number}: it was killed, or is still running")
    return verdict


def _figures(piece: Piece) -> Line:
    ran = piece.campaigns
    counters = piece.samples[-1]["counters"] if piece.samples else {}
    return {
        "minutes": round(piece.samples[-1]["t"] / 60.0, 1) if piece.samples else 0.0,
        "campaigns": len(ran),
        "complete": sum(campaign["complete"] for campaign in ran),
        "restarts": sum(len(campaign["restarts"]) for campaign in ran),
        "outcomes": dict(sum((Counter(campaign["outcomes"]) for campaign in ran), Counter())),
        **{
            name: sum(campaign[name] for campaign in ran)
            for name in ("motions", "archives", "records")
        },
        **counters,
    }
