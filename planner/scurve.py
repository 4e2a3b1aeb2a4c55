"""Jerk-limited scalar profiles in closed form.

A profile is built from acceleration pulses of one shape: jerk up for `rise`, none for `flat`,
jerk down for `rise`.
"""

from __future__ import annotations

from math import cbrt, sqrt
from typing import NamedTuple

import numpy as np

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
