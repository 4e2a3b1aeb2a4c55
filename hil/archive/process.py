"""The archive process of a real link: drains the exchange's shared memory into files.

Run as ``python -m hil.archive.process`` with the descriptors of ring, event log, control block,
command socket and exchange process, the number of joints, and the descriptor of the raw packets
where they are stored. It is in a process session of its own and ignores SIGINT and SIGHUP: what is
being recorded is completed whatever happens to the terminal. If the supervisor dies, it goes on
until the exchange has ended the motion or is dead, closes the archive with the true outcome, and
ends. If it cannot write, it says so in the control block, and the exchange brings the arm to rest.
"""

from __future__ import annotations

import select
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from socket import SOCK_SEQPACKET, socket
from types import FrameType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.events import InitReceived
from drivers.exchange.control import ArchiveState, ControlBlock, HeartbeatMonitor
from drivers.exchange.event_log import EventReader, ExchangeEvent
from drivers.record import PACKET_DTYPE, PacketReader, RingReader
from hil.archive.live import LivePublisher, Serve
from hil.archive.recorder import Recorder
from hil.archive.supervised import (
    Answer,
    Channel,
    Close,
    Closed,
    End,
    Failed,
    Open,
    Opened,
    Serving,
)
from hil.errors import ArchiveError, InputError

Records = NDArray[np.void]

RECENT: Final = 5000
"""Cycles held back for what came before an event."""
_PACKETS_PER_CYCLE = 2


@dataclass
class Recent:
    """The newest records, events and raw packets; the oldest go as others come."""

    _records: list[Records] = field(default_factory=list)
    _packets: list[Records] = field(default_factory=list)
    _events: list[ExchangeEvent] = field(default_factory=list)

    def keep(
        self, records: Records, events: Sequence[ExchangeEvent], packets: Records | None = None
    ) -> None:
        """Take in what has come; `packets` None where they are not recorded."""
        self._events = [*self._events, *events][-RECENT:]
        for parts, rows, count in (
            (self._records, records, RECENT),
            (self._packets, packets, _PACKETS_PER_CYCLE * RECENT),
        ):
            if rows is not None and len(rows):
                parts.append(rows)
            while sum(map(len, parts[1:])) >= count:  # a part goes that has none of the newest
                parts.pop(0)

    def take_session(self) -> tuple[Records, list[ExchangeEvent], Records]:
        """Records, events and raw packets of the session that began last; they are removed here.

        Its init packet is not among the events: it is not news any more.
        """
        events = self._events
        inits = [index for index, event in enumerate(events) if isinstance(event, InitReceived)]
        session = (
            _after_restart(self._records, np.dtype(np.void(0).dtype), least=1),
            events[inits[-1] + 1 :] if inits else events,
            # Several packets may belong to one cycle.
            _after_restart(self._packets, PACKET_DTYPE, least=0),
        )
        self._records, self._events, self._packets = [], [], []
        return session


def _after_restart(parts: list[Records], dtype: np.dtype[np.void], *, least: int) -> Records:
    """The rows since the cycles last began anew: since they grew by less than `least`."""
    rows = np.concatenate(parts) if parts else np.zeros(0, dtype)
    if not parts:
        return rows
    restarts = np.flatnonzero(np.diff(rows["cycle"]) < least)
    return rows[int(restarts[-1]) + 1 :] if restarts.size else rows


DRAIN_PERIOD = 0.02
"""s between two looks at the ring."""
BEHIND, LONGEST_BEHIND = 0.005, 0.2
"""s by which raw packets come later than the record made of them: as a rule, and at most."""
PUNCTUAL = 0.0005
"""s after the last cycle of a chunk is due, when it is looked for."""
BEAT_PERIOD = 0.05
"""s between two heartbeats."""
STALL_LIMIT = 5.0
"""s that a disk may keep us waiting before the heartbeat ends; the ring holds more."""
SILENCE = 0.2
"""s without a record after which an unfinished chunk is written out."""
AFTERMATH_TIMEOUT = 2.0
"""s after the end of a motion, by which its archive is completed on a link that is silent."""
EXCHANGE_QUIET = 1.0
"""s without a heartbeat of the exchange process after which the archive says so."""
ORPHAN_QUIET = 60.0
"""s after which one that lives, but gives no sign of it, is not waited for by us alone."""


@dataclass
class Job:
    """The archive that is open.

    Attributes:
        number: by which the supervisor knows it.
        recorder: fills it.
        until_ended: whether it is closed when the motion ends.
        overflow: of the ring's reader when it began.
        packets_overflow: likewise of the raw packets' reader.
        accepted, ended_count: fields of the control block when it began.
        heard: when the last record came, monotonic s.
        flushed: whether everything taken so far was written out.
        ended: when the motion's end was seen, monotonic s.
        quiet: whether it was said that the exchange gives no sign of life.
    """

    number: int
    recorder: Recorder
    until_ended: bool
    overflow: int
    packets_overflow: int
    accepted: int
    ended_count: int
    heard: float
    flushed: bool = True
    ended: float | None = None
    quiet: bool = False


class ArchiveProcess:
    """Drains, writes, and answers the supervisor.

    Args:
        ring, events, control: the exchange's memory.
        commands: to the supervisor.
        exchange: descriptor of the exchange process (a pidfd), which tells its death.
        packets: the raw packets' memory, None where they are not recorded.
    """

    def __init__(
        self,
        ring: RingReader,
        events: EventReader,
        control: ControlBlock,
        commands: Channel,
        exchange: int,
        packets: PacketReader | None = None,
    ) -> None:
        self._ring, self._events, self._control = ring, events, control
        self._commands: Channel | None = commands
        self._job: Job | None = None
        self._leaving = False
        self._progress = time.monotonic()
        self._exchange = exchange
        self._monitor = HeartbeatMonitor(lambda: control.exchange_heartbeat)
        self._packets = packets
        self._live: LivePublisher | None = None
        self._recent = Recent()

    def run(self) -> None:
        """Work until asked to end, or left alone with nothing to do."""
        threading.Thread(target=self._beat, daemon=True).start()
        while not (self._leaving and self._job is None):
            self._progress = time.monotonic()
            self._obey()
            self._take()
            if self._commands is None and self._job is None and self._exchange_gone():
                return
            self._look_after_exchange()

    def end_view(self) -> None:
        """Nobody can look any more."""
        if self._live is not None:
            self._live.close()

    def leave(self, _signum: int, _frame: FrameType | None) -> None:
        """SIGTERM: complete the archive that is open, then end."""
        self._leaving = True

    def _beat(self) -> None:
        while True:
            if time.monotonic() - self._progress < STALL_LIMIT:
                self._control.archive_heartbeat = time.monotonic()
            time.sleep(BEAT_PERIOD)

    def _obey(self) -> None:
        """Wait for a command until the ring is to be looked at again, and carry it out."""
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
                self._take()
                self._close(command.outcome, command.reason)
        elif isinstance(command, Serve):
            self._serve(command)
        elif isinstance(command, End):
            self._leaving = True
            if self._job is not None and not self._job.until_ended:
                self._close("stopped", "the recording was ended")

    def _pause(self) -> float:
        """Until the next look at the ring [s]: a chunk is written out as soon as it is full."""
        if self._job is None or self._job.flushed:
            return DRAIN_PERIOD
        return min(DRAIN_PERIOD, self._job.recorder.writer.chunk_ends_in + PUNCTUAL)

    def _serve(self, command: Serve) -> None:
        try:
            self._live = LivePublisher(command)
        except InputError as error:
            self._answer(Failed(command.job, "", error.problem, error.remedy))
        else:
            self._answer(Serving(command.job, self._live.port))

    def _open(self, command: Open) -> None:
        if self._job is not None:
            self._take()
            self._close("interrupted", "another archive was begun")
        self._idle()
        records, events, packets = self._recent.take_session()
        overflow, control = self._ring.overflow, self._control
        accepted, ended_count = control.program_accepted, control.ended_count
        try:
            recorder = Recorder(command.spec.open(), command.drive_train)
            if not command.from_now:
                recorder.record_packets(packets)
                recorder.record(records, events)
        except Exception as error:
            self._fail(command.job, error)
            return
        self._job = Job(
            command.job,
            recorder,
            command.until_ended,
            overflow,
            0 if self._packets is None else self._packets.overflow,
            accepted,
            ended_count,
            heard=time.monotonic(),
        )
        if self._live is not None:
            self._live.drive_train = command.drive_train
        control.archive_state = ArchiveState.READY
        self._answer(Opened(command.job))

    def _take(self) -> None:
        """Move what has come into the archive, and close it if the interval is over."""
        job = self._job
        if job is None:
            self._idle()
            return
        # Looked at first, so that what it left behind is taken.
        gone, ended_count = self._exchange_gone(), self._control.ended_count
        events, records = self._events.drain(), self._ring.drain()
        lost, job.overflow = self._ring.overflow - job.overflow, self._ring.overflow
        if self._live is not None:
            self._live.publish(records, events)
        now = time.monotonic()
        try:
            self._take_packets(job)
            job.recorder.record(records, events, lost)
            if ended_count != job.ended_count and job.recorder.ended is None:
                # The motion has ended, and the event that says so was overwritten.
                job.recorder.motion_ended(self._control.outcome, self._control.ended_interval)
            if len(records):
                job.heard, job.flushed = now, False
            elif not job.flushed and now - job.heard > SILENCE:
                job.recorder.writer.flush()
                job.flushed = True
        except Exception as error:  # whatever it is, the arm must not move unrecorded
            self._fail(job.number, error)
            return
        self._complete(job, now, gone=gone)

    def _take_packets(self, job: Job) -> None:
        """Move the raw packets that have come into the archive, and count those overwritten."""
        if self._packets is None:
            return
        packets, before = self._packets.drain(), job.packets_overflow
        job.packets_overflow = self._packets.overflow
        job.recorder.record_packets(packets, job.packets_overflow - before)

    def _complete(self, job: Job, now: float, *, gone: bool) -> None:
        """Close the archive if the interval is over."""
        ended = job.recorder.ended
        if ended is not None and job.ended is None:
            job.ended = now
        waited = job.ended is not None and now - job.ended > AFTERMATH_TIMEOUT
        if job.until_ended and ended is not None and (job.recorder.complete or waited or gone):
            self._close(ended.outcome, ended.reason)
        elif gone and job.until_ended:
            who = "exchange process" if self._commands is not None else "supervising program"
            if self._control.program_accepted == job.accepted:
                self._close("void", f"nothing was sent: the {who} ended")
            else:
                self._close("lost", "the exchange process ended")
        elif gone and self._commands is None:
            self._close("stopped", "the supervising program ended")

    def _look_after_exchange(self) -> None:
        """Note in the archive that the exchange stands still, and that it goes on again."""
        quiet, job = self._monitor.silence(), self._job
        if job is None:
            return
        if (quiet > EXCHANGE_QUIET) is not job.quiet:
            job.quiet = not job.quiet
            name = "ExchangeSilent" if job.quiet else "ExchangeBack"
            text = "no sign of life from the exchange process" if job.quiet else "it goes on again"
            try:
                job.recorder.warn(name, text)
            except Exception as error:
                self._fail(job.number, error)
                return
        if quiet > ORPHAN_QUIET and self._commands is None:
            self._close("lost", f"no sign of life from the exchange process for {quiet:.0f} s")

    def _idle(self) -> None:
        """Keep the newest of what comes while no archive is open."""
        records, events = self._ring.drain(), self._events.drain()
        if self._live is not None:
            self._live.publish(records, events)
        packets = None if self._packets is None else self._packets.drain()
        self._recent.keep(records, events, packets)

    def _close(self, outcome: str, reason: str) -> None:
        job, self._job = self._job, None
        if job is None:
            return
        self._control.archive_state = ArchiveState.NONE
        recorder = job.recorder
        try:
            until = time.monotonic() + LONGEST_BEHIND
            while self._packets and recorder.lacks_packets and time.monotonic() < until:
                time.sleep(BEHIND)
                self._take_packets(job)
            recorder.close(outcome, reason)
        except Exception as error:
            self._fail(job.number, error)
            return
        ended = recorder.ended
        self._answer(
            Closed(
                job.number,
                outcome,
                reason,
                interval=-1 if ended is None else ended.interval,
                records=recorder.records,
                records_lost=recorder.records_lost,
                events_lost=recorder.events_lost,
                missed=recorder.missed,
                late=recorder.late,
                not_accepted=recorder.not_accepted,
                disk_waited=recorder.writer.slowest_flush,
            )
        )

    def _fail(self, number: int, error: Exception) -> None:
        """The arm comes to rest first: that needs nothing but this one field."""
        self._control.archive_state = ArchiveState.FAILED
        self._job = None
        path, problem, remedy = "", f"{type(error).__name__}: {error}", ""
        if isinstance(error, ArchiveError):
            path, problem, remedy = str(error.path), error.problem, error.remedy
        cause = error if isinstance(error, OSError) else error.__cause__
        number_of_cause = cause.errno if isinstance(cause, OSError) else None
        self._answer(Failed(number, path, problem, remedy, number_of_cause))

    def _answer(self, answer: Answer) -> None:
        if self._commands is None:
            return
        try:
            self._commands.send(answer)
        except OSError:
            self._commands = None

    def _exchange_gone(self) -> bool:
        gone = self._control.finished or select.select([self._exchange], [], [], 0.0)[0]
        return bool(gone)


def main() -> None:
    """Attach what the command line names, and work."""
    ring, events, control, commands, exchange, n_joints, *packets = map(int, sys.argv[1:])
    for signum in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(signum, signal.SIG_IGN)
    process = ArchiveProcess(
        RingReader(ring, n_joints),
        EventReader(events),
        ControlBlock(control),
        Channel(socket(fileno=commands, type=SOCK_SEQPACKET)),
        exchange,
        PacketReader(packets[0]) if packets else None,
    )
    signal.signal(signal.SIGTERM, process.leave)
    try:
        process.run()
    finally:
        process.end_view()


if __name__ == "__main__":
    main()
