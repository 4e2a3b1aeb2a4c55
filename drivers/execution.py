"""Execution of one requested motion, from request to rest.

A source is foreign code inside the cycle: anything it raises (SystemExit included), any array that
is not (n,) numbers, and bounds wider than allowed become `SourceFailed`. Allowed are the bounds of
a plan; those of an override from the first change of override on; those of a stop from `stop` or
the first `hold` on. A stop that takes too long is a failure;
a hold that does not come to rest becomes a stop.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from drivers.arrays import Array
from drivers.errors import SourceFailed, error_text
from drivers.guard import RANK
from drivers.motion_source import BoundsName, MotionSource, has_members
from drivers.states import Outcome

_REST_TOLERANCE: Final = 1e-9
"""Rounding of standstill, rad per cycle and rad/s."""
_MEMBERS: Final = ("begin", "advance", "finished", "stop", "bounds")
_HOLD: Final = ("hold", "resume")
_SET_POINT: Final = ("position", "velocity")


class Execution:
    """Set-points of a `MotionSource`.

    Args:
        source: of the set-points.
        n_joints: number of joints.
        settle_cycles: for which the end is held.
        stop_cycles: that a stop or hold may take.

    Attributes:
        started: the first set-point was sent.
        position: (n,) rad, the last set-point.
        fraction: of the planned speed, last requested; None before.
        held: a hold is active.
        leaving: the motion came to rest and open mode is being left.
        finished: the source is finished.
        outcome, reason: of the motion once open mode has been left.
    """

    def __init__(
        self,
        source: MotionSource,
        n_joints: int,
        settle_cycles: int,
        stop_cycles: int,
    ) -> None:
        self._source: Any = source
        self._settle_cycles = settle_cycles
        self._stop_cycles = stop_cycles
        self._still = np.zeros(n_joints)
        self._shape = (n_joints,)
        self._allowed: tuple[BoundsName, ...] = ("plan",)
        self._rest_by: int | None = None  # first cycle in which it takes too long
        self._resting = 0
        self.position = self._still
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
    def is_resumable(self) -> bool:
        """Whether the source runs and can continue from the controller's target."""
        running = self.started and not self.finished
        return running and callable(getattr(self._source, "resume_from", None))

    def begin(self, position: Array, cycle: int) -> None:
        """Begin at the first set-point, (n,) rad; hold immediately if requested before.

        Raises:
            SourceFailed: the source does not begin there, or does not hold.
        """
        with _failing("cannot begin", cycle):
            self.position = position
            self._source.begin(position.copy())
            self.finished = bool(self._source.finished)
        self.started = True
        if self.held and (reason := self.hold(cycle)) is not None:
            raise SourceFailed(f"{reason}, before it began", cycle)

    def stop(self, reason: str, cycle: int) -> None:
        """Come to rest on the path; the first reason stays. Raises SourceFailed."""
        if self.outcome == "stopped" or self.finished:
            return
        self.outcome = "stopped"
        self.reason = reason
        self.held = False
        self._rest_by = cycle + self._stop_cycles
        self._allow("stop")
        with _failing("failed to stop", cycle):
            self._source.stop()

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
        try:
            if not has_members(self._source, _HOLD):
                return "held, which this motion cannot: it was stopped instead"
            if self.started:  # a source may reset itself when it begins
                self._allow("stop")
                self._source.hold()
        except BaseException as error:
            return f"the motion source failed to hold: {error_text(error)}"
        self.held = True
        if self._rest_by is None and self.started:
            self._rest_by = cycle + 1 + self._stop_cycles
        return None

    def resume(self) -> str | None:
        """Continue after a hold; return why that is not possible, or None."""
        try:
            if not has_members(self._source, _HOLD):
                return "this motion cannot be held"
            if self.outcome == "stopped":
                return "the motion is being stopped"
            if self.started:
                self._source.resume()
        except BaseException as error:
            return f"the motion source refused it: {error_text(error)}"
        self._rest_by = None
        self.held = False
        return None

    def advance(self, cycle: int) -> tuple[Array, Array, BoundsName]:
        """Return the next set-point (n,) rad, rad/s, and its bounds; the end is held.

        Raises SourceFailed.
        """
        try:
            if self.finished:
                self._resting += 1
                return self.position, self._still, self._bounds()
            first, second = self._source.advance()
            first = self._checked(first, _SET_POINT[0])
            second = self._checked(second, _SET_POINT[1])
            bounds = self._bounds()
            self.finished = bool(self._source.finished)
        except BaseException as error:
            raise _failed("failed", error, cycle) from error
        if self._rest_by is not None:
            moved = np.abs(first - self.position).max()
            if max(moved, np.abs(second).max()) <= _REST_TOLERANCE:
                self.mark_at_rest()
            self._require_rest(cycle)
        # The source may reuse its arrays.
        self.position = first.copy()
        return self.position, second, bounds

    def resume_from(self, position: Array, velocity: Array, cycles: int, cycle: int) -> None:
        """Continue from the controller's target, see `MotionSource`.

        Args:
            position: of the target (n,) [rad].
            velocity: of the target (n,) [rad/s].
            cycles: since the source gave its last set-point.
            cycle: number of the cycle.

        Raises:
            SourceFailed: the source cannot continue.
        """
        with _failing("cannot continue", cycle):
            # Copies, because the guard compares with these arrays.
            self._source.resume_from(position.copy(), velocity.copy(), cycles)

    def mark_at_rest(self) -> None:
        """The motion is at rest, which completes a hold, and its bounds where none are named."""
        if self.outcome == "stopped":
            return
        self._rest_by = None

    def _allow(self, bounds: BoundsName) -> None:
        if bounds not in self._allowed:
            self._allowed = tuple(sorted((*self._allowed, bounds), key=RANK.__getitem__))

    def _checked(self, values: object, what: str) -> Array:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != self._shape:
            raise ValueError(f"a {what} of shape {array.shape}, not {self._shape}")
        return array

    def _bounds(self) -> BoundsName:
        bounds: BoundsName = self._source.bounds
        if not isinstance(bounds, str) or bounds not in self._allowed:
            raise ValueError(f"bounds {bounds!r}, not {' or '.join(self._allowed)}")
        return bounds

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


@contextmanager
def _failing(what: str, cycle: int) -> Iterator[None]:
    """Make a `SourceFailed` of whatever a source raises."""
    try:
        yield
    except BaseException as error:
        raise _failed(what, error, cycle) from error


def _failed(what: str, error: BaseException, cycle: int) -> SourceFailed:
    return SourceFailed(f"the motion source {what}: {error_text(error)}", cycle)


def execution_of(
    source: MotionSource, n_joints: int, settle_cycles: int, stop_cycles: int
) -> Execution | str:
    """Return the execution of a source, or why it cannot run.

    Args:
        source: of the set-points.
        n_joints: of the cell.
        settle_cycles: that the end is held.
        stop_cycles: that a stop or a hold may take.
    """
    try:
        if has_members(source, _MEMBERS):
            return Execution(source, n_joints, settle_cycles, stop_cycles)
    except BaseException as error:
        return f"the motion source cannot be inspected: {error_text(error)}"
    return f"a {type(source).__name__} is not a motion source"
