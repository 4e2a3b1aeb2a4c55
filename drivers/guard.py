"""What every set-point has to pass before it leaves.

Rates are differences of the joint-side float64 set-points that were really *sent*, taken before
encoding: a float32 motor position near 100 revolutions moves in steps of 8e-6, which over T³ look
like a jerk as large as the limit itself. For a motion q(t) sampled at the cycle, the k-th
difference over T^k is a mean of the k-th derivative over k cycles: it never exceeds what the
derivative keeps, and a motion that runs *at* a limit hits the bound exactly. Hence a relative
tolerance of 1e-6, which is how well planners keep their limits and far below anything a drive
could feel, plus the rounding of the difference itself, which 1/T³ makes visible at joint angles
of many turns.

All comparisons are written so that NaN fails them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.checks import report, require, require_finite
from drivers.errors import (
    AccelerationLimit,
    CurrentLimit,
    FirstSetPoint,
    FollowingError,
    GuardError,
    JerkLimit,
    MotionHeld,
    MotionNotCarriedOn,
    MotionPaused,
    NotAtStandstill,
    PositionLimit,
    VelocityLimit,
    VelocityMismatch,
)
from drivers.guard_limits import CARRIED_ON, BoundsInForce, GuardLimits
from drivers.motion_source import BoundsName

__all__ = ["FIRST_FRACTION", "RELATIVE_TOLERANCE", "Guard", "GuardLimits"]

Array = NDArray[np.float64]

RELATIVE_TOLERANCE: Final = 1e-6
FIRST_FRACTION: Final = 0.1
"""Share of the following-error threshold allowed between target and arm at the first set-point,
and between the target and the set-points sent last from then on."""
LAG: Final = 0.05
"""s that the velocity of an arm may lag behind that of its set-points: position loops of robots
have a gain of 20 to 50 /s."""

# Rows of the matrix of checked quantities, in the order in which a violation is reported.
_SET_POINT_CHECKS: Final[tuple[type[GuardError], ...]] = (
    PositionLimit,
    VelocityLimit,
    VelocityLimit,
    VelocityMismatch,
    AccelerationLimit,
    JerkLimit,
)
_FEEDBACK_CHECKS: Final[tuple[type[GuardError], ...]] = (
    FollowingError,
    FollowingError,
    CurrentLimit,
)


class Guard:
    """Checks feedback and set-points of one arm, cycle by cycle.

    Attributes:
        limits: what is enforced.
        period: s, the controller's cycle.
    """

    def __init__(self, limits: GuardLimits, period: float) -> None:
        if not period > 0.0:
            raise ValueError(f"guard: period {period} s is not positive")
        self.limits = limits
        self.period = period
        n = limits.n_joints
        self._middle = 0.5 * (limits.lower + limits.upper)
        self._every = np.ones(n, dtype=np.bool_)
        self._sets = {rank: self._bounds(rank) for rank in range(CARRIED_ON + 1)}
        self._in_force = BoundsInForce()
        # Three sent set-points (oldest first), the candidate, and its stated velocity.
        self._history = np.zeros((5, n))
        self._quantities = np.zeros((len(_SET_POINT_CHECKS), n))
        T = period
        self._differences = np.array(
            [
                [0, 0, 0, 1, 0],
                [0, 0, -1 / T, 1 / T, 0],
                [0, 0, 0, 0, 1],
                [0, 0, 1 / T, -1 / T, 1],
                [0, 1 / T**2, -2 / T**2, 1 / T**2, 0],
                [-1 / T**3, 3 / T**3, -3 / T**3, 1 / T**3, 0],
            ]
        )
        self._feedback = np.zeros((len(_FEEDBACK_CHECKS), n))
        self._feedback_bounds = np.zeros((len(_FEEDBACK_CHECKS), n))
        self.narrow(np.full(n, np.inf), np.full(n, np.inf))

    def _bounds(self, rank: int) -> Array:
        """Bounds (6, n) of one set, tolerances included."""
        limits = self.limits
        factor_a, factor_j = limits.factors(rank)
        T = self.period
        acceleration = factor_a * limits.acceleration
        reach = np.maximum(np.abs(limits.lower), np.abs(limits.upper))
        rounding = 4.0 * np.finfo(np.float64).eps * reach
        return np.array(
            [
                0.5 * (limits.upper - limits.lower) * (1.0 + RELATIVE_TOLERANCE),
                limits.velocity * (1.0 + RELATIVE_TOLERANCE) + rounding / T,
                limits.velocity * (1.0 + RELATIVE_TOLERANCE),
                # A backward, central or forward difference is off by at most a T.
                acceleration * T * (1.0 + RELATIVE_TOLERANCE) + rounding / T,
                acceleration * (1.0 + RELATIVE_TOLERANCE) + 2.0 * rounding / T**2,
                factor_j * limits.jerk * (1.0 + RELATIVE_TOLERANCE) + 4.0 * rounding / T**3,
            ]
        )

    @property
    def following_error(self) -> Array:
        """Threshold in force, (n,) motor revolutions."""
        return self._threshold

    @property
    def current(self) -> Array:
        """Limit in force, (n,) A."""
        return self._current

    def narrow(self, following_error: Array, current: Array) -> None:
        """Take the controller's own limits where they are narrower; NaN means it has none.

        Args:
            following_error: (n,) motor revolutions.
            current: (n,) A.
        """
        self._threshold = np.fmin(self.limits.following_error, following_error)
        self._feedback_bounds[0] = self._threshold
        self._feedback_bounds[1] = self._threshold
        self._current = np.fmin(self.limits.current, current)
        self._feedback_bounds[2] = self._current
        self._feedback_bounds *= 1.0 + RELATIVE_TOLERANCE

    def check_hold(self, target: Array, actual: Array, held: NDArray[np.bool_], cycle: int) -> None:
        """Axes `held` (n,) at the target received, while others are not open yet.

        Args:
            target: (n,) D1, motor revolutions.
            actual: (n,) D3, motor revolutions.
            held: (n,) which axes.
            cycle: for the error.

        Raises:
            NotFinite, FollowingError: a target that cannot be held.
        """
        require_finite(target, held, cycle)
        error = np.abs(actual - target)
        require(held, error, self._threshold * (1.0 + RELATIVE_TOLERANCE), FollowingError, cycle)

    def begin(self, q: Array, target: Array, actual: Array, step: Array, cycle: int) -> None:
        """First set-point: the target received in the packet in which the last axis opened.

        Args:
            q: (n,) rad, that target on the joint side.
            target: (n,) D1, motor revolutions.
            actual: (n,) D3, motor revolutions.
            step: (2, n) D2 and D4, motor revolutions per cycle.
            cycle: for the error.

        Raises:
            NotFinite, PositionLimit, FirstSetPoint, NotAtStandstill: it must not be sent.
        """
        self.check_start(target, actual, step, cycle)
        self._in_force.reset()
        self._history[:4] = q
        self.check_set_point(q, np.zeros_like(q), "plan", cycle)

    def go_on_from(self, q: Array, qd: Array, cycles: int) -> None:
        """The controller moved by itself: its target, (n,) rad, and velocity, rad/s, count as sent.

        For so many cycles jerk has no bound.
        """
        self._in_force.reset(CARRIED_ON, cycles)
        self._history[:4] = q - np.arange(3.0, -1.0, -1.0)[:, None] * (self.period * qd)

    def check_start(self, target: Array, actual: Array, step: Array, cycle: int) -> None:
        """What holds in the cycle in which the arm may begin to move.

        Args:
            target: (n,) D1, motor revolutions.
            actual: (n,) D3, motor revolutions.
            step: (2, n) D2 and D4, motor revolutions per cycle.
            cycle: for the error.

        Raises:
            NotFinite, FirstSetPoint, NotAtStandstill: it may not.
        """
        every = self._every
        require_finite(target, every, cycle)
        bound = FIRST_FRACTION * self._threshold
        require(every, np.abs(target - actual), bound, FirstSetPoint, cycle)
        standstill = np.full(len(target), self.limits.standstill)
        for velocity in step:
            require(every, np.abs(velocity), standstill, NotAtStandstill, cycle)

    def check_feedback(
        self,
        target: Array,
        actual: Array,
        current: Array,
        commanded: Array,
        cycle: int,
        where: NDArray[np.bool_] | None = None,
    ) -> None:
        """What the packet says of the arm, before the next set-point is asked for.

        Following error is held against both the target the controller reports and the one sent
        last; they differ where an answer was lost.

        Args:
            target: (n,) D1, motor revolutions.
            actual: (n,) D3, motor revolutions.
            current: (n,) D5, A.
            commanded: (n,) D1 of the answer sent last, motor revolutions.
            cycle: for the error.
            where: (n,) which joints; None for all.

        Raises:
            NotFinite, FollowingError, CurrentLimit: the motion must not go on.
        """
        found = self._feedback
        np.subtract(actual, commanded, out=found[0])
        np.subtract(actual, target, out=found[1])
        found[2] = current
        np.abs(found, out=found)
        if where is not None:
            found[:, ~where] = 0.0
        if not (found <= self._feedback_bounds).all():
            report(found, found, self._feedback_bounds, _FEEDBACK_CHECKS, cycle)

    def check_after_gap(
        self,
        target: Array,
        velocity: Array,
        commanded: Array,
        step: Array,
        cycle: int,
        where: NDArray[np.bool_],
    ) -> None:
        """The first packet after a long gap, before an axis goes on from the set-point sent last.

        A velocity may be off by half the step sent last, or by what counts as standstill. The
        target's is always held against that; the arm's lags behind, so only where it stands.

        Args:
            target: (n,) D1, motor revolutions.
            velocity: (2, n) D2 and D4, motor revolutions per cycle.
            commanded: (n,) where the target should be, motor revolutions.
            step: (n,) D2 of the answer sent last, motor revolutions per cycle.
            cycle: for the error.
            where: (n,) which joints.

        Raises:
            NotFinite, MotionNotCarriedOn, MotionHeld: going on would be a jump.
        """
        bound = FIRST_FRACTION * self._threshold
        require(where, np.abs(target - commanded), bound, MotionNotCarriedOn, cycle)
        standstill = self.limits.standstill
        bound = np.maximum(0.5 * np.abs(step), standstill)
        moving = np.abs(velocity[1]) > standstill
        for joints, found in ((where, velocity[0]), (where & ~moving, velocity[1])):
            require(joints, np.abs(found - step), bound, MotionHeld, cycle)

    def check_after_pause(self, velocity: Array, cycle: int, where: NDArray[np.bool_]) -> None:
        """A packet came late by the clock: the arm moves as the set-points sent last.

        A servo lags behind; what it gains in `LAG` at the acceleration allowed is no pause.

        Args:
            velocity: (n,) of the arm, rad/s.
            cycle: for the error.
            where: (n,) which joints.

        Raises:
            NotFinite, MotionPaused: it does not, so that the next set-point would be a jump.
        """
        sent = (self._history[3] - self._history[2]) / self.period
        factor, _ = self.limits.factors(self._in_force.rank)
        bound = LAG * factor * self.limits.acceleration
        require(where, np.abs(velocity - sent), bound, MotionPaused, cycle)

    def check_set_point(self, q: Array, qd: Array, bounds: BoundsName, cycle: int) -> None:
        """The next set-point; if it passes, it counts as sent.

        Args:
            q: (n,) rad.
            qd: (n,) rad/s.
            bounds: the set that applies from this set-point on. Wider bounds stay in force until
                no difference reaches back to them.
            cycle: for the error.

        Raises:
            NotFinite, PositionLimit, VelocityLimit, VelocityMismatch, AccelerationLimit,
            JerkLimit: it must not be sent.
        """
        history = self._history
        history[:3] = history[1:4]
        history[3] = q
        history[4] = qd
        found = self._quantities
        np.matmul(self._differences, history, out=found)
        found[0] -= self._middle
        magnitude = np.abs(found)
        allowed = self._sets[self._in_force.take(bounds)]
        if not (magnitude <= allowed).all():
            report(magnitude, found, allowed, _SET_POINT_CHECKS, cycle, self.position_limits)

    def position_limits(self, joint: int, value: float) -> tuple[float, float]:
        """The position meant by `value` off the middle of the range, and the limit nearest it."""
        limit = self.limits.upper if value > 0.0 else self.limits.lower
        return float(self._middle[joint] + value), float(limit[joint])
