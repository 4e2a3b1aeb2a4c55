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

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from drivers.errors import (
    AccelerationLimit,
    CurrentLimit,
    FirstSetPoint,
    FollowingError,
    GuardError,
    JerkLimit,
    MotionHeld,
    MotionNotCarriedOn,
    NotAtStandstill,
    NotFinite,
    PositionLimit,
    VelocityLimit,
    VelocityMismatch,
)
from drivers.motion_source import BoundsName

Array = NDArray[np.float64]

RELATIVE_TOLERANCE: Final = 1e-6
FIRST_FRACTION: Final = 0.1
"""Share of the following-error threshold allowed between target and arm at the first set-point,
and between the target and the set-point sent last after a long gap."""
DEFAULT_STANDSTILL: Final = 5e-4
"""Motor revolutions per cycle below which an axis stands still.

An encoder at rest toggles between two increments, so a velocity formed over one cycle shows one
increment per cycle at worst and two with a little servo dither. Two increments of a coarse 12-bit
encoder are 4.9e-4; at 2 ms this is some 0.5 % of a drive's full speed.
"""

_RANK: Final[Mapping[BoundsName, int]] = {"plan": 0, "override": 1, "stop": 2}
_MEMORY: Final = 2
"""Cycles for which wider bounds stay: a third difference reaches over three cycles."""


@dataclass(frozen=True, eq=False)
class GuardLimits:
    """What the guard enforces; arrays (n,).

    Attributes:
        lower: rad, smallest joint position.
        upper: rad, largest.
        velocity: rad/s, magnitude, in all three sets of bounds.
        acceleration: rad/s², of the set "plan".
        jerk: rad/s³, of the set "plan".
        following_error: motor revolutions, as the controller states its thresholds.
        current: A.
        override_acceleration: factor on acceleration while an override changes.
        override_jerk: factor on jerk while an override changes.
        stop_acceleration: factor on acceleration during hold and stop.
        stop_jerk: factor on jerk during hold and stop.
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
        for name in ("lower", "upper", "velocity", "acceleration", "jerk"):
            self._check(name, n, positive=name not in ("lower", "upper"))
        self._check("following_error", n, positive=True)
        self._check("current", n, positive=True)
        if not np.all(self.lower < self.upper):
            raise ValueError(f"guard limits: lower {self.lower} is not below upper {self.upper}")
        for plan, override, stop in (
            (1.0, self.override_acceleration, self.stop_acceleration),
            (1.0, self.override_jerk, self.stop_jerk),
        ):
            if not plan <= override <= stop:
                raise ValueError(f"guard limits: factors 1 <= {override} <= {stop} do not hold")
        if not self.standstill > 0.0:
            raise ValueError(f"guard limits: standstill {self.standstill} is not positive")

    def _check(self, name: str, n: int, *, positive: bool) -> None:
        array = np.array(getattr(self, name), dtype=np.float64)
        if array.shape != (n,) or not np.all(np.isfinite(array)):
            raise ValueError(f"guard limits: {name} must be {n} finite numbers, got {array}")
        if positive and not np.all(array > 0.0):
            raise ValueError(f"guard limits: {name} must be positive, got {array}")
        object.__setattr__(self, name, array)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.lower)


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
        self._sets = {rank: self._bounds(rank) for rank in _RANK.values()}
        self._rank = 0
        self._age = 0
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
        factor_a = (1.0, limits.override_acceleration, limits.stop_acceleration)[rank]
        factor_j = (1.0, limits.override_jerk, limits.stop_jerk)[rank]
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

    def narrow(self, following_error: Array, current: Array) -> None:
        """Take the controller's own limits where they are narrower; NaN means it has none.

        Args:
            following_error: (n,) motor revolutions.
            current: (n,) A.
        """
        self._threshold = np.fmin(self.limits.following_error, following_error)
        self._feedback_bounds[0] = self._threshold
        self._feedback_bounds[1] = self._threshold
        self._feedback_bounds[2] = np.fmin(self.limits.current, current)
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
        _require_finite(target, held, cycle)
        error = np.abs(actual - target)
        _require(held, error, self._threshold * (1.0 + RELATIVE_TOLERANCE), FollowingError, cycle)

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
        every = np.ones(len(q), dtype=np.bool_)
        _require_finite(target, every, cycle)
        bound = FIRST_FRACTION * self._threshold
        _require(every, np.abs(target - actual), bound, FirstSetPoint, cycle)
        standstill = np.full(len(q), self.limits.standstill)
        for velocity in step:
            _require(every, np.abs(velocity), standstill, NotAtStandstill, cycle)
        self._rank = self._age = 0
        self._history[:4] = q
        self.check_set_point(q, np.zeros_like(q), "plan", cycle)

    def check_feedback(
        self, target: Array, actual: Array, current: Array, commanded: Array, cycle: int
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

        Raises:
            NotFinite, FollowingError, CurrentLimit: the motion must not go on.
        """
        found = self._feedback
        np.subtract(actual, commanded, out=found[0])
        np.subtract(actual, target, out=found[1])
        found[2] = current
        np.abs(found, out=found)
        if not (found <= self._feedback_bounds).all():
            _report(found, found, self._feedback_bounds, _FEEDBACK_CHECKS, cycle)

    def check_after_gap(
        self, target: Array, velocity: Array, commanded: Array, step: Array, cycle: int
    ) -> None:
        """The first packet after a long gap, before a motion goes on from the set-point sent last.

        A velocity may be off by half the step sent last, or by what counts as standstill. The
        target's is always held against that; the arm's lags behind, so only where it stands.

        Args:
            target: (n,) D1, motor revolutions.
            velocity: (2, n) D2 and D4, motor revolutions per cycle.
            commanded: (n,) D1 of the answer sent last, motor revolutions.
            step: (n,) D2 of the answer sent last, motor revolutions per cycle.
            cycle: for the error.

        Raises:
            NotFinite, MotionNotCarriedOn, MotionHeld: going on would be a jump.
        """
        every = np.ones(len(step), dtype=np.bool_)
        bound = FIRST_FRACTION * self._threshold
        _require(every, np.abs(target - commanded), bound, MotionNotCarriedOn, cycle)
        standstill = self.limits.standstill
        bound = np.maximum(0.5 * np.abs(step), standstill)
        moving = np.abs(velocity[1]) > standstill
        for where, found in ((every, velocity[0]), (~moving, velocity[1])):
            _require(where, np.abs(found - step), bound, MotionHeld, cycle)

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
        rank = _RANK[bounds]
        if rank >= self._rank:
            self._rank, self._age = rank, 0
        elif self._age < _MEMORY:
            self._age += 1
        else:
            self._rank = rank
        history = self._history
        history[:3] = history[1:4]
        history[3] = q
        history[4] = qd
        found = self._quantities
        np.matmul(self._differences, history, out=found)
        found[0] -= self._middle
        magnitude = np.abs(found)
        allowed = self._sets[self._rank]
        if not (magnitude <= allowed).all():
            _report(magnitude, found, allowed, _SET_POINT_CHECKS, cycle, self)

    def position_limits(self, joint: int, value: float) -> tuple[float, float]:
        """The position meant by `value` off the middle of the range, and the limit nearest it."""
        limit = self.limits.upper if value > 0.0 else self.limits.lower
        return float(self._middle[joint] + value), float(limit[joint])


def _require_finite(values: Array, where: NDArray[np.bool_], cycle: int) -> None:
    bad = where & ~np.isfinite(values)
    if bad.any():
        joint = int(np.argmax(bad))
        raise NotFinite(joint, float(values[joint]), np.inf, cycle)


def _require(
    where: NDArray[np.bool_], values: Array, bounds: Array, error: type[GuardError], cycle: int
) -> None:
    bad = where & ~(values <= bounds)
    if bad.any():
        joint = int(np.argmax(bad))
        kind = error if np.isfinite(values[joint]) else NotFinite
        raise kind(joint, float(values[joint]), float(bounds[joint]), cycle)


def _report(
    magnitude: Array,
    found: Array,
    allowed: Array,
    checks: tuple[type[GuardError], ...],
    cycle: int,
    guard: Guard | None = None,
) -> NoReturn:
    """Raise for the first row and joint outside its bound; NaN before everything else."""
    not_finite = ~np.isfinite(magnitude)
    bad = not_finite if not_finite.any() else ~(magnitude <= allowed)
    row, joint = (int(index) for index in np.argwhere(bad)[0])
    value, bound = float(found[row, joint]), float(allowed[row, joint])
    kind = NotFinite if not_finite.any() else checks[row]
    if kind is PositionLimit and guard is not None:
        value, bound = guard.position_limits(joint, value)
    raise kind(joint, value, bound, cycle)
