"""Moves that the controller makes by itself: from posture to posture, at rest in each.

Repeated for ever they go to and fro through the list: each way but the first is one that the list
has, so that where the list keeps clear of something, so do the repetitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_fixtures.errors import SettingError

Array = NDArray[np.float64]

RUN_UP = 0.4
"""Time [s] to full speed at the acceleration that these moves keep; a guess."""
_PEAK_SPEED = 15.0 / 8.0
_PEAK_ACCELERATION = 10.0 / sqrt(3.0)


def quintic(s: float) -> tuple[float, float]:
    """Return the share of the way at time share s in [0, 1] and its derivative.

    10 s^3 - 15 s^4 + 6 s^5: speed and acceleration are zero at both ends, the jerk is finite.
    """
    left = 1.0 - s
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * s * s * left * left


def duration(distance: Array, speed: Array) -> float:
    """Return how long [s] a quintic over `distance` [rad] at most at `speed` [rad/s] takes."""
    reach = np.abs(distance)
    by_speed = float((_PEAK_SPEED * reach / speed).max())
    by_acceleration = sqrt(float((_PEAK_ACCELERATION * reach * RUN_UP / speed).max()))
    return max(by_speed, by_acceleration)


class OwnMotion:
    """Visits postures one after the other; all joints of a move start and stop together.

    Attributes:
        position, velocity: set-point of the present tick, (n,) [rad], [rad/s].
        finished: the last posture is reached, or the motion was asked to end.
        at_rest: no move is under way.
    """

    def __init__(
        self,
        postures: Sequence[Sequence[float]],
        *,
        speed: ArrayLike,
        period: float,
        dwell: float = 0.2,
        repeats: bool = False,
    ) -> None:
        """Take the list; `begin` says from where.

        Args:
            postures: joint angles (n,) [rad] each.
            speed: greatest speed of each joint, (n,) [rad/s].
            period: cycle [s].
            dwell: rest in each posture [s].
            repeats: go back through the list at its end, and forth again, until asked to end.

        Raises:
            SettingError: a posture of another size, or a speed that is not a finite number above 0.
        """
        self._speed: Array = np.array(speed, dtype=np.float64)
        if not (np.isfinite(self._speed).all() and (self._speed > 0.0).all()):
            raise SettingError("own_motion", self._speed.tolist(), "velocity limits in the URDF")
        n = self._speed.size
        for posture in postures:
            if len(posture) != n:
                raise SettingError("own_motion", tuple(posture), f"{n} joint angles")
        self._postures = [np.array(posture, dtype=np.float64) for posture in postures]
        self._period = period
        self._repeats = repeats
        self._dwell_cycles = max(1, round(dwell / period))
        self._ending = False
        self.begin(np.zeros(n))

    def begin(self, position: ArrayLike) -> None:
        """Start the list from where the arm stands, (n,) [rad]."""
        self.position: Array = np.array(position, dtype=np.float64)
        self.velocity: Array = np.zeros_like(self.position)
        self._next = 0
        self._stride = 1
        self._from = self._to = self.position
        self._cycle = self._cycles = 0
        self._rested = 0
        self._ending = False

    @property
    def at_rest(self) -> bool:
        """Whether no move is under way."""
        return self._cycle >= self._cycles

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        done = self._ending or not 0 <= self._next < len(self._postures)
        return done and self.at_rest

    def end(self) -> None:
        """Finish the move that is under way and begin no other."""
        self._ending = True

    def advance(self) -> tuple[Array, Array]:
        """Return the set-point of the next tick: position [rad] and velocity [rad/s], (n,)."""
        if self.at_rest and not self.finished:
            self._rested += 1
            if self._rested > self._dwell_cycles:
                self._start_move()
        if not self.at_rest:
            self._cycle += 1
            share, rate = quintic(self._cycle / self._cycles)
            way = self._to - self._from
            # at the end exactly where it was to go, not a rounding beside it
            at_end = self._cycle == self._cycles
            self.position = self._to if at_end else self._from + share * way
            self.velocity = rate / (self._cycles * self._period) * way
        return self.position, self.velocity

    def _start_move(self) -> None:
        self._from, self._to = self.position, self._postures[self._next]
        self._next += self._stride
        at_an_end = not 0 <= self._next < len(self._postures)
        if self._repeats and len(self._postures) > 1 and at_an_end:
            self._stride = -self._stride
            self._next += 2 * self._stride
        self._cycle = self._rested = 0
        self._cycles = ceil(duration(self._to - self._from, self._speed) / self._period)
