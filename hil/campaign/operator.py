"""The person at a running campaign: what is shown of it and its motions, and what is requested."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from drivers.states import State
from hil.archive.header import KIND_NAMES

if TYPE_CHECKING:
    from .dry_run import DryRun

Array = NDArray[np.float64]

REQUESTS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, whoever ends programs, and the end of the terminal."""


@dataclass
class Stop:
    """Set by Ctrl-C; the link then brings the arm to rest on its path.

    Attributes:
        requested: once.
        insisted: again, where that is asked for.
    """

    requested: bool = False
    insisted: bool = False


@contextmanager
def stop_on_interrupt(*, twice: bool = False) -> Iterator[Stop]:
    """Turn SIGINT, SIGTERM and SIGHUP into a request to stop on the path.

    A second one is the ordinary interrupt: it ends the program at once. In virtual time the
    controller is then on its own; on a real link the exchange process notices, and still brings
    the arm to rest. With `twice` the second is a request too, `insisted`, and the third ends.
    A signal that is ignored (SIGHUP under nohup) stays ignored.
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
    """What the person wants of the motion, until another request.

    Attributes:
        override: fraction (0 to 1) of the planned speed.
        held: whether the arm is to rest on its path.

    Raises:
        ValueError: an override that is none.
    """

    override: float = 1.0
    held: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.override <= 1.0:
            raise ValueError(f"an override of {self.override!r} is not one of 0..1")


@dataclass(frozen=True)
class Latency:
    """How long the PC took from a packet's arrival to its answer, in this motion [s].

    `p99` is not exceeded by 99 % of the answers.
    """

    median: float
    p99: float
    worst: float


@dataclass(frozen=True, eq=False)
class MotionProgress:
    """A motion at one moment. Joint arrays are (n,); None before the first record.

    Attributes:
        motion_time, duration: s of the planned motion, done and in all, at full speed; None if
            the source does not tell.
        cycles, missed, late, not_accepted: packets of this motion that were answered, never
            arrived, were answered late or left out, and whose reply was not accepted.
        state: of the session.
        position: rad, measured.
        following_error: rad, the controller's target minus position.
        following_share: magnitude of that as a share of the threshold in force.
        current: A at the motors, the controller's target (there is no measured one).
        current_share: magnitude of that as a share of the limit in force.
        override: the fraction asked for last.
        rate: fraction of the planned speed at this moment; None if the source does not tell.
        held: whether a hold was asked for.
        latency: None in virtual time, which has none, and before the first answer.
        events: the last ones of this motion, in words, oldest first.
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
    latency: Latency | None = None
    events: tuple[str, ...] = ()


class MotionWatch(Protocol):
    """Whoever looks at a motion and may slow, hold and release it.

    Both are called from the loop that supervises the motion and must return at once: no stop and
    no hold is passed on meanwhile. On a real link the arm is brought to rest on its path when one
    of them takes longer than a second.
    """

    def show(self, progress: MotionProgress) -> None:
        """Look; called about ten times a second."""
        ...

    def request(self) -> OperatorRequest:
        """The latest request."""
        ...


Phase = Literal["dry run", "warm-up", "standstill", "repetition", "validation", "move"]
"""What a motion is for, in the words of the screen. A "move" is a way between the others."""


@dataclass(frozen=True, eq=False)
class DriftCurve:
    """How friction changes while the joints warm up, from one motion to the next.

    Attributes:
        joint_names: of the n joints.
        friction: (k, n) friction of each motion so far [N·m], by the measure of `warmup`.
        change: (k,) largest change of any joint from the motion before, as a share of its
            friction; NaN for the first.
        threshold: change below which the joints count as warm.
    """

    joint_names: tuple[str, ...]
    friction: Array
    change: Array
    threshold: float


@dataclass(frozen=True, eq=False)
class RunStatus:
    """Where a run stands, about ten times a second while something moves.

    Attributes:
        phase: what the motion is for.
        number: which of its kind, from 1.
        total: how many there are of its kind; of a warm-up, how many there may be.
        time_left: of motion to the end of the run, the present one at its override [s]; of a
            warm-up, whose length nobody knows, at least as many motions as it has to have.
        motions_left: after the present one.
        motion: of the motion that is being run; None between two.
        drift: of the warm-up so far, None where there is none.
        notes: on the quality of the last repetitions, newest last.
    """

    phase: Phase
    number: int
    total: int
    time_left: float
    motion: MotionProgress | None = None
    drift: DriftCurve | None = None
    notes: tuple[str, ...] = ()
    motions_left: int = 0


class Operator(Protocol):
    """Who watches a run; as quick as a `MotionWatch`. One that raises costs only what it shows."""

    @property
    def can_answer(self) -> bool:
        """Whether there is a person to accept a dry run."""
        ...

    def show(self, status: RunStatus) -> None:
        """Show where the run stands."""
        ...

    def request(self) -> OperatorRequest:
        """Return what the person requests now: override and hold."""
        ...

    def accept_dry_run(self, found: DryRun) -> bool:
        """Ask whether the slow motion looked right; False where nobody can answer."""
        ...


class Unattended:
    """Nobody watches a run, or a motion: full speed, no hold, and no dry run is accepted."""

    can_answer = False

    def show(self, status: object) -> None:
        """Show nothing."""
        del status

    def request(self) -> OperatorRequest:
        """Full speed."""
        return OperatorRequest()

    def accept_dry_run(self, found: object) -> bool:
        """Nobody has seen it."""
        del found
        return False


unwatched_motion = Unattended()
"""For motions that nobody watches."""

NOTES = 4
"""Last notes on quality that are shown."""


@dataclass(eq=False)
class RunWatch:
    """A `MotionWatch` that tells the operator where the whole run stands.

    What an operator's screen gets wrong must not end a motion: it is reported, and the motion goes
    on at the speed requested last. Each request is asked for anew, whatever the last one met with.
    A hold is another matter: one that nobody can release any more becomes a stop.

    Attributes:
        operator: who looks.
        stop: brings the arm to rest on its path.
        time_left: s of motion after the present one, each at the largest override it may have.
        began: when the present motion began, or the last one [s since 1970]; later than it was
            asked for where it was held.
        status: what was shown last, but for its time left.
    """

    operator: Operator
    stop: Stop
    time_left: float = 0.0
    began: float = 0.0
    status: RunStatus = RunStatus("move", 1, 1, 0.0)
    _duration: float = 0.0
    _most: float = 1.0
    _request: OperatorRequest = OperatorRequest()
    _troubles: dict[str, str] = field(default_factory=dict)

    def expect(self, times: list[float]) -> None:
        """More motions are to come, of so many s each."""
        self.time_left += sum(times)
        self.status = replace(self.status, motions_left=self.status.motions_left + len(times))

    def begin(self, kind: str, number: int, total: int, duration: float, most: float) -> None:
        """The next motion, of `duration` s at full speed, at an override of at most `most`."""
        self.time_left = max(0.0, self.time_left - duration / most)
        self._duration, self._most, self.began = duration, most, time.time()
        self._tell(
            None,
            phase=cast(Phase, KIND_NAMES.get(kind, kind)),
            number=number,
            total=total,
            motions_left=max(0, self.status.motions_left - 1),
        )

    def note(self, text: str) -> None:
        """A line on the quality of the motion that has ended."""
        self._duration = 0.0
        self._tell(None, notes=(*self.status.notes, text)[-NOTES:])

    def warms(self, drift: DriftCurve) -> None:
        """How far the warm-up is."""
        self.status = replace(self.status, drift=drift)

    def show(self, progress: MotionProgress) -> None:
        """See `MotionWatch.show`; links do not show a motion before they ask for it."""
        if self.status.motion is None:
            self.began = time.time()
        self._tell(progress)

    def request(self) -> OperatorRequest:
        """See `MotionWatch.request`."""
        try:
            request: object = self.operator.request()
            if not isinstance(request, OperatorRequest):
                raise TypeError(f"{request!r} is no OperatorRequest")
            self._request = request
        except Exception as error:  # the arm moves: a screen must not decide how it ends
            became = "the last request stayed in force"
            if self._request.held and not self.stop.requested:
                self.stop.requested = True
                became = "the arm was held, which nobody could end any more: the run was stopped"
                self._troubles.pop("request", None)
            self._troubles.setdefault(
                "request",
                f"the operator could not be asked for requests ({type(error).__name__}: {error}); "
                f"{became}",
            )
        return self._request

    @property
    def troubles(self) -> tuple[str, ...]:
        """What went wrong with the operator's screen, in sentences."""
        return tuple(self._troubles.values())

    def _tell(self, progress: MotionProgress | None, **changes: Any) -> None:
        done = 0.0 if progress is None or progress.motion_time is None else progress.motion_time
        requested = max(self._request.override, 0.01)
        left = max(self._duration - done, 0.0) / min(self._most, requested)
        self.status = replace(
            self.status, motion=progress, time_left=left + self.time_left / requested, **changes
        )
        if "show" in self._troubles:
            return
        try:
            self.operator.show(self.status)
        except Exception as error:  # likewise
            said = f"{type(error).__name__}: {error}"
            self._troubles["show"] = f"the operator's screen failed ({said}); nothing was shown"
