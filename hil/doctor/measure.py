"""Starts probes and waits for them; a probe that hangs is ended, never waited for."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hil.progress import Reporter

from .latency import Latency
from .machine import DiskTrial, Obtained

TURNAROUND_PERIOD = 1e-3
"""s between two questions."""
_GRACE = 15.0
"""s that a probe may take beyond its measurement (start-up on a slow disk)."""


def obtained() -> Obtained | None:
    """What a real-time process is given here; None if the probe failed."""
    answer = run_probe(["permissions"], 0.0)
    return None if answer is None else Obtained.from_mapping(answer)


def disk_trial(place: Path) -> DiskTrial | None:
    """Room and write times at `place`; None if the disk did not answer."""
    answer = run_probe(["disk", str(place)], 0.0)
    return None if answer is None else DiskTrial.from_mapping(answer)


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
