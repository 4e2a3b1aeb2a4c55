"""Time law of a motion under an override, hold or stop: a jerk-limited scalar profile.

Along a path q(s) the joints move as q(s(t)). The rate r = ds/dt, from 0 (at rest) to 1 (as
planned), changes with bounded r' and r''. From any state (r, r') the fastest change to a new rate
has at most three pieces of constant r'': the slope rises, stays, and falls to zero.

The rate at which r would stop if its slope fell to zero at once, r + r' |r'| / (2 r''max), moves
monotonically to the target, and every extreme of r is one of its values. So if it starts within
[0, 1], r stays within [0, 1] however the target changes. Wider bounds bring it closer to r, so
they may be widened at any time.
"""

from __future__ import annotations

from math import copysign, sqrt
from typing import NamedTuple

import numpy as np

from planner.limits import JointLimits
from planner.piecewise_cubic import Extrema


class RateBounds(NamedTuple):
    """Bounds on |r'| [1/s] and |r''| [1/s²]."""

    slope: float
    change: float


class _Piece(NamedTuple):
    """A piece of constant r'': time of its start [s] and state there."""

    begin: float
    motion_time: float
    rate: float
    slope: float
    change: float


class Ramp(NamedTuple):
    """A change of rate to a constant target; `motion_time` [s] passes in its `duration` [s]."""

    duration: float
    motion_time: float
    target: float
    pieces: tuple[_Piece, _Piece, _Piece]

    def sample(self, t: float) -> tuple[float, float, float]:
        """Return motion time from 0 [s], rate and slope [1/s] at a time `t` >= 0 [s]."""
        if t >= self.duration:
            return self.motion_time + self.target * (t - self.duration), self.target, 0.0
        first, second, third = self.pieces
        piece = third if t >= third.begin else second if t >= second.begin else first
        begin, time, rate, slope, change = piece
        return _after(t - begin, time, rate, slope, change)


def _after(
    x: float, time: float, rate: float, slope: float, change: float
) -> tuple[float, float, float]:
    """Return the state a time `x` into a piece."""
    return (
        time + x * (rate + x * (slope * 0.5 + x * change * (1.0 / 6.0))),
        rate + x * (slope + x * change * 0.5),
        slope + x * change,
    )


def stopping_rate(rate: float, slope: float, change: float) -> float:
    """Return the rate reached if the slope falls to zero with |r''| = `change`."""
    return rate + slope * abs(slope) / (2.0 * change)


def admits(bounds: RateBounds, rate: float, slope: float) -> bool:
    """Whether the rate can stay within [0, 1] under `bounds` from this state."""
    return abs(slope) <= bounds.slope and (0.0 <= stopping_rate(rate, slope, bounds.change) <= 1.0)


def ramp(rate: float, slope: float, target: float, bounds: RateBounds) -> Ramp:
    """Return the fastest change from a state to a target rate, reached with zero slope.

    Args:
        rate: of the state.
        slope: of the rate; one beyond its bound, which came from wider bounds, does not grow
            further.
        target: rate at the end.
        bounds: of slope and its change.
    """
    way = target - rate
    change = bounds.change
    up = 1.0 if target >= stopping_rate(rate, slope, change) else -1.0
    way = up * way
    slope_up = up * slope
    peak = sqrt(max(change * way + 0.5 * slope_up * slope_up, 0.0))
    peak = max(min(peak, bounds.slope), slope_up)
    # Change of rate while the slope rises and falls; the rest is made at the peak slope.
    covered = (peak * peak - 0.5 * slope_up * slope_up) / change
    rising = (peak - slope_up) / change
    falling = peak / change
    staying = max((way - covered) / peak, 0.0) if peak > 0.0 else 0.0

    jerk = copysign(change, up)
    first = _Piece(0.0, 0.0, rate, slope, jerk)
    second = _Piece(rising, *_after(rising, *first[1:]), 0.0)
    third = _Piece(rising + staying, *_after(staying, *second[1:]), -jerk)
    passed, _, _ = _after(falling, *third[1:])
    return Ramp(rising + staying + falling, passed, target, (first, second, third))


class TimeLaw:
    """Motion time s [s], advanced period by period at a rate r whose target may change.

    `slope` is r' [1/s]; `settled` means that the rate has reached its target.
    """

    __slots__ = ("_began", "_period", "_ramp", "_ticks", "motion_time", "rate", "settled", "slope")

    def __init__(self, period: float) -> None:
        self._period = period
        self.restart(0.0, 1.0)

    def restart(self, motion_time: float, rate: float, slope: float = 0.0) -> None:
        """Set motion time [s], a constant rate, and the slope [1/s] for the next `aim`."""
        self.motion_time = motion_time
        self.rate = rate
        self.slope = slope
        self._follow(ramp(rate, 0.0, rate, RateBounds(1.0, 1.0)))

    def aim(self, target: float, bounds: RateBounds) -> None:
        """Change the rate to `target` in [0, 1], from the present state, as fast as allowed."""
        self._follow(ramp(self.rate, self.slope, target, bounds))

    def advance(self) -> None:
        """Advance by one period."""
        # Counted from the last change of target, so that no rounding accumulates.
        self._ticks += 1
        t = self._ticks * self._period
        passed, self.rate, self.slope = self._ramp.sample(t)
        # Near zero rate, rounding could make the time fall by its last digit.
        self.motion_time = max(self.motion_time, self._began + passed)
        self.settled = t >= self._ramp.duration

    def _follow(self, way: Ramp) -> None:
        self._ramp = way
        self._began = self.motion_time
        self._ticks = 0
        self.settled = way.duration <= 0.0


# Least peak velocity assumed of a joint, as a share of its limit: the bounds of a path on which no
# joint moves would be infinite.
_MIN_SPEED_SHARE = 1e-3
# Slopes tried, as shares of the largest one possible.
_SLOPE_SHARES = np.linspace(0.02, 1.0, 99)


def slowing_bounds(
    limits: JointLimits, acceleration: float, jerk: float, extrema: Extrema | None = None
) -> RateBounds:
    """Return bounds that keep acceleration and jerk below multiples of the limits.

    With r = ds/dt in [0, 1],

        qd   = q' r
        qdd  = q'' r² + q' r'
        jerk = q''' r³ + 3 q'' r r' + q' r''

    are worst at r = 1 with all terms of one sign. The jerk left over is divided between the terms
    in r' and r'' such that a change from full rate to rest takes the least time.

    Args:
        limits: of the joints.
        acceleration: largest multiple of its limit (> 1).
        jerk: likewise (> 1).
        extrema: of the path; by default the limits.
    """
    v = limits.velocity
    a = limits.acceleration
    j = limits.jerk
    spare_acceleration = (acceleration - 1.0) * a
    spare_jerk = (jerk - 1.0) * j
    if extrema is not None:
        spare_acceleration = acceleration * a - np.minimum(extrema.acceleration, a)
        spare_jerk = jerk * j - np.minimum(extrema.jerk, j)
        v = np.clip(extrema.velocity, _MIN_SPEED_SHARE * v, v)
        a = np.minimum(extrema.acceleration, a)
    with np.errstate(divide="ignore", over="ignore"):
        largest = np.minimum(spare_acceleration / v, spare_jerk / (3.0 * a))
    slopes = _SLOPE_SHARES * np.min(largest)
    changes = np.maximum(np.min((spare_jerk - 3.0 * slopes[:, None] * a) / v, axis=1), 0.0)
    reached = slopes * slopes <= changes  # whether the slope reaches its bound
    with np.errstate(divide="ignore"):
        times = np.where(reached, 1.0 / slopes + slopes / changes, 2.0 / np.sqrt(changes))
    best = int(np.argmin(times))
    return RateBounds(float(slopes[best]), float(changes[best]))


def within(inner: RateBounds, outer: RateBounds) -> RateBounds:
    """Return bounds `inner`, narrowed where they are wider than `outer`."""
    return RateBounds(min(inner.slope, outer.slope), min(inner.change, outer.change))
