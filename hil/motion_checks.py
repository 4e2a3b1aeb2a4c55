"""What every motion of a cell is checked against before it is sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from hil.cell import Cell
from identification.excitation import CollisionChecker, CurrentModel, check_motion
from planner import FourierSeries, JointLimits, NotSmooth, PiecewiseCubic
from planner.verify import check_rest, check_smooth


@dataclass(frozen=True, eq=False)
class MotionChecks:
    """What every motion of a cell is checked against before it is sent.

    Attributes:
        limits: joint limits.
        checker: floor, walls and the arm itself.
        currents: motor currents by the nominal model, with its uncertainty.
    """

    limits: JointLimits
    checker: CollisionChecker
    currents: CurrentModel

    @classmethod
    def of(cls, cell: Cell) -> Self:
        """The checks of a cell."""
        return cls(
            limits=cell.joint_limits,
            checker=CollisionChecker(cell.urdf, cell.workspace),
            currents=current_model(cell),
        )

    def refusal(self, trajectory: PiecewiseCubic | FourierSeries) -> str | None:
        """Why a motion must not be sent, or None if it may be."""
        if trajectory.n_joints != self.limits.n_joints:
            return f"it is for {trajectory.n_joints} joints, the arm has {self.limits.n_joints}"
        if isinstance(trajectory, FourierSeries) and trajectory.ramp == 0.0:
            return "its sines begin and end at full speed; give them a ramp"
        try:
            if isinstance(trajectory, FourierSeries):
                check_rest(trajectory, self.limits)
            else:
                check_smooth(trajectory, self.limits)
        except NotSmooth as error:
            return str(error)
        result = check_motion(trajectory, self.limits, checker=self.checker, currents=self.currents)
        return None if result.ok else str(result.violations[0])


def current_model(cell: Cell) -> CurrentModel:
    """Motor currents of a cell's arm by its nominal model."""
    drives = cell.drive_train
    return CurrentModel(
        model=cell.model,
        values=cell.nominal_values(),
        motor_from_joint=drives.motor_from_joint,
        torque_constant=drives.torque_constant,
        current_limit=drives.current_limit,
        uncertainty=cell.nominal.uncertainty,
    )
