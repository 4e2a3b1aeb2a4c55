"""Checks of every motion of a cell before it is sent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from drivers.init_check import float32_text, is_narrower
from hil.base.arrays import Array
from hil.cell import AngleFrame, Cell, CellError
from identification.excitation import (
    CollisionChecker,
    CollisionModelError,
    CurrentModel,
    MissingMeshError,
    Violation,
    check_motion,
    messages,
)
from identification.excitation.violation import CloseBodies, JointQuantity, LoadedDrive
from planner import FourierSeries, JointLimits, NotSmooth, PiecewiseCubic
from planner.piecewise_cubic import check_rest, check_smooth

_UNITS: Final = {
    "position": " deg",
    "velocity": " deg/s",
    "acceleration": " deg/s²",
    "jerk": " deg/s³",
}
_MIN_DISTANCE_CHANGE: Final = 0.01
"""Change of a distance below which no motion changes it, m."""


def violation_text(violation: Violation, frame: AngleFrame) -> str:
    """Return a violation in degrees, in the frame of the cell's limits."""
    joints = frame.text_of_angles(violation.posture) if violation.posture else ""
    subject = violation.subject
    if not isinstance(subject, JointQuantity):
        return messages.violation_text(violation, joints)
    joint = subject.joint
    # The magnitude of a rate is the same in any frame.
    is_position = subject.quantity == "position"
    sign, zero = (frame.sign[joint], frame.offset[joint]) if is_position else (1.0, 0.0)
    value, bound = (
        float(np.degrees(sign * number + zero)) for number in (violation.value, violation.bound)
    )
    shown = replace(violation, value=value, bound=bound)
    where = f" at the {subject.end}" if subject.end else ""
    name = f"{subject.quantity} of J{joint + 1}{where}"
    return messages.violation_text(shown, joints, _UNITS[subject.quantity], name)


def always_so(violation: Violation, checker: CollisionChecker) -> str | None:
    """Return the remedy for a pair that is too close in any posture; None for other violations."""
    pair = violation.subject
    if not isinstance(pair, CloseBodies) or (pair.first, pair.second) not in checker.pairs:
        return None
    nearest, farthest = checker.spread(pair.first, pair.second)
    if farthest - nearest > _MIN_DISTANCE_CHANGE:
        return None
    message = (
        f"{pair.first} and {pair.second} are {nearest:.3f} to {farthest:.3f} m apart in any posture"
    )
    if nearest >= violation.bound:
        return f"{message}, too close to contact to be resolved; narrow [workspace] margin"
    if nearest > 0.0:
        return f"{message}; [workspace] margin must be below that"
    return f"{message}: they overlap; correct their collision shapes in the URDF"


MAX_MOTION_SECONDS: Final = 600.0
"""Longest motion, s: checks take time and memory in proportion, and a failed motion is repeated."""
MAX_SINES: Final = 20
"""Most sines per joint, as in a design."""
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

    def refusal(self, trajectory: PiecewiseCubic | FourierSeries) -> str | None:
        """Return why a motion must not be sent, or None."""
        if trajectory.n_joints != self.limits.n_joints:
            return f"it is for {trajectory.n_joints} joints, the arm has {self.limits.n_joints}"
        unsupported = _unsupported(trajectory)
        if unsupported is not None:
            return unsupported
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
            return self._refusal(trajectory)

    def _refusal(self, trajectory: PiecewiseCubic | FourierSeries) -> str | None:
        try:
            if isinstance(trajectory, FourierSeries):
                check_rest(trajectory, self.limits)
            else:
                check_smooth(trajectory, self.limits)
        except NotSmooth as error:
            return str(error)
        # First the quick checks.
        violations = check_motion(trajectory, self.limits) or check_motion(
            trajectory, self.limits, checker=self.checker, currents=self.currents
        )
        return self._sentence(violations[0]) if violations else None

    def _sentence(self, violation: Violation) -> str:
        text = violation_text(violation, self.frame)
        remedy = always_so(violation, self.checker)
        if isinstance(violation.subject, LoadedDrive) and violation.subject.is_motor:
            text += self._whose_limit(violation.subject.joint)
        return text if remedy is None else f"{text}; {remedy}"

    def _whose_limit(self, joint: int) -> str:
        """Return the remedy for the motor of a joint if its limit is the controller's."""
        if self.cell_limit is None:
            return ""
        ours = self.cell_limit[joint]
        theirs = self.currents.current_limit[joint]
        if theirs == ours:
            return ""
        return (
            f"; the controller has {float32_text(theirs)} A as the limit of that motor, the "
            f"cell file {ours:.9g} A: write the controller's into [drive_train] current_limit"
        )


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


def _unsupported(trajectory: PiecewiseCubic | FourierSeries) -> str | None:
    """Return why a motion cannot be checked, or None."""
    if not trajectory.duration <= MAX_MOTION_SECONDS:
        return f"it lasts {trajectory.duration:.6g} s; at most {MAX_MOTION_SECONDS:g} s are allowed"
    if not isinstance(trajectory, FourierSeries):
        return None
    if trajectory.ramp == 0.0:
        return "its sines begin and end at full speed; give them a ramp"
    sines = trajectory.amplitude.shape[1]
    if sines > MAX_SINES:
        return f"it has {sines} sines for each joint; at most {MAX_SINES} are allowed"
    for quantity, order in (("velocity", 1), ("acceleration", 2), ("jerk", 3)):
        endless = np.flatnonzero(~np.isfinite(trajectory.derivative_bound(order)))
        if len(endless):
            return f"the {quantity} of joint {int(endless[0])} is not finite"
    return None
