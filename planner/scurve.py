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
        ramp: Time spent accelerating, equal to that spent decelerating [s].
    """

    law: PiecewiseCubic
    ramp: float


def rest_to_rest(distance: float, velocity: float, acceleration: float, jerk: float) -> RestToRest:
    """Plan the fastest move over `distance` > 0 that starts and ends at rest."""
    rise, flat = _pulse(velocity, acceleration, jerk)
    cruises = distance > velocity * (2.0 * rise + flat)
    if not cruises:
        rise = acceleration / jerk
        if distance >= 2.0 * acceleration * rise * rise:
            # peak velocity a (rise + flat), held on average for 2 rise + flat
            flat = (sqrt(rise * rise + 4.0 * distance / acceleration) - 3.0 * rise) / 2.0
            flat = max(flat, 0.0)
        else:
            rise, flat = cbrt(distance / (2.0 * jerk)), 0.0

    # States at the knots of the first half; the second half mirrors them, so that nothing that
    # rounding leaves behind, such as a trace of acceleration, is integrated over a long cruise.
    a1 = jerk * rise
    v1 = a1 * rise / 2.0
    p1 = v1 * rise / 3.0
    v2, p2 = v1 + a1 * flat, p1 + flat * (v1 + a1 * flat / 2.0)
    v3, p3 = v2 + v1, p2 + rise * (v2 + a1 * rise / 3.0)
    cruise = (distance - 2.0 * p3) / v3 if cruises else 0.0
    pieces = np.array(
        [
            (0.0, 0.0, 0.0, jerk),
            (p1, v1, a1, 0.0),
            (p2, v2, a1, -jerk),
            (p3, v3, 0.0, 0.0),
            (distance - p3, v3, 0.0, -jerk),
            (distance - p2, v2, -a1, 0.0),
            (distance - p1, v1, -a1, jerk),
        ]
    )
    knots = np.cumsum([0.0, rise, flat, rise, cruise, rise, flat, rise])
    return RestToRest(PiecewiseCubic((knots,), (pieces,)), 2.0 * rise + flat)


def ramp_down(velocity: float, acceleration: float, jerk: float) -> PiecewiseCubic:
    """Plan the fastest change from a constant `velocity` > 0 to rest; path counted from 0."""
    rise, flat = _pulse(velocity, acceleration, jerk)
    # The jerk is refitted so that the pulse takes away exactly `velocity`.
    jerk = velocity / (rise * (rise + flat))
    return PiecewiseCubic.from_jerks(
        start=np.array([[0.0, velocity, 0.0]]),
        knots=np.cumsum([[0.0, rise, flat, rise]], axis=1),
        jerks=np.array([[-jerk, 0.0, jerk]]),
    )


def _pulse(velocity_change: float, acceleration: float, jerk: float) -> tuple[float, float]:
    """Return (rise, flat) of the shortest acceleration pulse that changes velocity so much."""
    rise = min(acceleration / jerk, sqrt(velocity_change / jerk))
    return rise, max(velocity_change / (jerk * rise) - rise, 0.0)
