"""The services that say how the arm goes to the targets set from then on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from planner.arguments import member, real, reals, whole
from planner.arrays import Array, read_only
from planner.commands import (
    STOP,
    Fly,
    FlyDistance,
    FlyPercent,
    Move,
    Overrides,
    Termination,
)
from planner.limits import JointLimits
from planner.rrs import AccelerationKind, FlybyCriterion, MotionType, PointAccuracy, Status

# The joint kinds differ from the others only for Cartesian motion.
_TERMINATIONS: dict[PointAccuracy, Termination] = {
    PointAccuracy.FINE: "fine",
    PointAccuracy.COARSE: "coarse",
    PointAccuracy.NOSETTLE: "nosettle",
    PointAccuracy.JNT_FINE: "fine",
    PointAccuracy.JNT_COARSE: "coarse",
}
# No joint space is wider than this [rad].
_WIDEST = 1e9
# COMAU's default is 100 %; its distance of 5 mm says nothing of joints, so here it is 5 mrad.
_FLYBY = {FlybyCriterion.PERCENT: 100.0, FlybyCriterion.DISTANCE: 5e-3}


@dataclass(frozen=True, eq=False)
class MoveSettings:
    """What holds for every target until it is set again; shares in (0, 1].

    Attributes:
        speed: Share of each joint's velocity limit (n,).
        acceleration: Share of each joint's acceleration limit (n,).
        jerk: Share of each joint's jerk limit (n,).
        flying: Whether via points are flown by.
        criterion: What rules the size of a corner.
        flyby: Its value by each criterion: a percentage, a distance [rad].
        accuracy: Termination kind.
        overrides: Of the program, own quantity only.
        motion_time: What the next move has to take [s]; 0 for as short as possible.
        advance: How many targets should be known beyond the one that the arm moves to.
    """

    speed: Array
    acceleration: Array
    jerk: Array
    flying: bool = False
    criterion: FlybyCriterion = FlybyCriterion.PERCENT
    flyby: dict[FlybyCriterion, float] = field(default_factory=lambda: dict(_FLYBY))
    accuracy: PointAccuracy = PointAccuracy.NOSETTLE
    overrides: Overrides = field(default_factory=Overrides)
    motion_time: float = 0.0
    advance: int = 1

    @classmethod
    def default(cls, n_joints: int) -> MoveSettings:
        """Return what holds after initialisation: full rates, no fly-by."""
        full = read_only(np.ones(n_joints))
        return cls(full, full, full)

    def move_to(self, target: Array) -> Move:
        """Return a move to a target (n,) [rad] as set; `motion_time` is not in it."""
        return Move(
            target,
            joint_speed=self.speed,
            joint_acceleration=self.acceleration,
            fly=self._fly(),
            termination=_TERMINATIONS[self.accuracy],
            joint_jerk=self.jerk,
        )

    def _fly(self) -> Fly:
        value = self.flyby[self.criterion]
        if not self.flying or value == 0.0:
            return STOP
        return FlyPercent(value) if self.criterion is FlybyCriterion.PERCENT else FlyDistance(value)


class MoveServices:
    """RRS-1 services that describe moves. Each returns a `Status`; a refusal changes nothing.

    Attributes:
        refusal: Why the last refused service was refused, in words.
    """

    def __init__(self, limits: JointLimits) -> None:
        self._limits = limits
        self._settings = MoveSettings.default(limits.n_joints)
        self._initialized = False
        self.refusal = ""

    def select_motion_type(self, motion_type: int) -> Status:
        """Select how the arm gets to targets: `MotionType.JOINT`, nothing else is offered."""
        if member(MotionType, motion_type) is not MotionType.JOINT:
            return self._refuse(Status.INCONSISTENT, f"motion type {motion_type} is not JOINT (1)")
        return self._set()

    def set_advance_motion(self, count: int) -> Status:
        """Set how many targets beyond the present one are asked for (NEED_MORE_DATA), from 0."""
        targets = whole(count)
        if targets is None or targets < 0:
            return self._refuse(Status.INCONSISTENT, f"advance of {count} targets")
        return self._set(advance=targets)

    def set_joint_speeds(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> Status:
        """Set the share of the velocity limit, in (0, 100] %, of all or of some joints."""
        return self._set_shares("speed", percent, joints)

    def set_joint_accelerations(
        self, percent: ArrayLike, joints: Sequence[int] | None = None
    ) -> Status:
        """Set the share of the acceleration limit, in (0, 100] %, of all or of some joints."""
        return self._set_shares("acceleration", percent, joints)

    def set_joint_jerks(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> Status:
        """Set the share of the jerk limit, in (0, 100] %, of all or of some joints."""
        return self._set_shares("jerk", percent, joints)

    def set_override_acceleration(
        self, percent: float, kind: AccelerationKind = AccelerationKind.BOTH
    ) -> Status:
        """Scale the ramps of targets set from now on (PROG_ACC_OVR, PROG_DEC_OVR), (0, 100] %.

        Nothing but the ramps is scaled, so the path at fly-by corners can change.
        """
        share, overrides = real(percent) / 100.0, self._settings.overrides
        scaled = member(AccelerationKind, kind)
        if not 0.0 < share <= 1.0 or scaled is None:
            reason = f"acceleration override of {percent} %, kind {kind}"
            return self._refuse(Status.INCONSISTENT, reason)
        if scaled is not AccelerationKind.DECELERATION:
            overrides = replace(overrides, acceleration=share)
        if scaled is not AccelerationKind.ACCELERATION:
            overrides = replace(overrides, deceleration=share)
        return self._set(overrides=overrides)

    def select_flyby_mode(self, on: bool) -> Status:
        """Select whether the arm flies by the targets set from now on or stops there."""
        if not isinstance(on, bool | np.bool_) and whole(on) not in (0, 1):
            return self._refuse(Status.INCONSISTENT, f"fly-by {on!r} is neither on nor off")
        return self._set(flying=bool(on))

    def select_flyby_criteria(self, criterion: int) -> Status:
        """Select what rules the size of a corner, a `FlybyCriterion`."""
        selected = member(FlybyCriterion, criterion)
        if selected is None:
            return self._refuse(Status.INCONSISTENT, f"there is no fly-by criterion {criterion}")
        return self._set(criterion=selected)

    def set_flyby_criteria_parameter(self, criterion: int, value: float) -> Status:
        """Set the size of a corner: FLY_PER in 0..100 %, or the distance from the via point.

        The distance is the Euclidean one in joint space [rad], and is not exceeded.
        """
        most = {FlybyCriterion.PERCENT: 100.0, FlybyCriterion.DISTANCE: _WIDEST}
        named, size = member(FlybyCriterion, criterion), real(value)
        if named is None or not 0.0 <= size <= most[named]:
            return self._refuse(Status.INCONSISTENT, f"fly-by criterion {criterion} of {value}")
        return self._set(flyby={**self._settings.flyby, named: size})

    def cancel_flyby_criteria(self, criterion: int) -> Status:
        """Forget the value of a criterion; if it is selected, the percentage is from now on."""
        cancelled = member(FlybyCriterion, criterion)
        if cancelled is None:
            return self._refuse(Status.INCONSISTENT, f"there is no fly-by criterion {criterion}")
        previous = self._settings.criterion
        return self._set(
            flyby={**self._settings.flyby, cancelled: _FLYBY[cancelled]},
            criterion=FlybyCriterion.PERCENT if previous is cancelled else previous,
        )

    def select_point_accuracy(self, accuracy: int) -> Status:
        """Select the termination kind of the targets set from now on, a `PointAccuracy`.

        Set-points are exact whatever it is; it says what a servo has to do behind them.
        """
        selected = member(PointAccuracy, accuracy)
        if selected is None:
            return self._refuse(Status.INCONSISTENT, f"there is no point accuracy {accuracy}")
        return self._set(accuracy=selected)

    def set_point_accuracy_parameter(self, criterion: int, value: float) -> Status:
        """Set the size of a corner and select its criterion in one, as COMAU maps this service."""
        status = self.set_flyby_criteria_parameter(criterion, value)
        return status if status < 0 else self.select_flyby_criteria(criterion)

    def set_motion_time(self, seconds: float) -> Status:
        """Set what the move to the next target takes from rest to rest [s]; 0 takes that back.

        Its speed is lowered accordingly; `set_next_target` answers TIME_TOO_SHORT where the time
        is too short. Flying by either end of the move shortens it.
        """
        if not 0.0 <= real(seconds) < np.inf:
            return self._refuse(Status.INCONSISTENT, f"motion time of {seconds} s")
        return self._set(motion_time=real(seconds))

    def _set_shares(self, name: str, percent: ArrayLike, joints: Sequence[int] | None) -> Status:
        shares = np.array(getattr(self._settings, name))
        try:
            named = range(len(shares)) if joints is None else list(joints)
            chosen = [joint for joint in map(whole, named) if joint is not None]
            if len(chosen) < len(named) or not all(0 <= joint < len(shares) for joint in chosen):
                raise ValueError(f"joints {joints!r} are not of the arm's 0 to {len(shares) - 1}")
            each = reals(percent)
            if each.shape not in ((), (len(chosen),)):
                raise ValueError(f"{each.shape} values for {len(chosen)} joints")
            shares[chosen] = each / 100.0
        except (TypeError, ValueError) as error:
            return self._refuse(Status.INCONSISTENT, f"joint {name}: {error}")
        if not np.all((shares > 0.0) & (shares <= 1.0)):
            return self._refuse(Status.INCONSISTENT, f"joint {name} of {percent!r} %")
        return self._set(**{name: read_only(shares)})

    def _set(self, **changes: object) -> Status:
        if not self._initialized:
            return self._refuse(Status.INCONSISTENT, "the interpolator is not initialized")
        self._settings = replace(self._settings, **changes)  # type: ignore[arg-type]
        return Status.OK

    def _refuse(self, status: Status, reason: str) -> Status:
        self.refusal = reason
        return status
