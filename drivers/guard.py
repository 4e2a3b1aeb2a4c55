"""Checks of every set-point before it is sent.

Rates are differences of the joint-side float64 set-points that were *sent*, before encoding: a
float32 motor position near 100 revolutions has steps of 8e-6, which over T³ is a jerk as large as
the limit. For a motion q(t) sampled at the cycle, the k-th difference over T^k is a mean of the
k-th derivative over k cycles: it never exceeds the bound of the derivative, and a motion *at* a
limit reaches the bound exactly. Hence a relative tolerance of 1e-6, the accuracy of planners, plus
the rounding of the difference itself, which 1/T³ amplifies at joint angles of many turns.

All comparisons are written so that NaN fails them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.errors import Check, GuardError
from drivers.motion_source import BoundsName

Joints = NDArray[np.bool_]


def require(where: Joints, values: Array, bounds: Array, check: Check, cycle: int) -> None:
    """Raise for the first joint whose value is above its bound.

    Args:
        where: joints that are checked (n,).
        values: magnitudes (n,).
        bounds: of the values (n,).
        check: that they belong to.
        cycle: number of the cycle.

    Raises:
        GuardError: a value is above its bound.
    """
    bad = where & ~(values <= bounds)
    if bad.any():
        joint = int(np.argmax(bad))
        raise GuardError(check, joint, float(values[joint]), float(bounds[joint]), cycle)


def all_true(flags: NDArray[np.bool_]) -> bool:
    """Whether all flags are true, in a fifth of the time of `flags.all()`."""
    return b"\0" not in flags.tobytes()


def require_finite(values: Array, where: Joints, cycle: int) -> None:
    """Raise for the first joint of `where` (n,) whose value (n,) is not finite."""
    offending = np.where(np.isfinite(values), 0.0, values)
    require(where, np.abs(offending), np.zeros_like(values), Check.FINITE, cycle)


def raise_first(
    values: Array,
    allowed: Array,
    checks: tuple[Check, ...],
    cycle: int,
    middle: Array | None = None,
) -> NoReturn:
    """Raise for the first row and joint outside its bound; not finite values come first.

    Args:
        values: one row for each check (k, n).
        allowed: largest magnitude of each (k, n).
        checks: that the rows belong to (k).
        cycle: number of the cycle.
        middle: of the range (n,), from which a position is measured.

    Raises:
        GuardError: always.
    """
    not_finite = ~np.isfinite(values)
    bad = not_finite if not_finite.any() else ~(np.abs(values) <= allowed)
    row, joint = (int(index) for index in np.argwhere(bad)[0])
    value = float(values[row, joint])
    bound = float(allowed[row, joint])
    if checks[row] is Check.POSITION and middle is not None:
        bound = float(middle[joint]) + math.copysign(bound / (1.0 + RELATIVE_TOLERANCE), value)
        value += float(middle[joint])
    raise GuardError(checks[row], joint, value, bound, cycle)


DEFAULT_STANDSTILL: Final = 5e-4
"""Motor revolutions per cycle below which an axis is at standstill.

An encoder at rest toggles between two increments, so its velocity over one cycle is at most one
increment per cycle, two with servo dither. Two increments of a coarse 12-bit encoder are 4.9e-4;
at 2 ms this is some 0.5 % of a drive's full speed.
"""

RANK: Final[Mapping[BoundsName, int]] = {"plan": 0, "override": 1, "stop": 2}
EXTRAPOLATED_RANK: Final = 3
"""Rank of the bounds of a stop without one on jerk: the steps that a controller extrapolates have
no acceleration, so that returning to the motion is a jump of acceleration."""
MEMORY_CYCLES: Final = 2
"""Cycles for which wider bounds stay active: a third difference spans three cycles."""


@dataclass(frozen=True, eq=False)
class GuardLimits:
    """Limits that the guard enforces; arrays (n,).

    Attributes:
        lower, upper: rad, range of the joint positions.
        velocity: rad/s, magnitude, in all three sets of bounds.
        acceleration, jerk: rad/s², rad/s³, of the set "plan".
        following_error: motor revolutions.
        current: A.
        override_acceleration, override_jerk: factors while an override changes.
        stop_acceleration, stop_jerk: factors during hold and stop.
        standstill: motor revolutions per cycle, see `DEFAULT_STANDSTILL`.

    Raises:
        ValueError: a shape, sign or order is wrong; names the field.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    following_error: Array
    current: Array
    override_acceleration: float = 1.3
    override_jerk: float = 1.7
    stop_acceleration: float = 2.0
    stop_jerk: float = 3.0
    standstill: float = DEFAULT_STANDSTILL

    def __post_init__(self) -> None:
        n = np.size(self.lower)
        ranges = ("lower", "upper")
        positive = ("velocity", "acceleration", "jerk", "following_error", "current")
        for name in (*ranges, *positive):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (n,) or not np.all(np.isfinite(array)):
                raise ValueError(f"guard limits: {name} must be {n} finite numbers, got {array}")
            if name in positive and not np.all(array > 0.0):
                raise ValueError(f"guard limits: {name} must be positive, got {array}")
            object.__setattr__(self, name, array)
        if not np.all(self.lower < self.upper):
            raise ValueError(f"guard limits: lower {self.lower} is not below upper {self.upper}")
        for override, stop in (
            (self.override_acceleration, self.stop_acceleration),
            (self.override_jerk, self.stop_jerk),
        ):
            if not 1.0 <= override <= stop:
                raise ValueError(f"guard limits: factors 1 <= {override} <= {stop} do not hold")
        for name in ("standstill",):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"guard limits: {name} {getattr(self, name)} is not positive")

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.lower)

    def factors(self, rank: int) -> tuple[float, float]:
        """Return the factors on acceleration and jerk of a set of bounds, by rank."""
        stop = self.stop_acceleration
        return (
            (1.0, self.override_acceleration, stop, stop)[rank],
            (1.0, self.override_jerk, self.stop_jerk, np.inf)[rank],
        )


class ActiveBounds:
    """The active set of bounds.

    A wider set stays active until the differences are made of set-points within a narrower one.

    Attributes:
        rank: of the active set.
    """

    _age: int
    """Cycles within a narrower set while the active one, wider than a plan's, remains."""

    def __init__(self) -> None:
        self.rank = 0

    def reset(self) -> None:
        """Activate the bounds of a plan."""
        self.rank = 0

    def extrapolate(self, cycles: int) -> None:
        """Activate the widest set for `cycles` more than `MEMORY_CYCLES`."""
        self.rank = EXTRAPOLATED_RANK
        self._age = -cycles

    def update(self, bounds: BoundsName) -> int:
        """Return the rank of the active set for a next set-point within `bounds`."""
        rank = RANK[bounds]
        if rank >= self.rank:
            self.rank = rank
            self._age = 0
        elif self._age < MEMORY_CYCLES:
            self._age += 1
        else:
            self.rank = rank
        return self.rank


RELATIVE_TOLERANCE: Final = 1e-6
FIRST_SET_POINT_FRACTION: Final = 0.1
"""Share of the following-error threshold allowed between target and arm at the first set-point,
and later between the target and the set-points sent last."""
SERVO_LAG_SECONDS: Final = 0.05
"""Lag of the arm's velocity behind the set-points' velocity, s: position loops of robots have a
gain
of 20 to 50 /s."""

# Rows of the matrix of checked quantities, in the order in which a violation is reported.
_SET_POINT_CHECKS: Final = (
    Check.POSITION,
    Check.VELOCITY,
    Check.VELOCITY,
    Check.STATED_VELOCITY,
    Check.ACCELERATION,
    Check.JERK,
)
_FEEDBACK_CHECKS: Final = (Check.FOLLOWING_ERROR, Check.FOLLOWING_ERROR, Check.CURRENT)


class Guard:
    """Checks feedback and set-points of one arm, cycle by cycle.

    Every check raises `GuardError` where the set-point must not be sent or the motion not continue.

    Attributes:
        limits: of the arm.
        period: s, the controller's cycle.
        following_error: (n,) motor revolutions, the narrower of limits and controller.
        current: (n,) A, the narrower of limits and controller.
    """

    following_error: Array
    current: Array

    def __init__(self, limits: GuardLimits, period: float) -> None:
        if not period > 0.0:
            raise ValueError(f"guard: period {period} s is not positive")
        self.limits = limits
        self.period = period
        n = limits.n_joints
        self._middle = 0.5 * (limits.lower + limits.upper)
        self._every = np.ones(n, dtype=np.bool_)
        self._sets = {rank: self._bounds(rank) for rank in range(EXTRAPOLATED_RANK + 1)}
        self._active = ActiveBounds()
        # Three sent set-points (oldest first), the next one, and its stated velocity.
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

    def narrow(self, following_error: Array, current: Array) -> None:
        """Use the controller's limits (n,) where they are narrower; NaN where it has none."""
        self.following_error = np.fmin(self.limits.following_error, following_error)
        self._feedback_bounds[0] = self.following_error
        self._feedback_bounds[1] = self.following_error
        self.current = np.fmin(self.limits.current, current)
        self._feedback_bounds[2] = self.current
        self._feedback_bounds *= 1.0 + RELATIVE_TOLERANCE

    def check_hold(self, target: Array, actual: Array, opened: Joints, cycle: int) -> None:
        """Check that open axes can hold their target while others are closed.

        Args:
            target: D1 of the packet (n,), motor revolutions.
            actual: D3 of the packet (n,), motor revolutions.
            opened: axes that are open (n,).
            cycle: number of the cycle.

        Raises:
            GuardError: a target is too far from its axis.
        """
        require_finite(target, opened, cycle)
        bound = self.following_error * (1.0 + RELATIVE_TOLERANCE)
        require(opened, np.abs(actual - target), bound, Check.FOLLOWING_ERROR, cycle)

    def begin(self, q: Array, cycle: int) -> None:
        """Check the first set-point q (n,) rad, at rest, which then counts as sent."""
        self._active.reset()
        self._history[:] = q
        self.check_set_point(q, 0.0 * q, "plan", cycle)

    def resume_from(self, q: Array, qd: Array, cycles: int) -> None:
        """Treat the controller's target (n,) rad and velocity, rad/s, as sent.

        Jerk is unbounded for this number of cycles.
        """
        self._active.extrapolate(cycles)
        self._history[:4] = q - np.arange(3.0, -1.0, -1.0)[:, None] * (self.period * qd)

    def check_start(self, target: Array, actual: Array, step: Array, cycle: int) -> None:
        """Check that the arm may begin to move in this cycle.

        Args:
            target: D1 of the packet (n,), motor revolutions.
            actual: D3 of the packet (n,), motor revolutions.
            step: D2 and D4 of the packet (2, n), motor revolutions per cycle.
            cycle: number of the cycle.

        Raises:
            GuardError: the arm moves, or is not at its target.
        """
        every = self._every
        require_finite(target, every, cycle)
        bound = FIRST_SET_POINT_FRACTION * self.following_error
        require(every, np.abs(target - actual), bound, Check.FIRST_SET_POINT, cycle)
        standstill = np.full(len(target), self.limits.standstill)
        for velocity in step:
            require(every, np.abs(velocity), standstill, Check.STANDSTILL, cycle)

    def check_feedback(
        self,
        target: Array,
        actual: Array,
        current: Array,
        commanded: Array,
        cycle: int,
        where: Joints | None = None,
    ) -> None:
        """Check following error and current, before the next set-point is computed.

        The following error is measured from both the target received and the one sent last; they
        differ where a reply was lost.

        Args:
            target: (n,) D1, motor revolutions.
            actual: (n,) D3, motor revolutions.
            current: (n,) D5, A.
            commanded: (n,) D1 of the last reply, motor revolutions.
            cycle: for the error.
            where: (n,) which joints; None for all.
        """
        deviations = self._feedback
        np.subtract(actual, commanded, out=deviations[0])
        np.subtract(actual, target, out=deviations[1])
        deviations[2] = current
        np.abs(deviations, out=deviations)
        if where is not None:
            deviations[:, ~where] = 0.0
        if not all_true(deviations <= self._feedback_bounds):
            raise_first(deviations, self._feedback_bounds, _FEEDBACK_CHECKS, cycle)

    def check_after_gap(
        self,
        target: Array,
        velocity: Array,
        commanded: Array,
        step: Array,
        cycle: int,
        where: Joints,
    ) -> None:
        """Check the first packet after a long gap, before the axes `where` (n,) continue.

        The target's velocity may differ by half the step sent last, or by the standstill
        threshold; so may the arm's, which lags behind, where it is at standstill.

        Args:
            target: (n,) D1, motor revolutions.
            velocity: (2, n) D2 and D4, motor revolutions per cycle.
            commanded: (n,) expected target, motor revolutions.
            step: (n,) D2 of the last reply, motor revolutions per cycle.
            cycle: for the error.
            where: which joints.
        """
        bound = FIRST_SET_POINT_FRACTION * self.following_error
        require(where, np.abs(target - commanded), bound, Check.ACCEPTED, cycle)
        standstill = self.limits.standstill
        bound = np.maximum(0.5 * np.abs(step), standstill)
        moving = np.abs(velocity[1]) > standstill
        for joints, measured in ((where, velocity[0]), (where & ~moving, velocity[1])):
            require(joints, np.abs(measured - step), bound, Check.GAP_VELOCITY, cycle)

    def check_after_pause(self, velocity: Array, cycle: int, where: Joints) -> None:
        """Check after a late packet that the velocity (n,) rad/s agrees with the sent set-points.

        The servo may lag behind by what it gains in `SERVO_LAG_SECONDS` at the allowed
        acceleration.
        """
        sent = (self._history[3] - self._history[2]) / self.period
        factor, _ = self.limits.factors(self._active.rank)
        bound = SERVO_LAG_SECONDS * factor * self.limits.acceleration
        require(where, np.abs(velocity - sent), bound, Check.PAUSE_VELOCITY, cycle)

    def check_set_point(self, q: Array, qd: Array, bounds: BoundsName, cycle: int) -> None:
        """Check the next set-point, which then counts as sent.

        Args:
            q: positions (n,) [rad].
            qd: velocities (n,) [rad/s].
            bounds: that apply from this set-point on; wider ones stay active until no difference
                reaches back to them.
            cycle: number of the cycle.

        Raises:
            GuardError: the set-point breaks a bound.
        """
        history = self._history
        history[:3] = history[1:4]
        history[3] = q
        history[4] = qd
        quantities = self._quantities
        self._differences.dot(history, quantities)
        quantities[0] -= self._middle
        allowed = self._sets[self._active.update(bounds)]
        if not all_true(np.abs(quantities) <= allowed):
            raise_first(quantities, allowed, _SET_POINT_CHECKS, cycle, self._middle)
