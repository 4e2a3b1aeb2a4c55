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
    """What is wrong with the course of the pieces, and what only the machine's load explains.

    Args:
        pieces: of a journal.
        settled: s of a piece after which nothing is to be added to a process any more.
        faults: told of what is wrong.
        doubts: told of what load explains, or what cannot be told.
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

    A controller that misses some answers in a row ends open mode, as it should. Where processes
    wait for a core, that is the machine's doing; where none does, nothing excuses it.
    """
    given_up = [one for one in piece.campaigns if one.given_up]
    if len(given_up) > GIVEN_UP * len(piece.campaigns):
        faults.append(
            f"piece {number}: {len(given_up)} of {len(piece.campaigns)} campaigns were given up"
        )
        return
    crowded = set(_crowded_campaigns(piece))
    faults += [
        f"piece {number}: campaign {one.number} was given up, without any load"
        for one in given_up
        if one.number not in crowded
    ]
    if excused := sum(one.number in crowded for one in given_up):
        doubts.append(
            f"piece {number}: {excused} of {len(piece.campaigns)} campaigns were given up while "
            "the machine had more to do than it has cores"
        )
    quiet = [one for one in piece.campaigns if one.number not in crowded and one.complete]
    if resumed := sum(len(one.restarts) for one in quiet):
        doubts.append(f"piece {number}: {resumed} restarts of campaigns without any load")


def _crowded_campaigns(piece: Piece) -> Iterator[int]:
    """Numbers of the campaigns during which the machine had more to do than it has cores."""
    begun = 0.0
    for one in piece.campaigns:
        load = [sample.load for sample in piece.samples if begun <= sample.t <= one.t]
        begun = one.t
        if load and np.median(load) > cores(piece):
            yield one.number


def cores(piece: Piece) -> float:
    """Of the machine; if that is not known, no load explains anything."""
    count = str(piece.begun.get("machine", "")).partition(" ")[0]
    return float(count) if count.isdigit() else float("inf")


def _judge_answers(number: int, piece: Piece, faults: list[str], doubts: list[str]) -> None:
    """Answers that were missed or late: too many, or any of them without load."""
    if not piece.samples:
        return
    counters = piece.samples[-1].counters
    answered = max(1.0, counters["answered"])
    for name in ("missed", "late"):
        count = counters[name]
        if count > NOT_IN_TIME * answered:
            faults.append(f"piece {number}: {count / answered:.1%} of the answers were {name}")
        elif calm := _without_load(piece, name):
            doubts.append(f"piece {number}: {calm:.0f} answers were {name} without any load")


def _without_load(piece: Piece, name: str) -> float:
    """How far a counter rose between samples at which no process had to wait for a core."""
    most = cores(piece)
    return sum(
        after.counters[name] - before.counters[name]
        for before, after in pairwise(piece.samples)
        if max(before.load, after.load) <= most
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
