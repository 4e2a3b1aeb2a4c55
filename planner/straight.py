"""Straight moves from rest to rest, many at once: `planner.segments` over whole arrays."""

from __future__ import annotations

from math import cbrt
from typing import NamedTuple

import numpy as np

from planner.arrays import Array
from planner.blocks import Rows, after


class StraightMoves(NamedTuple):
    """Straight joint-space lines, each run by one scalar profile of seven pieces.

    Attributes:
        start: Where each begins (s, n) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (s, n).
        knots: Times of the profile (s, 8) [s].
        pieces: Path, its rates at the start of each piece, and its constant jerk, (s, 7, 4).
        ramp: Time spent accelerating, equal to that spent decelerating (s,) [s].
    """

    start: Array
    direction: Array
    knots: Array
    pieces: Array
    ramp: Array

    @classmethod
    def between(
        cls, starts: Array, ends: Array, velocity: Array, acceleration: Array, jerk: Array
    ) -> StraightMoves:
        """Plan the fastest straight moves (s, n) under limits that are each (s, n)."""
        change = ends - starts
        length = np.max(np.abs(change), axis=1)
        moves = length > 0.0
        direction = change / np.where(moves, length, 1.0)[:, None]
        with np.errstate(divide="ignore", over="ignore"):
            along = [
                np.where(moves, np.min(bound / np.abs(direction), axis=1), 1.0)
                for bound in (velocity, acceleration, jerk)
            ]
        knots, pieces, ramp = _profiles(np.where(moves, length, 1.0), *along)
        knots *= moves[:, None]
        pieces *= moves[:, None, None]
        return cls(starts, direction, knots, pieces, ramp * moves)

    def take(self, rows: Rows) -> StraightMoves:
        """Return some of the moves, by index."""
        return StraightMoves(*(field[rows] for field in self))

    @property
    def durations(self) -> Array:
        """Length in time (s,) [s]."""
        last: Array = self.knots[:, -1]
        return last

    def states(self, t: Array) -> Array:
        """Return position, velocity, acceleration (s, n, 3) at one time `t` (s,) [s] in each."""
        along = self._along(t)
        states = self.direction[:, :, None] * along[:, None, :3]
        states[..., 0] += self.start
        return states

    def cut(self, begin: Array, end: Array) -> tuple[Array, Array]:
        """Return the parts between two times (s,) [s], with pieces outside them of no length.

        Those hold the state at the cut, so that the table stays continuous.

        Returns:
            Times from 0 (s, 8) [s] and pieces (s, n, 7, 4).
        """
        begin, end = begin[:, None], end[:, None]
        knots = np.clip(self.knots, begin, end)
        pieces = self.pieces.copy()
        moved = knots[:, :-1] - self.knots[:, :-1]
        p, v, a, j = np.moveaxis(self.pieces, -1, 0)
        pieces[..., :3] = np.stack(after(p, v, a, j, moved), axis=-1)
        for outside, at in (
            (self.knots[:, 1:] <= begin, begin[:, 0]),
            (self.knots[:, :-1] >= end, end[:, 0]),
        ):
            np.copyto(pieces, self._along(at)[:, None, :], where=outside[..., None])
        table = self.direction[:, :, None, None] * pieces[:, None]
        table[..., 0] += self.start[:, :, None]
        return knots - begin, table

    def _along(self, t: Array) -> Array:
        """Return path, its two rates and its jerk at a time in each move, (s, 4)."""
        index = np.sum(self.knots[:, 1:-1] <= t[:, None], axis=1)
        rows = np.arange(len(t))
        p, v, a, j = self.pieces[rows, index].T
        return np.stack((*after(p, v, a, j, t - self.knots[rows, index]), j), axis=-1)


def _profiles(
    distance: Array, velocity: Array, acceleration: Array, jerk: Array
) -> tuple[Array, Array, Array]:
    """Return knots (s, 8), pieces (s, 7, 4) and ramps (s,), as `scurve.rest_to_rest` does."""
    rise = np.minimum(acceleration / jerk, np.sqrt(velocity / jerk))
    flat = np.maximum(velocity / (jerk * rise) - rise, 0.0)
    cruises = distance > velocity * (2.0 * rise + flat)
    # Too short to reach full speed; the shortest do not even reach full acceleration.
    full = acceleration / jerk
    holds = distance >= 2.0 * acceleration * full * full
    held = (np.sqrt(full * full + 4.0 * distance / acceleration) - 3.0 * full) / 2.0
    short = full.copy()
    # As plain floats have it: that of arrays may differ in the last digit.
    least = (distance / (2.0 * jerk))[~holds].tolist()
    short[~holds] = [cbrt(cube) for cube in least]
    rise = np.where(cruises, rise, short)
    flat = np.where(cruises, flat, np.where(holds, np.maximum(held, 0.0), 0.0))

    a1 = jerk * rise
    v1 = a1 * rise / 2.0
    p1 = v1 * rise / 3.0
    v2, p2 = v1 + a1 * flat, p1 + flat * (v1 + a1 * flat / 2.0)
    v3, p3 = v2 + v1, p2 + rise * (v2 + a1 * rise / 3.0)
    cruise = np.where(cruises, (distance - p3 - p3) / v3, 0.0)
    zero = np.zeros_like(distance)
    pieces = np.array(
        [
            (zero, zero, zero, jerk),
            (p1, v1, a1, zero),
            (p2, v2, a1, -jerk),
            (p3, v3, zero, zero),
            (distance - p3, v3, zero, -jerk),
            (distance - p2, v2, -a1, zero),
            (distance - p1, v1, -a1, jerk),
        ]
    )
    lengths = np.stack((zero, rise, flat, rise, cruise, rise, flat, rise), axis=-1)
    return np.cumsum(lengths, axis=-1), np.moveaxis(pieces, -1, 0), 2.0 * rise + flat
