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
from .rehearsal import AS_MODELLED, CRITERIA, EFFECTS, Criterion, Rehearsal
from .rehearsal_twin import Twin
from .stop import Stop

if TYPE_CHECKING:
    from hil.cell import Cell


from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.errors import InputError
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import prepare_sources
from hil.identify.sources import gather_sources
from identification.distributions import normal_limit
from identification.errors import IdentificationError
from identification.signals.recording import RecordingError
from identification.validation.prediction import over_all, prediction_error

from .folder import CampaignFolder

Array = NDArray[np.float64]

MOST_SIGMA: Final = 4.0
"""Standard deviations that an estimate may lie from what was planted."""
MOST_ERROR: Final = 1.2
"""Error on unseen motion, as a multiple of what the planted parameters themselves leave."""
SATURATED: Final = 0.99
"""Share of it from which a motor counts as saturated."""
_NAMED: Final = 3


@dataclass(frozen=True)
class Ran:
    """How the motions went on one twin.

    Attributes:
        name: of the run, in words.
        failures: what went wrong, in sentences.
    """

    name: str
    failures: tuple[str, ...]


def of_motions(ran: Ran) -> Criterion:
    """Every motion was accepted, and none refused, lost or stopped."""
    good = not ran.failures
    return Criterion(
        name=f"motions ({ran.name})",
        value=float(len(ran.failures)),
        bound=0.0,
        passed=good,
        sentence=(
            f"{ran.name}: every motion ran to its end, none was refused by the guard or tripped"
            if good
            else f"{ran.name}: {'; '.join(ran.failures)}"
        ),
    )


def of_currents(twin: Twin, folder: CampaignFolder, name: str, bound: float) -> Criterion:
    """The largest current of any motor, as a share of its limit."""
    worst, motor, where = 0.0, 0, ""
    limit = twin.cell.drive_train.current_limit
    for entry in folder.manifest():
        current = np.abs(open_archive(folder.archives / entry.name).columns["target_current"])
        share = np.nan_to_num(current).max(axis=0, initial=0.0) / limit
        if share.max() > worst:
            worst, motor, where = float(share.max()), int(share.argmax()), entry.name
    return Criterion(
        name=f"current ({name})",
        value=worst,
        bound=bound,
        passed=worst <= bound,
        sentence=f"{name}: the largest current is {worst:.0%} of its limit (motor of "
        f"{twin.cell.joint_names[motor]}, {where}), at most {bound:.0%} is wanted",
    )


def of_estimate(
    twin: Twin, folder: CampaignFolder, reporter: Reporter
) -> tuple[Criterion, Criterion, Criterion]:
    """What identification makes of the archives: determined, found again, predicting."""
    paths = [
        path
        for kind in ("excitation", "validation", "standstill")
        for path in folder.completed(kind)
    ]
    options = FIXED
    try:
        prepared = prepare_sources(gather_sources(paths, options.split), options, reporter)
        estimation = estimate_with(prepared, options, reporter)
    except (InputError, IdentificationError, RecordingError) as error:
        return _unjudged(str(error))
    model, found = twin.cell.model, estimation.result.pooled
    factor = found.interval_factor / normal_limit(0.025)
    ours, theirs = (
        over_all(prediction_error(model, values, prepared.held_out)).rms
        for values in (found.values, twin.truth)
    )
    return (
        _determined(found.undetermined),
        _found_again(found.names, (found.values - twin.truth) / (factor * found.std)),
        _predicting(twin.cell.joint_names, ours / np.maximum(theirs, np.finfo(np.float64).tiny)),
    )


def _unjudged(why: str) -> tuple[Criterion, Criterion, Criterion]:
    def missing(name: str, bound: float) -> Criterion:
        sentence = f"{name}: cannot be determined, for nothing can be identified ({why})"
        return Criterion(name=name, value=None, bound=bound, passed=False, sentence=sentence)

    return (
        missing("excitation", 0.0),
        missing("parameters", MOST_SIGMA),
        missing("unseen motion", MOST_ERROR),
    )


def _determined(undetermined: Sequence[str]) -> Criterion:
    count = len(undetermined)
    return Criterion(
        name="excitation",
        value=float(count),
        bound=0.0,
        passed=count == 0,
        sentence=(
            "the excitation determines every parameter"
            if count == 0
            else f"the excitation says nothing about {count} parameters "
            f"({_some(undetermined)}): design a motion that moves every joint"
        ),
    )


def _found_again(names: Sequence[str], apart: Array) -> Criterion:
    """`apart`: of each parameter from what was planted, in standard deviations (p,)."""
    known = np.isfinite(apart)
    if not known.any():
        return _unjudged("no parameter has a standard deviation")[1]
    distance = np.where(known, np.abs(apart), 0.0)
    beyond = [names[i] for i in np.argsort(-distance) if distance[i] > MOST_SIGMA]
    worst = float(distance.max())
    return Criterion(
        name="parameters",
        value=worst,
        bound=MOST_SIGMA,
        passed=not beyond,
        sentence=(
            f"all {int(known.sum())} parameters were found within {worst:.1f} standard deviations "
            f"of what was planted, {MOST_SIGMA:g} are allowed"
            if not beyond
            else f"{len(beyond)} of {int(known.sum())} parameters ({_some(beyond)}) are more than "
            f"{MOST_SIGMA:g} standard deviations, up to {worst:.3g}, from what was planted: the "
            "drive train or the model of the cell file is not that of the arm"
        ),
    )


def _predicting(joints: Sequence[str], ratio: Array) -> Criterion:
    """`ratio`: error on unseen motion over that of the planted parameters (n,)."""
    worst = int(np.nanargmax(ratio)) if np.isfinite(ratio).any() else 0
    value = float(ratio[worst])
    passed = bool(np.isfinite(ratio).all()) and value <= MOST_ERROR
    found = (
        f"on unseen motion the torque error is {value:.2f} times what noise leaves "
        f"({joints[worst]}), at most {MOST_ERROR:g} is wanted"
    )
    remedy = ": the excitation teaches too little; search a better one (`hil design`)"
    return Criterion(
        name="unseen motion",
        value=value if np.isfinite(value) else None,
        bound=MOST_ERROR,
        passed=passed,
        sentence=found if passed else found + remedy,
    )


def _some(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


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
        OperatorStopError: it was stopped; what was recorded remains.
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
        same = before is not None and before.covers(folder, plan_hash) and before.seed == seed
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
    for name, where, effects in ((AS_MODELLED, "plain", False), (EFFECTS, "effects", True)):
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
        motion_hash=campaign.folder.motion_hash,
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
    """Length of all motions of a plan, without the moves between them."""
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
                "the rehearsal was stopped; the recordings remain, rehearse again to go on"
            ) from error
        failures.append(_reason(error))
    return Ran(name, tuple(failures))


def _reason(error: Exception) -> str:
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
