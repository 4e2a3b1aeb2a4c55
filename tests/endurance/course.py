"""How campaigns, answers and processes fared in each piece: what counts tell, and no trend."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

from tests.endurance.journal import Piece, Sample

GIVEN_UP: Final = 0.5
"""Of the campaigns of a piece that may be given up, whatever stood still: with more of them it has
hardly shown anything."""
QUARTERS: Final = 4
NOT_IN_TIME: Final = 0.01
"""Of the answers of a piece that may be missed, or late, whatever stood still. The exchange stops a
motion that loses 3 of 100: with a third of that all the time next to no motion comes to its end."""
OTHERWISE: Final = 1e-4
"""Of the answers of a piece that may be missed, or late, while no core stood still."""


def judge_course(
    pieces: Sequence[Piece], settled: float, faults: list[str], doubts: list[str]
) -> None:
    """What is wrong with the course of the pieces, and what the machine explains.

    It does where its cores stand still (`tests.endurance.stalls`); no load explains anything, as
    exchange and controller run before whatever else there is to do.

    Args:
        pieces: of a journal.
        settled: s of a piece after which nothing is to be added to a process any more.
        faults: told of what is wrong.
        doubts: told of what the machine explains, or what cannot be determined.
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
        f"piece {number}: campaign {one.number} was given up, and no core stood still"
        for one in given_up
        if one.number not in excused
    ]
    if count := sum(one.number in excused for one in given_up):
        doubts.append(
            f"piece {number}: {count} of {len(piece.campaigns)} campaigns were given up, as cores "
            "stood still"
        )
    calm = [one for one in piece.campaigns if one.number not in excused and one.complete]
    if resumed := sum(len(one.restarts) for one in calm):
        doubts.append(f"piece {number}: {resumed} restarts of campaigns, and no core stood still")


def _excused_campaigns(piece: Piece) -> Iterator[int]:
    """Numbers of the campaigns in which answers were missed, and cores stood still for as long."""
    begun = 0.0
    for one in piece.campaigns:
        samples = [sample for sample in piece.samples if begun <= sample.t <= one.t]
        begun = one.t
        if not samples:
            continue
        missed = samples[-1].counters["missed"] - samples[0].counters["missed"]
        if missed and not _otherwise(piece, samples, "missed"):
            yield one.number


def _judge_answers(number: int, piece: Piece, faults: list[str], doubts: list[str]) -> None:
    """Answers that were missed or late: too many, or any while no core stood still."""
    if not piece.samples:
        return
    counters = piece.samples[-1].counters
    answered = max(1.0, counters["answered"])
    for name in ("missed", "late"):
        if (count := counters[name]) > NOT_IN_TIME * answered:
            faults.append(f"piece {number}: {count / answered:.1%} of the answers were {name}")
        elif count := _otherwise(piece, piece.samples, name):
            (faults if count > OTHERWISE * answered else doubts).append(
                f"piece {number}: {count:.0f} of {answered:.0f} answers were {name} while no core "
                "stood still"
            )


def _otherwise(piece: Piece, samples: Sequence[Sample], name: str) -> float:
    """How far a counter rose beyond the time, from sample to sample, that cores stood still.

    A stall costs the cycles that it lasts, and the one in which it begins.
    """
    rate = float(piece.begun.get("rate", 0.0))
    return sum(
        max(0.0, after.counters[name] - before.counters[name] - stood)
        for before, after in pairwise(samples)
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
