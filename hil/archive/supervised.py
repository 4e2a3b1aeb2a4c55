"""The supervisor's handle on the archive process."""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from socket import AF_UNIX, SOCK_SEQPACKET, socketpair
from typing import IO, Any, Protocol

from drivers.drive_train import DriveTrain
from drivers.exchange.control import ControlBlock, HeartbeatMonitor
from hil.archive.live import Serve
from hil.archive.recorder import ArchiveSpec


@dataclass(frozen=True, eq=False)
class Open:
    """Begin an archive; one that is still open is closed as interrupted.

    Attributes:
        job: number of the archive.
        spec: which.
        drive_train: in force on the link.
        from_now: leave out what came before; otherwise begin with the session's oldest record
            that is still there.
        until_ended: close it when the motion has ended; otherwise only on `Close`.
    """

    job: int
    spec: ArchiveSpec
    drive_train: DriveTrain
    from_now: bool
    until_ended: bool


@dataclass(frozen=True)
class Close:
    """Complete archive `job`, if it is open, with this outcome."""

    job: int
    outcome: str
    reason: str


@dataclass(frozen=True)
class End:
    """Close what is open and end the process."""


@dataclass(frozen=True)
class Opened:
    """Archive `job` is open: the motion may begin."""

    job: int


@dataclass(frozen=True)
class Serving:
    """Viewers can look, at this TCP port."""

    job: int
    port: int


@dataclass(frozen=True)
class Closed:
    """Archive `job` is complete.

    Attributes:
        job: its number.
        outcome, reason: as in it.
        interval: of the motion, -1 without one.
        records, records_lost: how many it holds, and how many it should hold but does not.
        events_lost: likewise of events.
        missed: packets that never arrived.
        late: answers that were late or left out.
        not_accepted: answers that the controller did not take.
        disk_waited: longest time that the disk took at once [s].
    """

    job: int
    outcome: str
    reason: str
    interval: int
    records: int
    records_lost: int
    events_lost: int
    missed: int
    late: int
    not_accepted: int
    disk_waited: float


@dataclass(frozen=True)
class Failed:
    """Archive `job` could not be opened or written further; what was flushed is whole.

    Attributes:
        errno: the operating system's number of the failure, None where it was none of its own.
    """

    job: int
    path: str
    problem: str
    remedy: str
    errno: int | None = None


Command = Open | Close | Serve | End
Answer = Opened | Closed | Serving | Failed


class Channel:
    """One end of the socket, a `SOCK_SEQPACKET`.

    A message may be larger than the socket takes at once: it is sent in parts, the number of
    parts first. Neither end waits longer than `TIMEOUT` for the other.
    """

    PART = 64 << 10
    TIMEOUT = 5.0

    def __init__(self, end: socket.socket, timeout: float = TIMEOUT) -> None:
        self._socket = end
        end.settimeout(timeout)

    def fileno(self) -> int:
        """For `select`."""
        return self._socket.fileno()

    def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            TimeoutError: the far end does not take it; the channel is of no use any more.
            OSError: the far end is gone.
        """
        data = pickle.dumps(message, protocol=5)
        parts = range(0, len(data), self.PART)
        self._socket.sendall(len(parts).to_bytes(4, "little"))
        for start in parts:
            self._socket.sendall(data[start : start + self.PART])

    def receive(self) -> Any:
        """The next message; waits for it.

        Raises:
            EOFError: the far end is gone, or has stopped in the middle of a message.
        """
        head = self._part()
        return pickle.loads(b"".join(self._part() for _ in range(int.from_bytes(head, "little"))))

    def _part(self) -> bytes:
        try:
            part = self._socket.recv(self.PART)
        except TimeoutError as error:
            raise EOFError("the far end stopped in the middle of a message") from error
        except ConnectionError as error:
            raise EOFError("the far end is gone") from error
        if not part:
            raise EOFError("the far end is gone")
        return part

    def close(self) -> None:
        """Give the socket up."""
        self._socket.close()


END_TIMEOUT = 30.0
"""s for the last flush of a slow disk."""
HUNG = 5.0
"""s without a sign of life after which it is ended; a slow disk alone does not silence it."""
LAST_BREATH = 2.0
"""s that a process whose socket is closed, or that was killed, may take to be gone."""
LOOK = 0.05
"""s between two looks while it is waited for."""


class SharedMemory(Protocol):
    """What the archive process attaches: the exchange process and its descriptors."""

    pid: int
    ring_fd: int
    event_fd: int
    control_fd: int


def _import_paths() -> list[str]:
    return [path or str(Path.cwd()) for path in sys.path]


@dataclass(eq=False)
class ArchiveProcessHandle:
    """Starts, commands and ends the archive process.

    Attributes:
        process: the child, in a process session of its own.
        channel: our end of the command socket.
        pulse: of its heartbeat.
    """

    process: subprocess.Popen[bytes]
    channel: Channel
    monitor: HeartbeatMonitor
    _words: IO[bytes]
    _gone: bool = False
    _ended_for: str = field(default="")

    @classmethod
    def start(
        cls, memory: SharedMemory, n_joints: int, packets_fd: int = -1
    ) -> ArchiveProcessHandle:
        """Start the process on the exchange's shared memory; `packets_fd` where packets are stored.

        Raises:
            OSError: the system refuses a process, a socket or memory.
        """
        control = ControlBlock(memory.control_fd)
        pulse = HeartbeatMonitor(lambda: control.archive_heartbeat)
        with contextlib.ExitStack() as undo:
            words: IO[bytes] = undo.enter_context(tempfile.TemporaryFile())
            exchange = os.pidfd_open(memory.pid)
            undo.callback(os.close, exchange)
            ours, theirs = socketpair(AF_UNIX, SOCK_SEQPACKET)
            undo.callback(theirs.close)
            undo.callback(ours.close)
            passed = (memory.ring_fd, memory.event_fd, memory.control_fd, theirs.fileno(), exchange)
            packets = () if packets_fd < 0 else (packets_fd,)
            numbers = map(str, (*passed, n_joints, *packets))
            process = subprocess.Popen(
                [sys.executable, "-m", "hil.archive.process", *numbers],
                pass_fds=(*passed, *packets),
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=words,
                # What this process can import, that one can.
                env={**os.environ, "PYTHONPATH": os.pathsep.join(_import_paths())},
            )
            undo.pop_all()
            os.close(exchange)
            theirs.close()
        return cls(process, Channel(ours), pulse, words)

    @property
    def alive(self) -> bool:
        """Whether the process runs and can be talked to."""
        return not self._gone and self.process.poll() is None

    def failure(self) -> str | None:
        """What is wrong with the process, in words; one that hangs is ended. None if it works."""
        if self.alive and self.monitor.silence() > HUNG:
            self.kill(f"sent no heartbeat for {HUNG:g} s and was ended")
        if self.alive:
            return None
        return f"the archive process {self._ended_for or 'ended' + self.last_words()}"

    def kill(self, why: str) -> None:
        """End a process that hangs, for a reason that follows "the archive process"."""
        self._ended_for, self._gone = why, True
        self.process.kill()
        self._wait(LAST_BREATH)

    def send(self, command: Command) -> None:
        """Send a command; one that cannot be delivered shows in `failure`."""
        try:
            self.channel.send(command)
        except TimeoutError:
            self.kill(f"took no command for {Channel.TIMEOUT:g} s and was ended")
        except OSError:
            self._lose()

    def answer(self, timeout: float, job: int) -> Answer | None:
        """The next answer about archive `job`; those about earlier ones are dropped.

        None if none comes within `timeout` s, or none will ever.
        """
        deadline = time.monotonic() + timeout
        while self.alive or not self._gone:
            left = max(0.0, deadline - time.monotonic())
            if not select.select([self.channel], [], [], left)[0]:
                return None
            try:
                answer: Answer = self.channel.receive()
            except EOFError:
                self._lose()
                return None
            if answer.job == job:
                return answer
        return None

    def last_words(self) -> str:
        """What a process that died wrote last, as the rest of a sentence."""
        if self._words.closed:
            return ""
        size = os.fstat(self._words.fileno()).st_size
        text = os.pread(self._words.fileno(), 400, max(0, size - 400)).decode(errors="replace")
        lines = text.strip().splitlines()
        return f" ({lines[-1]})" if lines else f" (exit status {self.process.poll()})"

    def end(self) -> str | None:
        """Let it complete what is open and end; what was wrong with it, None if nothing was.

        It is waited for; one that hangs is killed.
        """
        if self.alive:
            self.send(End())
        deadline = time.monotonic() + END_TIMEOUT
        while self.process.poll() is None and not self._gone:
            if self.monitor.silence() > HUNG:
                self.kill(f"sent no heartbeat for {HUNG:g} s and was ended")
            elif time.monotonic() > deadline:
                self.kill(f"did not end within {END_TIMEOUT:g} s and was killed")
            else:
                self._wait(LOOK)
        status = self.process.poll()
        if not self._ended_for and status not in (0, None):
            self._ended_for = f"ended{self.last_words()}"
        self.channel.close()
        self._words.close()
        return f"the archive process {self._ended_for}" if self._ended_for else None

    def _lose(self) -> None:
        """Its socket is closed: it is dead or about to be."""
        self._wait(LAST_BREATH)
        self._gone = True

    def _wait(self, timeout: float) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout)
