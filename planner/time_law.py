"""How fast motion time runs: a jerk-limited scalar law in closed form.

Along a path q(s) the joints move as q(s(t)). The rate r = ds/dt, from 0 (at rest) to 1 (as
planned), changes with a bounded slope r' and a bounded change of slope r''. From any state
(r, r') the fastest way to a new rate is at most three pieces of constant r'': the slope builds
up, stays, and dies away.

What keeps r within [0, 1] is where it would settle if its slope died away at once,
r + r' |r'| / (2 r''max). On the way to a target that number moves monotonically to the target,
and every extreme of r is one of its values; so if it starts within [0, 1], it stays there, and
so does r, however often and whenever the target changes. With wider bounds it only comes
closer to r, so that the bounds may be widened at any time.
"""

from __future__ import annotations

from math import copysign, sqrt
from typing import NamedTuple

import numpy as np

from planner.limits import JointLimits
from planner.piecewise_cubic import Extrema


class RateBounds(NamedTuple):
    """How abruptly the rate may change: bounds on |r'| [1/s] and |r''| [1/s²]."""

    slope: float
    change: float


class _Piece(NamedTuple):
    """A piece of constant r'': when it begins and the state there."""

    begin: float
    gone: float
    rate: float
    slope: float
    change: float


class Ramp(NamedTuple):
    """A change of rate, after which the rate stays.

    Attributes:
        duration: Time until the rate is the target, with no slope [s].
        gone: Motion time that passes meanwhile [s].
        target: Rate from then on.
        pieces: The three pieces of constant r''.
    """

    duration: float
    gone: float
    target: float
    pieces: tuple[_Piece, _Piece, _Piece]

    def sample(self, t: float) -> tuple[float, float, float]:
        """Return motion time from 0 [s], rate and slope [1/s] at a time `t` >= 0 [s]."""
        if t >= self.duration:
            return self.gone + self.target * (t - self.duration), self.target, 0.0
        first, second, third = self.pieces
        piece = third if t >= third.begin else second if t >= second.begin else first
        begin, gone, rate, slope, change = piece
        return _after(t - begin, gone, rate, slope, change)


def _after(
    x: float, gone: float, rate: float, slope: float, change: float
) -> tuple[float, float, float]:
    """Return the state a time `x` into a piece."""
    return (
        gone + x * (rate + x * (slope * 0.5 + x * change * (1.0 / 6.0))),
        rate + x * (slope + x * change * 0.5),
        slope + x * change,
    )


def stopping_rate(rate: float, slope: float, change: float) -> float:
    """Return where the rate ends up if its slope dies away as fast as r'' = `change` allows."""
    return rate + slope * abs(slope) / (2.0 * change)


def admits(bounds: RateBounds, rate: float, slope: float) -> bool:
    """Whether a state may go on under `bounds` without the rate ever leaving [0, 1]."""
    return abs(slope) <= bounds.slope and (0.0 <= stopping_rate(rate, slope, bounds.change) <= 1.0)


def ramp(rate: float, slope: float, target: float, bounds: RateBounds) -> Ramp:
    """Return the fastest change from a state to a target rate, reached without slope.

    A slope beyond its bound is not built up further; it is assumed to have come from wider bounds.
    """
    way, change = target - rate, bounds.change
    up = 1.0 if target >= stopping_rate(rate, slope, change) else -1.0
    way, slope_up = up * way, up * slope
    peak = sqrt(max(change * way + 0.5 * slope_up * slope_up, 0.0))
    peak = max(min(peak, bounds.slope), slope_up)
    # Of the way, building up and dying away cover this; the rest is covered at the peak.
    covered = (peak * peak - 0.5 * slope_up * slope_up) / change
    rising, dying = (peak - slope_up) / change, peak / change
    staying = max((way - covered) / peak, 0.0) if peak > 0.0 else 0.0

    jerk = copysign(change, up)
    first = _Piece(0.0, 0.0, rate, slope, jerk)
    second = _Piece(rising, *_after(rising, *first[1:]), 0.0)
    third = _Piece(rising + staying, *_after(staying, *second[1:]), -jerk)
    gone, _, _ = _after(dying, *third[1:])
    return Ramp(rising + staying + dying, gone, target, (first, second, third))


class TimeLaw:
    """Motion time that advances by one period at a time, at a rate whose target may change.

    Args:
        period: Time between two advances [s].

    Attributes:
        motion_time: s [s].
        rate: r.
        slope: r' [1/s].
        settled: Whether the rate has come to its target.
    """

    __slots__ = ("_began", "_period", "_ramp", "_ticks", "motion_time", "rate", "settled", "slope")

    def __init__(self, period: float) -> None:
        self._period = period
        self.restart(0.0, 1.0)

    def restart(self, motion_time: float, rate: float, slope: float = 0.0) -> None:
        """Go on from a motion time [s] at a constant rate, whatever was before.

        A slope [1/s] is where the next `aim` begins.
        """
        self.motion_time, self.rate, self.slope = motion_time, rate, slope
        self._follow(ramp(rate, 0.0, rate, RateBounds(1.0, 1.0)))

    def aim(self, target: float, bounds: RateBounds) -> None:
        """Change the rate to `target` in [0, 1], from the present state, as fast as allowed."""
        self._follow(ramp(self.rate, self.slope, target, bounds))

    def advance(self) -> None:
        """Let one period pass."""
        # Counted from where the target was set, so that nothing adds up over a long motion.
        self._ticks += 1
        t = self._ticks * self._period
        gone, self.rate, self.slope = self._ramp.sample(t)
        # Where the rate dies away, rounding alone would take time back by its last digit.
        self.motion_time = max(self.motion_time, self._began + gone)
        self.settled = t >= self._ramp.duration

    def _follow(self, way: Ramp) -> None:
        self._ramp = way
        self._began = self.motion_time
        self._ticks = 0
        self.settled = way.duration <= 0.0


# How abruptly motion time may change its rate on a path whose joints have limits.
#
# Along a path q(s) the joints move as q(s(t)). With r = ds/dt,
#
#     qd   = q' r
#     qdd  = q'' r² + q' r'
#     jerk = q''' r³ + 3 q'' r r' + q' r''
#
# so with r within [0, 1], bounds on r' and r'' bound acceleration and jerk whatever the path
# does, as long as q', q'' and q''' keep what is known of them: the limits the path was planned
# for, or better the most it really uses.
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
