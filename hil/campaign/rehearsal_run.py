"""A rehearsal: exactly the plan of a campaign, on a simulated twin of its cell.

The twin is an arm near the nominal one, behind the cell's own link. It knows of the cell what a
robot would: its links, its gears, its limits. What nobody knows before the robot has moved is
varied: masses, inertias, rotors and friction within `SPREAD` of the nominal figures. A cell without
`[simulation]` gets one from `[nominal]` and the defaults below.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pinocchio
from numpy.typing import NDArray

from drivers.transports.faults import Delay, Duplicate, Fault, Lose
from drivers.transports.simulated import SimulatedTransport
from hil.archive import open_archive
from hil.cell import Cell
from hil.errors import ControllerFault, HilError, InputError, OperatorStopError
from hil.files import make_folder
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import prepare_sources
from hil.identify.sources import gather_sources
from hil.motion_checks import PLANNED_CURRENT
from hil.progress import Reporter
from hil.simulation import (
    controller_settings,
    planted_values,
    simulated_controller,
    simulated_provenance,
)
from hil.version import software
from identification.distributions import normal_limit
from identification.errors import IdentificationError
from identification.signals.recording import RecordingError
from identification.validation.prediction import pooled_error, prediction_error
from sim_fixtures import ServoSettings, SimulatedDrive, SimulationError, UnmodelledEffects

from .campaign import Campaign
from .errors import CampaignFolderError, MotionFailedError, RepetitionsRejectedError
from .folder import CampaignFolder
from .intervals import planned_intervals, require_runnable
from .link import Link
from .operator import Stop
from .rehearsal import AS_MODELLED, CRITERIA, EFFECTS, Criterion, Rehearsal

Array = NDArray[np.float64]

SPREAD: Final = 0.1
"""Largest relative distance of what is planted from what is nominal."""
NOISE_SHARE: Final = 0.005
"""Current that flows about the target current, rms, as a share of the weakest motor's limit."""
RESOLUTION_SHARE: Final = 0.001
"""Step of the target current, likewise."""
FAULT_EVERY: Final = 3.0
"""s between two faults of the link, on average."""
LOOP_CYCLES: Final = 0.5
"""A target current acts over the cycle before the packet: half a cycle earlier on average."""
RESONANCE: Final = 500.0
"""rad/s of a main axis, rotor against link, where the cell says nothing of elasticity."""
FASTEST: Final = 800.0
"""rad/s that no resonance exceeds in any posture: the simulated arm is stepped in half cycles."""
POSTURES: Final = 60
"""That are looked at for it."""
MAIN_AXES: Final = 3
SLOWEST_LOOP: Final = 0.002
"""s; a slower current loop would shake the simulated arm."""
_HORIZON: Final = 4.0
"""Faults are varied for so many times the motion's length: settling and ways take time too."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A simulated arm to rehearse on.

    Attributes:
        cell: nominal, but simulated; what was varied is in its `[simulation]`.
        truth: planted parameters (p,) in the order of the model.
        assumed: what the arm has by assumption, in sentences.
        seed: of everything varied.
    """

    cell: Cell
    truth: Array
    assumed: tuple[str, ...]
    seed: int

    @classmethod
    def of(cls, cell: Cell, *, seed: int, repetitions: int) -> Twin:
        """Draw an arm for a cell."""
        rng = np.random.default_rng(seed)
        planted = _varied(cell, rng)
        settings, assumed = _simulation(cell, planted, seed)
        twin = cell.with_values(
            {
                **{f"simulation.{key}": value for key, value in settings.items()},
                "controller.transport": "simulated",
                "campaign.repetitions": min(repetitions, cell.campaign.repetitions),
            }
        )
        return cls(twin, planted_values(twin), tuple(assumed), seed)

    def link(self, seconds: float, *, effects: bool, drive: SimulatedDrive | None = None) -> Link:
        """A link in virtual time to the arm, with faults now and then."""
        table = self.cell.controller
        # A current loop as late as the cell says that its currents are.
        lag = (LOOP_CYCLES - table.current_delay_cycles) * self.cell.period
        settings = replace(
            controller_settings(self.cell, effects=effects),
            servo=ServoSettings(current_lag=float(np.clip(lag, 0.0, SLOWEST_LOOP))),
            # Packets in a row that the cell says a motion survives.
            missed_replies=table.max_gap + 1,
            while_silent="continue",
        )
        controller = simulated_controller(
            self.cell,
            settings=settings,
            effects=effects,
            drive=drive,
            seed=self.seed,
        )
        faults = link_faults(self.cell, _HORIZON * seconds, self.seed)
        return Link.over(
            SimulatedTransport(controller, faults), self.cell, finish=controller.finish
        )

    @property
    def provenance(self) -> dict[str, str]:
        """Metadata that mark an archive as a rehearsal's, and say what was planted."""
        planted = dict(zip(self.cell.model.parameter_names, self.truth.tolist(), strict=True))
        return {
            **simulated_provenance(self.cell, effects=False),
            "rehearsal": "yes",
            "planted": json.dumps(planted),
        }


def link_faults(cell: Cell, seconds: float, seed: int) -> tuple[Fault, ...]:
    """Faults of an ordinary network: single packets that are lost, doubled or late.

    Args:
        cell: its `max_gap` says whether a lost packet is survived at all.
        seconds: of the controller's time that they are varied for.
        seed: of the draw.
    """
    rng = np.random.default_rng([seed, 7])
    cycles = round(seconds / cell.period)
    count = max(1, round(seconds / FAULT_EVERY))
    kinds = ["delay", "duplicate", *(["lose"] if cell.controller.max_gap else [])]
    faults: list[Fault] = []
    # Not in the packets of the start: what is rehearsed is motion.
    for cycle in sorted(rng.integers(1000, max(1001, cycles), count).tolist()):
        match kinds[rng.integers(len(kinds))]:
            case "delay":
                faults.append(Delay(cycle, cycles=float(rng.uniform(0.1, 0.8))))
            case "duplicate":
                faults.append(Duplicate(cycle))
            case _:
                faults.append(Lose(cycle))
    return tuple(faults)


def _varied(cell: Cell, rng: np.random.Generator) -> dict[str, list[float]]:
    """Inertias of links, rotors and friction within the spread of the URDF and of `[nominal]`."""
    nominal = cell.nominal
    n = len(cell.joint_names)

    def varied(values: list[float]) -> list[float]:
        factors = 1.0 + SPREAD * rng.uniform(-1.0, 1.0, n)
        return (np.array(values) * factors).tolist()  # type: ignore[no-any-return]

    return {
        "inertia_scale": varied([1.0] * n),
        "rotor_inertia": varied(nominal.rotor_inertia),
        "coulomb": varied(nominal.coulomb),
        "viscous": varied(nominal.viscous),
        "third": varied(nominal.third or [0.0] * n),
    }


def _simulation(
    cell: Cell, planted: dict[str, list[float]], seed: int
) -> tuple[dict[str, Any], list[str]]:
    """`[simulation]` of the twin, and what in it is assumed."""
    table: dict[str, Any] = {**planted, "seed": seed}
    assumed = []
    given = cell.file.simulation
    if given is None:
        weakest = min(cell.drive_table.current_limit)
        table["initial_deg"] = cell.campaign.home_deg
        table["current_noise"] = NOISE_SHARE * weakest
        table["current_resolution"] = RESOLUTION_SHARE * weakest
        assumed.append(
            f"the current trembles by {table['current_noise']:.3g} A rms and comes in steps of "
            f"{table['current_resolution']:.3g} A ({NOISE_SHARE:.1%} and {RESOLUTION_SHARE:.1%} of "
            "the weakest motor's limit)"
        )
    if given is None or not (
        given.torque_ripple or given.friction_drift or any(given.elasticity) or given.delay
    ):
        effects = _ordinary_effects(cell, np.array(planted["rotor_inertia"]))
        table |= asdict(effects) | {"elasticity": list(effects.elasticity)}
        assumed.append(
            f"what the model leaves out is of ordinary size: torque ripple of "
            f"{effects.torque_ripple:.0%} of the Coulomb torque, friction that falls by "
            f"{effects.friction_drift:.0%}, springs in the main axes, {1e3 * effects.delay:g} ms "
            "of delay"
        )
    unknown = [key for key in ("rotor_inertia", "coulomb", "viscous") if not any(planted[key])]
    if unknown:
        assumed.append(f"[nominal] has nothing but zeros for {', '.join(unknown)}: so has the arm")
    return table, assumed


def _ordinary_effects(cell: Cell, rotors: Array) -> UnmodelledEffects:
    """Effects at their default sizes, with springs that suit the size of the arm.

    None is stiffer than resonates at `FASTEST` in any of some postures within the limits. Where
    axes are almost parallel, as the first and the third of an arm with seven, the link beyond a
    spring is much lighter than its own inertia says: the next axis gives way.
    """
    n, limits = len(rotors), cell.joint_limits
    model = pinocchio.buildModelFromXML(cell.urdf)
    data = model.createData()

    def inertia(posture: Array) -> Array:
        upper = np.triu(pinocchio.crba(model, data, posture))
        return np.asarray(upper + np.triu(upper, 1).T)

    links = inertia(cell.home).diagonal()
    reduced = rotors * links / np.maximum(rotors + links, np.finfo(np.float64).tiny)
    soft = (np.arange(n) < MAIN_AXES) & (reduced > 0.0)
    compliance = np.zeros(n)
    compliance[soft] = 1.0 / (reduced[soft] * RESONANCE**2)
    root, fastest = 1.0 / np.sqrt(compliance[soft]), 0.0
    shares = np.random.default_rng(0).random((POSTURES, n))
    for posture in [cell.home, *(limits.lower + shares * (limits.upper - limits.lower))]:
        if soft.any():
            whole = inertia(posture) + np.diag(np.where(soft, 0.0, rotors))
            mobility = np.linalg.inv(whole)[np.ix_(soft, soft)] + np.diag(1.0 / rotors[soft])
            found = float(np.linalg.eigvalsh(root[:, None] * mobility * root)[-1])
            fastest = max(fastest, found)
    compliance *= max(1.0, float(np.sqrt(fastest)) / FASTEST) ** 2
    return replace(UnmodelledEffects.default_sizes(n), elasticity=tuple(compliance.tolist()))


MOST_SIGMA: Final = 4.0
"""Standard deviations that an estimate may lie from what was planted."""
MOST_ERROR: Final = 1.2
"""Error on unseen motion, as a multiple of what the planted parameters themselves leave."""
SATURATED: Final = 0.99
"""Share of it from which a motor counts as saturated."""
_NAMED: Final = 3


def judged(name: str, value: float | None, bound: float, good: str, bad: str = "") -> Criterion:
    """A criterion that is met by a finite value up to `bound`.

    Args:
        name: of the criterion.
        value: what was found; None where it cannot be determined.
        bound: the largest value that passes.
        good: what was found, in words.
        bad: the same of what does not pass, where that is more.
    """
    known = value is not None and np.isfinite(value)
    passed = value is not None and known and value <= bound
    return Criterion(
        name=name,
        value=value if known else None,
        bound=bound,
        passed=bool(passed),
        sentence=good if passed else bad or good,
    )


def of_currents(cell: Cell, folder: CampaignFolder, name: str, bound: float) -> Criterion:
    """The largest current of any motor, as a share of its limit."""
    worst, motor, where = 0.0, 0, ""
    limit = cell.drive_train.current_limit
    for entry in folder.manifest():
        current = np.abs(open_archive(folder.archives / entry.name).columns["target_current"])
        share = np.nan_to_num(current).max(axis=0, initial=0.0) / limit
        if share.max() > worst:
            worst, motor, where = float(share.max()), int(share.argmax()), entry.name
    return judged(
        f"current ({name})",
        worst,
        bound,
        f"{name}: the largest current is {worst:.0%} of its limit (motor of "
        f"{cell.joint_names[motor]}, {where}), at most {bound:.0%} is wanted",
    )


def of_estimate(twin: Twin, folder: CampaignFolder, reporter: Reporter) -> list[Criterion]:
    """What identification makes of the archives: determined, found again, predicting."""
    bounds = {"excitation": 0.0, "parameters": MOST_SIGMA, "unseen motion": MOST_ERROR}
    kinds = ("excitation", "validation", "standstill")
    paths = [path for kind in kinds for path in folder.completed(kind)]
    try:
        prepared = prepare_sources(gather_sources(paths, FIXED.split), FIXED, reporter)
        estimation = estimate_with(prepared, FIXED, reporter)
    except (InputError, IdentificationError, RecordingError) as error:
        why = f"cannot be determined, for nothing can be identified ({error})"
        return [judged(name, None, bound, f"{name}: {why}") for name, bound in bounds.items()]
    model, found = twin.cell.model, estimation.result.pooled
    undetermined = found.undetermined
    deviation = found.interval_factor / normal_limit(0.025) * found.std
    apart = np.abs(found.values - twin.truth) / deviation
    distance = np.where(np.isfinite(apart), apart, 0.0)
    known = int(np.isfinite(apart).sum())
    far = [found.names[k] for k in np.argsort(-distance) if distance[k] > MOST_SIGMA]
    sigma, asked = float(distance.max()) if known else None, f"{MOST_SIGMA:g} standard deviations"
    ours, theirs = (
        pooled_error(prediction_error(model, values, prepared.held_out)).rms
        for values in (found.values, twin.truth)
    )
    ratio = ours / np.maximum(theirs, np.finfo(np.float64).tiny)
    joint = int(np.argmax(np.where(np.isfinite(ratio), ratio, np.inf)))
    error_is = (
        f"on unseen motion the torque error is {ratio[joint]:.2f} times what noise leaves "
        f"({twin.cell.joint_names[joint]}), at most {MOST_ERROR:g} is wanted"
    )
    return [
        judged(
            "excitation",
            float(len(undetermined)),
            bounds["excitation"],
            "the excitation determines every parameter",
            f"the excitation says nothing about {len(undetermined)} parameters "
            f"({_some(undetermined)}): design a motion that moves every joint",
        ),
        judged(
            "parameters",
            sigma,
            MOST_SIGMA,
            f"all {known} parameters were found within {sigma or 0.0:.1f} standard deviations of "
            f"what was planted, {MOST_SIGMA:g} are allowed",
            f"{len(far)} of {known} parameters ({_some(far)}) are more than {asked}, up to "
            f"{sigma:.3g}, from what was planted: the drive train or the model of the cell file is "
            "not that of the arm"
            if sigma is not None
            else "parameters: no parameter has a standard deviation",
        ),
        judged(
            "unseen motion",
            float(ratio[joint]),
            MOST_ERROR,
            error_is,
            f"{error_is}: the excitation teaches too little; search a better one (`hil design`)",
        ),
    ]


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

    See `Campaign.rehearse`. Until something has been recorded in the campaign, changes of its cell
    file are taken in when it is opened; later they are refused. Whatever is edited meanwhile, the
    result is of the cell and plan that were rehearsed, or there is none.

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
        motions = planned_intervals(rehearsal.cell, rehearsal.plan)
        planned = sum(one.trajectory.duration for one in motions)
        link = twin.link(planned, effects=effects, drive=drive)
        failure = _failure(rehearsal, link, twin, reporter, stop)
        seconds += link.cycles * cell.period
        criteria.append(
            judged(
                f"motions ({name})",
                float(bool(failure)),
                0.0,
                f"{name}: every motion ran to its end, none was refused by the guard or tripped",
                f"{name}: {failure}",
            )
        )
        if rehearsal.folder.manifest():
            bound = SATURATED if effects else PLANNED_CURRENT
            criteria.append(of_currents(twin.cell, rehearsal.folder, name, bound))
        if failure:
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


def _failure(rehearsal: Campaign, link: Link, twin: Twin, reporter: Reporter, stop: Stop) -> str:
    """Run what is missing; what went wrong, in words."""
    try:
        rehearsal.run(
            link, stop, reporter, provenance=twin.provenance, durable=False, unrehearsed=True
        )
    except (ControllerFault, RepetitionsRejectedError, SimulationError) as error:
        if stop.requested:
            raise OperatorStopError(
                "the rehearsal was stopped; the recordings remain, rehearse again to go on"
            ) from error
        if isinstance(error, MotionFailedError):
            return error.sentence
        return str(error).rstrip(".")
    return ""


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
