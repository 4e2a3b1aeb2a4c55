"""Settings of the moves of an `Interpolator`, and how its services refuse."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import wraps
from math import inf
from operator import index
from typing import Any, Concatenate, Final, ParamSpec, TypeVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from planner.arrays import Array, read_only
from planner.errors import InvalidSetting, PlannerError
from planner.interpolator_codes import (
    AccelerationKind,
    FlybyCriterion,
    MotionType,
    PointAccuracy,
    Status,
)
from planner.limits import JointLimits, position_rounding
from planner.motion_queue import MotionQueue
from planner.moves import Move, Overrides, checked_shares

# Tolerance on motion times [s].
_MOTION_TIME_TOLERANCE: Final = 1e-9
# COMAU's default of FLY_PER.
_DEFAULT_FLY_PERCENT: Final = 100.0

P = ParamSpec("P")
S = TypeVar("S", bound="MoveSettings")


class _TimeTooShortError(Exception):
    pass


def require(condition: bool, reason: str) -> None:
    """Refuse a service with INCONSISTENT unless a condition holds."""
    if not condition:
        raise ValueError(reason)


def service(
    method: Callable[Concatenate[S, P], Status | None],
) -> Callable[Concatenate[S, P], Status]:
    """Return a service that returns the status of the errors which the method raises."""

    @wraps(method)
    def checked(self: S, /, *args: P.args, **kwargs: P.kwargs) -> Status:
        try:
            require(self._initialized, "the interpolator is not initialized")
            return method(self, *args, **kwargs) or Status.OK
        except _TimeTooShortError as error:
            status = Status.TIME_TOO_SHORT
            self.refusal = str(error)
        except (TypeError, ValueError, OverflowError) as error:
            status = Status.INCONSISTENT
            self.refusal = str(error)
        except PlannerError as error:
            status = Status.FATAL
            self.refusal = str(error)
        return status

    return checked


class MoveSettings:
    """Settings of the next targets, set by services; `refusal` is why the last one was refused."""

    def __init__(self, limits: JointLimits) -> None:
        self.refusal = ""
        self._initialized = False
        self._limits = limits
        rounding = position_rounding(limits)
        self._inside = (limits.lower + rounding, limits.upper - rounding)
        self._reset_settings()

    def _reset_settings(self) -> None:
        """Set all settings to their defaults."""
        full = np.ones(self._limits.n_joints)
        self._move = Move(full, joint_speed=full, joint_acceleration=full, joint_jerk=full)
        self._flying = False
        self._fly_percent = _DEFAULT_FLY_PERCENT
        self._motion_time = 0.0
        self._overrides = Overrides()
        self._advance = 1

    @service
    def select_motion_type(self, motion_type: int) -> None:
        """Select the kind of path; only `MotionType.JOINT` is implemented."""
        joint = MotionType(motion_type) is MotionType.JOINT
        require(joint, f"motion type {motion_type} is not JOINT (1)")

    @service
    def set_advance_motion(self, count: int) -> None:
        """Set the number of targets beyond the next one below which NEED_MORE_DATA is returned."""
        require(index(count) >= 0, f"advance of {count} targets")
        self._advance = index(count)

    @service
    def set_joint_speeds(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> None:
        """Set the share of the velocity limit, in (0, 100] %, of all or of some joints."""
        self._set_shares("joint_speed", percent, joints)

    @service
    def set_joint_accelerations(
        self, percent: ArrayLike, joints: Sequence[int] | None = None
    ) -> None:
        """Set the share of the acceleration limit, in (0, 100] %, of all or of some joints."""
        self._set_shares("joint_acceleration", percent, joints)

    @service
    def set_joint_jerks(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> None:
        """Set the share of the jerk limit, in (0, 100] %, of all or of some joints."""
        self._set_shares("joint_jerk", percent, joints)

    @service
    def set_override_acceleration(
        self, percent: float, kind: AccelerationKind = AccelerationKind.BOTH
    ) -> None:
        """Scale the ramps of later targets (PROG_ACC_OVR, PROG_DEC_OVR), in (0, 100] %.

        The path at fly-by corners can change.
        """
        share = percent / 100.0
        overrides = self._overrides
        scaled = AccelerationKind(kind)
        if scaled is not AccelerationKind.DECELERATION:
            overrides = replace(overrides, acceleration=share)
        if scaled is not AccelerationKind.ACCELERATION:
            overrides = replace(overrides, deceleration=share)
        self._overrides = overrides

    @service
    def select_flyby_mode(self, on: bool) -> None:
        """Select whether the arm flies by later targets or stops there."""
        require(on in (0, 1), f"fly-by {on!r} is neither on nor off")
        self._flying = bool(on)

    @service
    def select_flyby_criteria(self, criterion: int) -> None:
        """Select the criterion of the size of corners; only PERCENT is implemented."""
        percent = FlybyCriterion(criterion) is FlybyCriterion.PERCENT
        require(percent, "only percentages of the deceleration are implemented")

    @service
    def set_flyby_criteria_parameter(self, criterion: int, value: float) -> Status:
        """Set the size of corners: FLY_PER in 0..100 %."""
        require(0.0 <= value <= 100.0, f"fly-by of {value} %")
        status = self.select_flyby_criteria(criterion)
        if status >= 0:
            self._fly_percent = float(value)
        return status

    def set_point_accuracy_parameter(self, criterion: int, value: float) -> Status:
        """Set the size of corners, as COMAU maps this service."""
        return self.set_flyby_criteria_parameter(criterion, value)

    def cancel_flyby_criteria(self, criterion: int) -> Status:
        """Reset the value of a criterion."""
        return self.set_flyby_criteria_parameter(criterion, _DEFAULT_FLY_PERCENT)

    @service
    def select_point_accuracy(self, accuracy: int) -> None:
        """Select the `PointAccuracy` of later targets; it does not change set-points."""
        PointAccuracy(accuracy)

    @service
    def set_motion_time(self, seconds: float) -> None:
        """Set the duration of the next move, from rest to rest [s]; 0 for the shortest."""
        require(0.0 <= seconds < inf, f"motion time of {seconds} s")
        self._motion_time = float(seconds)

    def _set_shares(self, name: str, percent: ArrayLike, joints: Sequence[int] | None) -> None:
        shares = np.array(getattr(self._move, name))
        chosen = [index(joint) for joint in (range(len(shares)) if joints is None else joints)]
        valid = all(0 <= joint < len(shares) for joint in chosen)
        require(valid, f"joints {joints!r} are not of the arm's 0 to {len(shares) - 1}")
        each = np.divide(percent, 100.0)
        shares[chosen] = checked_shares(name.replace("_", " "), each, len(chosen))
        changes: dict[str, Any] = {name: shares}
        self._move = replace(self._move, **changes)

    def _checked(self, position: ArrayLike) -> Array:
        """Return a position (n,) checked to be inside the limits."""
        point = read_only(position)
        lower = self._limits.lower
        upper = self._limits.upper
        inside = point.shape == lower.shape and np.all((point >= lower) & (point <= upper))
        require(bool(inside), f"position {position!r:.200} is not in the limits")
        return point

    def _at_ends(self, position: Array) -> int:
        """Return the bits of the joints that are at an end of their range."""
        low, high = self._inside
        ends = (position <= low) | (position >= high)
        return sum(1 << joint for joint in np.flatnonzero(ends).tolist()) if ends.any() else 0

    def _next_move(self, queue: MotionQueue, target: Array) -> Move:
        """Return the move to a target (n,) [rad] that follows a queue, with its motion time.

        Raises:
            InvalidSetting: a motion time for a target that is the point before.
        """
        fly = self._fly_percent if self._flying else 0.0
        move = replace(self._move, target=target, fly_percent=fly)
        seconds = self._motion_time
        if seconds == 0.0:
            return move

        def excess(speed: float) -> float:
            leg = queue.leg_to(replace(move, speed=speed), self._overrides)
            return float(leg.moves.durations[0]) - seconds

        least = excess(1.0)
        if least == -seconds:
            valid = "0 s where the target is the point before"
            raise InvalidSetting("motion time", seconds, valid)
        if least > _MOTION_TIME_TOLERANCE:
            raise _TimeTooShortError(f"the move takes longer than its motion time of {seconds} s")
        slow = 1.0
        while excess(slow) < 0.0:
            slow /= 2.0
        if slow < 1.0:
            slow = float(scipy.optimize.brentq(excess, slow, 1.0, xtol=1e-300, rtol=1e-15))
        return replace(move, speed=slow)
