"""The operator of a running campaign: what the run shows, and what it asks to accept."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Protocol

from hil.archive.header import KIND_NAMES
from hil.control.motion_watch import MotionProgress, OperatorRequest, Stop

if TYPE_CHECKING:
    from .dry_run_record import DryRunRecord


@dataclass(frozen=True, eq=False)
class RunStatus:
    """Progress of a run, about ten times a second while the arm moves.

    Attributes:
        phase: purpose of the motion, such as "repetition"; "move" for a way between the others.
        number: which of its kind, from 1.
        total: number of its kind; of a warm-up, the largest number.
        time_left: to the end of the run, each motion at its override [s]; of a warm-up with its
            least number of motions. What is requested in a dry run counts until its end.
        motion: the motion that is being run; None between two.
        most: largest override of the motion, whatever is requested.
    """

    phase: str
    number: int
    total: int
    time_left: float
    motion: MotionProgress | None = None
    most: float = 1.0


@dataclass(frozen=True)
class ExpectedMotion:
    """A motion that is to be run.

    Attributes:
        duration: at full speed [s].
        most: its largest override, a fraction.
        dry_run: whether it belongs to the dry run.
    """

    duration: float
    most: float = 1.0
    dry_run: bool = False

    def time(self, override: float = 1.0) -> float:
        """Return the time of the motion at a requested override [s]."""
        return self.duration / min(self.most, override)


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


@dataclass(frozen=True)
class ScreenFailed:
    """An operator's screen that failed, and showed nothing from then on."""

    error: str  #: type and message


@dataclass(frozen=True)
class RequestUnread:
    """A request of the operator that could not be read."""

    error: str  #: type and message
    ended_hold: bool  #: whether a hold could not be released, so that the run was stopped


OperatorFault = ScreenFailed | RequestUnread


SECONDS_BETWEEN_MOTIONS: Final = 0.6  # s between two motions, to open and close the axes
_MIN_OVERRIDE: Final = 0.01  # override at which the time left is computed, at least


@dataclass(eq=False)
class RunWatch:
    """A `MotionWatch` that shows the progress of the whole run to its operator.

    Errors of the operator's screen are reported and end no motion, which continues at the speed
    requested last. A hold that cannot be released any more becomes a stop.

    Attributes:
        began: when the present or the last motion began [s since 1970], after any hold.
        status: shown last, except for its time left.
    """

    operator: Operator
    stop: Stop
    began: float = 0.0
    status: RunStatus = RunStatus("move", 1, 1, 0.0)
    _expected: list[ExpectedMotion] = field(default_factory=list)
    _present: ExpectedMotion = ExpectedMotion(0.0)
    _in_dry_run: bool = False
    _override_after: float = 1.0
    _request: OperatorRequest = OperatorRequest()
    _faults: dict[str, OperatorFault] = field(default_factory=dict)

    def expect(self, motions: Sequence[ExpectedMotion]) -> None:
        """Add motions that are to be run."""
        self._expected += motions

    def begin(self, kind: str, number: int, total: int, duration: float, most: float) -> None:
        """Begin a motion.

        Args:
            kind: of the motion.
            number: of the motion, from 1.
            total: of the motions.
            duration: at full speed [s].
            most: largest override.
        """
        if kind not in ("dryrun", "move"):
            self._expected = [one for one in self._expected if not one.dry_run]
        known = (one for one in self._expected if math.isclose(one.duration, duration))
        if (expected := next(known, None)) is not None:
            self._expected.remove(expected)
        self._present = ExpectedMotion(duration, most)
        in_dry_run = kind == "dryrun" or any(one.dry_run for one in self._expected)
        if in_dry_run and not self._in_dry_run:
            self._override_after = self.request().override
        if in_dry_run or kind != "move":
            self._in_dry_run = in_dry_run
        self.began = time.time()
        self._show(
            None,
            phase=KIND_NAMES.get(kind, kind),
            number=number,
            total=total,
            most=most,
        )

    def end(self) -> None:
        """Show that the motion has ended."""
        self._present = ExpectedMotion(0.0)
        self._show(None)

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
            ends_hold = self._request.held and not self.stop.requested
            if ends_hold:
                self.stop.requested = True
                self._faults.pop("request", None)
            self._faults.setdefault("request", RequestUnread(_described(error), ends_hold))
        return self._request

    @property
    def faults(self) -> tuple[OperatorFault, ...]:
        """Errors of the operator's screen."""
        return tuple(self._faults.values())

    def _show(self, progress: MotionProgress | None, **changes: Any) -> None:
        done = 0.0 if progress is None or progress.motion_time is None else progress.motion_time
        override = max(self._request.override, _MIN_OVERRIDE)
        after = max(self._override_after, _MIN_OVERRIDE) if self._in_dry_run else override
        remaining = self._present.time(override) - done / min(self._present.most, override)
        remaining = max(remaining, 0.0) + SECONDS_BETWEEN_MOTIONS * len(self._expected)
        remaining += sum(one.time(override if one.dry_run else after) for one in self._expected)
        self.status = replace(self.status, motion=progress, time_left=remaining, **changes)
        if "show" in self._faults:
            return
        try:
            self.operator.show(self.status)
        except Exception as error:  # nor what is shown
            self._faults["show"] = ScreenFailed(_described(error))


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
