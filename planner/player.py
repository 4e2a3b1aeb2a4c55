"""Turning a trajectory into one set-point per controller cycle."""

from __future__ import annotations

from math import ceil
from typing import Literal, NamedTuple

import numpy as np

from planner.arrays import Array
from planner.errors import InvalidSetting, NotBegun, StartMismatch
from planner.limits import JointLimits
from planner.stop import slowing_bounds, stop_law
from planner.trajectory import Trajectory

# A last period this much shorter than the others is rounding, not motion.
_ROUNDING = 1e-9


class _SetPoints(NamedTuple):
    """One row (n,) per cycle: position [rad] and velocity [rad/s]."""

    position: Array
    velocity: Array

    def none(self) -> _SetPoints:
        return _SetPoints(self.position[:0], self.velocity[:0])


class TrajectoryPlayer:
    """Play a trajectory one period per call, whatever the clock says.

    Motion time advances only in `advance`, so a late or missing call delays the motion and
    never makes it jump. The table of set-points is made before the motion begins. `stop` swaps
    what is left of it for the same path run ever more slowly, until it rests. At the end the
    last set-point is the last position with zero velocity, however often it is asked for.

    Args:
        trajectory: What to play, keeping `limits`.
        period: Time between two set-points [s].
        limits: The limits the trajectory was planned for; what a stop may use is their multiple.
        stop_acceleration: Largest acceleration during a stop, as a multiple (> 1) of the limits.
        stop_jerk: Largest jerk during a stop, as a multiple (> 1) of the limits.
        start_tolerance: How far [rad] each joint may be from where the trajectory begins.

    Raises:
        InvalidSetting: a period or tolerance or stop factor outside its range, or limits of
            another number of joints.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        period: float,
        limits: JointLimits,
        *,
        stop_acceleration: float = 2.0,
        stop_jerk: float = 3.0,
        start_tolerance: float = 1e-3,
    ) -> None:
        for name, value, valid, allowed in (
            ("period", period, "a time above 0 s", period > 0.0),
            ("stop_acceleration", stop_acceleration, "above 1", stop_acceleration > 1.0),
            ("stop_jerk", stop_jerk, "above 1", stop_jerk > 1.0),
            ("start_tolerance", start_tolerance, "0 rad or more", start_tolerance >= 0.0),
            (
                "limits",
                f"those of {limits.n_joints} joints",
                f"those of {trajectory.n_joints}",
                limits.n_joints == trajectory.n_joints,
            ),
        ):
            if not (allowed and (isinstance(value, str) or np.isfinite(value))):
                raise InvalidSetting(name, value, valid)
        self._trajectory = trajectory
        self._period = period
        self._slowing = slowing_bounds(limits, stop_acceleration, stop_jerk)
        self._tolerance = start_tolerance
        times = period * np.arange(1 + self._cycles(trajectory.duration), dtype=np.float64)
        self._start: Array = trajectory.sample(times[:1])[0][0]
        self._rest: Array = np.zeros_like(self._start)
        self._plan = self._tabulate(times[1:], np.ones((len(times) - 1, 1)))
        self._table = self._plan
        self._last = self._start
        self._given = 0
        self._begun = False
        self._stopping = False

    @property
    def start(self) -> Array:
        """Position (n,) [rad] where the trajectory begins."""
        return self._start

    @property
    def finished(self) -> bool:
        """Whether the last set-point was given: the motion, or its stop, is over."""
        return self._given >= len(self._table.position)

    @property
    def bounds(self) -> Literal["plan", "override", "stop"]:
        """Which bounds the set-points keep: the plan's, or from `stop` on those of a stop."""
        return "stop" if self._stopping else "plan"

    def begin(self, position: Array) -> None:
        """Take up the motion, from its beginning, at the set-point the arm really starts from.

        The small difference to the planned start stays for the whole motion: a set-point that
        was rounded on its way must not become a jerk.

        Args:
            position: First set-point (n,) [rad], at rest.

        Raises:
            StartMismatch: a joint is farther from the planned start than the tolerance.
        """
        offset = np.asarray(position, dtype=np.float64) - self._start
        off = ~(np.abs(offset) <= self._tolerance)  # written so that NaN is off
        if np.any(off):
            joint = int(np.argmax(off))
            raise StartMismatch(
                joint, float(position[joint]), float(self._start[joint]), self._tolerance
            )
        self._offset = offset
        # The table stays as it is: to copy it would cost the cycle of the first set-point.
        self._table = self._plan
        self._last = self._start + offset
        self._given = 0
        self._begun = True
        self._stopping = False

    def advance(self) -> tuple[Array, Array]:
        """Return the next set-point: position (n,) [rad] and velocity (n,) [rad/s]."""
        if not self._begun:
            raise NotBegun
        row = self._given
        if self.finished:
            return self._last, self._rest
        self._given = row + 1
        self._last = self._table.position[row] + self._offset
        return self._last, self._table.velocity[row]

    def stop(self) -> None:
        """Come to rest on the path, starting now; once stopping or finished, do nothing."""
        if self.finished or self._stopping:
            return
        self._stopping = True
        played, self._given = self._given, 0
        if played == 0:  # still at rest at the start
            self._table = self._table.none()
            return
        law = stop_law(self._slowing)
        times = self._period * np.arange(1, 1 + self._cycles(law.duration), dtype=np.float64)
        gone_on, rate, _ = law.sample(times)
        motion_time = played * self._period + gone_on[:, 0]
        # The path may end before the time law does; what follows is rest.
        rows = 1 + int(np.searchsorted(motion_time[:-1], self._trajectory.duration))
        self._table = self._tabulate(motion_time[:rows], rate[:rows])

    def _cycles(self, duration: float) -> int:
        return max(1, ceil(duration / self._period - _ROUNDING))

    def _tabulate(self, motion_time: Array, rate: Array) -> _SetPoints:
        """Return the set-points at motion times (m,), which pass at a rate (m, 1)."""
        position, velocity, _ = self._trajectory.sample(motion_time)
        velocity = np.ascontiguousarray(velocity * rate)
        velocity[-1] = 0.0  # the last one is rest by definition, not to the last digit
        return _SetPoints(np.ascontiguousarray(position), velocity)
