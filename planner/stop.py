"""Stopping on the path: motion time slows from its normal rate to nothing.

Along a path q(s) the joints move as q(s(t)). With r = ds/dt,

    qd   = q' r
    qdd  = q'' r² + q' r'
    jerk = q''' r³ + 3 q'' r r' + q' r''

so bounds on r' and r'' bound acceleration and jerk whatever the path does, as long as q', q''
and q''' keep the limits the path was planned for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic
from planner.scurve import ramp_down


class SlowingBounds(NamedTuple):
    """How abruptly motion time may slow: bounds on |r'| [1/s] and |r''| [1/s²]."""

    rate: float
    change: float


def slowing_bounds(limits: JointLimits, acceleration: float, jerk: float) -> SlowingBounds:
    """Return bounds that keep acceleration and jerk below these multiples (> 1) of the limits.

    The worst case has r = 1 and all terms of one sign. Of the jerk that is to spare at most
    half goes to the term in r', the rest to the one in r''.
    """
    spare_acceleration = (acceleration - 1.0) * limits.acceleration
    spare_jerk = (jerk - 1.0) * limits.jerk
    rate = float(
        np.min(
            np.minimum(
                spare_acceleration / limits.velocity, spare_jerk / (6.0 * limits.acceleration)
            )
        )
    )
    change = float(np.min((spare_jerk - 3.0 * rate * limits.acceleration) / limits.velocity))
    return SlowingBounds(rate, change)


def stop_law(bounds: SlowingBounds) -> PiecewiseCubic:
    """Return how motion time goes on, s(t) from 0, as a one-joint trajectory: r falls 1 to 0."""
    return ramp_down(1.0, bounds.rate, bounds.change)
