"""Held-out motions of three classes: what estimates are asked to predict."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from hil.campaign import PlannedMotion
from hil.cell import AngleFrame, Cell
from hil.design import DesignSettings, problem_of
from hil.design.advice import NoExcitationError, forbidden
from hil.motion_checks import MotionChecks, planned
from identification.excitation import (
    DrawnMotion,
    NoFeasibleMotionError,
    random_validation_motions,
    sampled,
)
from planner import FourierSeries, PlanFile

MotionClass = Literal["fly-by", "stop-to-stop", "sinusoid"]
CLASSES: Final[tuple[MotionClass, ...]] = ("fly-by", "stop-to-stop", "sinusoid")

# Streams of random numbers that no search and no other class draws from.
_STOPS_SEED: Final = 1_000_003
_SINES: Final = 5
_TRIES: Final = 400


def via_point_motions(
    cell: Cell, checks: MotionChecks, *, fly: float, count: int, seed: int
) -> tuple[PlannedMotion, ...]:
    """Wide random motions through as many via points as the cell's excitation has.

    Raises:
        NoExcitationError: none keeps the constraints.
    """
    try:
        drawn = random_validation_motions(
            cell.joint_limits,
            home=cell.home,
            seed=seed if fly > 0.0 else seed + _STOPS_SEED,
            count=count,
            n_via=cell.campaign.n_via,
            fly=fly,
            checker=checks.checker,
            currents=planned(checks.currents),
        )
    except NoFeasibleMotionError as error:
        told = forbidden(error, AngleFrame.of(cell))
        raise NoExcitationError(f"no motion to predict: {told}") from error
    return tuple(PlannedMotion(one.trajectory, _moves(cell, one)) for one in drawn)


def sine_motions(
    cell: Cell, settings: DesignSettings, checks: MotionChecks, *, count: int, seed: int
) -> tuple[PlannedMotion, ...]:
    """Random sums of sines of the family that method A searched in.

    Args:
        cell: the robot.
        settings: of that search.
        checks: of the cell.
        count: how many.
        seed: the first ones do not depend on the number.

    Raises:
        NoExcitationError: none keeps the constraints.
    """
    problem = problem_of(cell, settings)
    found = []
    for k in range(count):
        for attempt in range(_TRIES):
            random = np.random.default_rng([_SINES, seed, k, attempt])
            (motion,) = problem.genome.motions(problem.genome.sample(random, 1))
            if (
                isinstance(motion, FourierSeries)
                and not problem.constraints.violations(motion, sampled(motion))
                and checks.refusal(motion) is None
            ):
                found.append(PlannedMotion(motion))
                break
        else:
            raise NoExcitationError(
                f"none of {_TRIES} random sums of sines keeps all constraints of the cell"
            )
    return tuple(found)


def _moves(cell: Cell, motion: DrawnMotion) -> PlanFile:
    return PlanFile(cell.joint_names, motion.via_points[0], motion.moves, limits=cell.joint_limits)
