"""How abruptly motion time may change its rate on a path whose joints have limits.

Along a path q(s) the joints move as q(s(t)). With r = ds/dt,

    qd   = q' r
    qdd  = q'' r² + q' r'
    jerk = q''' r³ + 3 q'' r r' + q' r''

so with r within [0, 1], bounds on r' and r'' bound acceleration and jerk whatever the path does,
as long as q', q'' and q''' keep what is known of them: the limits the path was planned for, or
better the most it really uses.
"""

from __future__ import annotations

import numpy as np

from planner.limits import JointLimits
from planner.piecewise_cubic import Extrema
from planner.time_law import RateBounds

# A joint counts as moving at this share of its velocity limit at least: a joint that rests says
# nothing about the rate, and without any other the bounds would be infinite.
_LEAST_SPEED = 1e-3
# Slopes that are tried, as shares of the largest one possible.
_SHARES = np.linspace(0.02, 1.0, 99)


def slowing_bounds(
    limits: JointLimits, acceleration: float, jerk: float, extrema: Extrema | None = None
) -> RateBounds:
    """Return bounds that keep acceleration and jerk below these multiples (> 1) of the limits.

    The worst case has r = 1 and all terms of one sign. What jerk is to spare is divided between
    the terms in r' and in r'' so that a change from full rate to rest takes the least time.

    Args:
        limits: What the multiples refer to, and what the path keeps.
        acceleration: Multiple of the acceleration limits.
        jerk: Multiple of the jerk limits.
        extrema: The most the path really uses, where that is known.
    """
    v, a, j = limits.velocity, limits.acceleration, limits.jerk
    spare_acceleration, spare_jerk = (acceleration - 1.0) * a, (jerk - 1.0) * j
    if extrema is not None:
        spare_acceleration = acceleration * a - np.minimum(extrema.acceleration, a)
        spare_jerk = jerk * j - np.minimum(extrema.jerk, j)
        v = np.clip(extrema.velocity, _LEAST_SPEED * v, v)
        a = np.minimum(extrema.acceleration, a)
    with np.errstate(divide="ignore", over="ignore"):
        largest = np.minimum(spare_acceleration / v, spare_jerk / (3.0 * a))
    slopes = _SHARES * np.min(largest)
    changes = np.maximum(np.min((spare_jerk - 3.0 * slopes[:, None] * a) / v, axis=1), 0.0)
    reached = slopes * slopes <= changes  # else the slope's bound is never reached
    with np.errstate(divide="ignore"):
        times = np.where(reached, 1.0 / slopes + slopes / changes, 2.0 / np.sqrt(changes))
    best = int(np.argmin(times))
    return RateBounds(float(slopes[best]), float(changes[best]))


def within(inner: RateBounds, outer: RateBounds) -> RateBounds:
    """Return bounds `inner`, narrowed where they are wider than `outer`.

    From every state under the result the rate can go on under `outer`: what was begun gently
    can be finished abruptly.
    """
    return RateBounds(min(inner.slope, outer.slope), min(inner.change, outer.change))
