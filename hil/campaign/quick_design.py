"""The plan of a campaign: around a designed excitation, or one found in a few seconds."""

from __future__ import annotations

from dataclasses import replace
from math import isqrt
from typing import Final

from hil.cell import Cell
from hil.design import DesignSettings, preset, run_search
from hil.design.advice import NoExcitationError, forbidden
from hil.motion_checks import MotionChecks, planned
from hil.progress import Reporter
from identification.excitation import (
    RESCORE_PERIOD,
    DrawnMotion,
    Excitation,
    NoFeasibleMotionError,
    Objective,
    random_validation_motions,
)
from planner import PlanFile

from .errors import MotionRefusedError
from .plan import CampaignPlan, PlannedMotion

LEAST: Final = 4
"""Individuals that a genetic search needs."""
SLOWEST: Final = 0.5
"""Smallest share of a joint's speed that is tried: slow motions excite little."""
LONGEST: Final = 60.0
"""s that the excitation may last."""


def design(cell: Cell, reporter: Reporter) -> CampaignPlan:
    """Search an excitation quickly and draw the validation motions, all within the cell.

    The paper's method B with as few individuals as `[campaign].candidates` allows; `hil design`
    searches longer and finds better ones.

    Raises:
        NoExcitationError: says which constraint forbids every motion, where, and by how much;
            of the validation motions as well.
    """
    excitation = run_search(cell, quick_settings(cell), reporter).excitation
    return plan_around(cell, excitation)


def quick_settings(cell: Cell) -> DesignSettings:
    """Settings of the quick search: its seed, via points and size are those of `[campaign]`.

    It scores at most `candidates` motions (4 at least), in about as many generations as each has
    individuals.
    """
    campaign = cell.campaign
    motions = max(LEAST, campaign.candidates)
    population = max(LEAST, isqrt(4 * motions // 3))
    return preset("b").replaced(
        seed=campaign.seed,
        search={"population": population, "generations": motions // population, "polish": 0},
        via_points={"n_via": campaign.n_via, "fly": campaign.fly, "slowest": SLOWEST},
        constraints={"closed": True, "collision": True, "current": True, "max_duration": LONGEST},
    )


def plan_around(
    cell: Cell, excitation: Excitation, checks: MotionChecks | None = None
) -> CampaignPlan:
    """Return a plan with this excitation, and validation motions motion for the cell.

    Args:
        cell: whose `[campaign]` says how many validation motions, and from which seed.
        excitation: designed for this cell.
        checks: those of the cell, where they are at hand.

    Raises:
        MotionRefusedError: the excitation must not be sent to this cell's arm.
        NoExcitationError: no validation motion keeps the constraints; says which one.
    """
    checks = checks or MotionChecks.of(cell)
    problem = checks.refusal(excitation.trajectory)
    if problem is not None:
        raise MotionRefusedError("the excitation", problem, "design another motion")
    # A design may have judged some parameters only, or what it adds to earlier archives; what is
    # executed is compared with the motion by itself, over all parameters.
    criteria = Objective(cell.model).criteria(excitation.trajectory, RESCORE_PERIOD)
    excitation = replace(excitation, criteria=criteria)
    validation = _validation_motions(cell, checks)
    return CampaignPlan(
        excitation,
        tuple(PlannedMotion(motion.trajectory, _moves_of(cell, motion)) for motion in validation),
        _moves_of(cell, excitation),
    )


def _validation_motions(cell: Cell, checks: MotionChecks) -> tuple[DrawnMotion, ...]:
    settings = cell.campaign
    try:
        return random_validation_motions(
            cell.joint_limits,
            home=cell.home,
            seed=settings.seed,
            count=settings.validation_runs,
            n_via=settings.n_via,
            fly=settings.fly,
            checker=checks.checker,
            currents=planned(checks.currents),
        )
    except NoFeasibleMotionError as error:
        reason = forbidden(error, checks.frame)
        raise NoExcitationError(f"no motion to test the result with: {reason}") from error


def _moves_of(cell: Cell, motion: Excitation | DrawnMotion) -> PlanFile | None:
    """The moves behind a motion through via points; none behind sines."""
    moves, via_points = motion.moves, motion.via_points
    if moves is None or via_points is None:
        return None
    return PlanFile(cell.joint_names, via_points[0], moves, limits=cell.joint_limits)
