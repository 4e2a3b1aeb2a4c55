"""A motion known at samples only, with the smoothest thing that can be said in between."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from planner.arrays import Array, read_only
from planner.errors import InvalidTrajectory
from planner.piecewise_cubic import Extrema


@dataclass(frozen=True, eq=False)
class SampledTrajectory:
    """A motion given as rows of a table; between two rows, the quintic that meets both.

    It is C2 and passes every row exactly. Between the rows it is a guess: where the motion that
    was sampled switches its jerk, this one swings. Jerk that switched between its limits reaches
    2.5 times the limit for less than two periods, whatever the period; what acceleration,
    velocity and position are off by falls with the first, second and third power of the period.

    Before time 0 and after `duration` the joints are assumed to rest where the motion begins and
    ends.

    Attributes:
        time: Times of the rows, rising from 0, (m,) [s], at least two.
        position: (m, n) [rad].
        velocity: (m, n) [rad/s].
        acceleration: (m, n) [rad/s²].

    Raises:
        InvalidTrajectory: shapes that do not belong together, values that are not finite, times
            that do not rise from 0.
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array

    def __post_init__(self) -> None:
        for name in ("time", "position", "velocity", "acceleration"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
            if not np.all(np.isfinite(getattr(self, name))):
                raise InvalidTrajectory(f"{name} of a sampled motion must be finite")
        rows = (self.position, self.velocity, self.acceleration)
        if (
            self.time.ndim != 1
            or len(self.time) < 2
            or self.position.ndim != 2
            or self.position.shape[1] == 0
            or any(row.shape != (len(self.time), self.position.shape[1]) for row in rows)
        ):
            raise InvalidTrajectory(
                f"time {self.time.shape}, position, velocity, acceleration "
                f"{', '.join(str(row.shape) for row in rows)} do not belong together; expected "
                "(m,) with m >= 2 and three times (m, n)"
            )
        if self.time[0] != 0.0 or np.any(np.diff(self.time) <= 0.0):
            raise InvalidTrajectory("the times of a sampled motion must rise from 0")

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return float(self.time[-1])

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.position.shape[1])

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at the times `t` (m,), each (m, n)."""
        t = np.asarray(t, dtype=np.float64)
        within = np.clip(t, 0.0, self.duration)
        piece = np.searchsorted(self.time[1:-1], within, side="right")
        x = (within - self.time[piece])[:, None]
        c0, c1, c2, c3, c4, c5 = (c[piece] for c in self._quintics)
        q = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
        qd = c1 + x * (2 * c2 + x * (3 * c3 + x * (4 * c4 + x * 5 * c5)))
        qdd = 2 * c2 + x * (6 * c3 + x * (12 * c4 + x * 20 * c5))
        outside = within != t
        qd[outside] = 0.0
        qdd[outside] = 0.0
        end = within == self.duration  # to the last digit, as every other row
        q[end] = self.position[-1]
        qd[end & ~outside] = self.velocity[-1]
        qdd[end & ~outside] = self.acceleration[-1]
        return q, qd, qdd

    def extrema(self) -> Extrema:
        """Return bounds of the extremes over all time, per joint.

        A polynomial stays within its Bézier points, so nothing between the rows escapes them.
        """
        hulls = [self._bezier]
        for degree in (5, 4, 3):
            hulls.append(degree * np.diff(hulls[-1], axis=0) / self._periods)
        position, *rates = hulls
        largest = [np.max(np.abs(hull), axis=(0, 1)) for hull in rates]
        return Extrema(position.min(axis=(0, 1)), position.max(axis=(0, 1)), *largest)

    @cached_property
    def _periods(self) -> Array:
        return np.diff(self.time)[:, None]

    @cached_property
    def _bezier(self) -> Array:
        """Bézier points of every piece (6, m - 1, n)."""
        h = self._periods
        q, v, a = self.position, self.velocity * 0.2, self.acceleration * 0.05
        return np.stack(
            (
                q[:-1],
                q[:-1] + h * v[:-1],
                q[:-1] + h * (2 * v[:-1] + h * a[:-1]),
                q[1:] - h * (2 * v[1:] - h * a[1:]),
                q[1:] - h * v[1:],
                q[1:],
            )
        )

    @cached_property
    def _quintics(self) -> tuple[Array, ...]:
        """Coefficients of every piece, lowest power of time since its row first, (m - 1, n)."""
        h = self._periods
        q, v, a = self.position[:-1], self.velocity[:-1], self.acceleration[:-1]
        # What a constant acceleration from the row leaves to be made up at the next one.
        dq = self.position[1:] - q - h * (v + h * a * 0.5)
        dv = h * (self.velocity[1:] - v - h * a)
        da = h * h * (self.acceleration[1:] - a)
        return (
            q,
            v,
            a * 0.5,
            (10.0 * dq - 4.0 * dv + 0.5 * da) / h**3,
            (-15.0 * dq + 7.0 * dv - da) / h**4,
            (6.0 * dq - 3.0 * dv + 0.5 * da) / h**5,
        )
