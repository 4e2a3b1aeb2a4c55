"""What the supervisor and the archive process say to each other, as pickles over a socket pair.

Both ends are our own processes, the one started by the other; nobody else can reach the socket.
Each archive has a number, so that an answer that comes late is not taken for that of the next one.
"""

from __future__ import annotations

import pickle
import socket
from dataclasses import dataclass
from typing import Any

from drivers.drive_train import DriveTrain
from hil.archive.live_view import LiveView
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
        until_ended: close it when the motion has ended; otherwise only when told to.
    """

    job: int
    spec: ArchiveSpec
    drive_train: DriveTrain
    from_now: bool
    until_ended: bool


@dataclass(frozen=True, eq=False)
class Serve:
    """Let viewers look from now on, whether or not an archive is open.

    Attributes:
        job: for the answer, `Serving` or `Failed`.
        view: where.
        joint_names: of the link's joints.
        period: of the controller, s.
        drive_train: in force until an archive says otherwise.
    """

    job: int
    view: LiveView
    joint_names: tuple[str, ...]
    period: float
    drive_train: DriveTrain


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
        untaken: answers that the controller did not take.
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
    untaken: int
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
