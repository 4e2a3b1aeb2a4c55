"""What a campaign is going to do: its excitation and its validation motions, in one small file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.cell import Cell
from hil.errors import InputError
from hil.files import write_atomically
from hil.progress import Reporter
from identification.excitation import (
    CollisionChecker,
    CurrentModel,
    Excitation,
    check_motion,
    random_search,
    random_validation_motions,
)
from planner import JointLimits, NotSmooth, PiecewiseCubic
from planner.verify import check_smooth

FORMAT_VERSION = 1


@dataclass(frozen=True, eq=False)
class CampaignPlan:
    """The excitation, and the motions that are kept for validation and never fitted."""

    excitation: Excitation
    validation: tuple[PiecewiseCubic, ...]

    def save(self, path: Path) -> None:
        """Write the plan as JSON."""
        content = {
            "format_version": FORMAT_VERSION,
            "excitation": self.excitation.to_dict(),
            "validation": [motion.to_dict() for motion in self.validation],
        }
        write_atomically(path, json.dumps(content) + "\n")

    @classmethod
    def load(cls, path: Path) -> CampaignPlan:
        """Read a plan.

        Raises:
            InputError: the file is not a plan.
        """
        try:
            content: dict[str, Any] = json.loads(path.read_text("utf-8"))
            if content["format_version"] != FORMAT_VERSION:
                raise ValueError(f"format version {content['format_version']}")
            return cls(
                Excitation.from_dict(content["excitation"]),
                tuple(PiecewiseCubic.from_dict(motion) for motion in content["validation"]),
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                path, f"is not a campaign plan ({error})", remedy="design the excitation again"
            ) from error


def design(cell: Cell, reporter: Reporter) -> CampaignPlan:
    """Search an excitation and draw the validation motions, all checked against the cell.

    Until a real search exists the excitation is the best of `candidates` random via-point sets
    by the paper's eq. 7.

    Raises:
        NoFeasibleMotion: says which constraint forbids every motion.
    """
    settings = cell.campaign
    checks = MotionChecks.of(cell)
    with reporter.task("designing the excitation (candidates)", settings.candidates) as task:
        excitation = random_search(
            cell.model,
            cell.joint_limits,
            home=cell.home,
            seed=settings.seed,
            n_via=settings.n_via,
            fly=settings.fly,
            candidates=settings.candidates,
            checker=checks.checker,
            currents=checks.currents,
            progress=lambda note: task.advance(1, note),
        )
    validation = random_validation_motions(
        cell.joint_limits,
        home=cell.home,
        seed=settings.seed,
        count=settings.validation_runs,
        n_via=settings.n_via,
        fly=settings.fly,
        checker=checks.checker,
        currents=checks.currents,
    )
    return CampaignPlan(excitation, validation)


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
    def of(cls, cell: Cell) -> MotionChecks:
        """The checks of a cell."""
        drives = cell.drive_train
        return cls(
            limits=cell.joint_limits,
            checker=CollisionChecker(cell.urdf, cell.workspace),
            currents=CurrentModel(
                model=cell.model,
                values=cell.nominal_values(),
                motor_from_joint=drives.motor_from_joint,
                torque_constant=drives.torque_constant,
                current_limit=drives.current_limit,
                uncertainty=cell.nominal.uncertainty,
            ),
        )

    def refusal(self, trajectory: PiecewiseCubic) -> str | None:
        """Why a motion must not be sent, or None if it may be."""
        if trajectory.n_joints != self.limits.n_joints:
            return f"it is for {trajectory.n_joints} joints, the arm has {self.limits.n_joints}"
        try:
            check_smooth(trajectory, self.limits)
        except NotSmooth as error:
            return str(error)
        result = check_motion(trajectory, self.limits, checker=self.checker, currents=self.currents)
        return None if result.ok else str(result.violations[0])
