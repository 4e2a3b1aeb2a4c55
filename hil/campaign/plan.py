"""What a campaign is going to do: its excitation and its validation motions, in one small file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from hil.cell import Cell
from hil.errors import InputError
from hil.files import write_atomically
from hil.progress import Reporter
from identification.excitation import (
    CollisionChecker,
    CurrentModel,
    DrawnMotion,
    Excitation,
    check_motion,
    random_search,
    random_validation_motions,
)
from planner import JointLimits, NotSmooth, PiecewiseCubic, PlanFile
from planner.verify import check_smooth

FORMAT_VERSION = 2
"""1 kept no moves: of validation motions the trajectories only, and no limits."""


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A motion, and the moves that it was planned from.

    Attributes:
        trajectory: the motion.
        moves: start, moves and limits, without the motion; None where they were not kept.
    """

    trajectory: PiecewiseCubic
    moves: PlanFile | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; `from_dict` restores every bit, through JSON too."""
        return {"trajectory": self.trajectory.to_dict(), **moves_to_dict(self.moves)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Restore what `to_dict` returned.

        Raises:
            KeyError, TypeError, ValueError: the data are no planned motion.
        """
        return cls(PiecewiseCubic.from_dict(data["trajectory"]), moves_from_dict(data))


def moves_to_dict(moves: PlanFile | None) -> dict[str, Any]:
    """Return the entry `moves` of plain data, a plan file without its motion; none without moves.

    The motion stands beside it, so that it is not kept twice.
    """
    return {} if moves is None else {"moves": replace(moves, trajectory=None).to_dict()}


def moves_from_dict(data: Mapping[str, Any]) -> PlanFile | None:
    """Return the entry `moves` of plain data, None if there is none."""
    return PlanFile.from_dict(data["moves"]) if "moves" in data else None


@dataclass(frozen=True, eq=False)
class CampaignPlan:
    """The excitation, and the motions that are kept for validation and never fitted.

    Attributes:
        excitation: the motion to fit, and how it was found.
        validation: the motions to predict.
        moves: those of the excitation, with the limits that it was planned for; None where they
            were not kept.
    """

    excitation: Excitation
    validation: tuple[PlannedMotion, ...]
    moves: PlanFile | None = None

    def save(self, path: Path) -> None:
        """Write the plan as JSON."""
        content = {
            "format_version": FORMAT_VERSION,
            "excitation": self.excitation.to_dict(),
            **moves_to_dict(self.moves),
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
            version = content["format_version"]
            if version not in (1, FORMAT_VERSION):
                raise ValueError(f"format version {version}")
            motions = content["validation"]
            return cls(
                Excitation.from_dict(content["excitation"]),
                tuple(
                    PlannedMotion(PiecewiseCubic.from_dict(motion))
                    if version == 1
                    else PlannedMotion.from_dict(motion)
                    for motion in motions
                ),
                moves_from_dict(content),
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
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

    def moves_of(motion: Excitation | DrawnMotion) -> PlanFile:
        return PlanFile(
            cell.joint_names, motion.via_points[0], motion.moves, limits=cell.joint_limits
        )

    return CampaignPlan(
        excitation,
        tuple(PlannedMotion(drawn.trajectory, moves_of(drawn)) for drawn in validation),
        moves_of(excitation),
    )


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
