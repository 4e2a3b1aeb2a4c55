"""Single states of a path, read one per controller cycle at any motion time."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from planner.arrays import Array
from planner.fourier import FourierSeries
from planner.piecewise_cubic import PiecewiseCubic, Trajectory


class PathReader:
    """Read position and velocity at one motion time, in a few microseconds.

    The knots of all joints are merged, so that one look-up finds the cubics of all of them. Sums
    of sines are summed here, without the accelerations that nobody asks for. A trajectory of
    another kind is asked for each state itself, at its own speed.

    Args:
        trajectory: The path as a function of motion time.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory: Trajectory | _Sines | None = None
        self._knots: list[float] = []
        self._pieces: Array = np.zeros((0, 4, trajectory.n_joints))
        # Rows: powers of the time into a piece, and their derivatives.
        self._basis: Array = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        if isinstance(trajectory, PiecewiseCubic):
            self._knots, self._pieces = _merged(trajectory)
        elif isinstance(trajectory, FourierSeries):
            self._trajectory = _Sines(trajectory)
        else:
            self._trajectory = trajectory

    def read(self, s: float) -> tuple[Array, Array]:
        """Return position (n,) [rad] and velocity (n,) [rad/s] at motion time `s` [s].

        It lies within the trajectory, which lasts longer than 0 s.
        """
        if isinstance(self._trajectory, _Sines):
            return self._trajectory.read(s)
        if self._trajectory is not None:
            position, velocity, _ = self._trajectory.sample(np.array([s]))
            return position[0], velocity[0]
        piece = bisect_right(self._knots, s) - 1
        x = s - self._knots[piece]
        basis, square = self._basis, x * x
        basis[0, 1] = x
        basis[0, 2] = square
        basis[0, 3] = square * x
        basis[1, 2] = 2.0 * x
        basis[1, 3] = 3.0 * square
        position, velocity = basis @ self._pieces[piece]
        return position, velocity


class _Sines:
    """Reads a sum of sines, to rounding what the series itself says."""

    def __init__(self, series: FourierSeries) -> None:
        self._offset, self._frequency = series.offset, series.frequency
        self._amplitude, self._rate = series.amplitude, series.amplitude * series.frequency
        self._length, self._ramp = series.length, series.ramp
        self._sum: Array = np.ones(series.frequency.shape[1])

    def read(self, s: float) -> tuple[Array, Array]:
        phase = s * self._frequency
        position = (self._amplitude * np.sin(phase)) @ self._sum
        velocity = (self._rate * np.cos(phase)) @ self._sum
        left = self._length - s
        if min(s, left) < self._ramp:
            share, grown = self._window(min(s, left) / self._ramp)
            slope = grown / self._ramp if s < left else -grown / self._ramp
            position, velocity = share * position, share * velocity + slope * position
        return self._offset + position, velocity

    @staticmethod
    def _window(u: float) -> tuple[float, float]:
        """w(u) of the ramp, 0 <= u < 1, and its derivative in u."""
        return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * (u * (1.0 - u)) ** 2


def _merged(trajectory: PiecewiseCubic) -> tuple[list[float], Array]:
    """Return the times at which the cubic of any joint changes, and the cubics (m, 4, n)."""
    begins = np.unique(np.concatenate(trajectory.knots))[:-1]
    merged = np.empty((len(begins), 4, trajectory.n_joints))
    for joint, (knots, pieces) in enumerate(
        zip(trajectory.knots, trajectory.coefficients, strict=True)
    ):
        piece = np.searchsorted(knots[1:-1], begins, side="right")
        x = begins - knots[piece]
        p, v, a, j = pieces[piece].T
        merged[:, 0, joint] = p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0)))
        merged[:, 1, joint] = v + x * (a + x * j * 0.5)
        merged[:, 2, joint] = (a + x * j) * 0.5
        merged[:, 3, joint] = j * (1.0 / 6.0)
    return begins.tolist(), merged
