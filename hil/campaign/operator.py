"""The operator of a running campaign: what is shown to him, and what he requests."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.states import State
from hil.archive.header import KIND_NAMES

if TYPE_CHECKING:
    from .dry_run import DryRunRecord

Array = NDArray[np.float64]

REQUESTS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
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
        for signum in REQUESTS:
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


@dataclass(frozen=True, eq=False)
class RunStatus:
    """Progress of a run, about ten times a second while the arm moves.

    Attributes:
        phase: purpose of the motion, such as "repetition"; "move" for a way between the others.
        number: which of its kind, from 1.
        total: number of its kind; of a warm-up, the largest number.
        time_left: to the end of the run, the present motion at its override [s]; of a warm-up with
            its least number of motions.
        motion: the motion that is being run; None between two.
    """

    phase: str
    number: int
    total: int
    time_left: float
    motion: MotionProgress | None = None


class Operator(Protocol):
    """Operator of a run; as quick as a `MotionWatch`. Errors of his screen end no motion."""

    @property
    def can_answer(self) -> bool:
        """Whether he can be asked to accept a dry run."""
        ...

    def show(self, status: RunStatus) -> None:
        """Show the progress of the run."""
        ...

    def request(self) -> OperatorRequest:
        """Return the present request."""
        ...

    def accept_dry_run(self, record: DryRunRecord) -> bool:
        """Ask whether the slow motion was right; False where he cannot be asked."""
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


BETWEEN: Final = 0.6  # s between two motions, to open and close the axes


@dataclass(eq=False)
class RunWatch:
    """A `MotionWatch` that shows the progress of the whole run to its operator.

    Errors of the operator's screen are reported and end no motion, which continues at the speed
    requested last. A hold that cannot be released any more becomes a stop.

    Attributes:
        time_left: s after the present motion, each of the others at its largest override.
        began: when the present or the last motion began [s since 1970], after any hold.
        status: shown last, except for its time left.
    """

    operator: Operator
    stop: Stop
    time_left: float = 0.0
    began: float = 0.0
    status: RunStatus = RunStatus("move", 1, 1, 0.0)
    _duration: float = 0.0
    _most: float = 1.0
    _request: OperatorRequest = OperatorRequest()
    _problems: dict[str, str] = field(default_factory=dict)

    def expect(self, times: Sequence[float]) -> None:
        """Add motions that are to be run, with the duration of each [s]."""
        self.time_left += sum(times) + BETWEEN * len(times)

    def begin(self, kind: str, number: int, total: int, duration: float, most: float) -> None:
        """Begin a motion of `duration` s at full speed, at an override of at most `most`."""
        self.time_left = max(0.0, self.time_left - duration / most - BETWEEN)
        self._duration = duration
        self._most = most
        self.began = time.time()
        self._show(
            None,
            phase=KIND_NAMES.get(kind, kind),
            number=number,
            total=total,
        )

    def show(self, progress: MotionProgress) -> None:
        """See `MotionWatch.show`."""
        if self.status.motion is None:
            self.began = time.time()
        self._show(progress)

    def request(self) -> OperatorRequest:
        """See `MotionWatch.request`."""
        try:
            request: object = self.operator.request()
            if not isinstance(request, OperatorRequest):
                raise TypeError(f"{request!r} is no OperatorRequest")
            self._request = request
        except Exception as error:  # the arm moves: a screen must not decide how it ends
            became = "the last request remained active"
            if self._request.held and not self.stop.requested:
                self.stop.requested = True
                became = "the arm was held and could not be released any more: the run was stopped"
                self._problems.pop("request", None)
            self._problems.setdefault(
                "request",
                f"the operator's request could not be read ({type(error).__name__}: {error}); "
                f"{became}",
            )
        return self._request

    @property
    def problems(self) -> tuple[str, ...]:
        """Errors of the operator's screen, in sentences."""
        return tuple(self._problems.values())

    def _show(self, progress: MotionProgress | None, **changes: Any) -> None:
        done = 0.0 if progress is None or progress.motion_time is None else progress.motion_time
        requested = max(self._request.override, 0.01)
        left = max(self._duration - done, 0.0) / min(self._most, requested)
        self.status = replace(
            self.status, motion=progress, time_left=left + self.time_left / requested, **changes
        )
        if "show" in self._problems:
            return
        try:
            self.operator.show(self.status)
        except Exception as error:  # nor what is shown
            text = f"{type(error).__name__}: {error}"
            self._problems["show"] = f"the operator's screen failed ({text}); nothing was shown"
