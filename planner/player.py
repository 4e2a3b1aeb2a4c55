"""Playing a trajectory: one set-point per controller cycle, with override, hold and stop."""

from __future__ import annotations

from bisect import bisect_right
from math import ceil, sqrt
from typing import Final, Literal, NamedTuple

import numpy as np

from planner.arrays import Array
from planner.errors import InvalidSetting, LimitExceeded, StartMismatch
from planner.fourier import FourierSeries
from planner.limits import JointLimits, position_rounding
from planner.piecewise_cubic import PiecewiseCubic, Trajectory, pieces_from
from planner.time_law import RateBounds, TimeLaw, admits, slowing_bounds, within


class PathReader:
    """Evaluates position and velocity at one motion time in a few microseconds.

    The knots of all joints of a `PiecewiseCubic` are merged for a single look-up; sums of sines
    are evaluated without accelerations; other trajectories are sampled.
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
        """Return position (n,) [rad] and velocity (n,) [rad/s] at a motion time `s` of it [s]."""
        if isinstance(self._trajectory, _Sines):
            return self._trajectory.read(s)
        if self._trajectory is not None:
            position, velocity, _ = self._trajectory.sample(np.array([s]))
            return position[0], velocity[0]
        piece = bisect_right(self._knots, s) - 1
        x = s - self._knots[piece]
        basis = self._basis
        square = x * x
        basis[0, 1] = x
        basis[0, 2] = square
        basis[0, 3] = square * x
        basis[1, 2] = 2.0 * x
        basis[1, 3] = 3.0 * square
        position, velocity = basis @ self._pieces[piece]
        return position, velocity


class _Sines:
    """Evaluates a `FourierSeries`, equal to its `sample` within rounding."""

    def __init__(self, series: FourierSeries) -> None:
        self._offset = series.offset
        self._frequency = series.frequency
        self._amplitude = series.amplitude
        self._rate = series.amplitude * series.frequency
        self._length = series.length
        self._ramp = series.ramp
        self._sum: Array = np.ones(series.frequency.shape[1])

    def read(self, s: float) -> tuple[Array, Array]:
        phase = s * self._frequency
        position = (self._amplitude * np.sin(phase)) @ self._sum
        velocity = (self._rate * np.cos(phase)) @ self._sum
        remaining = self._length - s
        if min(s, remaining) < self._ramp:
            share, grown = self._window(min(s, remaining) / self._ramp)
            slope = grown / self._ramp if s < remaining else -grown / self._ramp
            position, velocity = share * position, share * velocity + slope * position
        return self._offset + position, velocity

    @staticmethod
    def _window(u: float) -> tuple[float, float]:
        """Return w(u) of the ramp, 0 <= u < 1, and its derivative in u."""
        return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * (u * (1.0 - u)) ** 2


def _merged(trajectory: PiecewiseCubic) -> tuple[list[float], Array]:
    """Return the knots of all joints, and the polynomials between them (m, 4, n)."""
    begins = np.unique(np.concatenate(trajectory.knots))[:-1]
    joints = range(trajectory.n_joints)
    merged = np.stack([pieces_from(trajectory, joint, begins) for joint in joints], axis=2)
    return begins.tolist(), merged * np.array([1.0, 1.0, 0.5, 1.0 / 6.0])[:, None]


# Tolerance on times, as a share of the period.
_TIME_TOLERANCE = 1e-9
FLOAT32_RANGE_ROUNDING: Final = 9e-7
"""Rounding of a position at its limit in packets, as a share of half a joint's range; guard and
player allow as much."""
# Newton steps to the nearest point of the path.
_NEWTON_STEPS = 8
# Largest change of motion time in `resume_from` [s].
_MAX_TIME_CHANGE = 1.0


class _SetPoints(NamedTuple):
    """One row (n,) per cycle: position [rad] and velocity [rad/s]."""

    position: Array
    velocity: Array


class TrajectoryPlayer:
    """Returns the set-points of a trajectory, one period per call of `advance`.

    It has the methods of a `drivers.MotionSource`, and a session takes it as one.

    Motion time advances only in `advance`, so a late or missing call delays the motion and never
    makes it jump. At full rate the set-points come from a table; after a change of rate the path
    is evaluated. After the end, `advance` returns the last position with zero velocity.

    =============  =======================================  ==============
    call           target of the rate                       bounds
    =============  =======================================  ==============
    `override`     the fraction                             of an override
    `hold`         0, until `resume`                        of a stop
    `resume`       the fraction of the override             of a stop
    `stop`         0, where the motion ends                 of a stop
    =============  =======================================  ==============

    Each may be called between any two cycles, also while the rate changes. An override during a
    hold takes effect with `resume`. An override while a resumed motion accelerates changes the
    target at once, within the bounds of a stop if the bounds of an override do not suffice. While
    the arm is at rest at the start of the motion, every rate applies at once.

    Args:
        trajectory: Motion within `limits`.
        period: Time between two set-points [s].
        limits: Limits of the trajectory, to which the factors refer.
        override_acceleration, override_jerk: Largest acceleration and jerk while an override
            changes, as multiples (> 1) of the limits.
        stop_acceleration, stop_jerk: The same during a stop; not below the bounds of an override.
        start_tolerance: Largest distance of a joint from the start of the trajectory [rad].
        extendable: Bounds of changes of the rate hold for any motion within `limits`, and `extend`
            may be called.

    Attributes:
        start: First position of the trajectory (n,) [rad].
        duration: Duration of the trajectory at full rate [s].
        finished: Whether the last set-point of the motion, or of its stop, was returned.
        bounds: Bounds that the last set-point satisfies, or the next one if those are wider: "plan"
            at a constant rate, "override" or "stop" while the rate changes, "stop" after `stop`.
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
        extendable: bool = False,
    ) -> None:
        self._period = period
        self._tolerance = start_tolerance
        self._extendable = extendable
        self._extended = False
        extrema = None
        if isinstance(trajectory, PiecewiseCubic) and not extendable:
            extrema = trajectory.extrema()
        stopping = slowing_bounds(limits, stop_acceleration, stop_jerk, extrema)
        # Rate at which the path has the accelerations of a stop.
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
        self._set_path(trajectory)
        self.start: Array = trajectory.sample(np.zeros(1))[0][0]
        self._rest: Array = np.zeros_like(self.start)
        self._offset = self._rest
        self._law = TimeLaw(period)
        self._tabled = True
        self._override = 1.0
        self._begun = False
        self.finished: bool
        self.bounds: Literal["plan", "override", "stop"]
        self._rewind()

    def _set_path(self, trajectory: Trajectory) -> None:
        self.duration = trajectory.duration
        self._end = trajectory.duration - _TIME_TOLERANCE * self._period
        self._end_position: Array = trajectory.sample(np.array([trajectory.duration]))[0][0]
        self._path = PathReader(trajectory)

    def extend(self, trajectory: Trajectory) -> None:
        """Replace the motion by one within `limits` that equals it up to the present motion time.

        Raises:
            RuntimeError: the player is not `extendable`, or the motion was begun and is finished.
        """
        if not self._extendable or (self._begun and self.finished):
            raise RuntimeError("only a motion that is extendable and not finished is extended")
        self._set_path(trajectory)
        self._extended = True

    def _rewind(self) -> None:
        self._last = self.start + self._offset
        self._given = 0
        self._across: list[Array] = []
        self.finished = self._held = self._stopping = False
        self.bounds = "plan"
        self._ramp: Literal["override", "stop"] = "override"
        self._start_at(self._override)

    @property
    def rate(self) -> float:
        """Rate of motion time, from 0 (at rest) to 1 (as planned)."""
        return self._law.rate

    @property
    def motion_time(self) -> float:
        """Time in the trajectory [s] of the last set-point."""
        return self._given * self._period if self._tabled else self._law.motion_time

    def begin(self, position: Array) -> None:
        """Start the motion from its beginning, at the set-point of the resting arm (n,) [rad].

        The small difference to the planned start is added to the whole motion, so that a rounded
        set-point does not become a jerk. A hold or stop is cleared, an override is not.

        Raises:
            StartMismatch: a joint is farther from the planned start than the tolerance.
            LimitExceeded: with the difference added, a joint would leave its range.
            RuntimeError: the motion was extended.
        """
        if self._extended:
            raise RuntimeError("an extended motion cannot be begun again")
        offset = self._offset_from(self.start, position, self._tolerance)
        self._check_range(offset)
        # Not added to the table, which would take longer than the cycle of the first set-point.
        self._offset = offset
        self._begun = True
        self._rewind()

    def _offset_from(self, point: Array, position: Array, tolerance: float) -> Array:
        """Return the difference (n,) [rad] of a position from a point; StartMismatch if larger."""
        offset = np.asarray(position, dtype=np.float64) - point
        off = ~(np.abs(offset) <= tolerance)  # true also for NaN
        if np.any(off):
            joint = int(np.argmax(off))
            raise StartMismatch(joint, float(position[joint]), float(point[joint]), tolerance)
        return offset

    def _check_range(self, offset: Array) -> None:
        limits = self._limits
        rounding = position_rounding(self._limits)
        slack = np.maximum(rounding, 0.5 * FLOAT32_RANGE_ROUNDING * (limits.upper - limits.lower))
        for reach, bound, sign in (
            (self._lower + offset, limits.lower, -1.0),
            (self._upper + offset, limits.upper, 1.0),
        ):
            excess = sign * (reach - bound) - slack
            if np.any(excess > 0.0):
                joint = int(np.argmax(excess))
                raise LimitExceeded("position", joint, float(reach[joint]), float(bound[joint]))

    def resume_from(self, position: Array, velocity: Array, cycles: int) -> None:
        """Continue from a set-point to which the controller extrapolated the motion in a gap.

        The motion continues at the point of the path nearest to `position` (n,) [rad], with the
        share of `velocity` (n,) [rad/s] along it; the velocity across the path decays linearly in
        `cycles`. The distance from the path remains for the rest of the motion, like that at the
        start.

        Raises:
            StartMismatch: a joint is farther from the path than the tolerance.
        """
        offset = self._offset + (position - self._last)
        if velocity.any() and np.max(np.abs(offset)) <= self._tolerance:
            self._offset = offset
            self._last = position
            if self._stopping:
                self._slow_to(velocity)
            return
        s = self.motion_time
        here = position - self._offset
        # Below this squared speed the path has no usable direction.
        slowest = float(velocity @ velocity) * _TIME_TOLERANCE
        least = max(s - _MAX_TIME_CHANGE, 0.0)
        most = min(s + _MAX_TIME_CHANGE, self.duration)
        point, speed = self._path.read(s)
        for _ in range(_NEWTON_STEPS):
            square = float(speed @ speed)
            if square <= slowest:
                break
            before = s
            s = min(max(s + float((here - point) @ speed) / square, least), most)
            point, speed = self._path.read(s)
            if abs(s - before) <= _TIME_TOLERANCE * self._period:
                break
        square = float(speed @ speed) or 1.0
        self._offset_from(point, here, self._tolerance)
        # One tolerance for the start, one for all gaps together.
        self._offset = self._offset_from(point, position, 2.0 * self._tolerance)
        self._last = position
        rate = min(max(0.0, float(velocity @ speed) / square), self._fastest)
        shares = np.arange(1.0, cycles + 1.0)[:, None] / (cycles + 1.0)
        self._across = list(shares * (velocity - rate * speed)) if velocity.any() else []
        self._restart(s, rate)

    def _slow_to(self, velocity: Array) -> None:
        """Continue a stop with the share of `velocity` (n,) along the path, if that is slower."""
        s = self.motion_time
        _, speed = self._path.read(s)
        square = float(speed @ speed)
        rate = float(velocity @ speed) / square if square else 0.0
        if rate < self._law.rate:
            self._restart(s, max(0.0, rate))

    def _restart(self, s: float, rate: float) -> None:
        """Continue at this motion time and rate, within the bounds of a stop."""
        self._tabled = False
        stopping = self._allowed["stop"]
        # A deceleration continues: restarted after each of many gaps, it would never end.
        slope = max(min(self._law.slope, 0.0), -sqrt(2.0 * stopping.change * rate))
        self._law.restart(s, rate, slope)
        self._law.aim(0.0 if self._held or self._stopping else self._override, stopping)
        self._ramp = self.bounds = "stop"
        self.finished = self._stopping and self._settled

    @property
    def _settled(self) -> bool:
        """Whether the rate has reached its target and the velocity across the path is zero."""
        return self._law.settled and not self._across

    def advance(self) -> tuple[Array, Array]:
        """Return the next set-point: position (n,) [rad] and velocity (n,) [rad/s]."""
        if not self._begun:
            raise RuntimeError("the motion was not begun")
        if self.finished:
            return self._last, self._rest
        if not self._tabled:
            return self._advance_on_path()
        row = self._given
        self._given = row + 1
        self.finished = self._given >= len(self._table.position)
        self._last = self._table.position[row] + self._offset
        return self._last, self._table.velocity[row]

    def _advance_on_path(self) -> tuple[Array, Array]:
        law = self._law
        if self._settled:
            self.bounds = "plan"
            if law.rate == 0.0:
                return self._last, self._rest
        law.advance()
        if law.motion_time >= self._end and not self._across:
            self.finished = True
            self._last = self._end_position + self._offset
            return self._last, self._rest
        position, velocity = self._path.read(min(law.motion_time, self.duration))
        velocity = velocity * law.rate
        if self._across:
            across = self._across.pop()
            velocity += across
            self._offset = self._offset + self._period * across
        self.finished = self._stopping and self._settled
        self._last = position + self._offset
        return self._last, velocity

    def override(self, fraction: float) -> None:
        """Change the speed to this fraction, 0 to 1, of the planned one.

        Raises:
            InvalidSetting: the fraction is out of range.
        """
        if not 0.0 <= fraction <= 1.0:
            raise InvalidSetting("override", fraction, "a number from 0 to 1")
        self._override = float(fraction)
        if self.finished or self._stopping or self._held:
            return
        law = self._law
        # Checked only within ramps of wider bounds: within those of an override, the result would
        # depend on rounding.
        abrupt = self._ramp == "stop" and not (
            law.settled or admits(self._allowed["override"], law.rate, law.slope)
        )
        self._aim(self._override, "stop" if abrupt else "override")

    def hold(self) -> None:
        """Stop on the path until `resume`."""
        if self.finished or self._stopping or self._held:
            return
        self._held = True
        self._aim(0.0, "stop")

    def resume(self) -> None:
        """Continue after `hold`, also while the motion still slows down."""
        if self.finished or not self._held:
            return
        self._held = False
        self._aim(self._override, "stop")

    def stop(self) -> None:
        """Stop on the path and end the motion; without effect if stopping or finished."""
        if self.finished or self._stopping:
            return
        self._held = False
        self._stopping = True
        self._aim(0.0, "stop")
        self.bounds = "stop"
        self.finished = self._settled

    def _aim(self, target: float, ramp: Literal["override", "stop"]) -> None:
        """Change the rate to a target within the bounds of an override or a stop."""
        if self.motion_time == 0.0:
            self._start_at(target)
            return
        if self._tabled:
            if target == 1.0:
                return
            self._law.restart(self.motion_time, 1.0)
            self._tabled = False
        self._law.aim(target, self._allowed[ramp])
        self._ramp = ramp
        if not self._law.settled:
            self.bounds = ramp

    def _start_at(self, rate: float) -> None:
        """Set the rate at the start, where the arm is at rest."""
        self._law.restart(0.0, rate)
        # A table of a longer motion would take longer than a cycle.
        self._tabled = rate == 1.0 and not self._extendable


def _tabulate(trajectory: Trajectory, period: float) -> _SetPoints:
    """Return the set-points of a trajectory at full rate, from one period after its start."""
    cycles = max(1, ceil(trajectory.duration / period - _TIME_TOLERANCE))
    position, velocity, _ = trajectory.sample(period * np.arange(1, 1 + cycles, dtype=np.float64))
    velocity = np.ascontiguousarray(velocity)
    velocity[-1] = 0.0  # exactly at rest at the end
    return _SetPoints(np.ascontiguousarray(position), velocity)
