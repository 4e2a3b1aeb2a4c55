"""What a campaign is going to do: its excitation and its validation motions, in one small file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.cell import Cell
from hil.errors import InputError
from hil.progress import Reporter
from identification.excitation import (
    CollisionChecker,
    CurrentModel,
    Excitation,
    random_search,
    random_validation_motions,
)
from planner import PiecewiseCubic

from .folder import write_atomically

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
    """
    settings = cell.campaign
    model, limits = cell.model, cell.joint_limits
    checker = CollisionChecker(cell.urdf, cell.workspace)
    currents = current_model(cell)
    with reporter.task("designing the excitation", settings.candidates) as task:
        excitation = random_search(
            model,
            limits,
            home=cell.home,
            n_via=settings.n_via,
            fly=settings.fly,
            candidates=settings.candidates,
            seed=settings.seed,
            checker=checker,
            currents=currents,
            progress=lambda note: task.advance(1, note),
        )
    validation = random_validation_motions(
        limits,
        home=cell.home,
        n_via=settings.n_via,
        fly=settings.fly,
        count=settings.validation_runs,
        seed=settings.seed + 1,
        model=model,
        checker=checker,
        currents=currents,
    )
    return CampaignPlan(excitation, tuple(validation))


def current_model(cell: Cell) -> CurrentModel:
    """Predicts motor currents of a motion from the nominal model."""
    drives = cell.drive_train
    return CurrentModel(
        model=cell.model,
        values=cell.nominal_values(),
        motor_from_joint=drives.motor_from_joint,
        torque_constant=drives.torque_constant,
        current_limit=drives.current_limit,
        uncertainty=cell.nominal.uncertainty,
    )
