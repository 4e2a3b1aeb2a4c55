"""A rehearsal: exactly the plan of a campaign, on a simulated twin of its cell."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hil.errors import ControllerFault, HilError, OperatorStopError
from hil.files import make_folder
from hil.motion_checks import PLANNED_CURRENT
from hil.progress import Reporter
from hil.version import software
from sim_fixtures import SimulatedDrive, SimulationError

from .campaign import Campaign
from .errors import CampaignFolderError, MotionFailedError, RepetitionsRejectedError
from .intervals import require_runnable, wanted
from .link import Link
from .rehearsal import CRITERIA, EFFECTS, PLAIN, Criterion, Rehearsal
from .rehearsal_criteria import SATURATED, Ran, of_currents, of_estimate, of_motions
from .rehearsal_twin import Twin
from .stop import Stop

if TYPE_CHECKING:
    from hil.cell import Cell

REPETITIONS: Final = 3
"""Of the excitation: enough for its spread, few enough for a minute."""
SEED: Final = 1
OTHER_DRIVE: Final = "other_drive"
"""Folder of a rehearsal on other gears and motors than the cell file's; it opens no gate."""


def rehearse(
    campaign: Campaign,
    reporter: Reporter,
    *,
    seed: int = SEED,
    stop: Stop | None = None,
    again: bool = False,
    drive: SimulatedDrive | None = None,
) -> Rehearsal:
    """Run the plan on the twin, twice, and judge it; the result is in `rehearsal.json`.

    A rehearsal of the same plan and seed that passed is not repeated; one that was stopped goes
    on where it was. Until something has been recorded in the campaign, changes of its cell file
    are taken in when it is opened; later they are refused. Whatever is edited meanwhile, the
    result is of the cell and plan that were rehearsed, or there is none.

    Args:
        campaign: what is rehearsed.
        reporter: of progress.
        seed: of what is planted, the noise and the link's faults.
        stop: ends the rehearsal early.
        again: rehearse once more even if it passed.
        drive: the simulated arm's gears and motors, where they shall not be those of the cell
            file; the result is returned and not written down, for it is not of this cell.

    Raises:
        MotionRefusedError: a motion breaks a limit of the cell; nothing was rehearsed.
        OperatorStopError: it was stopped; what was recorded is kept.
        CampaignFolderError: the folder was changed after the first archive, or meanwhile, or is
            in use.
        OutputError: the result cannot be written.
    """
    folder, stop = campaign.folder, stop or Stop()
    with folder.locked():
        plan_hash = folder.hash_of(campaign.cell, campaign.plan)
        folder.accept_changes()
        require_runnable(campaign.cell, campaign.plan)
        if drive is not None:
            where = folder.rehearsed / OTHER_DRIVE
            shutil.rmtree(where, ignore_errors=True)
            return _rehearsed(campaign, where, plan_hash, reporter, seed, stop, drive)
        before = None
        with suppress(HilError):  # what cannot be read is made anew
            before = Rehearsal.load(folder)
        same = before is not None and (before.plan_hash, before.seed) == (plan_hash, seed)
        if before is not None and same and before.passed and not again:
            reporter.say("exactly this plan was rehearsed already and passed")
            return before
        if again or (same and before is not None):
            shutil.rmtree(folder.rehearsed, ignore_errors=True)
        found = _rehearsed(campaign, folder.rehearsed, plan_hash, reporter, seed, stop, None)
        if folder.hash_of(campaign.cell, campaign.plan) != plan_hash:
            raise CampaignFolderError(
                folder.root, "a mesh was changed while it was rehearsed", "rehearse again"
            )
        found = found.after(before)
        found.save(folder.rehearsal)
        return found


def _rehearsed(
    campaign: Campaign,
    root: Path,
    plan_hash: str,
    reporter: Reporter,
    seed: int,
    stop: Stop,
    drive: SimulatedDrive | None,
) -> Rehearsal:
    """Run the plan below `root` and judge it."""
    twin = Twin.of(campaign.cell, seed=seed, repetitions=REPETITIONS)
    for sentence in twin.assumed:
        reporter.say(f"assumed: {sentence}")
    criteria: list[Criterion] = []
    seconds = 0.0
    for name, where, effects in ((PLAIN, "plain", False), (EFFECTS, "effects", True)):
        # What the model leaves out is no matter of repetition.
        cell = twin.cell.with_campaign(repetitions=1) if effects else twin.cell
        rehearsal = _campaign(root / where, replace(campaign, cell=cell))
        reporter.say(f"rehearsing on a simulated arm, {name}")
        link = twin.link(_seconds(rehearsal), effects=effects, drive=drive)
        ran = _run(rehearsal, link, twin.provenance, reporter, stop, name)
        seconds += link.cycles * cell.period
        criteria.append(of_motions(ran))
        if rehearsal.folder.manifest():
            bound = SATURATED if effects else PLANNED_CURRENT
            criteria.append(of_currents(twin, rehearsal.folder, name, bound))
        if ran.failures:
            break  # the rest would say the same in other words
        if not effects:
            criteria += of_estimate(twin, rehearsal.folder, reporter)
    names = {one.name for one in criteria}
    return Rehearsal(
        plan_hash=plan_hash,
        seed=seed,
        passed=names == {*CRITERIA} and all(one.passed for one in criteria),
        criteria=criteria,
        assumed=[*twin.assumed],
        not_seen=_not_seen(campaign.cell),
        repetitions=twin.cell.campaign.repetitions,
        motion_seconds=seconds,
        software=software(),
    )


def _campaign(root: Path, like: Campaign) -> Campaign:
    """The twin's own campaign folder: that of a rehearsal that was stopped, or a new one."""
    with suppress(HilError):
        there = Campaign.open(root)
        expected = like.cell.with_urdf(there.folder.cell, there.folder.urdf.name)
        same = there.cell.text == expected.text and there.cell.urdf == expected.urdf
        whole = there.folder.sealed  # else whoever made it was killed, or its disk was full
        if same and whole and there.plan.to_text() == like.plan.to_text():
            return there
    shutil.rmtree(root, ignore_errors=True)
    make_folder(root.parent)
    return Campaign.create(root, like.cell, like.plan)


def _seconds(rehearsal: Campaign) -> float:
    """Length of all motions of a plan, without the ways between them."""
    return sum(one.trajectory.duration for one in wanted(rehearsal.cell, rehearsal.plan))


def _run(
    rehearsal: Campaign,
    link: Link,
    provenance: Mapping[str, str],
    reporter: Reporter,
    stop: Stop,
    name: str,
) -> Ran:
    """Run what is missing, and say how it went."""
    failures: list[str] = []
    try:
        rehearsal.run(link, stop, reporter, provenance=provenance, durable=False, unrehearsed=True)
    except (ControllerFault, RepetitionsRejectedError, SimulationError) as error:
        if stop.requested:
            raise OperatorStopError(
                "the rehearsal was stopped; what was recorded is kept, rehearse again to go on"
            ) from error
        failures.append(_told(error))
    return Ran(name, tuple(failures))


def _told(error: Exception) -> str:
    if isinstance(error, MotionFailedError):
        return error.sentence
    return str(error).rstrip(".")


def _not_seen(cell: Cell) -> list[str]:
    """What no simulation of this cell file can show."""
    known = cell.file.simulation
    given = set() if known is None else known.drive_train.model_fields_set
    unknown = [
        name for name in ("gear_ratio", "joint_sign", "joint_offset_deg") if name not in given
    ]
    sentences = [
        "torque constants and current limits: the simulated motors have those of the cell file",
        "floor, walls and shapes: they are checked, but as the cell file and the URDF have them",
    ]
    if unknown:
        sentences.append(
            f"{', '.join(unknown)} of [drive_train]: the simulated arm takes them from there, so "
            "that a mistake in them cannot show; the controller's init packet (gears, coupling) "
            "and the slow dry run (signs) will tell, or a table [simulation.drive_train] now"
        )
    return sentences
