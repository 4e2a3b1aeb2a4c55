"""Campaigns of a study: every excitation and the held-out motions on the simulated cell."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hil.base.errors import ExecutionError
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignFolder, CampaignPlan, Stop
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.plan import PlannedMotion, moves_of, validation_motions
from hil.cell import Cell
from hil.control.motion_checks import MotionChecks
from hil.control.simulated_cell import simulated_link, simulated_provenance
from hil.design.messages import NoExcitationError
from identification.excitation import SineGenome

from .child_calls import StudyError
from .searches import Search
from .settings import StudyFolder, StudySettings

FLY_BY: Final = "fly-by"
SINES: Final = "sines"
MOTION_CLASSES: Final = (FLY_BY, SINES)
"""Classes of held-out motions: as of method B, and as of method A."""
_CAMPAIGN: Final = {
    "campaign.approach_speed": 1.0,
    "campaign.settle_s": 0.2,
    "campaign.standstill_s": 2.0,
}
"""The arm is simulated and at home: it need not approach slowly."""
_VIA_POINTS: Final = {"campaign.n_via": 6, "campaign.fly": 0.5}  # of the paper's held-out motions
_HELD_OUT_SHARE: Final = 0.5  # duration of held-out sines over that of the excitations
_RAMP_SHARE: Final = 0.1  # of that duration
# first number of a random stream that no search and no fly-by motion uses
_HELD_OUT_STREAM: Final = 3
_MAX_ATTEMPTS: Final = 100


@dataclass(frozen=True, eq=False)
class StudyExecution:
    """One campaign of the study, without effects."""

    root: Path  #: its folder
    cell: Cell
    plan: CampaignPlan
    search: Search
    held_out: str = ""  #: class of its held-out motions, if it has any

    @property
    def complete(self) -> bool:
        """Whether all archives exist and are intact."""
        folder = CampaignFolder(self.root)
        kinds = ("standstill", "excitation", "validation")
        motions = 1 + self.cell.campaign.repetitions + len(self.plan.validation)
        return (self.root / "manifest.json").exists() and (
            sum(len(folder.completed(kind)) for kind in kinds) >= motions
        )


def plan_study(
    folder: StudyFolder, cell: Cell, settings: StudySettings, searches: Sequence[Search]
) -> list[StudyExecution]:
    """Return a campaign for each search; the first of A has the held-out sines, of B the fly-bys.

    Args:
        folder: of the study.
        cell: that is simulated.
        settings: of the study.
        searches: whose motions are run.

    Raises:
        NoExcitationError: there are no held-out motions that satisfy all constraints.
    """
    main = cell.with_values(
        {**_CAMPAIGN, "simulation.initial_deg": cell.campaign.home_deg}
    ).with_campaign(repetitions=settings.repetitions, simulation_seed=settings.seed)
    held_out = {
        next(search.key for search in searches if search.method == method): (kind, motions)
        for method, kind, motions in (
            ("a", SINES, sines(cell, settings)),
            ("b", FLY_BY, fly_bys(cell, settings)),
        )
    }
    executions = []
    for search in searches:
        kind, motions = held_out.get(search.key, ("", ()))
        excitation = search.excitation
        plan = CampaignPlan(excitation, motions, moves_of(cell, excitation))
        executions.append(StudyExecution(folder.campaign(search.key), main, plan, search, kind))
    return executions


def fly_bys(cell: Cell, settings: StudySettings) -> tuple[PlannedMotion, ...]:
    """Return wide fly-by motions through six via points, as of the paper's Fig. 3."""
    random = cell.with_values({**_VIA_POINTS, "campaign.seed": settings.seed}).with_campaign(
        validation_runs=settings.motions // 2
    )
    motions = validation_motions(random, MotionChecks.of(cell))
    return tuple(PlannedMotion(motion.trajectory, moves_of(cell, motion)) for motion in motions)


def sines(cell: Cell, settings: StudySettings) -> tuple[PlannedMotion, ...]:
    """Return random sums of three sines for each joint, about home and the middle in turn.

    Frequencies are bounded as in the appendix, amplitudes by eq. 8.

    Raises:
        NoExcitationError: none satisfies all constraints.
    """
    length = _HELD_OUT_SHARE * settings.duration
    checks = MotionChecks.of(cell)
    motions: list[PlannedMotion] = []
    for number in range(settings.motions - settings.motions // 2):
        genome = SineGenome(
            cell.joint_limits,
            length=length,
            ramp=_RAMP_SHARE * length,
            offset=cell.home if number % 2 else None,
        )
        for attempt in range(_MAX_ATTEMPTS):
            random = np.random.default_rng([_HELD_OUT_STREAM, settings.seed, number, attempt])
            (motion,) = genome.motions(genome.sample(random, 1))
            if not isinstance(motion, Exception) and checks.refusal(motion) is None:
                motions.append(PlannedMotion(motion))
                break
        else:
            raise NoExcitationError(
                f"no sum of sines of {length:g} s to test the result with satisfies all"
                f" constraints in {_MAX_ATTEMPTS} attempts"
            )
    return tuple(motions)


def execute(execution: StudyExecution) -> None:
    """Run or resume one campaign.

    Raises:
        StudyError: the controller ended it.
    """
    root = execution.root
    if execution.complete:
        return
    if (root / "manifest.json").exists():
        campaign = Campaign.open(root)
    else:
        if root.exists():  # interrupted while it was created
            shutil.rmtree(root)
        campaign = Campaign.create(root, execution.cell, execution.plan)
    try:
        campaign.run(
            simulated_link(campaign.cell),
            Stop(),
            Silent(),
            provenance=simulated_provenance(campaign.cell, effects=False),
            durable=False,
            unrehearsed=True,
        )
    except (ExecutionError, RepetitionsRejectedError) as error:
        raise StudyError(
            f"the controller ended the excitation: {error}; search another one with --seed, in"
            " another folder"
        ) from error
