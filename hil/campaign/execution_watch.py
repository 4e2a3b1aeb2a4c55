"""Between a motion and the operator: what is shown of it, and what is requested of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import cast

from hil.archive.header import WORDS

from .motion_watch import MotionProgress, OperatorRequest
from .operator import DriftCurve, Operator, Phase, RunStatus
from .stop import Stop

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
        motions_left: after the present one.
        drift: of the warm-up so far.
        began: when the present motion began, or the last one [s since 1970]; later than it was
            asked for where it was held.
        blind: what went wrong with showing, None for nothing; nothing is shown from then on.
        deaf: what went wrong first with asking for a request, None for nothing.
    """

    operator: Operator
    stop: Stop
    time_left: float = 0.0
    motions_left: int = 0
    drift: DriftCurve | None = None
    began: float = 0.0
    blind: Exception | None = None
    deaf: Exception | None = None
    _shown: bool = False
    _held_deaf: bool = False
    _phase: Phase = "move"
    _number: int = 1
    _total: int = 1
    _duration: float = 0.0
    _most: float = 1.0
    _request: OperatorRequest = field(default_factory=OperatorRequest)
    _notes: tuple[str, ...] = ()

    def expect(self, seconds: float) -> None:
        """One more motion is to come, of so many s."""
        self.time_left += seconds
        self.motions_left += 1

    def begin(self, kind: str, number: int, total: int, duration: float, most: float) -> None:
        """The next motion.

        Args:
            kind: of its archive.
            number: which of its kind, from 1.
            total: of how many.
            duration: at full speed [s].
            most: largest override.
        """
        self.time_left = max(0.0, self.time_left - duration / most)
        self.motions_left = max(0, self.motions_left - 1)
        self._phase, self._number, self._total = _phase_of(kind), number, total
        self._duration, self._most = duration, most
        self._shown, self.began = False, time.time()
        self._tell(None)

    def note(self, text: str) -> None:
        """A line on the quality of a motion."""
        self._duration = 0.0  # notes are written between motions
        self._notes = (*self._notes, text)[-NOTES:]
        self._tell(None)

    def show(self, progress: MotionProgress) -> None:
        """See `MotionWatch.show`; links do not show a motion before they ask for it."""
        if not self._shown:
            self._shown, self.began = True, time.time()
        self._tell(progress)

    def request(self) -> OperatorRequest:
        """See `MotionWatch.request`."""
        try:
            request: object = self.operator.request()
            if not isinstance(request, OperatorRequest):
                raise TypeError(f"{request!r} is no OperatorRequest")
            self._request = request
        except Exception as error:  # the arm moves: a screen must not decide how it ends
            self.deaf = self.deaf or error
            if self._request.held and not self.stop.requested:
                self._held_deaf = self.stop.requested = True
        return self._request

    @property
    def troubles(self) -> tuple[str, ...]:
        """What went wrong with the operator's screen, in sentences."""
        sentences = []
        if self.blind is not None:
            sentences.append(
                f"the operator's screen failed ({_words(self.blind)}); nothing was shown"
            )
        if self.deaf is not None:
            became = "the last request stayed in force"
            if self._held_deaf:
                became = "the arm was held, which nobody could end any more: the run was stopped"
            why = _words(self.deaf)
            sentences.append(f"the operator could not be asked for requests ({why}); {became}")
        return tuple(sentences)

    def _tell(self, progress: MotionProgress | None) -> None:
        if self.blind is not None:
            return
        done = 0.0 if progress is None or progress.motion_time is None else progress.motion_time
        wished = max(self._request.override, 0.01)
        left = max(self._duration - done, 0.0) / min(self._most, wished) + self.time_left / wished
        status = RunStatus(
            self._phase,
            self._number,
            self._total,
            left,
            motion=progress,
            drift=self.drift,
            notes=self._notes,
            motions_left=self.motions_left,
        )
        try:
            self.operator.show(status)
        except Exception as error:  # likewise
            self.blind = error


def _phase_of(kind: str) -> Phase:
    return cast(Phase, WORDS.get(kind, kind))


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
