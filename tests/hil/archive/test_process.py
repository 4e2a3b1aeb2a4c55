"""The archive process on memory that the tests fill: how an archive ends, whichever process fails.

After a power cut, what was flushed is on the disk. What its own death costs: `tests/process_death`.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.cycle_records import CycleRing, RingReader, cycle_dtype
from drivers.drive_train import DriveTrain
from drivers.events import MotionEnded, MotionStarted, PacketRejected, RepliesLost
from drivers.exchange import control as control_memory
from drivers.exchange import event_log
from drivers.exchange.control import OUTCOMES, ArchiveState, SharedState
from drivers.exchange.event_log import EventReader, EventWriter
from hil.archive import Archive, ArchiveOutcome, ArchiveSpec, ArchiveWriter, open_archive
from hil.archive.process import ArchiveProcess
from hil.archive.process_handle import (
    Answer,
    ArchiveProcessHandle,
    Close,
    Closed,
    CommandSocket,
    Open,
    Opened,
)
from hil.archive.recorder import Recorded

pytestmark = pytest.mark.long

PERIOD = 0.001
NAME = "excitation_000_a1.mcap"


class Memory:
    """Shared memory as of an exchange process, and a process in its place."""

    def __init__(self) -> None:
        self.ring = CycleRing.shared(2, 4000)
        self.ring_fd = self.ring.fd
        self.event_fd = event_log.create(4096)
        self.control_fd = control_memory.create()
        self.events = EventWriter(self.event_fd)
        self.control = SharedState(self.control_fd)
        self.exchange = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        self.pid = self.exchange.pid
        self.cycle = 0

    def cycles(self, count: int) -> None:
        """Add records of an arm at rest."""
        for _ in range(count):
            slot = self.ring.slot
            self.ring.rows[slot] = np.zeros((), self.ring.rows.dtype)
            self.ring.cycle[slot] = self.cycle
            self.ring.commit()
            self.cycle += 1

    def end(self) -> None:
        """Kill the exchange process."""
        self.exchange.kill()
        self.exchange.communicate()

    def close(self) -> None:
        self.end()
        for fd in (self.ring_fd, self.event_fd, self.control_fd):
            os.close(fd)


def drive_train() -> DriveTrain:
    ones = np.ones(2)
    return DriveTrain(
        gear_ratio=50.0 * ones,
        calibration=0.0 * ones,
        joint_sign=ones,
        joint_offset=0.0 * ones,
        torque_constant=ones,
        current_limit=10.0 * ones,
    )


class Rig:
    """An archive process on this memory."""

    def __init__(self, memory: Memory, folder: Path) -> None:
        self.memory = memory
        self.folder = folder
        self.process = ArchiveProcessHandle.start(memory, 2)

    def open(self, job: int, name: str = NAME, *, until_ended: bool = True) -> Path:
        path = self.folder / name
        spec = ArchiveSpec(path, joint_names=("a", "b"), period=PERIOD, metadata={}, durable=False)
        self.process.send(Open(job, spec, drive_train(), False, until_ended))
        assert self.answer(job) == Opened(job)
        return path

    def answer(self, job: int) -> Answer | None:
        return self.process.answer(30.0, job)

    def end(self) -> Recorded:
        """End the archive of the first job."""
        time.sleep(0.1)
        self.process.send(Close(1, "completed", "enough"))
        return self.closed(1)

    def closed(self, job: int) -> Recorded:
        answer = self.answer(job)
        assert isinstance(answer, Closed)
        return answer.recorded


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    memory = Memory()
    made = Rig(memory, tmp_path)
    try:
        yield made
    finally:
        memory.end()
        made.process.process.kill()
        made.process.process.wait()
        made.process.end()
        memory.close()


def wait(for_what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30.0
    while not for_what():
        assert time.monotonic() < deadline, "timeout"
        time.sleep(0.02)


def outcome(path: Path) -> ArchiveOutcome:
    return complete_archive(path).outcome


def complete_archive(path: Path) -> Archive:
    archive = open_archive(path)
    assert archive.complete
    return archive


class TestArchiveProcess:
    def test_end_with_lost_event_is_detected_by_the_count(self, rig: Rig) -> None:
        path = rig.open(1)
        memory = rig.memory
        memory.control.program_accepted = 1
        memory.cycles(20)
        memory.events.write(MotionStarted(4, 5))
        wait(lambda: open_archive(path).n_samples >= 0)
        memory.control.ended_outcome = OUTCOMES.index("stopped")
        memory.control.ended_interval = 4
        memory.control.ended_count += 1
        done = rig.closed(1)
        assert (done.outcome, done.interval) == ("stopped", 4)
        assert "was lost" in done.reason
        assert outcome(path).outcome == "stopped"
        assert [event.name for event in complete_archive(path).events][-1] == "MotionEnded"

    def test_events_are_counted_in_the_outcome(self, rig: Rig) -> None:
        path = rig.open(1, until_ended=False)
        memory = rig.memory
        memory.cycles(50)
        memory.events.write(RepliesLost(2, 10))
        memory.events.write(PacketRejected("replied to late", 3))
        memory.events.write(PacketRejected("late", 4))
        memory.events.write(PacketRejected("came late", 5))
        memory.events.write(PacketRejected("bunched", 6))
        wait(lambda: open_archive(path).n_samples > 0)
        for number in range(5000):  # far more than the log holds, faster than it is read
            memory.events.write(PacketRejected("foreign", number))
        done = rig.end()
        stored = outcome(path)
        assert (done.late, done.late_packets, done.not_accepted) == (7, 11, 2)
        assert (stored.late_replies, stored.replies_not_accepted) == (7, 2)
        assert stored.late_packets == 11
        assert stored.events_lost == done.events_lost > 0
        # The name of lost replies in archives is older than that of their event.
        names = {event.name for event in complete_archive(path).events}
        assert names >= {"EventsLost", "AnswersLost"}

    def test_motion_never_requested_leaves_a_void_archive(self, rig: Rig) -> None:
        path = rig.open(1)
        memory = rig.memory
        memory.cycles(20)
        rig.process.channel.close()  # the supervisor dies
        time.sleep(0.2)
        memory.end()
        wait(lambda: not rig.process.process.alive)
        stored = outcome(path)
        assert (stored.outcome, stored.reason) == (
            "void", "nothing was sent: the supervising program ended"
        )  # fmt: skip

    def test_motion_whose_exchange_died_is_lost(self, rig: Rig) -> None:
        path = rig.open(1)
        memory = rig.memory
        memory.control.program_accepted = 1
        memory.cycles(20)
        memory.end()
        assert rig.closed(1).outcome == "lost"
        assert complete_archive(path).n_samples == 20

    def test_silent_exchange_that_runs_is_waited_for(self, rig: Rig) -> None:
        memory = rig.memory
        memory.control.exchange_heartbeat = time.monotonic()
        path = rig.open(1)
        memory.control.program_accepted = 1
        memory.cycles(20)
        assert rig.process.answer(4.0, 1) is None, "its archive was closed"
        memory.control.exchange_heartbeat = time.monotonic()
        memory.cycles(30)
        memory.events.write(MotionEnded("completed", "the path is at its end", 0, 40))
        assert rig.closed(1).outcome == "completed"
        archive = complete_archive(path)
        assert archive.n_samples == 50
        names = [event.name for event in archive.events]
        assert "ExchangeSilent" in names

    def test_second_archive_interrupts_the_first(self, rig: Rig) -> None:
        first = rig.open(1)
        rig.memory.cycles(20)
        second = rig.open(2, "excitation_001_a1.mcap")
        assert outcome(first).outcome == "interrupted"
        rig.process.send(Close(1, "completed", "too late"))
        rig.process.send(Close(2, "completed", "enough"))  # answers about the first are dropped
        assert rig.closed(2).reason == "enough"
        assert outcome(second).outcome == "completed"
        assert rig.memory.control.archive_state == ArchiveState.NONE

    def test_an_open_archive_comes_with_a_heartbeat(self, rig: Rig, monkeypatch) -> None:
        """After a disk that hung for longer than heartbeats go on, a motion can begin at once."""
        memory = rig.memory
        supervisor, own = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        exchange = os.pidfd_open(memory.pid)
        with supervisor, own:
            process = ArchiveProcess(
                RingReader(memory.ring_fd, 2), EventReader(memory.event_fd), memory.control,
                CommandSocket(own), exchange,
            )  # fmt: skip
            path = rig.folder / NAME
            spec = ArchiveSpec(
                path, joint_names=("a", "b"), period=PERIOD, metadata={}, durable=False
            )
            clock = time.monotonic()
            monkeypatch.setattr(time, "monotonic", lambda: clock + 100.0)
            process._open(Open(1, spec, drive_train(), False, True))
            assert CommandSocket(supervisor).receive() == Opened(1)
            assert memory.control.archive_heartbeat == clock + 100.0
            assert process._progress == clock + 100.0
            process._close("completed", "enough")
        os.close(exchange)

    def test_dead_process_is_reported(self, rig: Rig) -> None:
        rig.process.process.kill()
        started = time.monotonic()
        assert rig.process.answer(10.0, 1) is None
        assert time.monotonic() - started < 5.0
        assert "ended" in rig.process.failure()

    def test_process_that_accepts_no_command_is_killed(self, rig: Rig) -> None:
        rig.open(1)
        rig.process.process.send_signal(signal.SIGSTOP)
        rig.process.channel._socket.settimeout(0.2)
        rig.process.send(Close(1, "x" * 4_000_000, ""))
        failure = rig.process.failure()
        assert failure is not None
        assert "accepted no command" in failure
        assert not rig.process.process.alive


FLUSH = 100  # cycles


def test_every_flush_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
