"""All checks and measurements of a PC."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from drivers.child_process import ChildProcess
from drivers.exchange.realtime import RealTimeReport
from hil.base.progress import Reporter

from .checks import DiskTrial, System, computer_checks, disk_checks, link_checks
from .findings import CheckStatus, DoctorCheck, ProbeFailed

if TYPE_CHECKING:
    from drivers.transports.base import TransportSpec

REPLY_RESERVE_SECONDS: Final = 100e-6
"""Part of a cycle for session and guard (20 µs, at most 40), transmission both ways (25 µs each at
100 Mbit/s) and the interrupt of the network card, s."""


@dataclass(frozen=True, eq=False)
class Latency:
    """Latencies (m,) [s], their kind ("wake-up" or "turnaround") and time of measurement [s]."""

    name: str
    samples: NDArray[np.float64]
    seconds: float

    def percentile(self, percent: float) -> float:
        """Return the smallest sample that `percent` of all do not exceed, s."""
        return float(np.percentile(self.samples, percent, method="inverted_cdf"))

    def late_cycles(self, period: float) -> int:
        """Return the number of cycles of `period` s without a reply in time."""
        return int(np.floor((self.samples + REPLY_RESERVE_SECONDS) / period).sum())

    def summary(self) -> dict[str, float | int]:
        """Return percentiles, µs, and late cycles."""
        percentiles = {"p50_us": 50.0, "p99_us": 99.0, "p999_us": 99.9, "max_us": 100.0}
        return {
            **{name: round(1e6 * self.percentile(p), 1) for name, p in percentiles.items()},
            "samples": len(self.samples),
            **{
                f"late_cycles_{cycle}ms": self.late_cycles(cycle / 1000)
                for cycle in JUDGED_CYCLES_MS
            },
        }


JUDGED_CYCLES_MS: Final = (1, 2)
MAX_SHARE_USED: Final = 0.5
"""A cycle is fit if none of the measurement was late, with `REPLY_RESERVE_SECONDS` reserved for
packet work and wire, and 99.9 % of the latencies used at most this share of it."""
MIN_MEASURED_SECONDS: Final = 60.0
"""Time of measurement below which a verdict is provisional, s."""
_CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class CycleEvidence:
    """The latencies that decide on a cycle."""

    worst: str  #: latency with the most late cycles
    seconds: float  #: of its measurement [s]
    longest: float  #: of its samples [s]
    slow: str  #: latency with the largest 99.9 %
    share_used: float  #: by that, plus reserve, of the cycle


@dataclass(frozen=True)
class Fitness:
    """The verdict on one cycle; evidence and bound are None if nothing was measured.

    `late_per_hour_upper_95` is a one-sided 95 % bound for independent late cycles (Poisson).
    """

    cycle_ms: int
    fit: bool
    late_cycles: int
    late_per_hour_upper_95: float | None
    evidence: CycleEvidence | None


def judge(latencies: Sequence[Latency], cycle_ms: int) -> Fitness:
    """Return the verdict by the worst of the latencies; without any the cycle is not fit."""
    if not latencies:
        return Fitness(cycle_ms, False, 0, None, None)
    period = cycle_ms / 1000
    worst = max(latencies, key=lambda each: (each.late_cycles(period), each.percentile(100)))
    slow = max(latencies, key=lambda each: each.percentile(99.9))
    late = worst.late_cycles(period)
    used = (slow.percentile(99.9) + REPLY_RESERVE_SECONDS) / period
    hours = worst.seconds / 3600.0
    # The mean at which a Poisson distribution gives `late` or fewer with 5 % probability.
    bound = float(gammaincinv(late + 1, _CONFIDENCE)) / hours
    longest = float(worst.samples.max())
    evidence = CycleEvidence(worst.name, worst.seconds, longest, slow.name, used)
    return Fitness(cycle_ms, not late and used <= MAX_SHARE_USED, late, bound, evidence)


TURNAROUND_PERIOD = 1e-3
"""Time between two packets, s."""
_PROBE_GRACE = 15.0
"""Time limit of a probe beyond its measurement (start-up on a slow disk), s."""


def realtime_permissions() -> RealTimeReport | None:
    """Return the permissions of a real-time process; None if the probe failed."""
    answer = run_probe(["permissions"], 0.0)
    return None if answer is None else RealTimeReport(**answer)


def disk_trial(folder: Path) -> DiskTrial | None:
    """Measure free space and write times at `folder`; None if the disk did not respond."""
    answer = run_probe(["disk", str(folder)], 0.0)
    return None if answer is None else DiskTrial(**answer)


def measure(name: str, period: float, seconds: float, reporter: Reporter) -> Latency | None:
    """Run a latency probe with a progress bar; None if it failed.

    Args:
        name: `wake-up` or `turnaround`.
        period: of the cycle [s].
        seconds: of the probe.
        reporter: of progress.
    """
    with tempfile.TemporaryDirectory() as folder, reporter.task(name, seconds) as task:
        file = Path(folder) / "latency.npy"
        if run_probe([name, repr(period), repr(seconds), str(file)], seconds, task.advance) is None:
            return None
        return Latency(name, np.load(file).astype(np.float64), seconds)


def run_probe(
    arguments: Sequence[str], seconds: float, advance: Callable[[float], None] = lambda _: None
) -> dict[str, Any] | None:
    """Return the JSON of `hil.doctor.probe` run for `seconds`; None if it failed or was killed."""
    try:
        probe = ChildProcess(("-m", "hil.doctor.probe", *arguments))
    except OSError:
        return None
    began = time.monotonic()
    shown = 0.0
    try:
        while (
            probe.wait(0.2) is None
            and (passed := time.monotonic() - began) < seconds + _PROBE_GRACE
        ):
            advance(min(passed, seconds) - shown)
            shown = min(passed, seconds)
        advance(seconds - shown)
        output = probe.output if probe.status == 0 else ""
    finally:
        probe.kill(1.0)  # one blocked by a dead disk is left behind
        probe.close()
    answer: dict[str, Any] | None = json.loads(output.splitlines()[-1]) if output else None
    return answer


@dataclass(frozen=True)
class Diagnosis:
    """All results: verdicts on 1 and 2 ms and on `cycle_ms`, which must be fit."""

    checks: tuple[DoctorCheck, ...]
    latencies: tuple[Latency, ...]
    cycles: tuple[Fitness, ...]
    cycle_ms: int
    seconds: float

    @property
    def cycle_fit(self) -> bool:
        """Whether the required cycle is fit."""
        return next(each.fit for each in self.cycles if each.cycle_ms == self.cycle_ms)

    @property
    def fit(self) -> bool:
        """Whether the cycle is fit and no check is bad."""
        return self.cycle_fit and not self.bad

    @property
    def bad(self) -> list[DoctorCheck]:
        """Checks that failed."""
        return [check for check in self.checks if check.status is CheckStatus.BAD]

    @property
    def provisional(self) -> bool:
        """Whether the measurement was too short for a reliable verdict."""
        return self.seconds < MIN_MEASURED_SECONDS


def examine(
    link: TransportSpec | None,
    cycle_ms: int,
    seconds: float,
    place: Path,
    reporter: Reporter,
) -> Diagnosis:
    """Run all checks, and measure.

    Args:
        link: to the controller, if any.
        cycle_ms: cycle of the controller [ms].
        seconds: of each of two probes.
        place: where archives will be written.
        reporter: of progress.
    """
    system = System()
    reporter.step("checking this PC; no packet is sent to the controller")
    checks = [
        *computer_checks(realtime_permissions(), system),
        *link_checks(link, system),
        *disk_checks(place, disk_trial(place)),
    ]
    periods = {"wake-up": cycle_ms / 1000, "turnaround": TURNAROUND_PERIOD}
    measured = {name: measure(name, each, seconds, reporter) for name, each in periods.items()}
    checks += [
        DoctorCheck(CheckStatus.BAD, ProbeFailed(name))
        for name, latency in measured.items()
        if latency is None
    ]
    latencies = tuple(latency for latency in measured.values() if latency is not None)
    cycles = tuple(judge(latencies, cycle) for cycle in sorted({*JUDGED_CYCLES_MS, cycle_ms}))
    return Diagnosis(tuple(checks), latencies, cycles, cycle_ms, seconds)
