"""What a long run has shown: figures over all its pieces, and what is wrong, in sentences."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Final, TypeVar

import numpy as np
from scipy.stats import mannwhitneyu

from tests.endurance.course import judge_course
from tests.endurance.journal import Piece, Ran, Sample
from tests.endurance.trends import Slope, largest_rise, quantile, slope

Told = TypeVar("Told", Sample, Ran)

PROCESSES: Final = ("exchange", "archive", "supervisor", "controller")
WARM_UP: Final = 300.0
"""s of a piece after which memory is to be flat. The exchange holds 32 MiB of heap in reserve from
its beginning: a leak shows in its memory only when that is used up."""
LONG: Final = 4.0
"""h that a leak is projected to."""
CONFIDENCE: Final = 0.99
SHARE: Final = 0.05
"""Of a process's memory that it may grow by in `LONG`; the upper end of the interval counts."""
SHARES: Final = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999}
RARE: Final = 0.01
"""Chance of one false alarm among all comparisons of first and last blocks."""
BLOCK: Final = 10
"""Minutes at each end of a piece that are compared as well: a change some time before the end shows
there and not in two minutes."""
BUSIER: Final = 0.5
"""By which a load has to be larger to explain that answers are slower."""
BIN: Final = 2.0**0.25
"""Ratio of two latencies that the exchange's own histogram just tells apart."""


@dataclass(frozen=True)
class Minute:
    """One minute of the exchange, and how busy the machine was with whatever."""

    load: float
    answered: int
    missed: int
    late: int
    quantiles: Mapping[str, float]


@dataclass(frozen=True)
class Memory:
    """One process over all pieces: MiB of resident memory at the first and last, MiB/h.

    What grows is judged by memory of its own, behind which is no file. The resident memory also
    grows while the rings between the processes are gone through for the first time, and by no more
    than their size.
    """

    process: str
    first: float
    last: float
    growth: Slope
    rss_growth: Slope
    share: float
    """Of its memory, by which it grows in `LONG` at most (the upper end of the interval)."""
    least: float
    """The same, of the lower end."""


@dataclass(frozen=True)
class Verdict:
    """All figures, and what is wrong."""

    faults: list[str]
    doubts: list[str]
    figures: dict[str, Any]


def minutes_of(piece: Piece) -> list[Minute]:
    """Each full minute of a piece, from samples at its ends."""
    ends: list[Sample] = []
    for sample in piece.samples:
        if not ends or sample.t - ends[-1].t >= 59.0:
            ends.append(sample)
    return [_minute(before, after) for before, after in pairwise(ends)]


def _minute(before: Sample, after: Sample) -> Minute:
    counts = np.subtract(after.latencies, before.latencies)
    counted = {
        name: int(after.counters[name] - before.counters[name])
        for name in ("answered", "missed", "late")
    }
    found = {name: quantile(counts, share) for name, share in SHARES.items()}
    return Minute(load=after.load, quantiles=found, **counted)


def memory_of(pieces: Sequence[Piece], process: str) -> Memory | None:
    """How the memory of a process went after the warm-up; None if it was too short to tell."""
    settled = _settled((piece.samples for piece in pieces), lambda one: process in one.processes)
    if not settled:
        return None
    growth = {
        name: _growth(settled, partial(_mib, process=process, name=name)) for name in ("rss", "own")
    }
    first = settled[0][0].processes[process].rss / 2**20
    last = settled[-1][-1].processes[process].rss / 2**20
    own = growth["own"]
    share, least = LONG * own.high / first, LONG * own.low / first
    return Memory(process, first, last, own, growth["rss"], share, least)


def _mib(sample: Sample, process: str, name: str) -> float:
    return float(getattr(sample.processes[process], name)) / 2**20


def _settled(told: Iterable[Sequence[Told]], tells: Callable[[Told], object]) -> list[list[Told]]:
    """Of each piece what was told after its warm-up and tells something; none of a single one."""
    found = [[one for one in piece if one.t >= WARM_UP and tells(one)] for piece in told]
    return [settled for settled in found if len(settled) >= 2]


def _growth(settled: Sequence[Sequence[Told]], value: Callable[[Told], float]) -> Slope:
    return slope([_by_minute(one, value) for one in settled], CONFIDENCE)


def _by_minute(
    told: Sequence[Told], value: Callable[[Told], float]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Hours, and the median of each minute: a sample is much like the one before."""
    minute = np.array([int(one.t // 60.0) for one in told])
    values = np.array([value(one) for one in told])
    present = np.unique(minute)
    return present / 60.0, np.array([np.median(values[minute == one]) for one in present])


def judge(pieces: Sequence[Piece]) -> Verdict:
    """The verdict over all pieces of a journal."""
    faults: list[str] = []
    doubts: list[str] = []
    figures: dict[str, Any] = {
        "pieces": len(pieces),
        "minutes": round(sum(piece.seconds for piece in pieces) / 60.0, 1),
        "killed": sum(piece.ended is None for piece in pieces),
        "scheduling": sorted({str(piece.begun.get("scheduling")) for piece in pieces}),
        "processor_share": _processor_share(pieces),
    }
    judge_course(pieces, WARM_UP, faults, doubts)
    figures["held"] = _judge_held(pieces, faults)
    figures["memory"] = _judge_memory(pieces, faults, doubts)
    figures["descriptors"] = _judge_descriptors(pieces, faults, doubts)
    figures["archives"] = _judge_archives(pieces, faults)
    figures["latency"] = _judge_latency(pieces, faults, doubts)
    return Verdict(faults, doubts, figures)


def _processor_share(pieces: Sequence[Piece]) -> dict[str, float]:
    """Of one core, by process."""
    spent: Counter[str] = Counter()
    seconds = 0.0
    for piece in pieces:
        if len(piece.samples) < 2:
            continue
        first, last = piece.samples[0], piece.samples[-1]
        seconds += last.t - first.t
        for name in PROCESSES:
            if name in first.processes and name in last.processes:
                spent[name] += last.processes[name].cpu - first.processes[name].cpu  # type: ignore[assignment]
    return {name: round(spent[name] / seconds, 3) for name in spent} if seconds else {}


def _judge_memory(
    pieces: Sequence[Piece], faults: list[str], doubts: list[str]
) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for name in PROCESSES:
        memory = memory_of(pieces, name)
        if memory is None:
            doubts.append(f"memory of the {name}: too short to tell (warm-up is {WARM_UP:g} s)")
            continue
        found[name] = asdict(memory)
        if memory.least > 0.0 and memory.growth.value * LONG / memory.first > SHARE:
            faults.append(
                f"the {name}'s memory grows: {memory.growth.value:.3f} MiB/h "
                f"({memory.growth.low:.3f} to {memory.growth.high:.3f})"
            )
        elif memory.share > SHARE:
            doubts.append(
                f"memory of the {name}: too short to tell, it may grow by "
                f"{memory.share:.0%} in {LONG:g} h"
            )
    return found


def _judge_held(pieces: Sequence[Piece], faults: list[str]) -> dict[str, dict[str, float]]:
    """What the supervisor holds of its memory, per hour: a leak that pages do not show yet."""
    found: dict[str, dict[str, float]] = {}
    for name in ("bytes", "blocks"):
        settled = _settled((piece.campaigns for piece in pieces), partial(_tells, name=name))
        if not settled:
            continue
        growth = _growth(settled, partial(_held, name=name))
        first = _held(settled[0][0], name)
        found[name] = {"first": first, **asdict(growth)}
        if growth.low > 0.0 and growth.value * LONG > SHARE * first:
            faults.append(
                f"what the supervisor holds grows: {growth.value:.0f} {name} an hour "
                f"({growth.low:.0f} to {growth.high:.0f}), of {first:.0f}"
            )
    return found


def _tells(ran: Ran, name: str) -> bool:
    return name in ran.held


def _held(ran: Ran, name: str) -> float:
    return float(ran.held[name])


def _judge_descriptors(
    pieces: Sequence[Piece], faults: list[str], doubts: list[str]
) -> list[dict[str, list[int]]]:
    found = []
    for number, piece in enumerate(pieces, 1):
        idle = [ran.descriptors for ran in piece.campaigns if not ran.stopped]
        if len(idle) < 2:
            doubts.append(f"descriptors in piece {number}: fewer than two campaigns were run")
            continue
        # The exchange keeps the table of the last motion open, or not, as that one ended.
        half = len(idle) // 2
        most = {
            name: [max(one[name] for one in part) for part in (idle[:half], idle[half:])]
            for name in PROCESSES
        }
        found.append(most)
        faults += [
            f"the {name} has {last} descriptors in the second half of piece {number}, {first} in "
            "the first"
            for name, (first, last) in most.items()
            if last > first
        ]
    return found


def _judge_archives(pieces: Sequence[Piece], faults: list[str]) -> dict[str, Any]:
    ran = [one for piece in pieces for one in piece.campaigns]
    outcomes: Counter[str] = Counter()
    for one in ran:
        outcomes.update(one.outcomes)
        faults += [f"campaign {one.number}: {text}" for text in one.faulty]
        moved = one.archives - one.outcomes.get("void", 0)
        if not one.stopped and moved != one.motions:
            faults.append(
                f"campaign {one.number}: {one.motions} motions ended and there are {moved} archives"
            )
        if one.records_lost:
            faults.append(f"campaign {one.number}: {one.records_lost} records lost")
    return {
        "campaigns": len(ran),
        "complete": sum(one.complete for one in ran),
        "given_up": sum(one.given_up for one in ran),
        "restarts": sum(len(one.restarts) for one in ran),
        "motions": sum(one.motions for one in ran),
        "archives": sum(one.archives for one in ran),
        "outcomes": dict(outcomes),
        "records": sum(one.records for one in ran),
    }


def _judge_latency(pieces: Sequence[Piece], faults: list[str], doubts: list[str]) -> dict[str, Any]:
    """Per piece its first and last minute among all, its first and last block; the trend of all."""
    every = [minutes_of(piece) for piece in pieces]
    long_enough = sum(len(minutes) >= 2 * BLOCK for minutes in every)
    if not long_enough:
        doubts.append(f"latency: no piece has {2 * BLOCK} full minutes, too short to tell")
    chance = RARE / (len(SHARES) * max(1, long_enough))
    of_pieces = []
    for number, minutes in enumerate(every, 1):
        if not minutes:
            continue
        compared = {name: _compared(minutes, name) for name in SHARES}
        of_pieces.append(compared)
        if len(minutes) < 2 * BLOCK:
            continue
        for name, one in compared.items():
            _judge_ends(f"piece {number}: {name} of the latency", one, chance, faults, doubts)
    return {
        "pieces": of_pieces,
        "ratio_in_4_h": _trends(every, faults, doubts),
        "minutes": [[asdict(one) for one in minutes] for minutes in every],
        "worst_us": max(
            (s.counters["worst_turnaround_us"] for p in pieces for s in p.samples[-1:]), default=0.0
        ),
        "answered": _summed(every, "answered"),
        "missed": _summed(every, "missed"),
        "late": _summed(every, "late"),
    }


def _compared(minutes: Sequence[Minute], name: str) -> dict[str, float]:
    """First and last minute among all, and first and last block of minutes; µs."""
    scale = [1e6 * one.quantiles[name] for one in minutes]
    block = min(BLOCK, max(1, len(scale) // 2))
    early, late = scale[:block], scale[-block:]
    return {
        "first_us": scale[0],
        "last_us": scale[-1],
        "least_us": min(scale),
        "median_us": float(np.median(scale)),
        "most_us": max(scale),
        "rise_of_others": 2.0 ** largest_rise(np.log2(scale[:-1])),
        "first_load": minutes[0].load,
        "last_load": minutes[-1].load,
        "first_block_us": float(np.median(early)),
        "last_block_us": float(np.median(late)),
        "first_block_load": float(np.median([one.load for one in minutes[:block]])),
        "last_block_load": float(np.median([one.load for one in minutes[-block:]])),
        "block_chance": float(mannwhitneyu(late, early, alternative="greater").pvalue),
    }


def _judge_ends(
    what: str, one: Mapping[str, float], chance: float, faults: list[str], doubts: list[str]
) -> None:
    """A last minute or block slower than the first, by more than minutes differ anyway.

    Of N like minutes the last is at most once in N so much slower than the first that no other two
    show such a rise. The machine is not alone: more load beside it explains slower answers as well.
    """
    minute = one["last_us"] / one["first_us"] > max(BIN, one["rise_of_others"])
    block = one["block_chance"] < chance and one["last_block_us"] > BIN * one["first_block_us"]
    for found, key, words in ((minute, "", "minute"), (block, "_block", f"{BLOCK} minutes")):
        if found:
            busier = one[f"last{key}_load"] > one[f"first{key}_load"] + BUSIER
            (doubts if busier else faults).append(
                f"{what} is {one[f'last{key}_us']:.0f} µs in its last {words} and "
                f"{one[f'first{key}_us']:.0f} µs in its first, at loads of "
                f"{one[f'last{key}_load']:.1f} and {one[f'first{key}_load']:.1f}"
            )


def _trends(
    every: Sequence[Sequence[Minute]], faults: list[str], doubts: list[str]
) -> dict[str, dict[str, float]]:
    """By how much each quantile grows in `LONG`, as a factor; a load that grows explains it."""
    trends = {}
    rises = [_rise_of_load(minutes) for minutes in every if len(minutes) >= 2 * BLOCK]
    busier = bool(rises) and float(np.median(rises)) > BUSIER
    for name in SHARES:
        logs = [np.log2([one.quantiles[name] for one in minutes]) for minutes in every]
        found = slope([(np.arange(len(one)) / 60.0, one) for one in logs], CONFIDENCE)
        factors = {key: _factor(LONG * value) for key, value in asdict(found).items()}
        trends[name] = factors
        long_enough = sum(len(one) for one in logs) >= 2 * BLOCK
        if long_enough and factors["low"] > BIN:
            grows = f"{name} of the latency grows {factors['value']:.2f}-fold in {LONG:g} h"
            if busier:
                doubts.append(f"{grows}, as the load grew by {np.median(rises):.1f}")
            else:
                faults.append(grows)
    return trends


def _rise_of_load(minutes: Sequence[Minute]) -> float:
    """From the first block of a piece to its last."""
    early, late = ([one.load for one in part] for part in (minutes[:BLOCK], minutes[-BLOCK:]))
    return float(np.median(late) - np.median(early))


def _factor(doublings: float) -> float:
    return 2.0**doublings if doublings < 1000.0 else math.inf


def _summed(pieces: Sequence[Sequence[Minute]], name: str) -> int:
    return sum(getattr(one, name) for minutes in pieces for one in minutes)
