"""The life of one requested motion, from request to rest."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import SourceFailed
from drivers.events import Outcome
from drivers.motion_source import BoundsName, MotionSource

Array = NDArray[np.float64]

_BOUNDS: Final = ("plan", "override", "stop")


class Execution:
    """Asks one motion source for set-points and keeps the answer honest.

    A source is foreign code inside the cycle: whatever it raises, and any array that is not (n,)
    numbers, becomes `SourceFailed`.

    Attributes:
        started: the first set-point was taken.
        leaving: the motion came to rest and open mode is being left.
        outcome: what it will be called when open mode has been left.
        reason: in words.
    """

    def __init__(self, source: MotionSource, n_joints: int, settle_cycles: int) -> None:
        self._source = source
        self._shape = (n_joints,)
        self._still = np.zeros(n_joints)
        self._settle_cycles = settle_cycles
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
            self._finished = self._source.finished
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
                return self.position, self._still, self._source.bounds
            position, velocity = self._source.advance()
            position = np.asarray(position, dtype=np.float64)
            velocity = np.asarray(velocity, dtype=np.float64)
            bounds = self._source.bounds
            self._finished = self._source.finished
        except Exception as error:
            raise SourceFailed(f"the motion source failed: {error}", cycle) from error
        if position.shape != self._shape or velocity.shape != self._shape:
            raise SourceFailed(
                f"the motion source gave shapes {position.shape} and {velocity.shape}, "
                f"not {self._shape}",
                cycle,
            )
        if bounds not in _BOUNDS:
            raise SourceFailed(f"the motion source named bounds {bounds!r}", cycle)
        # The source may reuse its arrays.
        self.position = position.copy()
        return self.position, velocity, bounds

    def stop(self, reason: str, cycle: int) -> None:
        """Come to rest on the path. The first reason stays.

        Raises:
            SourceFailed: the source raised.
        """
        if self.outcome == "stopped" or self._finished:
            return
        self.outcome = "stopped"
        self.reason = reason
        try:
            self._source.stop()
        except Exception as error:
            raise SourceFailed(f"the motion source failed to stop: {error}", cycle) from error
