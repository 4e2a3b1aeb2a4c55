"""Each axis's own profile over delays, the delays of the other axes held: where its valleys are.

A profile over delays that are common to all axes does not show that one axis lags otherwise: the
axes share parameters, and the strong ones decide. From Gram matrices of all axes at all delays of
a grid the residual of any combination follows without the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.factor import Factor

Array = NDArray[np.float64]

# Of the information of a column: keeps a direction that the data do not tell out of the way.
_RIDGE: Final = 1e-10
# Share of the torque's mean square below which a residual is rounding.
_ROUNDING: Final = 1e-12
_SWEEPS: Final = 6


class Rival(NamedTuple):
    """Another valley of each of n axes than the one looked at.

    Attributes:
        delays: where it is lowest (n,) [s], NaN without another valley.
        ratio: by how much twice the log likelihood, of white noise, is lower there (n,); negative
            where it fits better, infinite without another.
    """

    delays: Array
    ratio: Array


@dataclass(frozen=True, eq=False)
class DelayGrid:
    """Gram matrices of [W | y] at K delays of n axes.

    Attributes:
        delays: evenly spaced (K,) [s].
        gram: (K, n, p + 1, p + 1).
        rows: (K, n).
        stride: one sample in so many was taken.
    """

    delays: Array
    gram: Array
    rows: NDArray[np.intp]
    stride: int

    def start(self) -> NDArray[np.intp]:
        """Place of each axis's delay in the best combination found (n,).

        From what each axis says on its own, and from one delay common to all, axes are moved in
        turn to where all of them together fit best.
        """
        rows = np.maximum(self.rows, 1)
        squares = np.column_stack([_least_squares(own)[1] for own in self.gram.swapaxes(0, 1)])
        floor = _ROUNDING * self.gram[:, :, -1, -1] + 1e-300
        alone = np.log(np.maximum(squares, floor) / rows)
        alone[self.rows == 0] = np.inf
        alone[:, ~self.rows.any(axis=0)] = 0.0
        common = np.full(alone.shape[1], np.argmin(alone.sum(axis=1)), dtype=np.intp)
        starts = (common, np.argmin(alone, axis=0))
        return min((self._descend(start) for start in starts), key=lambda pair: pair[1])[0]

    def rivals(self, best: Factor, noise_std: Array, delays: Array) -> Rival:
        """Lowest other valley of each axis, with the others at their delays.

        Args:
            best: each axis at its delay, of the same samples.
            noise_std: of its residuals (n,).
            delays: (n,) [s].
        """
        n = len(delays)
        rows = np.maximum(best.samples, 1)
        weights = np.where(best.samples > 0, np.nan_to_num(noise_std, nan=np.inf) ** -2.0, 0.0)
        total = np.tensordot(weights, best.gram, axes=1)
        least = _least_squares(total[None])[1][0]
        step = float(self.delays[1] - self.delays[0])
        found, ratio = np.full(n, np.nan), np.full(n, np.inf)
        for joint in np.flatnonzero(best.samples > 0):
            # As many rows as at its own delay: a shift loses some at the ends.
            per_row = self.gram[:, joint] / np.maximum(self.rows[:, joint], 1)[:, None, None]
            others = total - weights[joint] * best.gram[joint]
            there = _least_squares(others + weights[joint] * rows[joint] * per_row)[1]
            excess = np.where(self.rows[:, joint] > 0, (there - least) * self.stride, np.inf)
            for place, low in _valleys(self.delays, excess):
                if abs(place - delays[joint]) > step and low < ratio[joint]:
                    found[joint], ratio[joint] = place, low
        return Rival(found, ratio)

    def _descend(self, places: NDArray[np.intp]) -> tuple[NDArray[np.intp], float]:
        """Move axes in turn to where the likelihood is largest; places (n,) and its negative."""
        places, axes = places.copy(), np.flatnonzero(self.rows.any(axis=0)).tolist()
        size = self.rows.max(axis=0)
        mean = self.gram / np.maximum(self.rows, 1)[:, :, None, None]
        floor = _ROUNDING * mean[:, :, -1, -1].max(axis=0)

        def spread(table: Array) -> Array:
            """Residual variance per axis (k, n) at the least-squares solutions of tables."""
            values = _least_squares(table)[0]
            augmented = np.concatenate([-values, np.ones((len(values), 1))], axis=1)
            own = mean[places, np.arange(len(places))]
            return np.asarray(np.einsum("ki,jil,kl->kj", augmented, own, augmented, optimize=True))

        def own_spread(table: Array, joint: int) -> Array:
            values = _least_squares(table)[0]
            augmented = np.concatenate([-values, np.ones((len(values), 1))], axis=1)
            return np.asarray(np.einsum("ki,kil,kl->k", augmented, mean[:, joint], augmented))

        best = np.inf
        for _ in range(_SWEEPS):
            before = best
            for joint in axes:
                state = mean[places, np.arange(len(places))]
                ordinary = spread(np.tensordot(size, state, axes=1)[None])[0]
                weights = np.where(size > 0, size / np.maximum(ordinary, floor + 1e-300), 0.0)
                tables = np.tensordot(weights, state, axes=1) + weights[joint] * (
                    mean[:, joint] - state[joint]
                )
                variance = spread(tables)
                variance[:, joint] = own_spread(tables, joint)
                cost = (size * np.log(np.maximum(variance, floor + 1e-300)))[:, axes].sum(axis=1)
                cost[self.rows[:, joint] == 0] = np.inf
                places[joint] = int(np.argmin(cost))
                best = float(cost[places[joint]])
            if best >= before - 1e-9 * abs(before):
                break
        return places, best


def _least_squares(tables: Array) -> tuple[Array, Array]:
    """Solutions (k, p) and residual squares (k,) of Gram matrices (k, p + 1, p + 1)."""
    length = np.sqrt(np.diagonal(tables, axis1=1, axis2=2)[:, :-1])
    scale = np.where(length > 0.0, length, 1.0)
    scaled = tables[:, :-1, :-1] / (scale[:, :, None] * scale[:, None, :])
    scaled += _RIDGE * np.eye(scale.shape[1])
    right = tables[:, :-1, -1] / scale
    values = np.linalg.solve(scaled, right[:, :, None])[:, :, 0]
    # A column without information has nothing but the ridge, and a right side of zero.
    return values / scale, tables[:, -1, -1] - np.einsum("kp,kp->k", right, values)


def _valleys(places: Array, heights: Array) -> list[tuple[float, float]]:
    """Local minima, by a parabola through three points; ends as they are."""
    found = []
    for k in range(len(places)):
        left = heights[k - 1] if k > 0 else np.inf
        right = heights[k + 1] if k + 1 < len(places) else np.inf
        here = heights[k]
        if not np.isfinite(here) or here > left or here > right:
            continue
        if np.isfinite(left) and np.isfinite(right) and left + right > 2.0 * here:
            bend, slope = 0.5 * (left + right) - here, 0.5 * (right - left)
            offset = -0.5 * slope / bend
            step = float(places[1] - places[0])
            found.append((float(places[k]) + offset * step, float(here - 0.25 * slope**2 / bend)))
        else:
            found.append((float(places[k]), float(here)))
    return found
