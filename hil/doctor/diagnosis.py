"""All checks and measurements of a PC; output as text and as JSON."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text
from scipy.special import gammaincinv

from drivers.child_process import ChildProcess
from drivers.exchange.realtime import RealTimeReport
from hil.base.progress import Reporter
from hil.base.terminal_text import printable

from .checks import (
    CheckStatus,
    DiskTrial,
    DoctorCheck,
    System,
    computer_checks,
    disk_checks,
    link_checks,
)

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
CRITERIA: Final = (
    "a cycle is fit if no cycle of the measurement was late, with"
    f" {1e6 * REPLY_RESERVE_SECONDS:.0f} µs reserved for packet work and wire, and 99.9 % of the"
    " latencies used at most half of this time"
)
MIN_MEASURED_SECONDS: Final = 60.0
"""Time of measurement below which a verdict is provisional, s."""
_CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Fitness:
    """The verdict on one cycle by `CRITERIA`; numbers are None if nothing was measured.

    `share_used` is the largest 99.9 % latency plus reserve over the cycle; `late_per_hour_upper_95`
    is a one-sided 95 % bound for independent late cycles (Poisson).
    """

    cycle_ms: int
    fit: bool
    late_cycles: int
    share_used: float | None
    late_per_hour_upper_95: float | None
    reason: str


def judge(latencies: Sequence[Latency], cycle_ms: int) -> Fitness:
    """Return the verdict by the worst of the latencies; without any the cycle is not fit."""
    if not latencies:
        return Fitness(cycle_ms, False, 0, None, None, "nothing was measured")
    period = cycle_ms / 1000
    worst = max(latencies, key=lambda each: (each.late_cycles(period), each.percentile(100)))
    slow = max(latencies, key=lambda each: each.percentile(99.9))
    late = worst.late_cycles(period)
    used = (slow.percentile(99.9) + REPLY_RESERVE_SECONDS) / period
    hours = worst.seconds / 3600.0
    # The mean at which a Poisson distribution gives `late` or fewer with 5 % probability.
    bound = float(gammaincinv(late + 1, _CONFIDENCE)) / hours
    if late:
        reason = (
            f"{late} cycles late in {worst.seconds:.0f} s of {worst.name} (some "
            f"{late / hours:.0f} an hour), the longest {1e3 * worst.samples.max():.1f} ms"
        )
    elif used > 0.5:
        reason = f"none late, but {slow.name} uses {100 * used:.0f} % of the cycle at 99.9 %"
    else:
        reason = (
            f"none late in {worst.seconds:.0f} s (fewer than {bound:.0f} an hour, with 95 % "
            f"confidence); {100 * used:.0f} % of the cycle used at 99.9 %"
        )
    fit = not late and used <= 0.5
    return Fitness(cycle_ms, fit, late, round(used, 4), round(bound, 4), reason)


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
    """All results: verdicts on 1 and 2 ms and on `cycle_ms`, which has to be fit."""

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
        return self.cycle_fit and not self._bad

    @property
    def _bad(self) -> list[str]:
        return [check.name for check in self.checks if check.status is CheckStatus.BAD]

    @property
    def provisional(self) -> bool:
        """Whether the measurement was too short for a reliable verdict."""
        return self.seconds < MIN_MEASURED_SECONDS

    @property
    def line(self) -> str:
        """The verdict in one or two sentences."""
        fit_at_1_ms, fit_at_2_ms = (verdict.fit for verdict in self.cycles[:2])
        text = "2 ms is fit; 1 ms is not." if fit_at_2_ms else "Neither 1 ms nor 2 ms is fit."
        if fit_at_1_ms:  # and then 2 ms is
            text = "1 ms is fit, and so is 2 ms."
        if self.fit:
            text += f" This PC can answer a controller at {self.cycle_ms} ms."
        elif self.cycle_fit:
            text += f" But the link will not work: {', '.join(self._bad)}."
        else:
            text += f" Do not connect an arm at {self.cycle_ms} ms."
        if self.provisional:
            text += f" Provisional: measured for {self.seconds:g} s; at least 60 s are needed."
        return text


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
    command = ("python -m hil.doctor.probe permissions   # prints the error",)
    checks += [
        DoctorCheck(f"{name} latency", CheckStatus.BAD, "the probe failed", command)
        for name, latency in measured.items()
        if latency is None
    ]
    latencies = tuple(latency for latency in measured.values() if latency is not None)
    cycles = tuple(judge(latencies, cycle) for cycle in sorted({*JUDGED_CYCLES_MS, cycle_ms}))
    return Diagnosis(tuple(checks), latencies, cycles, cycle_ms, seconds)


_COLOUR = {
    CheckStatus.OK: "green",
    CheckStatus.WARN: "yellow",
    CheckStatus.BAD: "red",
    CheckStatus.UNKNOWN: "blue",
}
_OTHERWISE = (
    "switch off C-states, frequency stepping and hyper-threading in the firmware set-up (BIOS); "
    "isolate a processor; {}use another PC."
)


def show(diagnosis: Diagnosis, console: Console) -> None:
    """Print checks, latencies, verdict and remedies."""
    table = Table(box=None, pad_edge=False)
    for title in ("check", "", "found"):
        table.add_column(title, overflow="fold")
    for check in diagnosis.checks:
        status = Text(check.status, style=_COLOUR[check.status])
        table.add_row(Text(check.name), status, Text(printable(check.facts)))
    console.print(table)
    lines = [
        f"{latency.name} [µs]: "
        + ", ".join(
            f"{name.removesuffix('_us')} {value:g}" for name, value in latency.summary().items()
        )
        for latency in diagnosis.latencies
    ]
    lines += fitness_lines(diagnosis.cycles)
    first = [*remedies(diagnosis.checks)]
    lines += [f"({CRITERIA})", *first]
    if not diagnosis.cycle_fit:
        case = "If it is still not fit after that" if first else "To make it fit"
        otherwise = _OTHERWISE.format("use 2 ms; " if diagnosis.cycles[1].fit else "")
        lines.append(f"\n{case}: {otherwise}")
    for line in (*lines, ""):
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
    style = "bold green" if diagnosis.fit else "bold red"
    console.print(Text(printable(diagnosis.line), style=style), soft_wrap=True)


def fitness_lines(verdicts: Sequence[Fitness]) -> list[str]:
    """Return a line for each verdict; cycles with the same verdict and reason share one."""
    cycles: dict[tuple[bool, str], list[str]] = {}
    for verdict in verdicts:
        cycles.setdefault((verdict.fit, verdict.reason), []).append(str(verdict.cycle_ms))
    return [
        f"{' and '.join(alike)} ms: {'fit' if fit else 'not fit'}; {reason}"
        for (fit, reason), alike in cycles.items()
    ]


def summary(diagnosis: Diagnosis) -> list[str]:
    """Return the verdict, the checks that are not passed with their first remedy, and latencies."""
    worst_first = sorted(diagnosis.checks, key=lambda check: _STATUS_ORDER.index(check.status))
    failed = [check for check in worst_first if check.status is not CheckStatus.OK]
    lines = [diagnosis.line]
    for check in failed:
        lines.append(f"{check.status}: {check.name}: {check.facts}")
        lines += [f"    {command}" for command in check.remedy[:1]]
    for latency in diagnosis.latencies:
        half, most, longest = (1e6 * latency.percentile(p) for p in (50.0, 99.9, 100.0))
        lines.append(
            f"{latency.name}: half within {half:.0f} µs, 99.9 % within {most:.0f} µs, all within"
            f" {longest:.0f} µs"
        )
    lines += fitness_lines(diagnosis.cycles)
    passed = [check.name for check in diagnosis.checks if check.status is CheckStatus.OK]
    return [*lines, *([f"ok: {', '.join(passed)}"] if passed else [])]


_STATUS_ORDER: Final = (CheckStatus.BAD, CheckStatus.WARN, CheckStatus.UNKNOWN, CheckStatus.OK)


def remedies(checks: Sequence[DoctorCheck]) -> Iterator[str]:
    """Yield the commands of each check with a remedy, worst first, each command once."""
    given: set[str] = set()
    for status in (CheckStatus.BAD, CheckStatus.WARN, CheckStatus.UNKNOWN):
        for check in checks:
            if check.status is status and check.remedy:
                yield f"\n{check.name} ({status}):"
                yield from (f"    {command}" for command in check.remedy if command not in given)
                given.update(check.remedy)


def as_json(diagnosis: Diagnosis) -> dict[str, object]:
    """Return all results; the keys are stable."""
    return {
        "fit": diagnosis.fit,
        "provisional": diagnosis.provisional,
        "cycle_ms": diagnosis.cycle_ms,
        "verdict": diagnosis.line,
        "criteria": CRITERIA,
        "seconds": diagnosis.seconds,
        "cycles": [asdict(verdict) for verdict in diagnosis.cycles],
        "latency": {each.name: each.summary() for each in diagnosis.latencies},
        "checks": [asdict(check) for check in diagnosis.checks],
    }
