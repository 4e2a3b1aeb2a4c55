"""The operator of a running campaign: what is shown to him of the run, and what he accepts."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Protocol

from hil.archive.header import KIND_NAMES
from hil.control.motion_watch import MotionProgress, OperatorRequest, Stop

if TYPE_CHECKING:
    from .dry_run import DryRunRecord


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
