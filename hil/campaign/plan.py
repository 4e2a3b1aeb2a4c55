"""Plan of a campaign: its excitation and its validation motions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isqrt
from pathlib import Path
from typing import Any, Final, Self

from hil.base.errors import InputError
from hil.base.files import write_atomically
from hil.base.progress import Reporter
from hil.base.safe_input import parse_json, read_text
from hil.cell import Cell
from hil.control.errors import MotionRefusedError
from hil.control.messages import refusal_words
from hil.control.motion_checks import MotionChecks, planned
from hil.control.motions import moves_from_dict, moves_to_dict
from hil.design import DesignSettings, preset, run_search
from hil.design.messages import NoExcitationError, infeasible_text
from identification.excitation import (
    RESCORE_PERIOD,
    Excitation,
    NoFeasibleMotionError,
    Objective,
    ViaPointMotion,
    random_validation_motions,
)
from identification.excitation.excitation import trajectory_from_dict
from planner import FourierSeries, PiecewiseCubic, PlanFile

MIN_POPULATION: Final = 4  # Least population of a genetic search
# Smallest share of a joint's speed in the search: slow motions excite little
MIN_SPEED_SHARE: Final = 0.5
MAX_EXCITATION_SECONDS: Final = 60.0  # Longest excitation, s
FORMAT_VERSION: Final = 4


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A motion, and the start, moves and limits that it was planned from, if they were stored."""

    trajectory: PiecewiseCubic | FourierSeries
    moves: PlanFile | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return data; `from_dict` restores every bit, also through JSON."""
        return {"trajectory": self.trajectory.to_dict(), **moves_to_dict(self.moves)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Restore what `to_dict` returned (KeyError, TypeError, ValueError for other data)."""
        return cls(trajectory_from_dict(data["trajectory"]), moves_from_dict(data))


@dataclass(frozen=True, eq=False)
class CampaignPlan:
    """The excitation, and motions that are predicted and never fitted.

    `moves` are of the excitation, with its limits; None for Fourier series, and if not stored.
    """

    excitation: Excitation
    validation: tuple[PlannedMotion, ...]
    moves: PlanFile | None = None

    def save(self, path: Path) -> None:
        """Write the plan as JSON."""
        write_atomically(path, self.to_text())

    def to_text(self) -> str:
        """Return the plan as JSON."""
        content = {
            "format_version": FORMAT_VERSION,
            "excitation": self.excitation.to_dict(),
            **moves_to_dict(self.moves),
            "validation": [motion.to_dict() for motion in self.validation],
        }
        return json.dumps(content) + "\n"

    def is_of(self, text: str) -> bool:
        """Return whether a text is this plan, in any layout."""
        plan_text = self.to_text()
        try:
            return text == plan_text or CampaignPlan.from_text(text).to_text() == plan_text
        except (ValueError, KeyError, TypeError, AttributeError):
            return False

    @classmethod
    def load(cls, path: Path) -> CampaignPlan:
        """Read a plan (InputError if the file is not one)."""
        try:
            return cls.from_text(read_text(path))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                path, f"is not a campaign plan ({error})", remedy="design the excitation again"
            ) from error

    @classmethod
    def from_text(cls, text: str) -> CampaignPlan:
        """Return the plan from its JSON (ValueError, KeyError, TypeError, AttributeError)."""
        content: dict[str, Any] = parse_json(text)
        if (version := content["format_version"]) != FORMAT_VERSION:
            raise ValueError(f"format version {version}")
        return cls(
            Excitation.from_dict(content["excitation"]),
            tuple(PlannedMotion.from_dict(motion) for motion in content["validation"]),
            moves_from_dict(content),
        )


def design(cell: Cell, reporter: Reporter) -> CampaignPlan:
    """Search an excitation quickly, and add random validation motions.

    The paper's method B with `[campaign].candidates` motions; `hil design` searches longer.

    Raises:
        NoExcitationError: a constraint forbids every motion; names it with the position and amount.
    """
    excitation = run_search(cell, quick_settings(cell), reporter).excitation
    return plan_around(cell, excitation)


def quick_settings(cell: Cell) -> DesignSettings:
    """Return settings of the quick search with seed, via points and size of `[campaign]`.

    It evaluates at most `candidates` motions, at least 4, in a population of about their root.
    """
    campaign = cell.campaign
    motions = max(MIN_POPULATION, campaign.candidates)
    population = max(MIN_POPULATION, isqrt(4 * motions // 3))
    settings = preset("b").replaced(
        seed=campaign.seed,
        search={"population": population, "generations": motions // population},
        via_points={"n_via": campaign.n_via, "fly": campaign.fly, "slowest": MIN_SPEED_SHARE},
        constraints={
            "closed": True,
            "collision": True,
            "current": True,
            "max_duration": MAX_EXCITATION_SECONDS,
        },
    )
    return within_ranges(settings, cell)


def within_ranges(settings: DesignSettings, cell: Cell) -> DesignSettings:
    """Return settings with via points in the part of the ranges that `[campaign]` names."""
    if settings.via_points is None or cell.campaign.range_share == 1.0:
        return settings
    return settings.replaced(via_points={"range_share": cell.campaign.range_share})


def plan_around(
    cell: Cell, excitation: Excitation, checks: MotionChecks | None = None
) -> CampaignPlan:
    """Return a plan with this excitation and random validation motions as in `[campaign]`.

    Raises:
        MotionRefusedError: the excitation must not be sent to this cell's arm.
        NoExcitationError: no validation motion satisfies the constraints.
    """
    checks = checks or MotionChecks.of(cell)
    if (refusal := checks.refusal(excitation.trajectory)) is not None:
        problem = refusal_words(refusal, checks.frame)
        raise MotionRefusedError("the excitation", problem, "design another motion")
    # A design may be judged by some parameters only; the plan has the criteria over all of them.
    criteria = Objective(cell.model).criteria(excitation.trajectory, RESCORE_PERIOD)
    excitation = replace(excitation, criteria=criteria)
    validation = validation_motions(cell, checks)
    return CampaignPlan(
        excitation,
        tuple(PlannedMotion(motion.trajectory, moves_of(cell, motion)) for motion in validation),
        moves_of(cell, excitation),
    )


def validation_motions(cell: Cell, checks: MotionChecks) -> tuple[ViaPointMotion, ...]:
    """Return the random validation motions of `[campaign]`; raise NoExcitationError for none."""
    settings = cell.campaign
    try:
        return random_validation_motions(
            cell.joint_limits,
            home=cell.home,
            seed=settings.seed,
            count=settings.validation_runs,
            n_via=settings.n_via,
            fly=settings.fly,
            range_share=settings.range_share,
            checker=checks.checker,
            currents=planned(checks.currents),
        )
    except NoFeasibleMotionError as error:
        reason = infeasible_text(error, checks.frame)
        raise NoExcitationError(f"no motion to test the result with: {reason}") from error


def moves_of(cell: Cell, motion: Excitation | ViaPointMotion) -> PlanFile | None:
    """Return the moves of a motion through via points; None for Fourier series."""
    moves = motion.moves
    via_points = motion.via_points
    if moves is None or via_points is None:
        return None
    return PlanFile(cell.joint_names, via_points[0], moves, limits=cell.joint_limits)
