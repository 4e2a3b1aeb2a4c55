"""Tables of many motions in one array, where all have the same number of pieces."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from planner.arrays import Array
from planner.limits import Allowance
from planner.piecewise_cubic import PiecewiseCubic
from planner.verify import jump_rounding, position_rounding

Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]


class Block(NamedTuple):
    """Cubic pieces of many motions, the same number m for every joint of every one.

    Attributes:
        knots: Times from 0 to the duration of each motion, (c, n, m + 1) [s].
        coefficients: Position, velocity, acceleration at the start of each piece, and its jerk,
            (c, n, m, 4).
        end: Position, velocity, acceleration at the end, (c, n, 3).
    """

    knots: Array
    coefficients: Array
    end: Array

    @classmethod
    def from_jerks(cls, start: Array, knots: Array, jerks: Array) -> Self:
        """Integrate constant jerks (c, n, m) between knots (c, n, m + 1) from states (c, n, 3)."""
        x = knots[..., 1:] - knots[..., :-1]
        states = np.empty((*knots.shape, 3))
        states[..., 0, :] = start
        # In the order of operations in which a table is evaluated: so pieces meet to the last bit.
        jx = jerks * x
        states[..., 1:, 2] = jx
        p, v, a = (states[..., i] for i in range(3))
        np.cumsum(a, axis=-1, out=a)
        v[..., 1:] = x * (a[..., :-1] + jx * 0.5)
        np.cumsum(v, axis=-1, out=v)
        p[..., 1:] = x * (v[..., :-1] + x * (a[..., :-1] * 0.5 + jx * (1.0 / 6.0)))
        np.cumsum(p, axis=-1, out=p)
        pieces = np.concatenate((states[..., :-1, :], jerks[..., None]), axis=-1)
        return cls(knots, pieces, states[..., -1, :])

    @classmethod
    def of_pieces(cls, knots: Array, coefficients: Array) -> Self:
        """Make a block of its pieces, which tell where it ends."""
        p, v, a, j = np.moveaxis(coefficients[..., -1, :], -1, 0)
        end = np.stack(after(p, v, a, j, knots[..., -1] - knots[..., -2]), axis=-1)
        return cls(knots, coefficients, end)

    @property
    def durations(self) -> Array:
        """Length in time of each motion (c,) [s]."""
        last: Array = self.knots[:, 0, -1]
        return last

    def take(self, rows: Rows | Mask) -> Block:
        """Return some of the motions, by index or mask."""
        return Block(*(field[rows] for field in self))

    def keeps(self, bounds: Allowance) -> Mask:
        """Whether each motion keeps its bounds at every instant (c,), from roots, not samples."""
        p, v, a, j = np.moveaxis(self.coefficients, -1, 0)
        length = np.diff(self.knots, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            fastest = -a / j
            # Roots of v + a x + j x²/2 in the form that loses no digits when j is small.
            root = -(a + np.copysign(np.sqrt(a * a - 2.0 * j * v), a))
            times = np.stack((root / j, 2.0 * v / root, fastest, length))
        # Any time inside its piece is a fair sample, so a root that does not exist may be that.
        times = np.fmax(np.fmin(times, length), 0.0)
        position, velocity, acceleration = after(p, v, a, j, times)
        slack = position_rounding(bounds)
        within = np.minimum(p, position.min(axis=0)).min(axis=-1) >= bounds.lower - slack
        within &= np.maximum(p, position.max(axis=0)).max(axis=-1) <= bounds.upper + slack
        for value, start, bound in (
            (np.abs(velocity).max(axis=0), np.abs(v), bounds.velocity),
            (np.abs(acceleration[2:]).max(axis=0), np.abs(a), bounds.acceleration),
            (np.abs(j), np.abs(j), bounds.jerk),
        ):
            within &= np.maximum(value, start).max(axis=-1) <= bound
        respected: Mask = within.all(axis=-1)
        return respected

    def smooth(self, bounds: Allowance) -> Mask:
        """Whether each motion is C2 and at rest at both ends, but for rounding, (c,)."""
        p, v, a, j = np.moveaxis(self.coefficients, -1, 0)
        ends = np.stack(after(p, v, a, j, np.diff(self.knots, axis=-1)), axis=-1)
        starts = self.coefficients[..., :3]
        jumps = np.abs(starts[..., 1:, :] - ends[..., :-1, :]).max(axis=-2, initial=0.0)
        rest = np.maximum(np.abs(starts[..., 0, 1:]), np.abs(ends[..., -1, 1:]))
        jumps[..., 1:] = np.maximum(jumps[..., 1:], rest)
        smooth: Mask = np.all(jumps <= jump_rounding(bounds, self.durations), axis=(1, 2))
        return smooth

    def tables(self) -> list[PiecewiseCubic]:
        """Return each motion as a table of its own, without pieces of no length."""
        real = np.diff(self.knots, axis=-1) > 0.0
        real[..., 0] |= ~real.any(axis=-1)
        ends = np.cumsum(real.sum(axis=-1), axis=None).tolist()
        times, pieces = self.knots[..., 1:][real], self.coefficients[real]
        tables, begin, n_joints = [], 0, real.shape[1]
        for row in range(0, len(ends), n_joints):
            knots, coefficients = [], []
            for end in ends[row : row + n_joints]:
                knots.append(np.concatenate(([0.0], times[begin:end])))
                coefficients.append(pieces[begin:end].copy())
                begin = end
            tables.append(PiecewiseCubic(tuple(knots), tuple(coefficients)))
        return tables


def after(p: Array, v: Array, a: Array, j: Array, x: Array) -> tuple[Array, Array, Array]:
    """Return position, velocity, acceleration a time `x` after a state under constant jerk."""
    return (
        p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0))),
        v + x * (a + x * j * 0.5),
        a + x * j,
    )
