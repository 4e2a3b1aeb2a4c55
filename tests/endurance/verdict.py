"""The journal of a long run, and what it has shown: figures of each piece, what is wrong."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import mannwhitneyu, theilslopes

from drivers.exchange.control import quantile
from tests.journal import entries

SYNC_EVERY: Final = 60.0  # s between two waits for the disk


@dataclass(frozen=True)
class Use:
    """What a process takes: bytes behind which is no file (swapped ones too), and threads."""

    own: int
    threads: int


@dataclass(frozen=True)
class Sample:
    """One look at everything.

    Attributes:
        stalls, stood: of the machine since the piece began, see `tests.endurance.stalls`, and the s
            that they lasted; 0 where nobody could look.
    """

    t: float  # s since the piece began
    load: float  # average of the machine over a minute
    processes: Mapping[str, Use]  # by name
    shared: int  # files in /dev/shm, of whoever
    counters: Mapping[str, float]  # of the exchange, since it began
    stalls: int = 0
    stood: float = 0.0
    latencies: Sequence[int] = ()  # answers by duration, in the bins of `drivers.exchange.control`


@dataclass(frozen=True)
class Ran:
    """One campaign.

    Attributes:
        stopped: whether it was stopped because the piece was over; otherwise one that is not
            complete was given up after some restarts.
        held: by the supervisor of its memory: bytes of malloc, blocks of Python's own allocator.
    """

    number: int  # in its piece, from 0
    t: float  # s since the piece began, at its end
    complete: bool  # whether everything of its plan was done
    stopped: bool
    restarts: Sequence[str]  # how often it was resumed, with the errors
    motions: int  # that ended on the link meanwhile, as the exchange counted them
    archives: int
    faulty: Sequence[str]  # those that do not keep the archive profile, with what is wrong
    outcomes: Mapping[str, int]  # archives by outcome
    records: int
    records_lost: int  # files, what is in them, and what they say is not
    descriptors: Mapping[str, int]  # open ones by process, with no archive open
    held: Mapping[str, int] = field(default_factory=dict)

    @property
    def given_up(self) -> bool:
        """Whether it was left incomplete, and nobody had asked for that."""
        return not (self.complete or self.stopped)


@dataclass(frozen=True)
class Piece:
    """One call of the command; `ended` is None if it was killed."""

    begun: Mapping[str, Any]
    samples: list[Sample] = field(default_factory=list)
    campaigns: list[Ran] = field(default_factory=list)
    ended: Mapping[str, Any] | None = None

    @property
    def seconds(self) -> float:
        """How long it was seen to run."""
        return self.samples[-1].t if self.samples else 0.0


def read_journal(path: Path) -> list[Piece]:
    """All pieces of a journal; none if there is no such file.

    Args:
        path: of the file; where its name ends in `.xz` it is compressed.

    Raises:
        JournalError: it cannot be read, or a line of it is none of ours.
    """
    pieces: list[Piece] = []
    entries(path, lambda facts: _take(facts, pieces), "line of a long run's journal")
    return pieces


def _take(facts: dict[str, Any], pieces: list[Piece]) -> None:
    """Take a line into the pieces that were read so far."""
    kind = facts.pop("kind")
    if kind == "begin":
        pieces.append(Piece(facts))
    elif kind == "link":
        pieces[-1] = replace(pieces[-1], begun={**pieces[-1].begun, **facts})
    elif kind == "sample":
        used = {name: Use(**use) for name, use in facts.pop("processes").items()}
        pieces[-1].samples.append(Sample(processes=used, **facts))
    elif kind == "campaign":
        pieces[-1].campaigns.append(Ran(**facts))
    elif kind == "end":
        pieces[-1] = replace(pieces[-1], ended=facts)
    else:
        raise KeyError(kind)


PROCESSES: Final = ("exchange", "archive", "supervisor", "controller")
WARM_UP: Final = 300.0
"""s of a piece after which nothing is to be added to a process any more. The exchange holds 32 MiB
of heap in reserve from its beginning: a leak shows in its memory only when that is used up."""
LONG: Final = 4.0  # h that a leak is projected to
CONFIDENCE: Final = 0.99
SHARE: Final = 0.05  # Of a process's memory that it may grow by in `LONG`
SHARES: Final = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999}
BLOCK: Final = 10  # Minutes at each end of a piece whose latencies are compared
RARE: Final = 0.01  # Chance of one false alarm among all comparisons of blocks
BUSIER: Final = 0.5  # By which a load has to be larger to explain that answers are slower
BIN: Final = 2.0**0.25  # Ratio of two latencies that the exchange's own histogram just tells apart
GIVEN_UP: Final = 0.5
"""Of the campaigns of a piece that may be given up, whatever stood still: with more of them it has
hardly shown anything."""
NOT_IN_TIME: Final = 0.01
"""Of the answers of a piece that may be missed, or late, whatever stood still. The exchange stops a
motion that loses 3 of 100: with a third of that all the time next to no motion comes to its end."""
OTHERWISE: Final = 1e-4
"""Of the answers of a piece that may be missed, or late, while no core stood still."""


@dataclass
class Verdict:
    """Figures of each piece, what is wrong, and what the machine explains or nobody can tell."""

    faults: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    figures: list[dict[str, Any]] = field(default_factory=list)


def judge(pieces: Sequence[Piece]) -> Verdict:
    """The verdict over all pieces of a journal."""
    verdict = Verdict()
    if not any(piece.campaigns for piece in pieces):
        verdict.faults.append("no campaign was run")
    for number, piece in enumerate(pieces, 1):
        one = _Judge(piece)
        one.ending()
        one.campaigns()
        one.answers()
        one.counts()
        one.memory()
        one.latency()
        verdict.faults += [f"piece {number}: {text}" for text in one.faults]
        verdict.doubts += [f"piece {number}: {text}" for text in one.doubts]
        verdict.figures.append(one.figures)
    return verdict


class _Judge:
    """Judges one piece.

    The machine explains what goes wrong where its cores stand still (`tests.endurance.stalls`); no
    load does, as exchange and controller run before whatever else there is to do.
    """

    def __init__(self, piece: Piece) -> None:
        self.faults: list[str] = []
        self.doubts: list[str] = []
        ran, samples = piece.campaigns, piece.samples
        outcomes: Counter[str] = Counter()
        for one in ran:
            outcomes.update(one.outcomes)
        counters = samples[-1].counters if samples else {}
        self.figures: dict[str, Any] = {
            "minutes": round(piece.seconds / 60.0, 1),
            "killed": piece.ended is None,
            "scheduling": piece.begun.get("scheduling"),
            "campaigns": len(ran),
            "complete": sum(one.complete for one in ran),
            "given_up": sum(one.given_up for one in ran),
            "restarts": sum(len(one.restarts) for one in ran),
            "motions": sum(one.motions for one in ran),
            "archives": sum(one.archives for one in ran),
            "outcomes": dict(outcomes),
            "records": sum(one.records for one in ran),
            "counters": dict(counters),
        }
        self._piece = piece
        self._settled = [one for one in samples if one.t >= WARM_UP]

    def ending(self) -> None:
        """How the piece ended."""
        piece = self._piece
        if not piece.campaigns and piece.seconds >= WARM_UP:
            self.faults.append(f"{piece.seconds:.0f} s without one campaign")
        if piece.ended is None:
            self.doubts.append("no end: it was killed, or it still runs")
            return
        if (reason := piece.ended.get("reason", "")) not in ("", "interrupted"):
            self.faults.append(f"ended early: {reason}")

    def campaigns(self) -> None:
        """Campaigns that were given up or resumed, and archives that are not whole.

        A controller that misses some answers in a row ends open mode, as it should. Where that is
        not the machine's doing, nothing excuses it.
        """
        ran = self._piece.campaigns
        for one in ran:
            what = [*one.faulty]
            moved = one.archives - one.outcomes.get("void", 0)
            if not one.stopped and moved != one.motions:
                what.append(f"{one.motions} motions ended and there are {moved} archives")
            if one.records_lost:
                what.append(f"{one.records_lost} records lost")
            self.faults += [f"campaign {one.number}: {text}" for text in what]
        given_up = [one for one in ran if one.given_up]
        if len(given_up) > GIVEN_UP * len(ran):
            self.faults.append(f"{len(given_up)} of {len(ran)} campaigns were given up")
            return
        excused = set(self._excused())
        self.faults += [
            f"campaign {one.number} was given up, and no core stood still"
            for one in given_up
            if one.number not in excused
        ]
        if count := sum(one.number in excused for one in given_up):
            self.doubts.append(
                f"{count} of {len(ran)} campaigns were given up, as cores stood still"
            )
        calm = [one for one in ran if one.number not in excused and one.complete]
        if resumed := sum(len(one.restarts) for one in calm):
            self.doubts.append(f"{resumed} restarts of campaigns, and no core stood still")

    def _excused(self) -> Iterator[int]:
        """Campaigns in which answers were missed, and cores stood still for as long."""
        begun = 0.0
        for one in self._piece.campaigns:
            samples = [sample for sample in self._piece.samples if begun <= sample.t <= one.t]
            begun = one.t
            if samples:
                missed = samples[-1].counters["missed"] - samples[0].counters["missed"]
                if missed and not self._otherwise(samples, "missed"):
                    yield one.number

    def answers(self) -> None:
        """Answers that were missed or late: too many, or any while no core stood still."""
        samples = self._piece.samples
        if not samples:
            return
        counters = samples[-1].counters
        answered = max(1.0, counters["answered"])
        for name in ("missed", "late"):
            if (count := counters[name]) > NOT_IN_TIME * answered:
                self.faults.append(f"{count / answered:.1%} of the answers were {name}")
            elif count := self._otherwise(samples, name):
                (self.faults if count > OTHERWISE * answered else self.doubts).append(
                    f"{count:.0f} of {answered:.0f} answers were {name} while no core stood still"
                )

    def _otherwise(self, samples: Sequence[Sample], name: str) -> float:
        """How far a counter rose beyond the time, from sample to sample, that cores stood still.

        A stall costs the cycles that it lasts, and the one in which it begins.
        """
        rate = float(self._piece.begun.get("rate", 0.0))
        return sum(
            max(0.0, after.counters[name] - before.counters[name] - stood)
            for before, after in pairwise(samples)
            for stood in (after.stalls - before.stalls + rate * (after.stood - before.stood),)
        )

    def counts(self) -> None:
        """Threads and descriptors of each process, and files of shared memory.

        More of a process in the second half is growth. The files are of whoever, and those of
        others come and go; what is never given back shows in the fewest of each quarter.
        """
        idle = [one.descriptors for one in self._piece.campaigns if not one.stopped]
        threads = [
            {name: use.threads for name, use in one.processes.items()} for one in self._settled
        ]
        for what, each in (("descriptors", idle), ("threads", threads)):
            if len(each) < 2:
                self.doubts.append(f"{what}: too short to tell")
                continue
            first, second = each[: len(each) // 2], each[len(each) // 2 :]
            for name in PROCESSES:
                before, after = (max(one.get(name, 0) for one in half) for half in (first, second))
                if after > before:
                    self.faults.append(
                        f"the {name} has {after} {what} in the second half, {before} in the first"
                    )
        fewest = [min(part) for part in np.array_split([s.shared for s in self._settled], 4) if
                  len(part)]  # fmt: skip
        if len(fewest) == 4 and all(after > before for before, after in pairwise(fewest)):
            self.faults.append(
                f"files in shared memory grow in number: {', '.join(map(str, fewest))} at least in "
                "the quarters"
            )

    def memory(self) -> None:
        """Memory of each process behind which is no file, and what the supervisor holds of its own.

        The resident memory also grows while the rings between the processes are gone through for
        the first time, and by no more than their size.
        """
        for name in PROCESSES:
            used = [
                (one.t, one.processes[name].own) for one in self._settled if name in one.processes
            ]
            self._growth(f"the {name}'s memory", used)
        for name in ("bytes", "blocks"):
            ran = [
                (one.t, one.held[name])
                for one in self._piece.campaigns
                if one.t >= WARM_UP and name in one.held
            ]
            if ran:  # else it is another C library
                self._growth(f"what the supervisor holds ({name})", ran)

    def _growth(self, what: str, told: Sequence[tuple[float, int]]) -> None:
        """A leak: by the median of each minute, as a sample is much like the one before."""
        minutes = np.array([int(t // 60.0) for t, _ in told])
        values = np.array([value for _, value in told], dtype=np.float64)
        present = np.unique(minutes)
        if len(present) < BLOCK:
            self.doubts.append(f"{what}: too short to tell (warm-up is {WARM_UP:g} s)")
            return
        medians = [np.median(values[minutes == one]) for one in present]
        found = theilslopes(medians, present / 60.0, CONFIDENCE)
        slope, low, high = (LONG * float(one) / values[0] for one in (found[0], found[2], found[3]))
        self.figures[what] = {"first": values[0], "growth": slope, "low": low, "high": high}
        words = f"{what} grows by {slope:.1%} in {LONG:g} h ({low:.1%} to {high:.1%})"
        if low > 0.0 and slope > SHARE:
            self.faults.append(words)
        elif high > SHARE:
            self.doubts.append(f"too short to tell whether {words}")

    def latency(self) -> None:
        """The last minutes against the first ones; more load beside it explains slower answers."""
        minutes = list(minutes_of(self._piece))
        if len(minutes) < 2 * BLOCK:
            self.doubts.append(f"latency: no {2 * BLOCK} full minutes, too short to tell")
            return
        loads = [float(np.median([m[0] for m in part])) for part in _ends(minutes)]
        for name in SHARES:
            early, late = ([m[1][name] for m in part] for part in _ends(minutes))
            first, last = 1e6 * float(np.median(early)), 1e6 * float(np.median(late))
            self.figures[f"{name} of the latency (µs)"] = {"first": first, "last": last}
            chance = mannwhitneyu(late, early, alternative="greater").pvalue
            if chance < RARE / len(SHARES) and last > BIN * first:
                busier = loads[1] > loads[0] + BUSIER
                (self.doubts if busier else self.faults).append(
                    f"{name} of the latency is {last:.0f} µs in the last {BLOCK} minutes and "
                    f"{first:.0f} µs in the first, at loads of {loads[1]:.1f} and {loads[0]:.1f}"
                )


def _ends(minutes: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
    return minutes[:BLOCK], minutes[-BLOCK:]


def minutes_of(piece: Piece) -> Iterator[tuple[float, dict[str, float]]]:
    """Load and quantiles of the latency [s] of each full minute of a piece."""
    last: Sample | None = None
    for sample in piece.samples:
        if last is None:
            last = sample
        elif sample.t - last.t >= 59.0:
            counts = np.subtract(sample.latencies, last.latencies).tolist()
            found = {name: quantile(counts, share) for name, share in SHARES.items()}
            yield sample.load, {n: math.nan if q is None else q for n, q in found.items()}
            last = sample
