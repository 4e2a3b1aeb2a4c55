"""A killed archive process: what it had flushed is there, whole, and little else was lost.

And a power cut: what was flushed is on the disk.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drivers.drive_train import DriveTrain
from drivers.exchange import ControlBlock, EventWriter, SharedCycleRing, event_log
from drivers.exchange import control as control_memory
from drivers.exchange.shared_ring import _READ
from drivers.record import cycle_dtype
from hil.archive import ArchiveSpec, ArchiveWriter, open_archive
from hil.archive.check import check_archive
from hil.archive.repair import repair
from hil.archive.supervised import ArchiveProcessHandle, Open, Opened

PERIOD = 0.001
FLUSH = 100  # cycles
LATE = 60
"""Cycles that may be taken at once, at their end."""
MOSTLY = 0.8
"""Share of the rounds in which a busy machine does not let the archive process wait."""
AT_ONCE = 4

DRIVES = DriveTrain(
    gear_ratio=50.0 * np.ones(2),
    calibration=np.zeros(2),
    joint_sign=np.ones(2),
    joint_offset=np.zeros(2),
    torque_constant=np.ones(2),
    current_limit=10.0 * np.ones(2),
)


class Cycles:
    """An exchange's memory, filled with a cycle every millisecond."""

    def __init__(self) -> None:
        self.ring = SharedCycleRing.create(2, 4000)
        self.ring_fd, self.event_fd = self.ring.fd, event_log.create(4096)
        self.control_fd = control_memory.create()
        self.events, self.control = EventWriter(self.event_fd), ControlBlock(self.control_fd)
        self.pid = os.getpid()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def begin(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        started = time.monotonic()
        while not self._over.is_set():
            due = int((time.monotonic() - started) / PERIOD)
            while self.ring.written < due:
                slot, cycle = self.ring.slot, self.ring.written
                self.ring.cycle[slot] = cycle
                self.ring.measured[slot] = position(cycle)
                self.ring.commit()
            time.sleep(PERIOD / 2)

    def close(self) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()
        for fd in (self.ring_fd, self.event_fd, self.control_fd):
            os.close(fd)


def position(cycle: object) -> np.ndarray:
    return np.sin(np.asarray(cycle, float))


@dataclass(frozen=True)
class Killed:
    path: Path
    written: int
    """Cycles there were when it was killed."""
    taken: int
    """Those that it had seen."""


def killed(folder: Path, seed: int) -> Killed:
    """An archive whose process was killed at some moment of its first second."""
    cycles = Cycles()
    process = ArchiveProcessHandle.start(cycles, 2)
    path = folder / f"excitation_{seed:03d}_a1.mcap"
    try:
        spec = ArchiveSpec(path, joint_names=("a", "b"), period=PERIOD, metadata={})
        process.send(Open(1, spec, DRIVES, from_now=True, until_ended=False))
        assert process.answer(30.0, 1) == Opened(1)
        cycles.begin()
        time.sleep(random.Random(seed).uniform(0.0, 1.0))
        written, taken = cycles.ring.written, cycles.ring._words[_READ]
        process.process.kill()
        process.process.wait()
    finally:
        process.process.kill()
        process.end()
        cycles.close()
    return Killed(path, written, int(taken))


def assert_little_is_lost(case: Killed, folder: Path) -> int:
    """Cycles that were lost, those included for which the process had had no time yet."""
    archive = open_archive(case.path)  # there is one from the moment it was said to be open
    assert not archive.complete
    columns = archive.columns
    count = archive.n_samples
    if count:
        assert columns["cycle"].tolist() == list(range(count))
        expected = position(np.arange(count))[:, None]
        assert np.array_equal(columns["position"], np.broadcast_to(expected, (count, 2)))
    repaired = repair(case.path, folder / case.path.name)
    assert repaired.output is not None
    assert check_archive(repaired.output).keeps
    assert open_archive(repaired.output).n_samples == count
    assert case.taken - count <= FLUSH + 1 + LATE
    return case.written - count


def require(rounds: int, tmp_path: Path) -> None:
    folder = tmp_path / "repaired"
    folder.mkdir()
    with ThreadPoolExecutor(AT_ONCE) as pool:
        cases = list(pool.map(lambda seed: killed(tmp_path, seed), range(rounds)))
    lost = [assert_little_is_lost(case, folder) for case in cases]
    assert any(case.written > FLUSH for case in cases)
    assert np.mean([count <= FLUSH + 1 for count in lost]) >= MOSTLY, sorted(lost)


def test_killed_at_any_moment_it_costs_a_flush_period_at_most(tmp_path: Path) -> None:
    require(20, tmp_path)


@pytest.mark.slow
def test_killed_at_any_of_many_moments_it_costs_a_flush_period_at_most(tmp_path: Path) -> None:
    require(300, tmp_path)


def test_every_flush_waits_for_the_disk_and_the_first_comes_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "excitation_000_a1.mcap"
    on_disk: list[int] = []
    wait = os.fdatasync

    def watched(descriptor: int) -> None:
        wait(descriptor)
        on_disk.append(path.stat().st_size)

    monkeypatch.setattr(os, "fdatasync", watched)
    archive = ArchiveWriter(path, joint_names=("a", "b"), period=PERIOD, metadata={})
    assert on_disk == [path.stat().st_size]
    assert open_archive(path).n_samples == 0
    rows = np.zeros(1000, cycle_dtype(2))
    rows["cycle"] = np.arange(1000)
    for start in range(0, 1000, 20):
        archive.write(rows[start : start + 20].copy())
        assert len(on_disk) == 1 + (start + 20) // FLUSH
        assert on_disk[-1] == path.stat().st_size
    archive.close("completed")
    assert on_disk[-1] == path.stat().st_size


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_the_archive_process_asks_the_disk_ten_times_a_second(tmp_path: Path) -> None:
    cycles = Cycles()
    process = ArchiveProcessHandle.start(cycles, 2)
    traced = tmp_path / "calls.txt"
    try:
        spec = ArchiveSpec(
            tmp_path / "excitation_000_a1.mcap", joint_names=("a", "b"), period=PERIOD, metadata={}
        )
        process.send(Open(1, spec, DRIVES, from_now=True, until_ended=False))
        assert process.answer(30.0, 1) == Opened(1)
        calls = ["-f", "-ttt", "-e", "trace=fdatasync", "-o", str(traced)]
        strace = subprocess.Popen(
            ["strace", *calls, "-p", str(process.process.pid)],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert strace.stderr is not None
        if "attached" not in strace.stderr.readline():
            strace.communicate()
            pytest.skip("this system does not allow to trace a process")
        cycles.begin()
        time.sleep(2.5)
        written = cycles.ring.written
        strace.send_signal(signal.SIGINT)
        strace.communicate()
    finally:
        process.process.kill()
        process.end()
        cycles.close()
    times = [float(t) for t in re.findall(r"^\d+ +([\d.]+) fdatasync", traced.read_text(), re.M)]
    assert len(times) == pytest.approx(written / FLUSH, abs=3)
    assert np.median(np.diff(times)) == pytest.approx(FLUSH * PERIOD, abs=0.02)
