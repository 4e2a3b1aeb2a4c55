"""Everything looked at and measured, in order; as a page for a person, and a table for a script."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.special import gammaincinv

from drivers.exchange.realtime import RealTimeReport
from hil.progress import Reporter
from hil.terminal_text import printable

from . import link as links
from . import machine
from .check import Check, Status, System
from .link import CanLink, Link, UdpLink, address_of, can_check, network_checks
from .machine import disk_checks
from .measure import RESERVE, TURNAROUND_PERIOD, Latency, disk_trial, measure, obtained

CRITERIA: Final = (
    f"a cycle is fit if no cycle of the measurement was late, with {1e6 * RESERVE:.0f} µs "
    "reserved for packet work and wire, and 99.9 % of the latencies used at most half of it"
)
ENOUGH_SECONDS: Final = 60.0
"""s of measurement below which a verdict is provisional."""
_CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Fitness:
    """The verdict on one cycle.

    Attributes:
        cycle_ms: the controller's cycle.
        fit: by `CRITERIA`.
        late: cycles late in the measurement.
        late_per_hour_upper_95: upper bound of the rate with 95 % confidence, one-sided, for late
            cycles that come independently of each other (Poisson). Those of one long stall do not.
        used: largest 99.9 % latency plus reserve, as a share of the cycle.
        reason: in words.
    """

    cycle_ms: int
    fit: bool
    late: int
    late_per_hour_upper_95: float
    used: float
    reason: str


def judge(latencies: Sequence[Latency], cycle_ms: int) -> Fitness:
    """Judge a cycle by the worse of the latencies; without any, it is not fit."""
    if not latencies:
        return Fitness(cycle_ms, False, 0, float("nan"), float("nan"), "nothing was measured")
    period = cycle_ms / 1000
    late, worst = max(((each.late_cycles(period), each) for each in latencies), key=lambda p: p[0])
    slow = max(latencies, key=lambda each: each.percentile(99.9))
    used = (slow.percentile(99.9) + RESERVE) / period
    hours = worst.seconds / 3600.0
    # The mean whose Poisson distribution gives `late` or fewer with 5 % probability only.
    bound = float(gammaincinv(late + 1, _CONFIDENCE)) / hours
    if late:
        longest = 1e3 * float(worst.samples.max())
        reason = (
            f"{late} cycles late in {worst.seconds:.0f} s of {worst.name} "
            f"(some {late / hours:.0f} an hour), the longest {longest:.1f} ms"
        )
    elif used > 0.5:
        reason = f"none late, but {slow.name} uses {100 * used:.0f} % of the cycle at 99.9 %"
    else:
        reason = (
            f"none late in {worst.seconds:.0f} s (fewer than {bound:.0f} an hour, with 95 % "
            f"confidence); {100 * used:.0f} % of the cycle used at 99.9 %"
        )
    return Fitness(cycle_ms, not late and used <= 0.5, late, bound, used, reason)


def in_words(one: Fitness, two: Fitness) -> str:
    """The verdict on both cycles in one sentence."""
    if one.fit and two.fit:
        return "1 ms is fit, and so is 2 ms."
    if two.fit:
        return "2 ms is fit; 1 ms is not."
    if one.fit:
        return "1 ms is fit."
    return "Neither 1 ms nor 2 ms is fit."


CYCLES_MS = (1, 2)


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        checks: in the order of a reader's interest.
        latencies: measured; an empty tuple if no probe ran.
        one: verdict on 1 ms.
        two: verdict on 2 ms.
        cycle_ms: the cycle that has to be fit.
        seconds: length of each measurement.
    """

    checks: tuple[Check, ...]
    latencies: tuple[Latency, ...]
    one: Fitness
    two: Fitness
    cycle_ms: int
    seconds: float

    @property
    def wanted(self) -> Fitness:
        """The verdict on the cycle that has to be fit."""
        return self.one if self.cycle_ms == CYCLES_MS[0] else self.two

    @property
    def fit(self) -> bool:
        """Whether the cell's link can be run from this PC: cycle fit, and no check bad."""
        return self.wanted.fit and not any(check.status is Status.BAD for check in self.checks)

    @property
    def provisional(self) -> bool:
        """Whether too little was measured for the verdict to be relied upon."""
        return self.seconds < ENOUGH_SECONDS

    @property
    def line(self) -> str:
        """The verdict in one or two plain sentences."""
        words = in_words(self.one, self.two)
        bad = [check.name for check in self.checks if check.status is Status.BAD]
        if self.fit:
            words += f" This PC can answer a controller at {self.cycle_ms} ms."
        elif self.wanted.fit:
            words += f" But the link will not work as it is: {', '.join(bad)}."
        else:
            words += f" Do not connect an arm at {self.cycle_ms} ms."
        if self.provisional:
            words += f" Provisional: measured for {self.seconds:g} s only, 60 s are the least."
        return words


def examine(
    link: Link | None,
    cycle_ms: int,
    seconds: float,
    place: Path,
    reporter: Reporter,
    system: System | None = None,
) -> Diagnosis:
    """Look at this PC and measure it for twice `seconds`.

    Args:
        link: the cell's link, None for a simulated controller.
        cycle_ms: the cycle that has to be fit; the wake-up timer runs at it.
        seconds: length of each measurement.
        place: where archives will be written.
        reporter: shows progress.
        system: the machine, this one if left out.
    """
    system = system or System()
    reporter.say("looking at this PC; no packet is sent to the controller")
    given = obtained()
    checks = [*permission_checks(given, system), *machine_checks(given, system)]
    checks += link_checks(link, system)
    checks += disk_checks(place, disk_trial(place))
    checks.append(machine.load(system))
    period, before = cycle_ms / 1000, system.text("/proc/stat") or ""
    wake_up = measure("wake-up", "wake-ups", period, seconds, reporter)
    turnaround = measure("turnaround", "turnaround", TURNAROUND_PERIOD, seconds, reporter)
    checks.append(machine.stolen(before, system.text("/proc/stat") or ""))
    for name, latency in (("wake-up", wake_up), ("turnaround", turnaround)):
        if latency is None:
            checks.append(failed(name))
    latencies = tuple(latency for latency in (wake_up, turnaround) if latency is not None)
    one, two = (judge(latencies, cycle) for cycle in CYCLES_MS)
    return Diagnosis(tuple(checks), latencies, one, two, cycle_ms, seconds)


def failed(name: str) -> Check:
    """A measurement that could not be made."""
    found = "the probe gave no figures"
    remedy = "python -m hil.doctor.probe permissions   # says why"
    return Check(f"{name} latency", Status.BAD, found, "without it nothing is known", (remedy,))


def permission_checks(given: RealTimeReport | None, system: System) -> list[Check]:
    """What the operating system allows."""
    return [
        machine.user(),
        machine.scheduling(given),
        machine.memory_lock(given),
        machine.processor_awake(given, system),
    ]


def machine_checks(given: RealTimeReport | None, system: System) -> list[Check]:
    """The computer itself."""
    return [
        machine.timer_resolution(),
        machine.clock_source(system),
        machine.governor(system),
        machine.idle_states(system, no_sleep=given is not None and given.cpu_awake),
        machine.isolation(system),
        machine.preemption(system),
        machine.virtualisation(system),
        machine.python(),
    ]


def link_checks(link: Link | None, system: System) -> list[Check]:
    """What lies between this PC and the controller."""
    if isinstance(link, CanLink):
        return [can_check(link, system)]
    if isinstance(link, UdpLink):
        trial = links.try_port(link.bind, link.port)
        return [
            *network_checks(link.host, link.port, address_of(link.host, system), system),
            links.port_check(link.bind, link.port, trial, system),
            links.options_check(trial),
        ]
    why = "routes, ports and buses are looked at when a cell with a real link is given"
    return [Check("controller link", Status.OK, "none: no cell, or a simulated one", why)]


_COLOUR = {Status.OK: "green", Status.WARN: "yellow", Status.BAD: "red", Status.UNKNOWN: "blue"}
_BAR = 40
_OTHERWISE = (
    "If it is still not fit after that: switch off C-states, frequency stepping and "
    "hyper-threading in the firmware set-up (BIOS); isolate a processor; {}use another PC."
)


def show(diagnosis: Diagnosis, console: Console) -> None:
    """Print checks, histograms, verdict and remedies."""
    console.print(_table(diagnosis.checks))
    for latency in diagnosis.latencies:
        console.print("\n".join(histogram(latency)), markup=False, highlight=False)
        console.print()
    for verdict in (diagnosis.one, diagnosis.two):
        console.print(verdict_line(verdict), markup=False, highlight=False, soft_wrap=True)
    console.print(f"({CRITERIA})", markup=False, highlight=False, soft_wrap=True)
    for line in remedies(diagnosis.checks):
        console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
    if not diagnosis.wanted.fit:
        otherwise = _OTHERWISE.format("use 2 ms; " if diagnosis.two.fit else "")
        console.print(f"\n{otherwise}", markup=False, highlight=False, soft_wrap=True)
    console.print()
    colour = "green" if diagnosis.fit else "red"
    console.print(
        f"[bold {colour}]{escape(printable(diagnosis.line))}[/]", highlight=False, soft_wrap=True
    )


def _table(checks: tuple[Check, ...]) -> Table:
    table = Table(box=None, pad_edge=False)
    for title in ("check", "", "found"):
        table.add_column(title, overflow="fold")
    for check in checks:
        status = f"[{_COLOUR[check.status]}]{check.status}[/]"
        table.add_row(escape(check.name), status, escape(printable(check.found)))
    return table


def histogram(latency: Latency) -> Iterator[str]:
    """Percentiles and bars on a logarithmic scale: rare stalls are what matters."""
    p50, p99, p999 = (1e6 * latency.percentile(percent) for percent in (50, 99, 99.9))
    worst = 1e6 * float(latency.samples.max())
    yield (
        f"{latency.name}: p50 {p50:.0f}  p99 {p99:.0f}  p99.9 {p999:.0f}  max {worst:.0f} µs, "
        f"{len(latency.samples)} samples in {latency.seconds:g} s"
    )
    most = math.log1p(len(latency.samples))
    for bounds, count in latency.histogram():
        bar = "█" * math.ceil(_BAR * math.log1p(count) / most) if count else ""
        yield f"  {bounds:>10} µs {count:>8} {bar}"


def verdict_line(verdict: Fitness) -> str:
    """One cycle's verdict and its reason."""
    return f"{verdict.cycle_ms} ms: {'fit' if verdict.fit else 'not fit'}; {verdict.reason}"


def remedies(checks: tuple[Check, ...]) -> Iterator[str]:
    """What to change, worst first: reason, then commands, each of them once."""
    given: set[str] = set()
    for status in (Status.BAD, Status.WARN, Status.UNKNOWN):
        for check in checks:
            if check.status is status and check.remedy:
                yield f"\n{check.name} ({status}): {check.why}"
                yield from (f"    {command}" for command in check.remedy if command not in given)
                given.update(check.remedy)


def as_json(diagnosis: Diagnosis) -> dict[str, object]:
    """Everything, for scripts; keys are stable."""
    return {
        "fit": diagnosis.fit,
        "provisional": diagnosis.provisional,
        "cycle_ms": diagnosis.cycle_ms,
        "verdict": diagnosis.line,
        "criteria": CRITERIA,
        "seconds": diagnosis.seconds,
        "cycles": [_verdict(verdict) for verdict in (diagnosis.one, diagnosis.two)],
        "latency": {each.name: each.summary() for each in diagnosis.latencies},
        "checks": [asdict(check) for check in diagnosis.checks],
    }


def _verdict(verdict: Fitness) -> dict[str, object]:
    figures = asdict(verdict)
    return {
        "cycle_ms": figures.pop("cycle_ms"),
        "fit": figures.pop("fit"),
        "late_cycles": figures.pop("late"),
        "share_used": _finite(figures.pop("used")),
        **figures,
        "late_per_hour_upper_95": _finite(verdict.late_per_hour_upper_95),
    }


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
