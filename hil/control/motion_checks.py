"""Checks of every motion of a cell before it is sent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self, get_args

import numpy as np

from drivers.init_check import is_narrower
from hil.base.arrays import Array
from hil.cell import AngleFrame, Cell, CellError
from identification.excitation import (
    CollisionChecker,
    CollisionModelError,
    CurrentModel,
    MissingMeshError,
    Violation,
    check_motion,
)
from identification.excitation.violation import CloseBodies, LoadedDrive
from planner import FourierSeries, JointLimits, NotSmooth, PiecewiseCubic
from planner.piecewise_cubic import check_rest, check_smooth

from .motion_refusals import (
    MAX_MOTION_SECONDS,
    MAX_SINES,
    BrokenConstraint,
    FixedDistance,
    MotionRefusal,
    NarrowerLimit,
    NoRamp,
    NotFinite,
    OtherJointCount,
    Rate,
    TooLong,
    TooManySines,
)

_MIN_DISTANCE_CHANGE: Final = 0.01
"""Change of a distance below which no motion changes it, m."""


def fixed_distance(violation: Violation, checker: CollisionChecker) -> FixedDistance | None:
    """Return the pair of a violation that is too close in any posture; None for others."""
    pair = violation.subject
    if not isinstance(pair, CloseBodies) or (pair.first, pair.second) not in checker.pairs:
        return None
    nearest, farthest = checker.spread(pair.first, pair.second)
    if farthest - nearest > _MIN_DISTANCE_CHANGE:
        return None
    return FixedDistance(pair.first, pair.second, nearest, farthest, violation.bound)


USABLE_CURRENT_SHARE: Final = 0.8
"""Share of a motor's current limit in planning and rehearsal. The rest is for noise and the control
error of the servo. Before a motion is sent, the full limit counts."""


@dataclass(frozen=True, eq=False)
class MotionChecks:
    """Checks of every motion of a cell before it is sent: limits, contacts, currents, torques.

    `frame` is of the angles in messages; `cell_limit` (n,) [A] are the cell's limits if the
    controller has narrower ones, else None.
    """

    limits: JointLimits
    checker: CollisionChecker
    currents: CurrentModel
    frame: AngleFrame
    cell_limit: Array | None = None

    @classmethod
    def of(cls, cell: Cell) -> Self:
        """Return the checks of a cell."""
        return cls(
            limits=cell.joint_limits,
            checker=collision_checker(cell),
            currents=current_model(cell),
            frame=AngleFrame.of(cell),
        )

    def within(self, controller_limits: Array) -> Self:
        """Return the checks with the narrower of these and a controller's current limits (n,) A."""
        below = is_narrower(controller_limits, self.currents.current_limit)
        if not below.any():
            return self
        ours = self.currents.current_limit
        currents = replace(self.currents, current_limit=np.where(below, controller_limits, ours))
        return replace(self, currents=currents, cell_limit=ours)

    def refusal(self, trajectory: PiecewiseCubic | FourierSeries) -> MotionRefusal | None:
        """Return why a motion must not be sent, or None."""
        if trajectory.n_joints != self.limits.n_joints:
            return OtherJointCount(trajectory.n_joints, self.limits.n_joints)
        unsupported = _unsupported(trajectory)
        if unsupported is not None:
            return unsupported
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
            return self._refusal(trajectory)

    def _refusal(self, trajectory: PiecewiseCubic | FourierSeries) -> MotionRefusal | None:
        try:
            if isinstance(trajectory, FourierSeries):
                check_rest(trajectory, self.limits)
            else:
                check_smooth(trajectory, self.limits)
        except NotSmooth as error:
            return error
        # First the quick checks.
        violations = check_motion(trajectory, self.limits) or check_motion(
            trajectory, self.limits, checker=self.checker, currents=self.currents
        )
        if not violations:
            return None
        violation = violations[0]
        subject = violation.subject
        narrower = None
        if isinstance(subject, LoadedDrive) and subject.is_motor:
            narrower = self._narrower(subject.joint)
        return BrokenConstraint(violation, fixed_distance(violation, self.checker), narrower)

    def _narrower(self, joint: int) -> NarrowerLimit | None:
        """Return the limits of the motor of a joint if the controller's counts."""
        if self.cell_limit is None:
            return None
        ours = float(self.cell_limit[joint])
        theirs = float(self.currents.current_limit[joint])
        return None if theirs == ours else NarrowerLimit(theirs, ours)


def collision_checker(cell: Cell) -> CollisionChecker:
    """Return the check of contacts with floor, walls and the arm; CellError without shapes."""
    folders = cell.mesh_folders
    urdf = cell.file.cell.urdf
    try:
        return CollisionChecker(
            cell.urdf, cell.workspace, limits=cell.joint_limits, mesh_folders=folders
        )
    except MissingMeshError as error:
        raise CellError(
            cell.path,
            "cell.mesh_folders",
            cell.file.cell.mesh_folders,
            f"the mesh {error.mesh} of {urdf} is in none of them",
            "add the folder in which its package:// path begins (or to ROS_PACKAGE_PATH); write "
            "other paths in the URDF as package://; only a design works without meshes, with "
            "collision = false in its [constraints]",
        ) from error
    except CollisionModelError as error:
        raise CellError(
            cell.path,
            "cell.urdf",
            urdf,
            str(error),
            "add <collision> shapes (boxes, cylinders or spheres); only a design works without "
            "them, with collision = false in its [constraints]",
        ) from error


def current_model(cell: Cell) -> CurrentModel:
    """Return motor currents and joint torques by the nominal model of a cell, with limits.

    Without a drive train only torques have limits, from `[limits] torque`.
    """
    n = cell.model.n_joints
    currents = CurrentModel(
        model=cell.model,
        values=cell.nominal_values(),
        motor_from_joint=np.eye(n),
        torque_constant=np.ones(n),
        current_limit=np.full(n, np.inf),
        uncertainty=cell.nominal.uncertainty,
        torque_limit=cell.torque_limit,
    )
    if cell.file.drive_train is None:
        return currents
    drives = cell.drive_train
    return replace(
        currents,
        motor_from_joint=drives.motor_from_joint,
        torque_constant=drives.torque_constant,
        current_limit=drives.current_limit,
    )


def planned(currents: CurrentModel) -> CurrentModel:
    """Return the currents with the share of their limits for planning."""
    return replace(currents, usable=USABLE_CURRENT_SHARE)


def _unsupported(trajectory: PiecewiseCubic | FourierSeries) -> MotionRefusal | None:
    """Return why a motion cannot be checked, or None."""
    if not trajectory.duration <= MAX_MOTION_SECONDS:
        return TooLong(trajectory.duration)
    if not isinstance(trajectory, FourierSeries):
        return None
    if trajectory.ramp == 0.0:
        return NoRamp()
    sines = trajectory.amplitude.shape[1]
    if sines > MAX_SINES:
        return TooManySines(sines)
    for order, quantity in enumerate(get_args(Rate), 1):
        endless = np.flatnonzero(~np.isfinite(trajectory.derivative_bound(order)))
        if len(endless):
            return NotFinite(quantity, int(endless[0]))
    return None
