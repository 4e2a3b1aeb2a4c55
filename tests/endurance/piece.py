"""A piece of a long run, and the laws of it: nothing is lost or late, and nothing grows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from drivers.exchange.control import quantile
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

    @property
    def is_long(self) -> bool:
        """Whether it is long enough to show growth."""
        return bool(self.samples) and self.samples[-1]["t"] >= 3 * BLOCK


def faults(piece: Piece) -> Iterator[str]:
    """Yield what must not happen, however long the piece was."""
    for end in piece.ended:
        if end["reason"] not in ("", "interrupted"):
            yield f"ended early: {end['reason']}"
    for campaign in piece.campaigns:
        what = [*campaign["faulty"]]
        moved = campaign["archives"] - campaign["outcomes"].get("void", 0)
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


def growth(piece: Piece) -> Iterator[str]:
    """Yield memory, threads, descriptors and latencies that grew from the first block to the last.

    The exchange has 32 MiB of heap in reserve from the start: a leak shows in its memory only when
    that is used up.
    """
    if not piece.is_long:
        return
    samples = piece.samples
    over = piece.samples[-1]["t"]
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


LAWS: Final = {"a long run loses nothing": faults, "a long run does not grow": growth}
"""By name, of a piece of a long run (`tests.laws.table`)."""
