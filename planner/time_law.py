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

    def restart(self, motion_time: float, rate: float) -> None:
        """Go on from a motion time [s] at a constant rate, whatever was before."""
        self.motion_time, self.rate, self.slope = motion_time, rate, 0.0
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
