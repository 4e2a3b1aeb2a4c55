"""How campaigns, answers and processes fared in each piece: what counts tell, and no trend."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from tests.endurance.journal import Piece, Sample

GIVEN_UP: Final = 0.5
"""Of the campaigns of a piece that may be given up at whatever load: with more of them it has
hardly shown anything."""
QUARTERS: Final = 4
NOT_IN_TIME: Final = 0.01
"""Of the answers of a piece that may be missed, or late, at whatever load. The exchange stops a
motion that loses 3 of 100: with a third of that all the time next to no motion comes to its end."""


def judge_course(
    pieces: Sequence[Piece], settled: float, faults: list[str], doubts: list[str]
) -> None:
    """What is wrong with the course of the pieces, and what the machine explains.

    It does where processes wait for a core, and where cores stand still (`tests.endurance.stalls`).

    Args:
        pieces: of a journal.
        settled: s of a piece after which nothing is to be added to a process any more.
        faults: told of what is wrong.
        doubts: told of what the machine explains, or what cannot be told.
    """
    if not any(piece.campaigns for piece in pieces):
        faults.append("no campaign was run")
    for number, piece in enumerate(pieces, 1):
        if not piece.campaigns and piece.seconds >= settled:
            faults.append(f"piece {number} ran for {piece.seconds:.0f} s without one campaign")
        _judge_end(number, piece, faults, doubts)
        _judge_campaigns(number, piece, faults, doubts)
        _judge_answers(number, piece, faults, doubts)
        _judge_growth(number, piece, settled, faults, doubts)


def _judge_end(number: int, piece: Piece, faults: list[str], doubts: list[str]) -> None:
    """How the piece and its supervisor ended."""
    if piece.ended is None:
        doubts.append(f"piece {number} has no end: it was killed, or it still runs")
        return
    if (reason := piece.ended.get("reason", "")) not in ("", "interrupted"):
        faults.append(f"piece {number} ended early: {reason}")
    status = piece.ended.get("supervisor")
    if status is None:
        faults.append(f"the supervisor of piece {number} did not end by itself")
    elif status:
        faults.append(f"the supervisor of piece {number} ended with exit status {status}")


def _judge_campaigns(number: int, piece: Piece, faults: list[str], doubts: list[str]) -> None:
    """Campaigns that were given up or resumed.

    A controller that misses some answers in a row ends open mode, as it should. Where that is not
    the machine's doing, nothing excuses it.
    """
    given_up = [one for one in piece.campaigns if one.given_up]
    if len(given_up) > GIVEN_UP * len(piece.campaigns):
        faults.append(
            f"piece {number}: {len(given_up)} of {len(piece.campaigns)} campaigns were given up"
        )
        return
    excused = set(_excused_campaigns(piece))
    faults += [
        f"piece {number}: campaign {one.number} was given up, without any load or stall"
        for one in given_up
        if one.number not in excused
    ]
    if count := sum(one.number in excused for one in given_up):
        doubts.append(
            f"piece {number}: {count} of {len(piece.campaigns)} campaigns were given up while "
            "the machine had more to do than it has cores, or stood still"
        )
    calm = [one for one in piece.campaigns if one.number not in excused and one.complete]
    if resumed := sum(len(one.restarts) for one in calm):
        doubts.append(f"piece {number}: {resumed} restarts of campaigns without any load or stall")


def _excused_campaigns(piece: Piece) -> Iterator[int]:
    """Numbers of the campaigns that were disturbed by the machine, and by nothing else.

    It had more to do than it has cores; or answers were missed, none of which is unexplained.
    """
    begun = 0.0
    for one in piece.campaigns:
        samples = [sample for sample in piece.samples if begun <= sample.t <= one.t]
        begun = one.t
        if not samples:
            continue
        crowded = np.median([sample.load for sample in samples]) > cores(piece)
        missed = samples[-1].counters["missed"] - samples[0].counters["missed"]
        if crowded or (missed and not _unexplained(piece, samples, "missed")):
            yield one.number


def cores(piece: Piece) -> float:
    """Of the machine; if that is not known, no load explains anything."""
    count = str(piece.begun.get("machine", "")).partition(" ")[0]
    return float(count) if count.isdigit() else float("inf")


def _judge_answers(number: int, piece: Piece, faults: list[str], doubts: list[str]) -> None:
    """Answers that were missed or late: too many, or any that the machine does not explain."""
    if not piece.samples:
        return
    counters = piece.samples[-1].counters
    answered = max(1.0, counters["answered"])
    for name in ("missed", "late"):
        count = counters[name]
        if count > NOT_IN_TIME * answered:
            faults.append(f"piece {number}: {count / answered:.1%} of the answers were {name}")
        elif rest := _unexplained(piece, piece.samples, name):
            doubts.append(f"piece {number}: {rest:.0f} answers were {name} without load or stall")


def _unexplained(piece: Piece, samples: Sequence[Sample], name: str) -> float:
    """How far a counter rose while no process waited for a core, and no core stood still so long.

    A stall costs the cycles that it lasts, and the one in which it begins.
    """
    most, rate = cores(piece), float(piece.begun.get("rate", 0.0))
    return sum(
        max(0.0, after.counters[name] - before.counters[name] - stood)
        for before, after in pairwise(samples)
        if max(before.load, after.load) <= most
        for stood in (after.stalls - before.stalls + rate * (after.stood - before.stood),)
    )


def _judge_growth(
    number: int, piece: Piece, settled: float, faults: list[str], doubts: list[str]
) -> None:
    """Threads of each process, and files of shared memory, once everything has settled.

    Threads are counted by process: more in the second half is growth. The files are of whoever, and
    those of others come and go; what is never given back shows in the fewest of each quarter.
    """
    samples = [sample for sample in piece.samples if sample.t >= settled]
    if len(samples) < QUARTERS:
        doubts.append(f"threads and shared memory in piece {number}: too short to tell")
        return
    halves = samples[: len(samples) // 2], samples[len(samples) // 2 :]
    for name in sorted(samples[-1].processes):
        first, last = (max(_threads(half, name), default=0) for half in halves)
        if last > first:
            faults.append(
                f"the {name} has {last} threads in the second half of piece {number}, {first} in "
                "the first"
            )
    ends = [len(samples) * k // QUARTERS for k in range(QUARTERS + 1)]
    fewest = [min(one.shared for one in samples[i:j]) for i, j in pairwise(ends)]
    if all(after > before for before, after in pairwise(fewest)):
        faults.append(
            f"files in shared memory grow in number: {', '.join(map(str, fewest))} at least in "
            f"the quarters of piece {number}"
        )


def _threads(samples: Sequence[Sample], name: str) -> list[int]:
    return [sample.processes[name].threads for sample in samples if name in sample.processes]
