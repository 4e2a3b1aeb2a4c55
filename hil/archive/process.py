"""The archive process of a real link: writes the exchange's shared memory to files.

It has its own process session and ignores SIGINT and SIGHUP, so that the end of a terminal does not
end a recording. If the supervisor dies, it continues until the exchange has ended the motion or is
dead, closes the archive with the true outcome, and ends. If it cannot write, it sets the archive's
state in the shared state to failed, and the exchange stops the arm.
"""

from __future__ import annotations

import select
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from socket import SOCK_SEQPACKET, socket
from types import FrameType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.cycle_records import RingReader
from drivers.events import InitReceived
from drivers.exchange.control import ArchiveState, HeartbeatMonitor, SharedState
from drivers.exchange.event_log import EventReader, ExchangeEvent
from hil.archive.live import LivePublisher, Serve
from hil.archive.process_handle import (
    Answer,
    Close,
    Closed,
    CommandSocket,
    Failed,
    Open,
    Opened,
    Serving,
    Shutdown,
)
from hil.archive.recorder import Recorder
from hil.base.errors import ArchiveError, InputError

Records = NDArray[np.void]

BUFFERED_CYCLES: Final = 5000  # Cycles buffered while no archive is open


class PreTriggerBuffer:
    """The newest records and events that came while no archive was open."""

    def __init__(self) -> None:
        self._records: list[Records] = []
        self._events: list[ExchangeEvent] = []

    def add(self, records: Records, events: Sequence[ExchangeEvent]) -> None:
        """Append what has come."""
        self._events = [*self._events, *events][-BUFFERED_CYCLES:]
        if len(records):
            self._records.append(records)
        while sum(map(len, self._records[1:])) >= BUFFERED_CYCLES:
            self._records.pop(0)

    def pop_session(self) -> tuple[Records, list[ExchangeEvent]]:
        """Remove and return the records of the last session, after its init packet."""
        events = self._events
        parts = self._records
        self._records = []
        self._events = []
        inits = [index for index, event in enumerate(events) if isinstance(event, InitReceived)]
        session_events = events[inits[-1] + 1 :] if inits else events
        if not parts:
            return np.zeros(0, np.dtype(np.void)), session_events
        rows = np.concatenate(parts)
        restarts = np.flatnonzero(np.diff(rows["cycle"]) < 1)
        return (rows[int(restarts[-1]) + 1 :] if restarts.size else rows), session_events


POLL_PERIOD: Final = 0.02  # Time between two readings of the ring, s
CHUNK_DELAY: Final = 0.0005  # Time after the last cycle of a chunk is due at which it is read, s
HEARTBEAT_PERIOD: Final = 0.05  # Time between two heartbeats, s
STALL_LIMIT: Final = 5.0
"""Time for which a disk may block before the heartbeat stops, s; the ring stores more."""
FLUSH_DELAY: Final = 0.2  # Time without a record after which an unfinished chunk is written, s
AFTERMATH_TIMEOUT: Final = 2.0
"""Time after the end of a motion until its archive is closed on a silent link, s."""
EXCHANGE_SILENCE: Final = 1.0
"""Time without a heartbeat of the exchange that is recorded in the archive, s."""
DETACHED_SILENCE: Final = 60.0  # Without a supervisor, until the archive is closed, s


@dataclass
class Job:
    """The open archive, and what was counted when it began.

    Attributes:
        number: identifies it to the supervisor.
        until_ended: whether it is closed at the end of the motion.
        overflow: of the reader.
        accepted, ended_count: of the shared state at its begin.
        last_record, ended: times of the last record and of the end of the motion, monotonic s.
        flushed: whether all records were written to the disk.
    """

    number: int
    recorder: Recorder
    until_ended: bool
    overflow: int
    accepted: int
    ended_count: int
    last_record: float
    flushed: bool = True
    ended: float | None = None
    exchange_silent: bool = False


class ArchiveProcess:
    """Transfers records and events to archives as commanded by the supervisor.

    Args:
        ring: records of the exchange process.
        events: of the exchange process.
        control: shared state.
        commands: of the supervisor.
        exchange: pidfd of the exchange process.
    """

    def __init__(
        self,
        ring: RingReader,
        events: EventReader,
        control: SharedState,
        commands: CommandSocket,
        exchange: int,
    ) -> None:
        self._ring = ring
        self._events = events
        self._control = control
        self._commands: CommandSocket | None = commands
        self._job: Job | None = None
        self._leaving = False
        self._progress = time.monotonic()
        self._exchange = exchange
        self._monitor = HeartbeatMonitor(lambda: control.exchange_heartbeat)
        self._live: LivePublisher | None = None
        self._buffer = PreTriggerBuffer()

    def run(self) -> None:
        """Work until the end is commanded, or supervisor and exchange have ended."""
        threading.Thread(target=self._send_heartbeats, daemon=True).start()
        try:
            while not (self._leaving and self._job is None):
                self._progress = time.monotonic()
                self._run_command()
                self._transfer()
                if self._commands is None and self._job is None and self._exchange_ended():
                    return
                self._watch_exchange()
        finally:
            if self._live is not None:
                self._live.close()

    def leave(self, _signum: int, _frame: FrameType | None) -> None:
        """Handle SIGTERM: complete the open archive, then end."""
        self._leaving = True

    def _send_heartbeats(self) -> None:
        while True:
            if time.monotonic() - self._progress < STALL_LIMIT:
                self._control.archive_heartbeat = time.monotonic()
            time.sleep(HEARTBEAT_PERIOD)

    def _run_command(self) -> None:
        """Wait for a command until the ring is to be read again, and run it."""
        if self._commands is None:
            time.sleep(self._pause())
            return
        readable, _, _ = select.select([self._commands], [], [], self._pause())
        if not readable:
            return
        try:
            command = self._commands.receive()
        except EOFError:
            self._commands = None
            return
        if isinstance(command, Open):
            self._open(command)
        elif isinstance(command, Close):
            if self._job is not None and self._job.number == command.job:
                self._transfer()
                self._close(command.outcome, command.reason)
        elif isinstance(command, Serve):
            self._serve(command)
        elif isinstance(command, Shutdown):
            self._leaving = True
            if self._job is not None and not self._job.until_ended:
                self._close("stopped", "the recording was ended")

    def _pause(self) -> float:
        """Time until the ring is read again, s: a chunk is written as soon as it is full."""
        if self._job is None or self._job.flushed:
            return POLL_PERIOD
        return min(POLL_PERIOD, self._job.recorder.writer.chunk_ends_in + CHUNK_DELAY)

    def _serve(self, command: Serve) -> None:
        try:
            self._live = LivePublisher(command)
        except InputError as error:
            self._reply(Failed(command.job, "", error.problem, error.remedy))
        else:
            self._reply(Serving(command.job, self._live.port))

    def _open(self, command: Open) -> None:
        if self._job is not None:
            self._transfer()
            self._close("interrupted", "another archive was opened")
        self._fill_buffer()
        records, events = self._buffer.pop_session()
        overflow = self._ring.missed
        control = self._control
        accepted = control.program_accepted
        ended_count = control.ended_count
        try:
            recorder = Recorder(command.spec.open(), command.drive_train)
            if not command.from_now:
                recorder.record(records, events)
        except Exception as error:
            self._fail(command.job, error)
            return
        self._job = Job(
            command.job,
            recorder,
            command.until_ended,
            overflow,
            accepted,
            ended_count,
            last_record=time.monotonic(),
        )
        if self._live is not None:
            self._live.drive_train = command.drive_train
        # Who asks for a motion now needs a recent heartbeat, even after a disk that hung.
        self._progress = control.archive_heartbeat = time.monotonic()
        control.archive_state = ArchiveState.READY
        self._reply(Opened(command.job))

    def _transfer(self) -> None:
        """Write what has arrived to the archive, and close it at the end of the interval."""
        job = self._job
        if job is None:
            self._fill_buffer()
            return
        # Read before the ring, so that nothing the exchange wrote is missed.
        exchange_ended = self._exchange_ended()
        ended_count = self._control.ended_count
        events = self._events.drain()
        records = self._ring.drain()
        lost = self._ring.missed - job.overflow
        job.overflow = self._ring.missed
        if self._live is not None:
            self._live.publish(records, events)
        now = time.monotonic()
        try:
            job.recorder.record(records, events, lost)
            if ended_count != job.ended_count and job.recorder.ended is None:
                job.recorder.motion_ended(self._control.outcome, self._control.ended_interval)
            if len(records):
                job.last_record = now
                job.flushed = False
            elif not job.flushed and now - job.last_record > FLUSH_DELAY:
                job.recorder.writer.flush()
                job.flushed = True
        except Exception as error:  # any of them: the arm must not move unrecorded
            self._fail(job.number, error)
            return
        self._close_if_ended(job, now, exchange_ended=exchange_ended)

    def _close_if_ended(self, job: Job, now: float, *, exchange_ended: bool) -> None:
        """Close the archive at the end of the interval."""
        ended = job.recorder.ended
        if ended is not None and job.ended is None:
            job.ended = now
        expired = job.ended is not None and now - job.ended > AFTERMATH_TIMEOUT
        if (
            job.until_ended
            and ended is not None
            and (job.recorder.complete or expired or exchange_ended)
        ):
            self._close(ended.outcome, ended.reason)
        elif exchange_ended and job.until_ended:
            process = "exchange process" if self._commands is not None else "supervising program"
            if self._control.program_accepted == job.accepted:
                self._close("void", f"nothing was sent: the {process} ended")
            else:
                self._close("lost", "the exchange process ended")
        elif exchange_ended and self._commands is None:
            self._close("stopped", "the supervising program ended")

    def _watch_exchange(self) -> None:
        """Record in the archive that the exchange sends no heartbeats, or sends them again."""
        silence = self._monitor.silence()
        job = self._job
        if job is None:
            return
        if (silence > EXCHANGE_SILENCE) is not job.exchange_silent:
            job.exchange_silent = not job.exchange_silent
            try:
                if job.exchange_silent:
                    job.recorder.warn("ExchangeSilent", "no heartbeat from the exchange process")
                else:
                    job.recorder.warn("ExchangeBack", "heartbeats from the exchange process again")
            except Exception as error:
                self._fail(job.number, error)
                return
        if silence > DETACHED_SILENCE and self._commands is None:
            self._close("lost", f"no heartbeat from the exchange process for {silence:.0f} s")

    def _fill_buffer(self) -> None:
        """Buffer what has come while no archive is open."""
        # rows up to the newest event
        events = self._events.drain()
        records = self._ring.drain()
        if self._live is not None:
            self._live.publish(records, events)
        self._buffer.add(records, events)

    def _close(self, outcome: str, reason: str) -> None:
        job = self._job
        self._job = None
        if job is None:
            return
        self._control.archive_state = ArchiveState.NONE
        try:
            recorded = job.recorder.close(outcome, reason)
        except Exception as error:
            self._fail(job.number, error)
            return
        self._reply(Closed(job.number, recorded))

    def _fail(self, number: int, error: Exception) -> None:
        """Report a failure; first by the field that makes the exchange stop the arm."""
        self._control.archive_state = ArchiveState.FAILED
        self._job = None
        path = ""
        problem = f"{type(error).__name__}: {error}"
        remedy = ""
        if isinstance(error, ArchiveError):
            path = str(error.path)
            problem = error.problem
            remedy = error.remedy
        cause = error if isinstance(error, OSError) else error.__cause__
        code = cause.errno if isinstance(cause, OSError) else None
        self._reply(Failed(number, path, problem, remedy, code))

    def _reply(self, answer: Answer) -> None:
        if self._commands is None:
            return
        try:
            self._commands.send(answer)
        except OSError:
            self._commands = None

    def _exchange_ended(self) -> bool:
        return bool(self._control.finished or select.select([self._exchange], [], [], 0.0)[0])


def main() -> None:
    """Attach the descriptors of the command line, and run."""
    ring, events, control, commands, exchange, n_joints = map(int, sys.argv[1:])
    for signum in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(signum, signal.SIG_IGN)
    process = ArchiveProcess(
        RingReader(ring, n_joints),
        EventReader(events),
        SharedState(control),
        CommandSocket(socket(fileno=commands, type=SOCK_SEQPACKET)),
        exchange,
    )
    signal.signal(signal.SIGTERM, process.leave)
    process.run()


if __name__ == "__main__":
    main()
