"""The supervisor's handle on the archive process."""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import socket
import time
from dataclasses import dataclass, field
from socket import AF_UNIX, SOCK_SEQPACKET, socketpair
from typing import Any, Protocol

from drivers.child_process import ChildProcess
from drivers.drive_train import DriveTrain
from drivers.exchange.control import HeartbeatMonitor, SharedState
from hil.archive.live import Serve
from hil.archive.recorder import ArchiveSpec, Recorded


@dataclass(frozen=True, eq=False)
class Open:
    """Open an archive; one that is open is closed as interrupted.

    Without `from_now` it begins with the oldest buffered record of the session. With `until_ended`
    it is closed at the end of the motion; otherwise only on `Close`.
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
class Shutdown:
    """Close the open archive and end the process."""


@dataclass(frozen=True)
class Opened:
    """Archive `job` is open: the motion may begin."""

    job: int


@dataclass(frozen=True)
class Serving:
    """The live view is served at this TCP port."""

    job: int
    port: int


@dataclass(frozen=True)
class Closed:
    """Archive `job` is complete."""

    job: int
    recorded: Recorded


@dataclass(frozen=True)
class Failed:
    """Archive `job` could not be opened or written; what was flushed is intact."""

    job: int
    path: str
    problem: str
    remedy: str
    errno: int | None = None


Command = Open | Close | Serve | Shutdown
Answer = Opened | Closed | Serving | Failed


class CommandSocket:
    """One end of the command socket, a `SOCK_SEQPACKET`.

    A message is sent in parts after their number; neither end waits longer than `TIMEOUT` s.
    """

    PART = 64 << 10
    TIMEOUT = 5.0

    def __init__(self, end: socket.socket, timeout: float = TIMEOUT) -> None:
        self._socket = end
        end.settimeout(timeout)

    def fileno(self) -> int:
        """Return the descriptor, for `select`."""
        return self._socket.fileno()

    def send(self, message: Any) -> None:
        """Send a message; TimeoutError if the peer does not receive it, and the channel is lost."""
        data = pickle.dumps(message, protocol=5)
        parts = range(0, len(data), self.PART)
        self._socket.sendall(len(parts).to_bytes(4, "little"))
        for start in parts:
            self._socket.sendall(data[start : start + self.PART])

    def receive(self) -> Any:
        """Wait for the next message; EOFError if the peer has closed, or stopped within one."""
        head = self._part()
        return pickle.loads(b"".join(self._part() for _ in range(int.from_bytes(head, "little"))))

    def _part(self) -> bytes:
        try:
            part = self._socket.recv(self.PART)
        except TimeoutError as error:
            raise EOFError("the peer stopped within a message") from error
        except ConnectionError as error:
            raise EOFError("the peer has closed its end") from error
        if not part:
            raise EOFError("the peer has closed its end")
        return part

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


LAST_FLUSH_TIMEOUT = 30.0  # Time for the last flush of a slow disk, s
HUNG_TIMEOUT = 5.0
"""Time without a heartbeat after which the process is killed, s; a slow disk does not stop it."""
NO_TIME = (
    "it was suspended, or this PC gave it no processor time: end other programs, and check this PC "
    "with `hil doctor`"
)
"""Why a process sends no heartbeat, and what to do."""
EXIT_TIMEOUT = 2.0  # Time to exit for a process that was killed or has closed its socket, s
EXIT_POLL_PERIOD = 0.05  # Time between two checks whether the process has ended, s


class SharedMemory(Protocol):
    """The exchange process and its descriptors."""

    pid: int
    ring_fd: int
    event_fd: int
    control_fd: int


def silent_for(silence: float) -> str:
    """Return why a process was ended that sent no heartbeat for a time [s]."""
    return f"sent no heartbeat for {silence:g} s and was ended ({NO_TIME})"


@dataclass(eq=False)
class ArchiveProcessHandle:
    """Starts, commands and ends the archive process, a child in its own process session."""

    process: ChildProcess
    channel: CommandSocket
    monitor: HeartbeatMonitor
    _gone: bool = False
    _ended_for: str = field(default="")

    @classmethod
    def start(cls, memory: SharedMemory, n_joints: int) -> ArchiveProcessHandle:
        """Start the process on the exchange's shared memory."""
        control = SharedState(memory.control_fd)
        monitor = HeartbeatMonitor(lambda: control.archive_heartbeat)
        with contextlib.ExitStack() as undo:
            exchange = os.pidfd_open(memory.pid)
            undo.callback(os.close, exchange)
            ours, theirs = socketpair(AF_UNIX, SOCK_SEQPACKET)
            undo.callback(theirs.close)
            undo.callback(ours.close)
            passed = (memory.ring_fd, memory.event_fd, memory.control_fd, theirs.fileno(), exchange)
            numbers = map(str, (*passed, n_joints))
            process = ChildProcess(("-m", "hil.archive.process", *numbers), descriptors=passed)
            undo.pop_all()
            os.close(exchange)
            theirs.close()
        return cls(process, CommandSocket(ours), monitor)

    @property
    def alive(self) -> bool:
        """Whether the process runs and its socket is open."""
        return not self._gone and self.process.alive

    def failure(self) -> str | None:
        """Return the fault of the process, None if it works; one that hangs is killed."""
        if self.alive and self.monitor.silence() > HUNG_TIMEOUT:
            self.kill(silent_for(HUNG_TIMEOUT))
        if self.alive:
            return None
        return f"the archive process {self._ended_for or f'ended ({self.process.last_error})'}"

    def kill(self, reason: str) -> None:
        """Kill the process; `reason` continues "the archive process" in messages."""
        self._ended_for = reason
        self._gone = True
        self.process.kill(EXIT_TIMEOUT)

    def send(self, command: Command) -> None:
        """Send a command; `failure` reports one that could not be delivered."""
        try:
            self.channel.send(command)
        except TimeoutError:
            self.kill(f"accepted no command for {CommandSocket.TIMEOUT:g} s and was ended")
        except OSError:
            self._lose()

    def answer(self, timeout: float, job: int) -> Answer | None:
        """Return the next answer about archive `job`; answers about earlier archives are dropped.

        None if none comes within `timeout` s, or the process has ended.
        """
        deadline = time.monotonic() + timeout
        while self.alive or not self._gone:
            remaining = max(0.0, deadline - time.monotonic())
            if not select.select([self.channel], [], [], remaining)[0]:
                return None
            try:
                answer: Answer = self.channel.receive()
            except EOFError:
                self._lose()
                return None
            if answer.job == job:
                return answer
        return None

    def end(self) -> str | None:
        """Close the open archive and end the process, killed if it hangs; return its fault."""
        if self.alive:
            self.send(Shutdown())
        deadline = time.monotonic() + LAST_FLUSH_TIMEOUT
        while self.process.alive and not self._gone:
            if self.monitor.silence() > HUNG_TIMEOUT:
                self.kill(silent_for(HUNG_TIMEOUT))
            elif time.monotonic() > deadline:
                self.kill(f"did not end within {LAST_FLUSH_TIMEOUT:g} s and was killed")
            else:
                self.process.wait(EXIT_POLL_PERIOD)
        if not self._ended_for and self.process.status not in (0, None):
            self._ended_for = f"ended ({self.process.last_error})"
        self.channel.close()
        self.process.close()
        return f"the archive process {self._ended_for}" if self._ended_for else None

    def _lose(self) -> None:
        """Wait for a process that has closed its socket."""
        self.process.wait(EXIT_TIMEOUT)
        self._gone = True
