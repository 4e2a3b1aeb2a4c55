"""Rehearsing: the plan of a campaign is run on the simulated arm, and judged."""

from __future__ import annotations

import shutil
from contextlib import suppress
from typing import Final

from hil.base.errors import CampaignFolderError, ExecutionError, HilError, OperatorStopError
from hil.base.files import make_folder
from hil.base.progress import Reporter
from hil.base.version import software
from hil.campaign.planned_motions import planned_motions, require_runnable
from hil.campaign.rehearsal_criteria import SATURATED, of_currents, of_estimate, of_motions
from hil.campaign.twin import Twin
from hil.cell import Cell
from hil.control.errors import MotionFailedError
from hil.control.motion_checks import PLANNED_CURRENT, collision_checker
from hil.control.motion_watch import Stop, Unattended
from hil.control.virtual_link import VirtualLink
from sim_fixtures import SimulationError

from .errors import RepetitionsRejectedError
from .motion_runner import RunOptions
from .operator import RunWatch
from .rehearsal import AS_MODELLED, CRITERIA, EFFECTS, Rehearsal, RehearsalCriterion
from .run import run_motions
from .state import CampaignState

REPETITIONS: Final = 3
"""Repetitions of the excitation: enough for their scatter, few enough for a minute."""
SEED: Final = 1


def rehearse(
    campaign: CampaignState, reporter: Reporter, *, seed: int, stop: Stop, again: bool
) -> Rehearsal:
    """Run the plan twice on the simulated arm, and judge it; see `Campaign.rehearse`.

    Changes of the cell file are accepted until the campaign has recordings, but not during the
    rehearsal (CampaignFolderError).
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
    """Run the plan in the folder of the rehearsal and judge it."""
    twin = Twin.of(campaign.cell, seed=seed, repetitions=REPETITIONS)
    for sentence in twin.assumed:
        reporter.say(f"assumed: {sentence}")
    criteria: list[RehearsalCriterion] = []
    seconds = 0.0
    for name, where, effects in ((AS_MODELLED, "plain", False), (EFFECTS, "effects", True)):
        # One repetition shows the effects that the model leaves out.
        cell = twin.cell.with_campaign(repetitions=1) if effects else twin.cell
        rehearsal = CampaignState.create(campaign.folder.rehearsed / where, cell, campaign.plan)
        reporter.step(f"rehearsing on a simulated arm, {name}")
        motions = planned_motions(rehearsal.cell, rehearsal.plan)
        planned = sum(motion.trajectory.duration for motion in motions)
        link = twin.link(planned, effects=effects)
        failure = _failure(rehearsal, link, twin, reporter, stop)
        seconds += link.cycles * cell.period
        criteria.append(of_motions(twin.cell, rehearsal.folder, name, failure))
        if rehearsal.folder.manifest():
            bound = SATURATED if effects else PLANNED_CURRENT
            criteria.append(of_currents(twin.cell, rehearsal.folder, name, bound))
        if failure:
            break  # the other criteria would fail for the same reason
        if not effects:
            criteria += of_estimate(twin, rehearsal.folder, reporter)
    names = {criterion.name for criterion in criteria}
    return Rehearsal(
        plan_hash=plan_hash,
        seed=seed,
        passed=names == {*CRITERIA} and all(criterion.passed for criterion in criteria),
        criteria=criteria,
        assumed=[*twin.assumed],
        not_seen=_not_seen(campaign.cell),
        repetitions=twin.cell.campaign.repetitions,
        motion_seconds=seconds,
        software=software(),
    )


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


def _not_seen(cell: Cell) -> list[str]:
    """Return what no simulation of this cell file can detect."""
    simulation = cell.file.simulation
    given = set() if simulation is None else simulation.drive_train.model_fields_set
    unknown = [
        name for name in ("gear_ratio", "joint_sign", "joint_offset_deg") if name not in given
    ]
    sentences = [
        "torque constants and current limits: the simulated motors have those of the cell file",
        "floor, walls and shapes: they are checked, but as the cell file and the URDF have them",
    ]
    if (unchecked := collision_checker(cell).exceptions) is not None:
        sentences.append(unchecked)
    if unknown:
        sentences.append(
            f"{', '.join(unknown)} of [drive_train]: the simulated arm takes them from there, so "
            "that errors in them are not detected; the controller's init packet (gears, coupling) "
            "and the dry run (signs) detect them, or a table [simulation.drive_train] now"
        )
    return sentences
