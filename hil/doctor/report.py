"""A diagnosis as a page for a person, and as a table for a script."""

from __future__ import annotations

import math
from collections.abc import Iterator

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.terminal_text import printable

from .check import Check, Status
from .measure import Latency
from .run import CRITERIA, Diagnosis, Fitness

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
        "checks": [
            {
                "name": check.name,
                "status": str(check.status),
                "found": check.found,
                "why": check.why,
                "remedy": list(check.remedy),
            }
            for check in diagnosis.checks
        ],
    }


def _verdict(verdict: Fitness) -> dict[str, object]:
    return {
        "cycle_ms": verdict.cycle_ms,
        "fit": verdict.fit,
        "late_cycles": verdict.late,
        "late_per_hour_upper_95": _finite(verdict.late_per_hour_upper_95),
        "share_used": _finite(verdict.used),
        "reason": verdict.reason,
    }


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
