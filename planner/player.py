"""Turning a trajectory into one set-point per controller cycle."""

from __future__ import annotations

from bisect import bisect_right
from math import ceil, isfinite, sqrt
from typing import Literal, NamedTuple

import numpy as np

from planner.arrays import Array
from planner.errors import InvalidSetting, LimitExceeded, NotBegun, StartMismatch
from planner.fourier import FourierSeries
from planner.limits import JointLimits, position_rounding
from planner.piecewise_cubic import PiecewiseCubic, Trajectory, pieces_from
from planner.time_law import RateBounds, TimeLaw, admits, slowing_bounds, within


class PathReader:
    """Read position and velocity at one motion time, in a few microseconds.

    The knots of all joints are merged, so that one look-up finds the cubics of all of them. Sums
    of sines are summed here, without the accelerations that nobody asks for. A trajectory of
    another kind is asked for each state itself, at its own speed.

    Args:
        trajectory: The path as a function of motion time.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory: Trajectory | _Sines | None = None
        self._knots: list[float] = []
        self._pieces: Array = np.zeros((0, 4, trajectory.n_joints))
        # Rows: powers of the time into a piece, and their derivatives.
        self._basis: Array = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        if isinstance(trajectory, PiecewiseCubic):
            self._knots, self._pieces = _merged(trajectory)
        elif isinstance(trajectory, FourierSeries):
            self._trajectory = _Sines(trajectory)
        else:
            self._trajectory = trajectory

    def read(self, s: float) -> tuple[Array, Array]:
        """Return position (n,) [rad] and velocity (n,) [rad/s] at motion time `s` [s].

        It lies within the trajectory, which lasts longer than 0 s.
        """
        if isinstance(self._trajectory, _Sines):
            return self._trajectory.read(s)
        if self._trajectory is not None:
            position, velocity, _ = self._trajectory.sample(np.array([s]))
            return position[0], velocity[0]
        piece = bisect_right(self._knots, s) - 1
        x = s - self._knots[piece]
        basis, square = self._basis, x * x
        basis[0, 1] = x
        basis[0, 2] = square
        basis[0, 3] = square * x
        basis[1, 2] = 2.0 * x
        basis[1, 3] = 3.0 * square
        position, velocity = basis @ self._pieces[piece]
        return position, velocity


class _Sines:
    """Reads a sum of sines, to rounding what the series itself says."""

    def __init__(self, series: FourierSeries) -> None:
        self._offset, self._frequency = series.offset, series.frequency
        self._amplitude, self._rate = series.amplitude, series.amplitude * series.frequency
        self._length, self._ramp = series.length, series.ramp
        self._sum: Array = np.ones(series.frequency.shape[1])

    def read(self, s: float) -> tuple[Array, Array]:
        phase = s * self._frequency
        position = (self._amplitude * np.sin(phase)) @ self._sum
        velocity = (self._rate * np.cos(phase)) @ self._sum
        left = self._length - s
        if min(s, left) < self._ramp:
            share, grown = self._window(min(s, left) / self._ramp)
            slope = grown / self._ramp if s < left else -grown / self._ramp
            position, velocity = share * position, share * velocity + slope * position
        return self._offset + position, velocity

    @staticmethod
    def _window(u: float) -> tuple[float, float]:
        """w(u) of the ramp, 0 <= u < 1, and its derivative in u."""
        return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * (u * (1.0 - u)) ** 2


def _merged(trajectory: PiecewiseCubic) -> tuple[list[float], Array]:
    """Return the times at which the cubic of any joint changes, and the cubics (m, 4, n)."""
    begins = np.unique(np.concatenate(trajectory.knots))[:-1]
    joints = range(trajectory.n_joints)
    merged = np.stack([pieces_from(trajectory, joint, begins) for joint in joints], axis=2)
    return begins.tolist(), merged * np.array([1.0, 1.0, 0.5, 1.0 / 6.0])[:, None]


# A last period this much shorter than the others is rounding, not motion.
_ROUNDING = 1e-9
# Share of half a joint's range by which a set-point rounded on the wire may lie outside it.
_CARRIED = 9e-7
# Steps of Newton towards the nearest point of a path, from a few cycles away.
_TRIES = 8
# s; no gap of which a motion goes on is longer, and no nearest point is farther away in time.
_FARTHEST = 1.0


class _SetPoints(NamedTuple):
    """One row (n,) per cycle: position [rad] and velocity [rad/s]."""

    position: Array
    velocity: Array


class TrajectoryPlayer:
    """Play a trajectory one period per call, whatever the clock says.

    Motion time advances only in `advance`, so a late or missing call delays the motion and
    never makes it jump. At full rate the set-points come from a table made before the motion
    begins. Once the rate was changed, the same path is read at the motion time that has come,
    for the table's rows lie elsewhere. At the end the last set-point is the last position with
    zero velocity, however often it is asked for.

    =============  ===========================================  ==============================
    asked for      the rate goes                                within the bounds
    =============  ===========================================  ==============================
    `override`     to this fraction                             of an override
    `hold`         to 0, until `resume`                         of a stop
    `resume`       to the fraction of the override              of a stop
    `stop`         to 0, where the motion ends; so `cancel`     of a stop
    =============  ===========================================  ==============================

    Each may be asked for between any two cycles, also while the rate still changes. An override
    asked for during a hold takes effect with `resume`. One asked for while a resumed motion is
    still gathering speed changes the target at once; it goes on within the bounds of a stop if
    those of an override no longer suffice. As long as the arm is at rest at the start of the
    motion, every rate applies at once.

    Args:
        trajectory: What to play, keeping `limits`.
        period: Time between two set-points [s].
        limits: The limits the trajectory was planned for; the bounds are their multiples.
        override_acceleration: Largest acceleration while an override changes, as a multiple (> 1)
            of the limits.
        override_jerk: Largest jerk while an override changes, likewise.
        stop_acceleration: Largest acceleration during a stop, likewise; not below the override's.
        stop_jerk: Largest jerk during a stop, likewise; not below the override's.
        start_tolerance: How far [rad] each joint may be from where the trajectory begins.

    Raises:
        InvalidSetting: a period or tolerance or factor outside its range, or limits of another
            number of joints.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        period: float,
        limits: JointLimits,
        *,
        override_acceleration: float = 1.3,
        override_jerk: float = 1.7,
        stop_acceleration: float = 2.0,
        stop_jerk: float = 3.0,
        start_tolerance: float = 1e-3,
    ) -> None:
        _check("period", period, "a time above 0 s", period > 0.0)
        for name, override, stop in (
            ("acceleration", override_acceleration, stop_acceleration),
            ("jerk", override_jerk, stop_jerk),
        ):
            _check(f"override_{name}", override, "above 1", override > 1.0)
            _check(f"stop_{name}", stop, "above 1", stop > 1.0)
            least = f"at least override_{name} = {override}"
            _check(f"stop_{name}", stop, least, stop >= override)
        _check("start_tolerance", start_tolerance, "0 rad or more", start_tolerance >= 0.0)
        if limits.n_joints != trajectory.n_joints:
            raise InvalidSetting(
                "limits", f"those of {limits.n_joints} joints", f"those of {trajectory.n_joints}"
            )
        self._period = period
        self._tolerance = start_tolerance
        extrema = trajectory.extrema() if isinstance(trajectory, PiecewiseCubic) else None
        stopping = slowing_bounds(limits, stop_acceleration, stop_jerk, extrema)
        # At this rate the path's own accelerations are those of a stop.
        self._fastest = sqrt(stop_acceleration)
        overriding = slowing_bounds(limits, override_acceleration, override_jerk, extrema)
        self._allowed: dict[Literal["override", "stop"], RateBounds] = {
            "override": within(overriding, stopping),
            "stop": stopping,
        }
        self._table = _tabulate(trajectory, period)
        self._limits = limits
        reach = self._table.position
        self._lower = reach.min(axis=0) if extrema is None else extrema.lower
        self._upper = reach.max(axis=0) if extrema is None else extrema.upper
        self._duration = trajectory.duration
        # The end of the motion, but for a last period that is no more than rounding.
        self._end = trajectory.duration - _ROUNDING * period
        self._path = PathReader(trajectory)
        self._start: Array = trajectory.sample(np.zeros(1))[0][0]
        self._rest: Array = np.zeros_like(self._start)
        self._offset = self._rest
        self._law = TimeLaw(period)
        self._tabled = True
        self._override = 1.0
        self._begun = False
        self._rewind()

    def _rewind(self) -> None:
        self._last = self._start + self._offset
        self._given = 0
        self._across: list[Array] = []
        self._finished = self._held = self._stopping = False
        self._bounds: Literal["plan", "override", "stop"] = "plan"
        self._ramp: Literal["override", "stop"] = "override"
        self._take_up(self._override)

    @property
    def start(self) -> Array:
        """Position (n,) [rad] where the trajectory begins."""
        return self._start

    @property
    def duration(self) -> float:
        """Duration [s] of the trajectory at full rate."""
        return self._duration

    @property
    def finished(self) -> bool:
        """Whether the last set-point was given: the motion, or its stop, is over."""
        return self._finished

    @property
    def bounds(self) -> Literal["plan", "override", "stop"]:
        """Which bounds the set-point given last keeps, or the next one if that is more.

        Those of the plan at any constant rate, those of what was asked for while the rate
        changes, and from `stop` on those of a stop for good.
        """
        return self._bounds

    @property
    def rate(self) -> float:
        """How fast motion time runs, from 0 (at rest) to 1 (as planned)."""
        return self._law.rate

    @property
    def motion_time(self) -> float:
        """Time in the trajectory [s] of the set-point given last."""
        return self._given * self._period if self._tabled else self._law.motion_time

    def begin(self, position: Array) -> None:
        """Take up the motion, from its beginning, at the set-point the arm really starts from.

        The small difference to the planned start stays for the whole motion: a set-point that
        was rounded on its way must not become a jerk. What was held or stopped before is not
        any more; an override stays as it was asked for.

        Args:
            position: First set-point (n,) [rad], at rest.

        Raises:
            StartMismatch: a joint is farther from the planned start than the tolerance.
            LimitExceeded: with the difference carried along, a joint would leave its range.
        """
        offset = self._near(position, self._start, self._tolerance)
        self._check_range(offset)
        # The table stays as it is: to copy it would cost the cycle of the first set-point.
        self._offset = offset
        self._begun = True
        self._rewind()

    def _near(self, position: Array, point: Array, tolerance: float) -> Array:
        """Return how far (n,) [rad] a position is from a point of the path, if that is near."""
        offset = np.asarray(position, dtype=np.float64) - point
        off = ~(np.abs(offset) <= tolerance)  # written so that NaN is off
        if np.any(off):
            joint = int(np.argmax(off))
            raise StartMismatch(joint, float(position[joint]), float(point[joint]), tolerance)
        return offset

    def _check_range(self, offset: Array) -> None:
        limits, rounding = self._limits, position_rounding(self._limits)
        slack = np.maximum(rounding, 0.5 * _CARRIED * (limits.upper - limits.lower))
        for reach, bound, sign in (
            (self._lower + offset, limits.lower, -1.0),
            (self._upper + offset, limits.upper, 1.0),
        ):
            excess = sign * (reach - bound) - slack
            if np.any(excess > 0.0):
                joint = int(np.argmax(excess))
                raise LimitExceeded("position", joint, float(reach[joint]), float(bound[joint]))

    def resume_from(self, position: Array, velocity: Array, cycles: int) -> None:
        """Go on where a controller carried the motion by itself, with what was asked for.

        That is at the nearest point of the path, and as fast along it; the velocity across dies
        away in `cycles`. The distance stays for the rest of the motion, like that at the start.

        Args:
            position: The controller's set-point (n,) [rad].
            velocity: Its velocity (n,) [rad/s].
            cycles: How many set-points have a part of the velocity across.

        Raises:
            StartMismatch: a joint is farther from the path than the tolerance.
        """
        way = self._offset + (position - self._last)
        if velocity.any() and np.max(np.abs(way)) <= self._tolerance:
            self._offset, self._last = way, position
            return
        s, here = self.motion_time, position - self._offset
        # Where the path hardly moves its direction says nothing.
        slowest = float(velocity @ velocity) * _ROUNDING
        least, most = max(s - _FARTHEST, 0.0), min(s + _FARTHEST, self._duration)
        point, speed = self._path.read(s)
        for _ in range(_TRIES):
            square = float(speed @ speed)
            if square <= slowest:
                break
            before, s = s, min(max(s + float((here - point) @ speed) / square, least), most)
            point, speed = self._path.read(s)
            if abs(s - before) <= _ROUNDING * self._period:
                break
        square = float(speed @ speed) or 1.0
        self._near(here, point, self._tolerance)
        # However many gaps there are: once the tolerance for the start, once for all of them.
        self._offset = self._near(position, point, 2.0 * self._tolerance)
        self._last = position
        self._tabled = False
        rate = min(max(0.0, float(velocity @ speed) / square), self._fastest)
        stopping = self._allowed["stop"]
        # What slows down goes on so: begun anew after each of many gaps, it would never be at rest.
        slope = max(min(self._law.slope, 0.0), -sqrt(2.0 * stopping.change * rate))
        self._law.restart(s, rate, slope)
        shares = np.arange(1.0, cycles + 1.0)[:, None] / (cycles + 1.0)
        self._across = list(shares * (velocity - rate * speed)) if velocity.any() else []
        self._law.aim(0.0 if self._held or self._stopping else self._override, stopping)
        self._ramp = self._bounds = "stop"
        self._finished = self._stopping and self._settled

    @property
    def _settled(self) -> bool:
        """Whether the rate has come to its target and no velocity across the path is left."""
        return self._law.settled and not self._across

    def advance(self) -> tuple[Array, Array]:
        """Return the next set-point: position (n,) [rad] and velocity (n,) [rad/s]."""
        if not self._begun:
            raise NotBegun
        if self._finished:
            return self._last, self._rest
        if not self._tabled:
            return self._advance_beside_the_table()
        row = self._given
        self._given = row + 1
        self._finished = self._given >= len(self._table.position)
        self._last = self._table.position[row] + self._offset
        return self._last, self._table.velocity[row]

    def _advance_beside_the_table(self) -> tuple[Array, Array]:
        law = self._law
        if self._settled:
            self._bounds = "plan"
            if law.rate == 0.0:
                return self._last, self._rest
        law.advance()
        if law.motion_time >= self._end and not self._across:
            self._finished = True
            self._last = self._table.position[-1] + self._offset
            return self._last, self._rest
        position, velocity = self._path.read(min(law.motion_time, self._duration))
        velocity = velocity * law.rate
        if self._across:
            across = self._across.pop()
            velocity += across
            self._offset = self._offset + self._period * across
        self._finished = self._stopping and self._settled
        self._last = position + self._offset
        return self._last, velocity

    def override(self, fraction: float) -> None:
        """Go on at this fraction, 0 to 1, of the planned speed.

        Raises:
            InvalidSetting: any other number.
        """
        _check("override", fraction, "a number from 0 to 1", 0.0 <= fraction <= 1.0)
        self._override = float(fraction)
        if self._finished or self._stopping or self._held:
            return
        law = self._law
        # Only what wider bounds began can be too abrupt; asked in a ramp of the same bounds,
        # rounding alone would decide.
        abrupt = self._ramp == "stop" and not (
            law.settled or admits(self._allowed["override"], law.rate, law.slope)
        )
        self._aim(self._override, "stop" if abrupt else "override")

    def hold(self) -> None:
        """Come to rest on the path and wait there, starting now."""
        if self._finished or self._stopping or self._held:
            return
        self._held = True
        self._aim(0.0, "stop")

    def resume(self) -> None:
        """Go on after a hold, or in the middle of it."""
        if self._finished or not self._held:
            return
        self._held = False
        self._aim(self._override, "stop")

    def stop(self) -> None:
        """Come to rest on the path, starting now; once stopping or finished, do nothing."""
        if self._finished or self._stopping:
            return
        self._held, self._stopping = False, True
        self._aim(0.0, "stop")
        self._bounds = "stop"
        self._finished = self._settled

    def cancel(self) -> None:
        """Give the motion up: come to rest on the path, from where it cannot be resumed."""
        self.stop()

    def _aim(self, target: float, ramp: Literal["override", "stop"]) -> None:
        """Let the rate go to a target within the bounds of an override or a stop."""
        if self.motion_time == 0.0:
            self._take_up(target)
            return
        if self._tabled:
            if target == 1.0:
                return
            self._law.restart(self.motion_time, 1.0)
            self._tabled = False
        self._law.aim(target, self._allowed[ramp])
        self._ramp = ramp
        if not self._law.settled:
            self._bounds = ramp

    def _take_up(self, rate: float) -> None:
        """Run at a rate from the start: nothing moves there yet that could move abruptly."""
        self._law.restart(0.0, rate)
        self._tabled = rate == 1.0


def _check(name: str, value: float, valid: str, allowed: bool) -> None:
    if not (allowed and isfinite(value)):
        raise InvalidSetting(name, value, valid)


def _tabulate(trajectory: Trajectory, period: float) -> _SetPoints:
    """Return the set-points of a trajectory at full rate, from one period after its start."""
    cycles = max(1, ceil(trajectory.duration / period - _ROUNDING))
    position, velocity, _ = trajectory.sample(period * np.arange(1, 1 + cycles, dtype=np.float64))
    velocity = np.ascontiguousarray(velocity)
    velocity[-1] = 0.0  # the last one is rest by definition, not to the last digit
    return _SetPoints(np.ascontiguousarray(position), velocity)
