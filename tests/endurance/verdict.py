"""Verdict on the journal of a long run: figures, faults, and warnings where it was too short."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.exchange.control import quantile
from tests.journal import entries
from tests.laws.archives import nothing_lost

PROCESSES: Final = ("exchange", "archive", "supervisor", "controller")
BLOCK: Final = 10 * 60.0  # s at the beginning, after a warm-up of half of it, and at the end
GROWTH: Final = 0.05  # of the memory of a process from the first block to the last
SLOWER: Final = 1.5  # ratio of the latencies of the last block and the first
SHARES: Final = {"p50": 0.5, "p99": 0.99}
NOT_IN_TIME: Final = 0.01
"""Share of the replies that may be missed, or late: stalls of a busy computer. With three times as
many the exchange stops a motion."""

Line = dict[str, Any]
"""One line of the journal, as `tests.endurance.__main__` writes it."""


@dataclass(frozen=True)
class Piece:
    """One call of the command: lines of its journal."""

    begun: Line
    samples: list[Line] = field(default_factory=list)
    campaigns: list[Line] = field(default_factory=list)
    ended: list[Line] = field(default_factory=list)  # none if it was killed


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
        verdict.faults += [f"piece {number}: {text}" for text in _faults(piece)]
        long = piece.samples and piece.samples[-1]["t"] >= 3 * BLOCK
        growth = _growth(piece) if long else ()
        verdict.faults += [f"piece {number}: {text}" for text in growth]
        if not long:
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


def _faults(piece: Piece) -> Iterator[str]:
    """Yield what must not happen, however long the piece was."""
    for end in piece.ended:
        if end["reason"] not in ("", "interrupted"):
            yield f"ended early: {end['reason']}"
    for campaign in piece.campaigns:
        what, moved = (
            [*campaign["faulty"]],
            campaign["archives"] - campaign["outcomes"].get("void", 0),
        )
        if not campaign["complete"] and not campaign["stopped"]:
            what.append(f"abandoned after {campaign['restarts']}")
        if not campaign["stopped"] and moved != campaign["motions"]:
            what.append(f"{campaign['motions']} motions ended and there are {moved} archives")
        what += nothing_lost(campaign["records_lost"])
        yield from (f"campaign {campaign['number']}: {text}" for text in what)
    if piece.samples:
        counters = piece.samples[-1]["counters"]
        for name in ("missed", "late"):
            if counters[name] > NOT_IN_TIME * max(1, counters["replied"]):
                yield f"{counters[name]} of {counters['replied']} replies were {name}"


def _growth(piece: Piece) -> Iterator[str]:
    """Yield memory, threads, descriptors and latencies that grew from the first block to the last.

    The exchange has 32 MiB of heap in reserve from the start: a leak shows in its memory only when
    that is used up.
    """
    samples, over = piece.samples, piece.samples[-1]["t"]
    first = [sample for sample in samples if 0.5 * BLOCK <= sample["t"] < 1.5 * BLOCK]
    last = [sample for sample in samples if sample["t"] >= over - BLOCK]
    for name in PROCESSES:
        memory, threads = (
            [[sample["processes"][name][what] for sample in block] for block in (first, last)]
            for what in ("memory", "threads")
        )
        before, after = map(float, map(np.median, memory))
        if after > (1.0 + GROWTH) * before:
            yield f"the {name}'s memory grew from {before:.3g} to {after:.3g} bytes"
        if max(threads[1]) > max(threads[0]):
            yield f"the {name} has {max(threads[1])} threads, {max(threads[0])} at the beginning"
        idle = [
            campaign["descriptors"][name] for campaign in piece.campaigns if not campaign["stopped"]
        ]
        early, late = (max(half, default=0) for half in np.array_split(idle, 2))
        if late > early > 0:
            yield f"the {name} has {late} descriptors, {early} in the first half"
    for name, share in SHARES.items():
        before, after = (
            quantile(np.subtract(block[-1]["latencies"], block[0]["latencies"]).tolist(), share)
            or math.inf
            for block in (first, last)
        )
        if after > SLOWER * before:
            yield f"{name} of the latency grew from {1e6 * before:.0f} to {1e6 * after:.0f} µs"
