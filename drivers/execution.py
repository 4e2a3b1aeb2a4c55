"""Execution of one requested motion or correction, from request to rest.

A source is foreign code inside the cycle: anything it raises (SystemExit included), any array that
is not (n,) numbers, and bounds wider than allowed become `SourceFailed`. Allowed are the bounds of
a plan; those of an override from the first change of override on; those of a stop from `stop` or
the first `hold` on; for a correction, until it is at rest. A stop that takes too long is a failure;
a hold that does not come to rest becomes a stop.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from drivers.errors import SourceFailed, error_text
from drivers.events import Outcome
from drivers.guard import RANK
from drivers.motion_source import (
    BoundsName,
    CorrectionSource,
    FeedForwardSource,
    MotionSource,
    ResumableSource,
    is_correction,
    is_holdable,
    is_motion,
)
from drivers.states import CORRECTION_MODES, POSITION_MODES

Array = NDArray[np.float64]

_AT_REST: Final = 1e-9
"""Rounding of standstill, rad per cycle and rad/s."""


class Execution(ABC):
    """Common part of motions and corrections.

    The end is held for `settle_cycles`; a stop or hold may take `stop_cycles`.

    Attributes:
        started: the first set-point was sent.
        fraction: of the planned speed, last requested; None before.
        held: a hold is active.
        leaving: the motion came to rest and open mode is being left.
        finished: the source is finished.
        outcome, reason: of the motion once open mode has been left.
    """

    def __init__(
        self,
        source: MotionSource | CorrectionSource,
        n_joints: int,
        settle_cycles: int,
        stop_cycles: int,
    ) -> None:
        self._source = source
        self._shape = (n_joints,)
        self._still = np.zeros(n_joints)
        self._settle_cycles = settle_cycles
        self._stop_cycles = stop_cycles
        self._allowed: tuple[BoundsName, ...] = ("plan",)
        self._rest_by: int | None = None  # first cycle in which it takes too long
        self._resting = 0
        self.finished = False
        self.started = False
        self.fraction: float | None = None
        self.held = False
        self.leaving = False
        self.outcome: Outcome = "completed"
        self.reason = "the motion is complete"

    @property
    def settled(self) -> bool:
        """Whether the end was held for `settle_cycles`."""
        return self.finished and self._resting >= self._settle_cycles

    @property
    def widest(self) -> BoundsName:
        """The widest bounds allowed now."""
        return self._allowed[-1]

    def begin(self, position: Array, cycle: int) -> None:
        """Begin at the first set-point, (n,) rad; hold at once if that was requested before.

        Raises:
            SourceFailed: the source does not begin there, or does not hold.
        """
        try:
            self._begin_source(position)
            self.finished = bool(self._source.finished)
        except BaseException as error:
            raise _failed("cannot begin", error, cycle) from error
        self.started = True
        if self.held and (reason := self.hold(cycle)) is not None:
            raise SourceFailed(f"{reason}, before it began", cycle)

    @abstractmethod
    def _begin_source(self, position: Array) -> None:
        """Begin the source at this position, (n,) rad."""

    def stop(self, reason: str, cycle: int) -> None:
        """Come to rest on the path; the first reason stays. Raises SourceFailed."""
        if self.outcome == "stopped" or self.finished:
            return
        self.outcome = "stopped"
        self.reason = reason
        self.held = False
        self._rest_by = cycle + self._stop_cycles
        self._allow("stop")
        try:
            self._source.stop()
        except BaseException as error:
            raise _failed("failed to stop", error, cycle) from error

    def override(self, fraction: float) -> str | None:
        """Change the override; return why that is not possible, or None."""
        try:
            change = getattr(self._source, "override", None)
            if not callable(change):
                return "this motion has no override"
            if self.outcome == "stopped":
                return "the motion is being stopped"
            if not 0.0 <= fraction <= 1.0:
                return f"an override of {fraction!r} is not one of 0..1"
            change(float(fraction))
        except BaseException as error:
            return f"the motion source refused it: {error_text(error)}"
        self._allow("override")
        self.fraction = float(fraction)
        return None

    def hold(self, cycle: int) -> str | None:
        """Come to rest on the path until `resume`; return why that is not possible, or None.

        Before its begin the request is stored: the motion begins at rest, and stays there.
        """
        if self.outcome == "stopped" or self.finished:
            return None
        source: object = self._source
        try:
            if not is_holdable(source):
                return "held, which this motion cannot: it was stopped instead"
            if self.started:  # a source may reset itself when it begins
                self._allow("stop")
                source.hold()
        except BaseException as error:
            return f"the motion source failed to hold: {error_text(error)}"
        self.held = True
        if self._rest_by is None and self.started:
            self._rest_by = cycle + 1 + self._stop_cycles
        return None

    def mark_at_rest(self) -> None:
        """The motion is at rest, which completes a hold."""
        if self.outcome != "stopped":
            self._rest_by = None

    def resume(self) -> str | None:
        """Continue after a hold; return why that is not possible, or None."""
        source: object = self._source
        try:
            if not is_holdable(source):
                return "this motion cannot be held"
            if self.outcome == "stopped":
                return "the motion is being stopped"
            if self.started:
                source.resume()
        except BaseException as error:
            return f"the motion source refused it: {error_text(error)}"
        self._rest_by, self.held = None, False
        return None

    def _allow(self, bounds: BoundsName) -> None:
        if bounds not in self._allowed:
            self._allowed = tuple(sorted((*self._allowed, bounds), key=RANK.__getitem__))

    def _checked(self, values: object, what: str, cycle: int) -> Array:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != self._shape:
            raise SourceFailed(
                f"the motion source gave a {what} of shape {array.shape}, not {self._shape}", cycle
            )
        return array

    def _require_rest(self, cycle: int) -> None:
        """Raise for a stop that takes too long; stop a hold that does."""
        if self._rest_by is None or cycle < self._rest_by:
            return
        if self.outcome != "stopped":
            self.stop(f"it did not come to rest in {self._stop_cycles} cycles of a hold", cycle)
            return
        raise SourceFailed(
            f"the motion source did not come to rest in the {self._stop_cycles} cycles after "
            "a stop was requested",
            cycle,
        )


class MotionExecution(Execution):
    """Set-points of a `MotionSource`.

    Attributes:
        position: (n,) rad, the last set-point.
        feeds_forward: the source is a `FeedForwardSource`.
    """

    _source: MotionSource

    def __init__(
        self, source: MotionSource, n_joints: int, settle_cycles: int, stop_cycles: int
    ) -> None:
        super().__init__(source, n_joints, settle_cycles, stop_cycles)
        self.position = self._still
        self.feeds_forward = callable(getattr(source, "feed_forward", None))

    def _begin_source(self, position: Array) -> None:
        self.position = position
        self._source.begin(position.copy())

    def advance(self, cycle: int) -> tuple[Array, Array, BoundsName]:
        """Return the next set-point (n,) rad, rad/s, and its bounds; the end is held."""
        try:
            if self.finished:
                self._resting += 1
                return self.position, self._still, self._bounds(cycle)
            given, speed = self._source.advance()
            position = self._checked(given, "position", cycle)
            velocity = self._checked(speed, "velocity", cycle)
            bounds = self._bounds(cycle)
            self.finished = bool(self._source.finished)
        except SourceFailed:
            raise
        except BaseException as error:
            raise _failed("failed", error, cycle) from error
        if self._rest_by is not None and self._is_at_rest(position, velocity):
            self.mark_at_rest()
        self._require_rest(cycle)
        # The source may reuse its arrays.
        self.position = position.copy()
        return self.position, velocity, bounds

    @property
    def is_resumable(self) -> bool:
        """Whether the source is a running `ResumableSource`."""
        running = self.started and not self.finished
        return running and callable(getattr(self._source, "resume_from", None))

    def resume_from(self, position: Array, velocity: Array, cycles: int, cycle: int) -> None:
        """Continue from the controller's target, see `ResumableSource`; raises SourceFailed."""
        try:
            # Copies, because the guard compares with these arrays.
            source = cast(ResumableSource, self._source)
            source.resume_from(position.copy(), velocity.copy(), cycles)
        except BaseException as error:
            raise _failed("cannot continue", error, cycle) from error

    def feed_forward(self, cycle: int) -> tuple[Array, Array]:
        """Return velocity (n,) rad/s and motor current (n,) A of the set-point given last."""
        if self._resting:
            return self._still, self._still
        try:
            velocity, current = cast(FeedForwardSource, self._source).feed_forward()
            return (
                self._checked(velocity, "feed-forward velocity", cycle).copy(),
                self._checked(current, "feed-forward current", cycle).copy(),
            )
        except SourceFailed:
            raise
        except BaseException as error:
            raise _failed("failed to feed forward", error, cycle) from error

    def _is_at_rest(self, position: Array, velocity: Array) -> bool:
        step = np.abs(position - self.position).max()
        return bool(max(step, np.abs(velocity).max()) <= _AT_REST)

    def _bounds(self, cycle: int) -> BoundsName:
        bounds = self._source.bounds
        if not isinstance(bounds, str) or bounds not in self._allowed:
            allowed = " or ".join(self._allowed)
            raise SourceFailed(f"the motion source named bounds {bounds!r}, not {allowed}", cycle)
        return bounds


class CorrectionExecution(Execution):
    """Corrections of a `CorrectionSource`; after its end they are zero."""

    _source: CorrectionSource

    def mark_at_rest(self) -> None:
        """End the bounds allowed for a hold, because a correction does not name its bounds."""
        super().mark_at_rest()
        if self.outcome != "stopped":
            self._allowed = tuple(name for name in self._allowed if name != "stop")

    def _begin_source(self, position: Array) -> None:  # noqa: ARG002  a correction has no position
        self._source.begin()

    def advance(self, cycle: int) -> tuple[Array, Array]:
        """Return the next correction: motion (n,), see `CorrectionSource`, and current (n,) A."""
        if self.finished:
            self._resting += 1
            return self._still, self._still
        try:
            given, amperes = self._source.advance()
            motion = self._checked(given, "correction", cycle)
            current = self._checked(amperes, "current", cycle)
            self.finished = bool(self._source.finished)
        except SourceFailed:
            raise
        except BaseException as error:
            raise _failed("failed", error, cycle) from error
        self._require_rest(cycle)
        return motion.copy(), current.copy()


def execution_of(
    source: MotionSource | CorrectionSource,
    mode: int,
    n_joints: int,
    settle_cycles: int,
    stop_cycles: int,
) -> Execution | str:
    """Return the execution of a source, or why the open mode cannot run it."""
    try:
        if mode in CORRECTION_MODES and is_correction(source):
            return CorrectionExecution(source, n_joints, settle_cycles, stop_cycles)
        if mode in POSITION_MODES and is_motion(source):
            return MotionExecution(source, n_joints, settle_cycles, stop_cycles)
    except BaseException as error:
        return f"the motion source cannot be inspected: {error_text(error)}"
    return f"a {type(source).__name__} is not the kind of source mode {mode} needs"


def _failed(what: str, error: BaseException, cycle: int) -> SourceFailed:
    return SourceFailed(f"the motion source {what}: {error_text(error)}", cycle)
