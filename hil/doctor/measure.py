"""Starts probes and waits for them; a probe that hangs is ended, never waited for."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.exchange.realtime import RealTimeReport
from hil.progress import Reporter

from .machine import DiskTrial

RESERVE: Final = 100e-6
"""s of a cycle reserved for what a bare measurement leaves out: session and guard (20 µs, at most
40),
the packet on the wire both ways (25 µs each at 100 Mbit/s), the card's interrupt."""
EDGES: Final = np.array([0, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, np.inf]) * 1e-6
"""s, bounds of the histogram's bars."""


@dataclass(frozen=True, eq=False)
class Latency:
    """Latencies of one kind.

    Attributes:
        name: "wake-up" or "turnaround".
        samples: (m,) s, finite and not negative, m >= 1.
        seconds: how long was measured.
    """

    name: str
    samples: NDArray[np.float64]
    seconds: float

    def __post_init__(self) -> None:
        if self.samples.ndim != 1 or not len(self.samples) or not self.seconds > 0:
            raise ValueError(f"{self.name}: no samples")
        if not (np.isfinite(self.samples).all() and (self.samples >= 0).all()):
            raise ValueError(f"{self.name}: samples must be finite and not negative")

    def percentile(self, percent: float) -> float:
        """The smallest sample that `percent` of all do not exceed, s."""
        return float(np.percentile(self.samples, percent, method="inverted_cdf"))

    def late_cycles(self, period: float) -> int:
        """Cycles of `period` s that would have ended before their answer.

        A latency of several cycles costs each of them: a stall counts by its length.
        """
        return int(np.floor((self.samples + RESERVE) / period).sum())

    def histogram(self) -> list[tuple[str, int]]:
        """Bars: bounds in µs, and how many samples lie in them (lower bound included)."""
        counts, _ = np.histogram(self.samples, EDGES)
        finite = (1e6 * EDGES[:-1]).tolist()
        bounds = [f"{low:.0f}-{high:.0f}" for low, high in pairwise(finite)]
        return list(zip([*bounds, f"over {finite[-1]:.0f}"], counts.tolist(), strict=True))

    def summary(self) -> dict[str, float | int]:
        """Figures for scripts, µs."""
        figures: dict[str, float | int] = {
            f"p{str(p).replace('.', '')}_us": round(1e6 * self.percentile(p), 1)
            for p in (50, 99, 99.9)
        }
        figures["max_us"] = round(1e6 * float(self.samples.max()), 1)
        figures["samples"] = len(self.samples)
        for cycle_ms in (1, 2):
            figures[f"late_cycles_{cycle_ms}ms"] = self.late_cycles(cycle_ms / 1000)
        return figures


TURNAROUND_PERIOD = 1e-3
"""s between two questions."""
_GRACE = 15.0
"""s that a probe may take beyond its measurement (start-up on a slow disk)."""


def obtained() -> RealTimeReport | None:
    """What a real-time process is given here; None if the probe failed."""
    answer = run_probe(["permissions"], 0.0)
    return None if answer is None else RealTimeReport(**answer)


def disk_trial(place: Path) -> DiskTrial | None:
    """Room and write times at `place`; None if the disk did not answer."""
    answer = run_probe(["disk", str(place)], 0.0)
    return None if answer is None else DiskTrial(**answer)


def measure(
    name: str, kind: str, period: float, seconds: float, reporter: Reporter
) -> Latency | None:
    """Run a latency probe (`wake-ups` or `turnaround`) under a progress bar; None if it failed."""
    with tempfile.TemporaryDirectory() as folder, reporter.task(name, seconds) as task:
        file = Path(folder) / "latency.npy"
        words = [kind, repr(period), repr(seconds), str(file)]
        if run_probe(words, seconds, task.advance) is None:
            return None
        try:
            return Latency(name, np.load(file).astype(np.float64), seconds)
        except (OSError, ValueError):
            return None


def run_probe(
    words: Sequence[str], seconds: float, advance: Callable[[float], None] | None = None
) -> dict[str, Any] | None:
    """The JSON answer of `hil.doctor.probe`; None if it failed or took `_GRACE` s too long."""
    command = [sys.executable, "-m", "hil.doctor.probe", *words]
    probe = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        output = _wait(probe, seconds, advance)
    finally:
        _end(probe)
    try:
        answer = json.loads(output.splitlines()[-1]) if output and not probe.returncode else None
    except ValueError:
        return None
    return answer if isinstance(answer, dict) else None


def _wait(
    probe: subprocess.Popen[str], seconds: float, advance: Callable[[float], None] | None
) -> str | None:
    """What the probe printed; advances the bar by the time that passed, up to `seconds`."""
    began, shown = time.monotonic(), 0.0
    while (passed := time.monotonic() - began) < seconds + _GRACE:
        try:
            output = probe.communicate(timeout=0.2)[0]
            if advance is not None and seconds > shown:
                advance(seconds - shown)
            return output
        except subprocess.TimeoutExpired:
            step = min(passed, seconds) - shown
            if advance is not None and step > 0:
                advance(step)
                shown += step
    return None


def _end(probe: subprocess.Popen[str]) -> None:
    """Kill what still runs; one caught in a dead disk is not waited for."""
    probe.kill()
    with suppress(subprocess.TimeoutExpired):
        probe.wait(timeout=1.0)
    if probe.stdout is not None:
        probe.stdout.close()
