"""Rehearsing: the plan of a campaign is run on the simulated arm, and judged."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Final

from hil.base.errors import CampaignFolderError, ExecutionError, HilError, OperatorStopError
from hil.base.files import make_folder
from hil.base.progress import Reporter, Silent
from hil.base.version import software
from hil.campaign.planned_motions import planned_motions, require_runnable
from hil.campaign.rehearsal_criteria import (
    SATURATION_SHARE,
    Judged,
    of_currents,
    of_estimate,
    of_motions,
)
from hil.campaign.twin import Twin
from hil.cell import Cell
from hil.control.errors import MotionFailedError
from hil.control.motion_checks import USABLE_CURRENT_SHARE
from hil.control.motion_watch import Stop, Unattended
from hil.control.virtual_link import VirtualLink
from planner.worker import WorkerProcess
from sim_fixtures import SimulationError

from .campaign_run import run_motions
from .errors import RepetitionsRejectedError
from .folder import CampaignFolder
from .motion_runner import RunOptions
from .operator import RunWatch
from .rehearsal_messages import assumption_words, criterion_record, undetected_words
from .rehearsal_record import AS_MODELLED, CRITERIA, EFFECTS, Rehearsal
from .simulated_sessions import MAX_RUN_SECONDS, result_of
from .state import CampaignState
from .undetected import undetected_of

REPETITIONS: Final = 3
"""Repetitions of the excitation: enough for their scatter, few enough for a minute."""
SEED: Final = 1


def rehearse(
    campaign: CampaignState, reporter: Reporter, *, seed: int, stop: Stop, again: bool
) -> Rehearsal:
    """Run the plan twice on the simulated arm, and judge it; see `Campaign.rehearse`.

    Changes of the cell file are accepted until the campaign has recordings, but not during the
    rehearsal.

    Args:
        campaign: state of its folder.
        reporter: of progress.
        seed: of the simulated arm.
        stop: request of the operator.
        again: also where a rehearsal has passed.

    Raises:
        CampaignFolderError: the cell file was changed during the rehearsal.
    """
    folder = campaign.folder
    with folder.locked():
        plan_hash = folder.hash_of(campaign.cell, campaign.plan)
        folder.accept_changes()
        require_runnable(campaign.cell, campaign.plan)
        before = None
        with suppress(HilError):  # a file that cannot be read is replaced
            before = Rehearsal.load(folder)
        same = before is not None and (before.plan_hash, before.seed) == (plan_hash, seed)
        if before is not None and same and before.passed and not again:
            reporter.say("this plan has passed its rehearsal already")
            return before
        shutil.rmtree(folder.rehearsed, ignore_errors=True)
        make_folder(folder.rehearsed)
        rehearsal = _rehearsed(campaign, plan_hash, reporter, seed, stop)
        if folder.hash_of(campaign.cell, campaign.plan) != plan_hash:
            raise CampaignFolderError(
                folder.root, "a mesh was changed during the rehearsal", "rehearse again"
            )
        rehearsal.save(folder.rehearsal)
        return rehearsal


def _rehearsed(
    campaign: CampaignState, plan_hash: str, reporter: Reporter, seed: int, stop: Stop
) -> Rehearsal:
    """Run the plan in the rehearsal folder on two simulated arms in parallel, and judge it."""
    twin = Twin.of(campaign.cell, seed=seed, repetitions=REPETITIONS)
    assumed = [*map(assumption_words, twin.assumed)]
    for words in assumed:
        reporter.say(f"assumed: {words}")
    modelled = _created(campaign, twin.cell, "plain")
    # One repetition shows the effects that the model leaves out.
    with_effects = _created(campaign, twin.cell.with_campaign(repetitions=1), "effects")
    with WorkerProcess(timeout=MAX_RUN_SECONDS) as child:
        child.begin(run_with_effects, with_effects.folder.root, twin)
        reporter.step(f"rehearsing on a simulated arm, {AS_MODELLED}")
        link = twin.link(_planned(modelled), effects=False)
        failure = _failure(modelled, link, twin, reporter, stop)
        seconds = link.cycles * modelled.cell.period
        judged = _of_run(twin, modelled.folder, AS_MODELLED, failure, USABLE_CURRENT_SHARE)
        if failure:  # the other criteria would fail for the same reason
            child.close()
            shutil.rmtree(with_effects.folder.root)
        else:
            judged += of_estimate(twin, modelled.folder, reporter)
            reporter.step(f"rehearsing on a simulated arm, {EFFECTS}")
            failure, cycles = result_of(child, stop, "the rehearsal", "rehearse again")
            seconds += cycles * modelled.cell.period
            judged += _of_run(twin, with_effects.folder, EFFECTS, failure, SATURATION_SHARE)
    criteria = [criterion_record(each, campaign.cell) for each in judged]
    names = {criterion.name for criterion in criteria}
    return Rehearsal(
        plan_hash=plan_hash,
        seed=seed,
        passed=names == {*CRITERIA} and all(criterion.passed for criterion in criteria),
        criteria=criteria,
        assumed=assumed,
        not_seen=[*map(undetected_words, undetected_of(campaign.cell))],
        repetitions=twin.cell.campaign.repetitions,
        motion_seconds=seconds,
        software=software(),
    )


def _created(campaign: CampaignState, cell: Cell, where: str) -> CampaignState:
    return CampaignState.create(campaign.folder.rehearsed / where, cell, campaign.plan)


def _planned(rehearsal: CampaignState) -> float:
    """Return the duration of the planned motions [s]."""
    motions = planned_motions(rehearsal.cell, rehearsal.plan)
    return float(sum(motion.trajectory.duration for motion in motions))


def _of_run(
    twin: Twin, folder: CampaignFolder, name: str, failure: str, bound: float
) -> list[Judged]:
    """Return the criteria of motions and currents of a run."""
    judged: list[Judged] = [of_motions(twin.cell, folder, name, failure)]
    if folder.manifest():
        judged.append(of_currents(twin.cell, folder, name, bound))
    return judged


def run_with_effects(folder: Path, twin: Twin) -> tuple[str, int]:
    """Run a plan on the arm with effects that the model lacks; return the failure and the cycles.

    In a separate process, parallel to the run as modelled. Each has its own link, seed and
    folder, so that neither affects the other.
    """
    rehearsal = CampaignState.open(folder)
    link = twin.link(_planned(rehearsal), effects=True)
    return _failure(rehearsal, link, twin, Silent(), Stop()), link.cycles


def _failure(
    rehearsal: CampaignState, link: VirtualLink, twin: Twin, reporter: Reporter, stop: Stop
) -> str:
    """Run what is missing; return the failure in a sentence, "" for none."""
    try:
        options = RunOptions(
            provenance=twin.provenance, durable=False, unrehearsed=True, say_unchecked=False
        )
        run_motions(rehearsal, link, RunWatch(Unattended(), stop), reporter, options)
    except (ExecutionError, RepetitionsRejectedError, SimulationError) as error:
        if stop.requested:
            raise OperatorStopError("the rehearsal was stopped; rehearse again") from error
        if isinstance(error, MotionFailedError):
            return error.sentence
        return str(error).rstrip(".")
    return ""
