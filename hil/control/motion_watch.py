"""What is shown of a motion to whoever watches it, and what he requests."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Final, Protocol

from drivers.states import State
from hil.base.arrays import Array

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, the usual request to end, and the end of the terminal."""


REFUSED: Final = "REFUSED"  # Begins the line of a refusal


@dataclass
class Stop:
    """Request to stop; the link then brings the arm to rest on its path.

    `insisted` is set by a second request.
    """

    requested: bool = False
    insisted: bool = False


@contextmanager
def stop_on_interrupt(*, twice: bool = False) -> Iterator[Stop]:
    """Turn SIGINT, SIGTERM and SIGHUP into a request to stop on the path.

    A second one is the ordinary interrupt and ends the program at once; on a real link the exchange
    process then still brings the arm to rest. With `twice` the second one sets `insisted`, and the
    third one ends the program. A SIGHUP that is ignored (nohup) stays ignored.
    """
    stop = Stop()

    def request(signum: int, frame: FrameType | None) -> None:
        if stop.insisted or (stop.requested and not twice):
            signal.default_int_handler(signum, frame)
        stop.insisted = stop.requested
        stop.requested = True

    with ExitStack() as undo:
        for signum in STOP_SIGNALS:
            previous = signal.getsignal(signum)
            if signum is signal.SIGHUP and previous is signal.SIG_IGN:
                continue
            signal.signal(signum, request)
            undo.callback(signal.signal, signum, previous)
        yield stop


@dataclass(frozen=True)
class OperatorRequest:
    """Override, a fraction of the planned speed (ValueError outside 0..1), and hold on the path."""

    override: float = 1.0
    held: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.override <= 1.0:
            raise ValueError(f"an override of {self.override!r} is not one of 0..1")


@dataclass(frozen=True, eq=False)
class MotionProgress:
    """State of a motion. Joint arrays are (n,); None before the first record.

    Following error and current are None while the drive is off, too.

    Attributes:
        motion_time, duration: s of the planned motion, done and in total; None if unknown.
        cycles, missed, late, not_accepted: packets of this motion that got a reply, never arrived,
            got it late or not at all, and whose reply was not accepted.
        late_packets: packets of this motion that came late themselves.
        position: rad, measured.
        following_error: rad, the controller's target minus position.
        current: A at the motors, the controller's target; no current is measured.
        following_share, current_share: their magnitudes as shares of the active limits.
        override: the fraction requested last.
        rate: present fraction of the planned speed; None if unknown.
    """

    motion_time: float | None
    duration: float | None
    cycles: int
    missed: int
    late: int
    not_accepted: int
    state: State
    position: Array | None = None
    following_error: Array | None = None
    following_share: Array | None = None
    current: Array | None = None
    current_share: Array | None = None
    override: float = 1.0
    rate: float | None = None
    held: bool = False
    late_packets: int = 0


class MotionWatch(Protocol):
    """Observer of a motion that may slow, hold and release it.

    Its methods must return at once: the arm is brought to rest on its path when one takes longer
    than a second on a real link.
    """

    def show(self, progress: MotionProgress) -> None:
        """Show the motion; called about ten times a second."""
        ...

    def request(self) -> OperatorRequest:
        """Return the present request."""
        ...


class Unattended:
    """No operator: full speed, no hold, and no dry run is accepted."""

    can_answer = False

    def show(self, status: object) -> None:
        """Show nothing."""
        del status

    def request(self) -> OperatorRequest:
        """Return full speed."""
        return OperatorRequest()

    def accept_dry_run(self, record: object) -> bool:
        """Return False."""
        del record
        return False


unwatched_motion = Unattended()  # For motions without a watch
