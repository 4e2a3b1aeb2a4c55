"""A long simulated campaign in two parallel controller sessions, in half the time.

Each session is a power-up of the same controller and arm (`simulated_link`), with noise of its own,
and runs its half of the motions from a cold arm. The second one runs in a process and a folder of
its own; its archives move to the campaign when both have ended, and whatever is complete when one
fails or is stopped. Which motions are in which session depends on the motions alone, not on the
computer: one seed remains one campaign.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from hil.base.errors import ExecutionError, OperatorStopError
from hil.base.files import make_folder
from hil.base.progress import Reporter, Silent
from hil.control.motion_watch import Stop, Unattended
from hil.control.motions import CampaignMotion
from hil.control.simulated_cell import simulated_link, simulated_provenance
from planner.errors import PlannerError
from planner.worker import WorkerProcess

from .campaign_run import run_motions
from .folder import CampaignFolder
from .motion_runner import RunOptions
from .operator import RunWatch
from .state import CampaignState

MIN_SPLIT_SECONDS: Final = 60.0
"""Missing motion from which the start of a second process is worthwhile [s]."""
MAX_RUN_SECONDS: Final = 24.0 * 3600.0
"""Most that a run on a simulated arm in another process may take [s]."""
_MOVES_AROUND: Final = 2
"""Moves of a session in addition to one before each motion: back to home, and to its start."""
_STOP_POLL_PERIOD: Final = 0.2  # s between two looks whether the operator stopped it


def run_simulated(campaign: CampaignState, stop: Stop, reporter: Reporter, *, effects: bool) -> int:
    """Run the missing motions on the simulated arm of the cell; return the cycles of the motions.

    Args:
        campaign: state of its folder.
        stop: request of the operator.
        reporter: of progress.
        effects: whether the arm has effects that the model leaves out.

    Raises:
        ExecutionError: a motion failed, or it was stopped; what is complete is in the manifest.
    """
    adopt_second_session(campaign)
    first, second = halves(campaign.missing())
    link = simulated_link(campaign.cell, effects=effects)
    options = RunOptions(provenance=simulated_provenance(campaign.cell, effects), unrehearsed=True)
    watch = RunWatch(Unattended(), stop)
    if not second:
        run_motions(campaign, link, watch, reporter, options)
        return link.cycles
    folder = _second_folder(campaign)
    elsewhere = replace(
        options, only=_keys(second), first_move=len(first) + _MOVES_AROUND, say_unchecked=False
    )
    with WorkerProcess(timeout=MAX_RUN_SECONDS) as child:
        try:
            child.begin(run_second_session, folder, elsewhere, effects=effects)
            run_motions(campaign, link, watch, reporter, replace(options, only=_keys(first)))
            cycles = result_of(child, stop, "the campaign", "resume it")
        finally:
            child.close()
            adopt_second_session(campaign)
    return link.cycles + int(cycles)


def halves(
    motions: Sequence[CampaignMotion],
) -> tuple[Sequence[CampaignMotion], Sequence[CampaignMotion]]:
    """Return motions in order in two parts of about the same duration, the second shorter.

    The second is empty where they are short.
    """
    total = sum(motion.trajectory.duration for motion in motions)
    if total < MIN_SPLIT_SECONDS:
        return motions, ()
    past = 0.0
    for count, motion in enumerate(motions, start=1):
        past += motion.trajectory.duration
        if past >= 0.5 * total:
            return motions[:count], motions[count:]
    return motions, ()


def run_second_session(folder: Path, options: RunOptions, *, effects: bool) -> int:
    """Run motions in a folder of their own, in the process of the second session; see above."""
    campaign = CampaignState.open(folder)
    link = simulated_link(campaign.cell, effects=effects, session=1)
    run_motions(campaign, link, RunWatch(Unattended(), Stop()), Silent(), options)
    return link.cycles


def adopt_second_session(campaign: CampaignState) -> None:
    """Move the archives of a second session that has ended, or was killed, to the campaign."""
    second = CampaignFolder(campaign.folder.second_session)
    if not second.root.exists():
        return
    with campaign.folder.locked():
        for entry in second.manifest():
            if (second.archives / entry.name).exists():  # else it was moved before
                (second.archives / entry.name).replace(campaign.folder.archives / entry.name)
                campaign.folder.add(entry.name, entry.outcome, entry.reason)
        shutil.rmtree(second.root)


def result_of(child: WorkerProcess, stop: Stop, what: str, remedy: str) -> Any:
    """Return what a run on a simulated arm in another process returned.

    Args:
        child: the process.
        stop: request of the operator.
        what: it runs, for errors.
        remedy: of these.

    Raises:
        OperatorStopError: it was stopped.
        ExecutionError: the process ended.
    """
    while not child.wait(_STOP_POLL_PERIOD):
        if stop.requested:
            raise OperatorStopError(f"{what} was stopped; {remedy}")
    try:
        return child.receive()
    except PlannerError as error:
        problem = f"the process of the second simulated arm ended: {error}"
        raise ExecutionError(f"{problem}; {remedy}") from error


def _second_folder(campaign: CampaignState) -> Path:
    """Create the folder of the second session, with copies of cell, URDF and plan."""
    second = CampaignFolder(campaign.folder.second_session)
    make_folder(second.archives)
    for name in ("cell", "urdf", "plan"):
        shutil.copyfile(getattr(campaign.folder, name), getattr(second, name))
    second.seal()
    return second.root


def _keys(motions: Sequence[CampaignMotion]) -> frozenset[tuple[str, int]]:
    return frozenset((motion.kind, motion.index) for motion in motions)
