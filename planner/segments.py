"""Straight joint-space moves between two via points, from rest to rest: one, or many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cbrt, sqrt
from typing import NamedTuple, Self

import numpy as np

from planner.arrays import Array
from planner.blocks import Rows, after
from planner.limits import Bounds
from planner.piecewise_cubic import PiecewiseCubic


class RestToRest(NamedTuple):
    """A scalar move from rest to rest.

    Attributes:
        law: Path covered as a function of time, one joint, from 0.
        speeding_up: Time from rest to the fastest [s].
        slowing_down: Time from the fastest to rest [s].
    """

    law: PiecewiseCubic
    speeding_up: float
    slowing_down: float


class _Pulse(NamedTuple):
    """An acceleration pulse: jerk up and down for `rise` [s], none for `flat` [s] between."""

    rise: float
    flat: float

    @property
    def duration(self) -> float:
        return 2.0 * self.rise + self.flat


def rest_to_rest(
    distance: float,
    velocity: float,
    acceleration: float,
    jerk: float,
    deceleration: float | None = None,
) -> RestToRest:
    """Plan the fastest move over `distance` > 0 that starts and ends at rest.

    `deceleration` bounds the slowing down where it differs from `acceleration`.
    """
    slowing = acceleration if deceleration is None else deceleration
    up, down = _pulse(velocity, acceleration, jerk), _pulse(velocity, slowing, jerk)
    # Velocity rises and falls symmetrically about its half.
    cruises = distance > velocity * (up.duration + down.duration) / 2.0
    if not cruises:
        up = down = _half_pulse(distance, max(acceleration, slowing), jerk)
        if slowing != acceleration:
            peak = jerk * up.rise * (up.rise + up.flat)
            peak = min(_peak(distance, peak, acceleration, slowing, jerk), velocity)
            up, down = _pulse(peak, acceleration, jerk), _pulse(peak, slowing, jerk)

    # The second ramp mirrors one from rest, so that nothing that rounding leaves behind, such as
    # a trace of acceleration, is integrated over a long cruise.
    (p1, v1, a1), (p2, v2, _), (p3, v3) = _ramp(up, jerk)
    (p4, v4, a4), (p5, v5, _), (p6, v6) = _ramp(down, jerk)
    cruise = (distance - p3 - p6) / v3 if cruises else 0.0
    pieces = np.array(
        [
            (0.0, 0.0, 0.0, jerk),
            (p1, v1, a1, 0.0),
            (p2, v2, a1, -jerk),
            (p3, v3, 0.0, 0.0),
            (distance - p6, v6, 0.0, -jerk),
            (distance - p5, v5, -a4, 0.0),
            (distance - p4, v4, -a4, jerk),
        ]
    )
    knots = np.cumsum([0.0, up.rise, up.flat, up.rise, cruise, down.rise, down.flat, down.rise])
    return RestToRest(PiecewiseCubic((knots,), (pieces,)), up.duration, down.duration)


def _ramp(
    pulse: _Pulse, jerk: float
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float]]:
    """Return the states at the ends of the three pieces of a ramp from rest."""
    rise, flat = pulse
    a1 = jerk * rise
    v1 = a1 * rise / 2.0
    p1 = v1 * rise / 3.0
    v2, p2 = v1 + a1 * flat, p1 + flat * (v1 + a1 * flat / 2.0)
    v3, p3 = v2 + v1, p2 + rise * (v2 + a1 * rise / 3.0)
    return (p1, v1, a1), (p2, v2, a1), (p3, v3)


def _half_pulse(distance: float, acceleration: float, jerk: float) -> _Pulse:
    """Return the pulse that, with its mirror image, covers `distance` without a cruise."""
    rise = acceleration / jerk
    if distance < 2.0 * acceleration * rise * rise:
        return _Pulse(cbrt(distance / (2.0 * jerk)), 0.0)
    # peak velocity a (rise + flat), held on average for 2 rise + flat
    flat = (sqrt(rise * rise + 4.0 * distance / acceleration) - 3.0 * rise) / 2.0
    return _Pulse(rise, max(flat, 0.0))


def _peak(
    distance: float, above: float, acceleration: float, deceleration: float, jerk: float
) -> float:
    """Return the peak velocity, at most `above`, of two unlike ramps that cover `distance`.

    The distance is a convex function of the peak, so Newton's steps from above never pass it.
    """
    peak = above
    for _ in range(60):
        way = slope = 0.0
        for rate in (acceleration, deceleration):
            pulse = _pulse(peak, rate, jerk)
            way += peak * pulse.duration / 2.0
            flat = pulse.rise == rate / jerk
            slope += peak / rate + rate / (2.0 * jerk) if flat else 1.5 * pulse.rise
        closer = peak - (way - distance) / slope
        if not closer < peak:
            break
        peak = closer
    return peak


def _pulse(velocity_change: float, acceleration: float, jerk: float) -> _Pulse:
    """Return the shortest acceleration pulse that changes the velocity so much."""
    rise = min(acceleration / jerk, sqrt(velocity_change / jerk))
    return _Pulse(rise, max(velocity_change / (jerk * rise) - rise, 0.0))


@dataclass(frozen=True, eq=False)
class StraightSegment:
    """A straight line that all joints run in phase, ruled by the slowest of them.

    One scalar profile moves along the line, so the line is straight for any ratio between the
    joints' limits. (A general planner asked for phase synchronisation leaves the line where
    the joint that is slowest overall is not the one that is slowest to build up acceleration.)

    Attributes:
        start: Where it begins (n,) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (n,).
        law: Path covered as a function of time, one joint.
        speeding_up: Time from rest to the fastest [s].
        slowing_down: Time from the fastest to rest [s].
    """

    start: Array
    direction: Array
    law: PiecewiseCubic
    speeding_up: float
    slowing_down: float

    @classmethod
    def between(
        cls, start: Array, end: Array, limits: Bounds, deceleration: Array | None = None
    ) -> Self:
        """Plan the fastest straight move that keeps the velocity, acceleration, jerk limits.

        `deceleration` (n,) [rad/s²] bounds the slowing down where it differs.
        """
        change = end - start
        size = np.abs(change)
        length = float(size.max())
        if length == 0.0:
            nowhere = PiecewiseCubic((np.zeros(2),), (np.zeros((1, 4)),))
            return cls(start, change, nowhere, 0.0, 0.0)
        slowing = limits.acceleration if deceleration is None else deceleration
        bounds = np.array((limits.velocity, limits.acceleration, limits.jerk, slowing))
        with np.errstate(divide="ignore", over="ignore"):
            along = (bounds / (size / length)).min(axis=1).tolist()
        return cls(start, change / length, *rest_to_rest(length, *along))

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return self.law.duration

    def state(self, t: float) -> Array:
        """Return position, velocity and acceleration (n, 3) at time `t` [s]."""
        state: Array = self.states(np.array([t]))[0]
        return state

    def states(self, times: Array) -> Array:
        """Return position, velocity and acceleration (m, n, 3) at times (m,) [s] within it."""
        knots, pieces = self.law.knots[0], self.law.coefficients[0]
        index = knots[1:-1].searchsorted(times, side="right")
        p, v, a, j = pieces[index].T
        x = times - knots[index]
        along = np.empty((len(times), 1, 3))
        along[:, 0, 0] = p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0)))
        along[:, 0, 1] = v + x * (a + x * j * 0.5)
        along[:, 0, 2] = a + x * j
        states: Array = self.direction[:, None] * along
        states[:, :, 0] += self.start
        return states

    def pieces(self, start: float, stop: float) -> PiecewiseCubic:
        """Return the part between two times [s] as a table of all joints."""
        law = self.law.restricted(start, stop)
        table = self.direction[:, None, None] * law.coefficients[0]
        table[:, :, 0] += self.start[:, None]
        return PiecewiseCubic(law.knots * len(table), tuple(table))


class StraightMoves(NamedTuple):
    """Straight joint-space lines, each run by one scalar profile of seven pieces.

    Attributes:
        start: Where each begins (s, n) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (s, n).
        knots: Times of the profile (s, 8) [s].
        pieces: Path, its rates at the start of each piece, and its constant jerk, (s, 7, 4).
        speeding_up: Time from rest to the fastest (s,) [s].
        slowing_down: Time from the fastest to rest (s,) [s].
    """

    start: Array
    direction: Array
    knots: Array
    pieces: Array
    speeding_up: Array
    slowing_down: Array

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
        ramp *= moves
        return cls(starts, direction, knots, pieces, ramp, ramp)

    @classmethod
    def of(cls, segments: Sequence[StraightSegment]) -> StraightMoves:
        """Return segments that lead somewhere."""
        return cls(
            np.array([each.start for each in segments]),
            np.array([each.direction for each in segments]),
            np.array([each.law.knots[0] for each in segments]),
            np.array([each.law.coefficients[0] for each in segments]),
            np.array([each.speeding_up for each in segments]),
            np.array([each.slowing_down for each in segments]),
        )

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
    """Return knots (s, 8), pieces (s, 7, 4) and ramps (s,), as `rest_to_rest` does."""
    rise = np.minimum(acceleration / jerk, np.sqrt(velocity / jerk))
    flat = np.maximum(velocity / (jerk * rise) - rise, 0.0)
    cruises = distance > velocity * (2.0 * rise + flat)
    # Too short to reach full speed; the shortest do not even reach full acceleration.
    full = acceleration / jerk
    holds = distance >= 2.0 * acceleration * full * full
    held = (np.sqrt(full * full + 4.0 * distance / acceleration) - 3.0 * full) / 2.0
    short = full.copy()
    # As floats have it: that of arrays may differ in the last digit.
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
