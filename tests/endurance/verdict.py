"""Journal of a long run and its verdict: figures of each piece, faults, warnings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from scipy.stats import mannwhitneyu, theilslopes

from drivers.exchange.control import quantile
from tests.journal import entries

PROCESSES: Final = ("exchange", "archive", "supervisor", "controller")
WARM_UP: Final = 300.0
"""s of a piece after which no process may grow any more. The exchange has 32 MiB of heap in reserve
from the start: a leak shows in its memory only when that is used up."""
LONG: Final = 4.0  # h that a leak is projected to
CONFIDENCE: Final = 0.99
SHARE: Final = 0.05  # of a process's memory that it may grow by in `LONG`
SHARES: Final = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999}
BLOCK: Final = 10  # minutes at each end of a piece whose latencies are compared
RARE: Final = 0.01  # chance of one false alarm among all comparisons of blocks
BUSIER: Final = 0.5  # by which a load has to be larger to explain that replies are slower
BIN: Final = 2.0**0.25  # ratio of two latencies that the exchange's own histogram just separates
GIVEN_UP: Final = 0.5
"""Share of a piece's campaigns that may be abandoned in any case."""
NOT_IN_TIME: Final = 0.01
"""Share of a piece's replies that may be missed, or late, in any case; with three times as many the
exchange stops a motion."""
OTHERWISE: Final = 1e-4  # of the replies that may be missed, or late, while no core stalled

Line = dict[str, Any]
"""One line of the journal, as `tests.endurance.piece` writes it."""
Finding = tuple[Literal["faults", "warnings"], str]


@dataclass(frozen=True)
class Piece:
    """One call of the command: lines of its journal."""

    begun: Line
    samples: list[Line] = field(default_factory=list)
    campaigns: list[Line] = field(default_factory=list)
    ended: Line | None = None  # None if it was killed

    @property
    def seconds(self) -> float:
        """How long it was seen to run."""
        return float(self.samples[-1]["t"]) if self.samples else 0.0


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
        elif kind == "link":
            pieces[-1].begun.update(line)
        elif kind == "end":
            pieces[-1] = replace(pieces[-1], ended=line)
        else:
            {"sample": pieces[-1].samples, "campaign": pieces[-1].campaigns}[kind].append(line)

    entries(path, add, "line of a long run's journal")
    return pieces


@dataclass
class Verdict:
    """Figures of each piece, faults, and warnings: what the computer explains or is unknown."""

    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    figures: list[dict[str, Any]] = field(default_factory=list)


def judge(pieces: Sequence[Piece]) -> Verdict:
    """The verdict over all pieces of a journal."""
    verdict = Verdict()
    if not any(piece.campaigns for piece in pieces):
        verdict.faults.append("no campaign was run")
    for number, piece in enumerate(pieces, 1):
        figures = _figures(piece)
        for findings in (
            _ending(piece), _campaigns(piece), _replies(piece), _counts(piece),
            _memory(piece, figures), _latency(piece, figures),
        ):  # fmt: skip
            for kind, text in findings:
                getattr(verdict, kind).append(f"piece {number}: {text}")
        verdict.figures.append(figures)
    return verdict


def _figures(piece: Piece) -> dict[str, Any]:
    ran = piece.campaigns
    return {
        "minutes": round(piece.seconds / 60.0, 1),
        "killed": piece.ended is None,
        "scheduling": piece.begun.get("scheduling"),
        "campaigns": len(ran),
        "complete": sum(one["complete"] for one in ran),
        "given_up": len(_given_up(ran)),
        "restarts": sum(len(one["restarts"]) for one in ran),
        "motions": sum(one["motions"] for one in ran),
        "archives": sum(one["archives"] for one in ran),
        "outcomes": dict(sum((Counter(one["outcomes"]) for one in ran), Counter())),
        "records": sum(one["records"] for one in ran),
        "counters": dict(piece.samples[-1]["counters"]) if piece.samples else {},
    }


def _given_up(ran: Iterable[Line]) -> list[Line]:
    """Campaigns left incomplete without a request to stop."""
    return [one for one in ran if not (one["complete"] or one["stopped"])]


def _ending(piece: Piece) -> Iterator[Finding]:
    if not piece.campaigns and piece.seconds >= WARM_UP:
        yield "faults", f"{piece.seconds:.0f} s without one campaign"
    if piece.ended is None:
        yield "warnings", "no end: it was killed, or it still runs"
    elif (reason := piece.ended.get("reason", "")) not in ("", "interrupted"):
        yield "faults", f"ended early: {reason}"


def _campaigns(piece: Piece) -> Iterator[Finding]:
    """Campaigns that were abandoned or resumed, and archives that are not complete.

    Missed replies end open mode. Stalled cores excuse that; a load does not, as exchange and
    controller have the highest priority.
    """
    ran = piece.campaigns
    for one in ran:
        what, moved = [*one["faulty"]], one["archives"] - one["outcomes"].get("void", 0)
        if not one["stopped"] and moved != one["motions"]:
            what.append(f"{one['motions']} motions ended and there are {moved} archives")
        if one["records_lost"]:
            what.append(f"{one['records_lost']} records lost")
        yield from (("faults", f"campaign {one['number']}: {text}") for text in what)
    given_up = _given_up(ran)
    if len(given_up) > GIVEN_UP * len(ran):
        yield "faults", f"{len(given_up)} of {len(ran)} campaigns were abandoned"
        return
    excused = set(_excused(piece))
    for one in given_up:
        if one["number"] not in excused:
            yield "faults", f"campaign {one['number']} was abandoned, and no core stalled"
    if count := sum(one["number"] in excused for one in given_up):
        yield "warnings", f"{count} of {len(ran)} campaigns were abandoned, as cores stalled"
    calm = [one for one in ran if one["number"] not in excused and one["complete"]]
    if resumed := sum(len(one["restarts"]) for one in calm):
        yield "warnings", f"{resumed} restarts of campaigns, and no core stalled"


def _excused(piece: Piece) -> Iterator[int]:
    """Campaigns in which replies were missed while cores stalled for as long."""
    begun = 0.0
    for one in piece.campaigns:
        samples = [sample for sample in piece.samples if begun <= sample["t"] <= one["t"]]
        begun = one["t"]
        if samples:
            first, last = (samples[k]["counters"]["missed"] for k in (0, -1))
            if last > first and not _otherwise(piece, samples, "missed"):
                yield one["number"]


def _replies(piece: Piece) -> Iterator[Finding]:
    """Replies missed or late: too many, or any without a stall."""
    if not piece.samples:
        return
    counters = piece.samples[-1]["counters"]
    answered = max(1.0, counters["answered"])
    for name in ("missed", "late"):
        if (count := counters[name]) > NOT_IN_TIME * answered:
            yield "faults", f"{count / answered:.1%} of the replies were {name}"
        elif count := _otherwise(piece, piece.samples, name):
            words = f"{count:.0f} of {answered:.0f} replies were {name} while no core stalled"
            yield "faults" if count > OTHERWISE * answered else "warnings", words


def _otherwise(piece: Piece, samples: Sequence[Line], name: str) -> float:
    """How far a counter rose beyond the time, from sample to sample, of stalls.

    A stall costs the cycles that it lasts, and the one in which it begins.
    """
    rate = float(piece.begun.get("rate", 0.0))
    stood = [sample["stalls"] + rate * sample["stood"] for sample in samples]
    rose = [sample["counters"][name] for sample in samples]
    return float(np.maximum(0.0, np.diff(rose) - np.diff(stood)).sum())


def _counts(piece: Piece) -> Iterator[Finding]:
    """Threads and descriptors of each process: more in the second half is growth."""
    settled = [one for one in piece.samples if one["t"] >= WARM_UP]
    idle = [one["descriptors"] for one in piece.campaigns if not one["stopped"]]
    threads = [{name: use["threads"] for name, use in one["processes"].items()} for one in settled]
    for what, each in (("descriptors", idle), ("threads", threads)):
        if len(each) < 2:
            yield "warnings", f"{what}: too short to tell"
            continue
        halves = each[: len(each) // 2], each[len(each) // 2 :]
        for name in PROCESSES:
            before, after = (max(one.get(name, 0) for one in half) for half in halves)
            if after > before:
                words = f"the {name} has {after} {what} in the second half, {before} in the first"
                yield "faults", words


def _memory(piece: Piece, figures: dict[str, Any]) -> Iterator[Finding]:
    """Anonymous memory of each process; resident memory also grows while rings are filled."""
    warm = [one for one in piece.samples if one["t"] >= WARM_UP]
    for name in PROCESSES:
        sizes = [(s["t"], s["processes"][name]["own"]) for s in warm if name in s["processes"]]
        yield from _growth(f"the {name}'s memory", sizes, figures)


def _growth(
    what: str, sizes: Sequence[tuple[float, int]], figures: dict[str, Any]
) -> Iterator[Finding]:
    """A leak, by the medians of minutes: successive samples are correlated."""
    minutes = np.array([int(t // 60.0) for t, _ in sizes])
    values = np.array([value for _, value in sizes], dtype=np.float64)
    present = np.unique(minutes)
    if len(present) < BLOCK:
        yield "warnings", f"{what}: too short to tell (warm-up is {WARM_UP:g} s)"
        return
    medians = [np.median(values[minutes == one]) for one in present]
    found = theilslopes(medians, present / 60.0, CONFIDENCE)
    slope, low, high = (LONG * float(one) / values[0] for one in (found[0], found[2], found[3]))
    figures[what] = {"first": values[0], "growth": slope, "low": low, "high": high}
    words = f"{what} grows by {slope:.1%} in {LONG:g} h ({low:.1%} to {high:.1%})"
    if low > 0.0 and slope > SHARE:
        yield "faults", words
    elif high > SHARE:
        yield "warnings", f"too short to tell whether {words}"


def _latency(piece: Piece, figures: dict[str, Any]) -> Iterator[Finding]:
    """The last minutes against the first ones; a higher load explains slower replies."""
    minutes = list(_minutes(piece))
    if len(minutes) < 2 * BLOCK:
        yield "warnings", f"latency: no {2 * BLOCK} full minutes, too short to tell"
        return
    ends = minutes[:BLOCK], minutes[-BLOCK:]
    loads = [float(np.median([m[0] for m in part])) for part in ends]
    for name in SHARES:
        early, late = ([m[1][name] for m in part] for part in ends)
        first, last = 1e6 * float(np.median(early)), 1e6 * float(np.median(late))
        figures[f"{name} of the latency (µs)"] = {"first": first, "last": last}
        chance = mannwhitneyu(late, early, alternative="greater").pvalue
        if chance < RARE / len(SHARES) and last > BIN * first:
            words = (
                f"{name} of the latency is {last:.0f} µs in the last {BLOCK} minutes and "
                f"{first:.0f} µs in the first, at loads of {loads[1]:.1f} and {loads[0]:.1f}"
            )
            yield "warnings" if loads[1] > loads[0] + BUSIER else "faults", words


def _minutes(piece: Piece) -> Iterator[tuple[float, dict[str, float]]]:
    """Load and quantiles of the latency [s] of each full minute of a piece."""
    last: Line | None = None
    for sample in piece.samples:
        if last is None:
            last = sample
        elif sample["t"] - last["t"] >= 59.0:
            counts = np.subtract(sample["latencies"], last["latencies"]).tolist()
            found = {name: quantile(counts, share) for name, share in SHARES.items()}
            yield sample["load"], {n: math.nan if q is None else q for n, q in found.items()}
            last = sample
