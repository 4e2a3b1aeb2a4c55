"""The life of one requested motion, from request to rest."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import SourceFailed
from drivers.events import Outcome
from drivers.motion_source import BoundsName, MotionSource

Array = NDArray[np.float64]

# No live override can be asked for, so no source has a use for its bounds.
_MOVING: Final = ("plan",)
_STOPPING: Final = ("plan", "stop")


class Execution:
    """Asks one motion source for set-points and keeps the answer honest.

    A source is foreign code inside the cycle: whatever it raises, any array that is not (n,)
    numbers, and bounds wider than what it was asked for become `SourceFailed`: it has those of a
    plan, from `stop` on those of a stop as well. So does a stop that takes too long.

    Args:
        source: the motion.
        n_joints: n.
        settle_cycles: how long its end is held.
        stop_cycles: how many set-points it may give after it was told to stop.

    Attributes:
        started: the first set-point was taken.
        leaving: the motion came to rest and open mode is being left.
        outcome: what it will be called when open mode has been left.
        reason: in words.
    """

    def __init__(
        self, source: MotionSource, n_joints: int, settle_cycles: int, stop_cycles: int
    ) -> None:
        self._source = source
        self._shape = (n_joints,)
        self._still = np.zeros(n_joints)
        self._settle_cycles = settle_cycles
        self._granted: tuple[str, ...] = _MOVING
        self._stop_cycles = stop_cycles
        self._stopping = 0
        self._resting = 0
        self._finished = False
        self.started = False
        self.leaving = False
        self.outcome: Outcome = "completed"
        self.reason = "the motion came to its end"
        self.position = self._still

    @property
    def settled(self) -> bool:
        """Whether the arm was held at the end for as long as was asked."""
        return self._finished and self._resting >= self._settle_cycles

    def begin(self, position: Array, cycle: int) -> None:
        """Take the first set-point, (n,) rad.

        Raises:
            SourceFailed: the source does not begin there.
        """
        self.position = position
        try:
            self._source.begin(position.copy())
            self._finished = bool(self._source.finished)
        except Exception as error:
            raise SourceFailed(f"the motion cannot begin: {error}", cycle) from error
        self.started = True

    def advance(self, cycle: int) -> tuple[Array, Array, BoundsName]:
        """The next set-point (n,) rad, rad/s, and the bounds it keeps; the end is held.

        Raises:
            SourceFailed: the source raised or gave no proper set-point.
        """
        try:
            if self._finished:
                self._resting += 1
                return self.position, self._still, self._bounds(cycle)
            position, velocity = self._source.advance()
            position = np.asarray(position, dtype=np.float64)
            velocity = np.asarray(velocity, dtype=np.float64)
            bounds = self._bounds(cycle)
            self._finished = bool(self._source.finished)
        except SourceFailed:
            raise
        except Exception as error:
            raise SourceFailed(f"the motion source failed: {error}", cycle) from error
        if position.shape != self._shape or velocity.shape != self._shape:
            raise SourceFailed(
                f"the motion source gave shapes {position.shape} and {velocity.shape}, "
                f"not {self._shape}",
                cycle,
            )
        self._count_stopping(cycle)
        # The source may reuse its arrays.
        self.position = position.copy()
        return self.position, velocity, bounds

    def _bounds(self, cycle: int) -> BoundsName:
        bounds = self._source.bounds
        if not isinstance(bounds, str) or bounds not in self._granted:
            granted = " or ".join(self._granted)
            raise SourceFailed(f"the motion source named bounds {bounds!r}, not {granted}", cycle)
        return bounds

    def _count_stopping(self, cycle: int) -> None:
        if self.outcome != "stopped":
            return
        self._stopping += 1
        if self._stopping > self._stop_cycles:
            raise SourceFailed(
                f"the motion source did not come to rest in the {self._stop_cycles} cycles after "
                "it was told to stop",
                cycle,
            )

    def stop(self, reason: str, cycle: int) -> None:
        """Come to rest on the path. The first reason stays.

        Raises:
            SourceFailed: the source raised.
        """
        if self.outcome == "stopped" or self._finished:
            return
        self.outcome = "stopped"
        self.reason = reason
        self._granted = _STOPPING
        try:
            self._source.stop()
        except Exception as error:
            raise SourceFailed(f"the motion source failed to stop: {error}", cycle) from error
