"""Straight joint-space moves between two positions, from rest to rest, many at once.

One scalar profile of seven pieces along each line keeps it straight for any ratio between the
limits of the joints; ruckig's phase synchronisation does not. Results do not depend on what else is
in the arrays.
"""

from __future__ import annotations

from math import cbrt
from typing import Any, NamedTuple

import numpy as np

from planner.arrays import Array
from planner.limits import Allowance
from planner.piecewise_cubic import Block, PiecewiseCubic, Rows, after


class StraightMoves(NamedTuple):
    """Straight moves of all joints in phase; the slowest joint determines the time.

    Attributes:
        start: Start of each (s, n) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (s, n).
        knots: Times of the profile (s, 8) [s].
        pieces: Path and its two rates at the start of each piece, and its jerk, (s, 7, 4).
        speeding_up, slowing_down: Time from rest to the highest speed and back (s,) [s].
    """

    start: Array
    direction: Array
    knots: Array
    pieces: Array
    speeding_up: Array
    slowing_down: Array

    @classmethod
    def between(
        cls, starts: Array, ends: Array, bounds: Allowance, deceleration: Array
    ) -> StraightMoves:
        """Plan the fastest straight moves (s, n) under velocity, acceleration, jerk limits (s, n).

        `deceleration` (s, n) [rad/s²] bounds the slowing down.
        """
        change = ends - starts
        length = np.max(np.abs(change), axis=1)
        moves = length > 0.0
        direction = change / np.where(moves, length, 1.0)[:, None]
        with np.errstate(divide="ignore", over="ignore"):
            along = [
                np.where(moves, np.min(bound / np.abs(direction), axis=1), 1.0)
                for bound in (bounds.velocity, bounds.acceleration, deceleration, bounds.jerk)
            ]
        knots, pieces, *ramps = rest_to_rest(np.where(moves, length, 1.0), *along)
        knots *= moves[:, None]
        pieces *= moves[:, None, None]
        return cls(starts, direction, knots, pieces, ramps[0] * moves, ramps[1] * moves)

    def take(self, rows: Rows) -> StraightMoves:
        """Return moves by index."""
        return StraightMoves(*(field[rows] for field in self))

    @property
    def durations(self) -> Array:
        """Length in time (s,) [s]."""
        last: Array = self.knots[:, -1]
        return last

    def states(self, t: Array) -> Array:
        """Return position, velocity, acceleration (s, n, 3) of each at its time `t` (s,) [s]."""
        along = self._along(t)
        states = self.direction[:, :, None] * along[:, None, :3]
        states[..., 0] += self.start
        return states

    def cut(self, begin: Array, end: Array) -> tuple[Array, Array]:
        """Return knots from 0 (s, 8) [s] and pieces (s, n, 7, 4) between two times (s,) [s].

        Pieces outside have zero length and the state at the cut.
        """
        begin, end = begin[:, None], end[:, None]
        knots = np.clip(self.knots, begin, end)
        pieces = self.pieces.copy()
        moved = knots[:, :-1] - self.knots[:, :-1]
        pieces[..., :3] = np.stack(after(np.moveaxis(self.pieces, -1, 0), moved), axis=-1)
        for outside, at in (
            (self.knots[:, 1:] <= begin, begin[:, 0]),
            (self.knots[:, :-1] >= end, end[:, 0]),
        ):
            np.copyto(pieces, self._along(at)[:, None, :], where=outside[..., None])
        table = self.direction[:, :, None, None] * pieces[:, None]
        table[..., 0] += self.start[:, :, None]
        return knots - begin, table

    def tables(self, begin: Array, end: Array) -> list[PiecewiseCubic]:
        """Return the parts between two times (s,) [s], each starting at time 0."""
        knots, pieces = self.cut(begin, end)
        each = np.broadcast_to(knots[:, None], (*pieces.shape[:2], knots.shape[1]))
        return Block.of_pieces(each, pieces).tables()

    def _along(self, t: Array) -> Array:
        """Return path, its two rates and its jerk at one time in each move, (s, 4)."""
        index = np.sum(self.knots[:, 1:-1] <= t[:, None], axis=1)
        rows = np.arange(len(t))
        pieces = self.pieces[rows, index].T
        return np.stack((*after(pieces, t - self.knots[rows, index]), pieces[3]), axis=-1)


def rest_to_rest(
    distance: Array, velocity: Array, acceleration: Array, deceleration: Array, jerk: Array
) -> tuple[Array, Array, Array, Array]:
    """Plan the fastest scalar moves over distances > 0 (s,) that start and end at rest.

    Returns:
        Knots (s, 8) [s], pieces (s, 7, 4), and the times of speeding up and slowing down (s,) [s].
    """
    rates = acceleration, deceleration
    ramps = [_pulse(velocity, rate, jerk) for rate in rates]
    # Velocity rises and falls symmetrically about its half.
    cruises = distance > velocity * sum(2.0 * rise + flat for rise, flat in ramps) / 2.0
    short = _half_pulse(distance, np.maximum(*rates), jerk)
    ramps = [_where(cruises, ramp, short) for ramp in ramps]
    unlike = ~cruises & (acceleration != deceleration)
    if np.any(unlike):
        peak = jerk * short[0] * (short[0] + short[1])
        peak = np.minimum(_peak(distance, peak, rates, jerk), velocity)
        ramps = [
            _where(unlike, _pulse(peak, rate, jerk), ramp)
            for rate, ramp in zip(rates, ramps, strict=True)
        ]

    # The second ramp is computed backwards from rest, so that no rounding error of the acceleration
    # is integrated over a long cruise.
    (p1, v1, a1, p2, v2, p3, v3), (p4, v4, a4, p5, v5, p6, v6) = (_ramp(*r, jerk) for r in ramps)
    cruise = np.where(cruises, (distance - p3 - p6) / v3, 0.0)
    zero = np.zeros_like(distance)
    pieces = np.array(
        [
            (zero, zero, zero, jerk),
            (p1, v1, a1, zero),
            (p2, v2, a1, -jerk),
            (p3, v3, zero, zero),
            (distance - p6, v6, zero, -jerk),
            (distance - p5, v5, -a4, zero),
            (distance - p4, v4, -a4, jerk),
        ]
    )
    (up, high), (down, low) = ramps
    knots = np.cumsum(np.stack((zero, up, high, up, cruise, down, low, down), axis=-1), axis=-1)
    return knots, np.moveaxis(pieces, -1, 0), 2.0 * up + high, 2.0 * down + low


_Pulse = tuple[Array, Array]
"""Acceleration pulses: rise time, equal to the fall time, and flat time (s,) [s]."""


def _pulse(velocity_change: Array, acceleration: Array, jerk: Array) -> _Pulse:
    """Return the shortest pulses with this change of velocity."""
    rise = np.minimum(acceleration / jerk, np.sqrt(velocity_change / jerk))
    return rise, np.maximum(velocity_change / (jerk * rise) - rise, 0.0)


def _half_pulse(distance: Array, acceleration: Array, jerk: Array) -> _Pulse:
    """Return the pulses that cover a distance with their mirror images, without a cruise."""
    rise = acceleration / jerk
    # peak velocity a (rise + flat), held on average for 2 rise + flat
    flat = (np.sqrt(rise * rise + 4.0 * distance / acceleration) - 3.0 * rise) / 2.0
    holds = distance >= 2.0 * acceleration * rise * rise
    # The shortest do not reach full acceleration. Roots of floats: those of arrays may differ in
    # the last digit.
    rise[~holds] = [cbrt(cube) for cube in (distance / (2.0 * jerk))[~holds].tolist()]
    return rise, np.where(holds, np.maximum(flat, 0.0), 0.0)


def _where(which: Any, pulses: _Pulse, others: _Pulse) -> _Pulse:
    return np.where(which, pulses[0], others[0]), np.where(which, pulses[1], others[1])


def _ramp(rise: Array, flat: Array, jerk: Array) -> tuple[Array, ...]:
    """Return path and rates at the ends of the three pieces of a ramp from rest."""
    a1 = jerk * rise
    v1 = a1 * rise / 2.0
    p1 = v1 * rise / 3.0
    v2, p2 = v1 + a1 * flat, p1 + flat * (v1 + a1 * flat / 2.0)
    v3, p3 = v2 + v1, p2 + rise * (v2 + a1 * rise / 3.0)
    return p1, v1, a1, p2, v2, p3, v3


def _peak(distance: Array, above: Array, rates: tuple[Array, Array], jerk: Array) -> Array:
    """Return the peak velocity, at most `above`, of two different ramps that cover a distance.

    The distance is convex in the peak, so Newton's method from above converges monotonically.
    """
    peak = above
    for _ in range(60):
        way, slope = np.zeros((2, len(peak)))
        for rate in rates:
            rise, flat = _pulse(peak, rate, jerk)
            way += peak * (2.0 * rise + flat) / 2.0
            held = peak / rate + rate / (2.0 * jerk)
            slope += np.where(rise == rate / jerk, held, 1.5 * rise)
        closer = peak - (way - distance) / slope
        if not np.any(closer < peak):
            break
        peak = np.minimum(closer, peak)
    return peak
