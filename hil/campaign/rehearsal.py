"""Rehearsal: runs the plan of a campaign on a simulated arm close to the nominal one.

Masses, inertias, rotors and friction are varied within `SPREAD` of their nominal values. A cell
without `[simulation]` gets one from `[nominal]` and the defaults below.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
import pinocchio
from numpy.typing import NDArray
from pydantic import StrictBool, model_validator

from drivers.open_mode import MAX_TARGET_JUMP
from drivers.transports.simulated import Delay, Duplicate, Fault, Lose, SimulatedTransport
from hil.archive import open_archive
from hil.archive.recorded_campaign import load_record
from hil.base.errors import InputError
from hil.base.files import write_output
from hil.base.progress import Reporter
from hil.base.terminal_text import typed
from hil.cell import Cell
from hil.control.simulation import (
    controller_settings,
    planted_values,
    simulated_controller,
    simulated_provenance,
)
from hil.control.virtual_link import VirtualLink
from hil.results.results import Frozen
from identification.distributions import normal_limit
from identification.errors import IdentificationError
from identification.signals.recording import RecordingError
from identification.text import percentage
from identification.validation.prediction import pooled_error, prediction_error
from sim_fixtures import ServoSettings, UnmodelledEffects

from .folder import CampaignFolder
from .oscillation import growing_oscillation

Array = NDArray[np.float64]

FORMAT_VERSION: Final = 1
AS_MODELLED: Final = "as modelled"
EFFECTS: Final = "with what the model leaves out"
"""The two runs of a rehearsal."""
CRITERIA: Final = (
    f"motions ({AS_MODELLED})",
    f"current ({AS_MODELLED})",
    "excitation",
    "parameters",
    "unseen motion",
    f"motions ({EFFECTS})",
    f"current ({EFFECTS})",
)
"""All criteria of a rehearsal."""


class Criterion(Frozen):
    """One criterion of a rehearsal."""

    name: str
    value: float | None
    """Null where it could not be determined."""
    bound: float
    """The largest value that passes."""
    passed: StrictBool
    sentence: str


class Rehearsal(Frozen):
    """The rehearsal of one plan."""

    format_version: Literal[1] = FORMAT_VERSION
    plan_hash: str
    """Of cell, URDF and plan as they were rehearsed."""
    seed: int
    """Of the simulated parameters, the noise and the link faults."""
    passed: StrictBool
    criteria: list[Criterion]
    assumed: list[str]
    """Assumed properties of the simulated arm, in sentences."""
    not_seen: list[str]
    """What this rehearsal cannot detect, in sentences."""
    repetitions: int
    motion_seconds: float
    software: dict[str, str]

    @model_validator(mode="after")
    def _judged_by_its_criteria(self) -> Self:
        """Require that it passed if and only if it met every criterion."""
        met = [criterion.name for criterion in self.criteria if criterion.passed]
        if self.passed != (len(met) == len(self.criteria) and set(met) == {*CRITERIA}):
            raise ValueError("passed is not what its criteria say")
        return self

    @classmethod
    def load(cls, folder: CampaignFolder) -> Rehearsal | None:
        """Return the rehearsal of a campaign, of any plan; None without one.

        Raises:
            CampaignFolderError: the file cannot be read.
        """
        remedy = f"rehearse again (`hil rehearse {typed(folder.root)} --again`)"
        return load_record(cls, folder.rehearsal, remedy, strict=False)

    def save(self, path: Path) -> None:
        """Write the file (OutputError if the disk refuses)."""
        write_output(path, self.model_dump_json(indent=1) + "\n")

    @property
    def failures(self) -> tuple[str, ...]:
        """Criteria that were not met, in sentences."""
        return tuple(criterion.sentence for criterion in self.criteria if not criterion.passed)

    @property
    def line(self) -> str:
        """Its result, in one sentence."""
        if self.passed:
            return (
                f"the rehearsal passed all {len(self.criteria)} criteria; what it cannot detect "
                "is in rehearsal.json (not_seen)"
            )
        return f"the rehearsal failed: {'; '.join(self.failures)}"


SPREAD: Final = 0.1  # Largest relative deviation of the simulated parameters from the nominal ones
NOISE_SHARE: Final = 0.005  # Noise of the current, rms, as a share of the weakest motor's limit
RESOLUTION_SHARE: Final = 0.001  # Resolution of the target current, as a share of the same limit
FAULT_EVERY: Final = 3.0  # Mean time between two faults of the link, s
LOOP_CYCLES: Final = 0.5
"""Mean delay of a target current, cycles: it acts over the cycle before the packet."""
RESONANCE: Final = 500.0
"""Resonance of a main axis, rotor against link, rad/s, where the cell has no elasticity."""
FASTEST: Final = 800.0
"""Highest resonance in any posture, rad/s: the simulated arm has steps of 0.5 ms."""
POSTURES: Final = 60  # Postures in which the resonances are computed
MAIN_AXES: Final = 3
SLOWEST_LOOP: Final = 0.002
"""Slowest current loop, s; a slower one makes the simulated arm oscillate."""
_HORIZON: Final = 4.0
"""Period of link faults as a multiple of the motions' duration: moves take time, too."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A simulated arm for a rehearsal.

    Attributes:
        cell: with a simulated controller; its `[simulation]` has the varied parameters.
        truth: simulated parameters (p,) in the order of the model.
        assumed: assumed properties, in sentences.
        seed: of the variation.
    """

    cell: Cell
    truth: Array
    assumed: tuple[str, ...]
    seed: int

    @classmethod
    def of(cls, cell: Cell, *, seed: int, repetitions: int) -> Twin:
        """Return an arm with random parameters for a cell."""
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
        if (sentence := too_far_without_a_packet(twin)) is not None:
            assumed.append(sentence)
        return cls(twin, planted_values(twin), tuple(assumed), seed)

    def link(self, seconds: float, *, effects: bool) -> VirtualLink:
        """Return a link in virtual time to the arm, with random faults."""
        table = self.cell.controller
        # The current loop has the delay of `[controller] current_delay_cycles`.
        lag = (LOOP_CYCLES - table.current_delay_cycles) * self.cell.period
        settings = replace(
            controller_settings(self.cell, effects=effects),
            servo=ServoSettings(current_lag=float(np.clip(lag, 0.0, SLOWEST_LOOP))),
            # `[controller] max_gap` missed packets in a row end no motion.
            missed_replies=table.max_gap + 1,
            while_silent="continue",
        )
        controller = simulated_controller(
            self.cell, settings=settings, effects=effects, seed=self.seed
        )
        faults = link_faults(self.cell, _HORIZON * seconds, self.seed)
        return VirtualLink.over(
            SimulatedTransport(controller, faults), self.cell, finish=controller.finish
        )

    @property
    def provenance(self) -> dict[str, str]:
        """Metadata of a rehearsal's archive, with the simulated parameters."""
        planted = dict(zip(self.cell.model.parameter_names, self.truth.tolist(), strict=True))
        return {
            **simulated_provenance(self.cell, effects=False),
            "rehearsal": "yes",
            "planted": json.dumps(planted),
        }


def link_faults(cell: Cell, seconds: float, seed: int) -> tuple[Fault, ...]:
    """Return single packets doubled, late or, where a motion survives it, lost within `seconds`."""
    rng = np.random.default_rng([seed, 7])
    cycles = round(seconds / cell.period)
    count = max(1, round(seconds / FAULT_EVERY))
    survived = cell.controller.max_gap > 0 and too_far_without_a_packet(cell) is None
    kinds = ["delay", "duplicate", *(["lose"] if survived else [])]
    faults: list[Fault] = []
    # Not in the packets of the start.
    for cycle in sorted(rng.integers(1000, max(1001, cycles), count).tolist()):
        match kinds[rng.integers(len(kinds))]:
            case "delay":
                faults.append(Delay(cycle, cycles=float(rng.uniform(0.1, 0.8))))
            case "duplicate":
                faults.append(Duplicate(cycle))
            case _:
                faults.append(Lose(cycle))
    return tuple(faults)


def too_far_without_a_packet(cell: Cell) -> str | None:
    """Return why a lost packet ends a motion at full speed; None where the motion survives it.

    A controller that extrapolates is then one step ahead of the set-point sent last.
    """
    if not cell.controller.max_gap:
        return None
    share = MAX_TARGET_JUMP * np.array(cell.drive_table.following_error)
    speeds = np.diag(cell.joint_limits.velocity)
    turns = cell.drive_train.motor_revolutions_per_cycle(speeds, cell.period)
    steps = np.abs(turns).sum(axis=0)
    motor = int(np.argmax(steps / share))
    if steps[motor] <= share[motor]:
        return None
    return (
        f"no packet is lost: at full speed the motor of {cell.joint_names[motor]} turns by "
        f"{steps[motor]:.2g} revolutions in a cycle of {cell.controller.cycle_ms} ms; the guard "
        f"allows {share[motor]:.2g} ({percentage(MAX_TARGET_JUMP)} of following_error in "
        "[drive_train]), so "
        "that a packet lost at that speed ends the motion on the real arm; a shorter cycle or a "
        "lower velocity_deg in [limits] avoids this"
    )


def _varied(cell: Cell, rng: np.random.Generator) -> dict[str, list[float]]:
    """Return inertias, rotors and friction varied about those of the URDF and `[nominal]`."""
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
    """Return `[simulation]` of the simulated arm, and what in it is assumed."""
    table: dict[str, Any] = {**planted, "seed": seed}
    assumed = []
    given = cell.file.simulation
    if given is None:
        weakest = min(cell.drive_table.current_limit)
        table["initial_deg"] = cell.campaign.home_deg
        table["current_noise"] = NOISE_SHARE * weakest
        table["current_resolution"] = RESOLUTION_SHARE * weakest
        assumed.append(
            f"the current has a noise of {table['current_noise']:.3g} A rms and a resolution of "
            f"{table['current_resolution']:.3g} A ({percentage(NOISE_SHARE, 1)} and "
            f"{percentage(RESOLUTION_SHARE, 1)} of the weakest motor's limit)"
        )
    if given is None or not (
        given.torque_ripple or given.friction_drift or any(given.elasticity) or given.delay
    ):
        effects = _ordinary_effects(cell, np.array(planted["rotor_inertia"]))
        table |= asdict(effects) | {"elasticity": list(effects.elasticity)}
        assumed.append(
            "effects that the model leaves out have default sizes: torque ripple of "
            f"{percentage(effects.torque_ripple)} of the Coulomb torque, friction that falls by "
            f"{percentage(effects.friction_drift)}, springs in the main axes, "
            f"{1e3 * effects.delay:g} ms "
            "of delay"
        )
    unknown = [key for key in ("rotor_inertia", "coulomb", "viscous") if not any(planted[key])]
    if unknown:
        assumed.append(f"[nominal] has only zeros for {', '.join(unknown)}: so has the arm")
    return table, assumed


def _ordinary_effects(cell: Cell, rotors: Array) -> UnmodelledEffects:
    """Return effects of default sizes, with springs that suit the arm.

    No resonance exceeds `FASTEST` in any of `POSTURES` random postures. Where axes are almost
    parallel, the effective inertia beyond a spring is much below that of its link.
    """
    n = len(rotors)
    limits = cell.joint_limits
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
    root = 1.0 / np.sqrt(compliance[soft])
    fastest = 0.0
    shares = np.random.default_rng(0).random((POSTURES, n))
    for posture in [cell.home, *(limits.lower + shares * (limits.upper - limits.lower))]:
        if soft.any():
            whole = inertia(posture) + np.diag(np.where(soft, 0.0, rotors))
            mobility = np.linalg.inv(whole)[np.ix_(soft, soft)] + np.diag(1.0 / rotors[soft])
            frequency = float(np.linalg.eigvalsh(root[:, None] * mobility * root)[-1])
            fastest = max(fastest, frequency)
    compliance *= max(1.0, float(np.sqrt(fastest)) / FASTEST) ** 2
    return replace(UnmodelledEffects.default_sizes(n), elasticity=tuple(compliance.tolist()))


MOST_SIGMA: Final = 4.0
"""Largest deviation of an estimate from the simulated value, in standard deviations."""
MOST_ERROR: Final = 1.2
"""Largest error on unseen motion, as a multiple of that of the simulated parameters."""
MOST_SPEED: Final = 1.05
"""Largest measured speed, as a share of the limit that a plan keeps; the rest is control error."""
SATURATED: Final = 0.99  # Share of the current limit from which a motor is saturated


def criterion(
    name: str, value: float | None, bound: float, text: str, remedy: str = ""
) -> Criterion:
    """Return a criterion that is met by a finite value up to `bound`; else with a remedy."""
    finite = None if value is None or not np.isfinite(value) else value
    passed = finite is not None and finite <= bound
    sentence = text if passed or not remedy else f"{text}: {remedy}"
    return Criterion(name=name, value=finite, bound=bound, passed=passed, sentence=sentence)


def of_currents(cell: Cell, folder: CampaignFolder, name: str, bound: float) -> Criterion:
    """Judge the largest current of any motor, as a share of its limit.

    The two cycles after a lost packet, in which the controller comes back from its extrapolation to
    the set-points, count only if a motor is saturated: `bound` is the margin of the motion.
    """
    worst = 0.0
    motor = 0
    where = ""
    limit = cell.drive_train.current_limit
    for entry in folder.manifest():
        columns = open_archive(folder.archives / entry.name).columns
        shares = np.nan_to_num(np.abs(columns["target_current"])) / limit
        after_loss = columns["gap"] > 0
        after_loss[1:] |= after_loss[:-1].copy()
        shares[after_loss[:, None] & (shares <= SATURATED)] = 0.0
        share = shares.max(axis=0, initial=0.0)
        if share.max() > worst:
            worst = float(share.max())
            motor = int(share.argmax())
            where = entry.name
    return criterion(
        f"current ({name})",
        worst,
        bound,
        f"{name}: the largest current is {percentage(worst)} of its limit (motor of "
        f"{cell.joint_names[motor]}, {where}), at most {percentage(bound)} is allowed",
        _motion_remedy(
            cell,
            name,
            folder.archives / where,
            motor,
            "lower acceleration_deg in [limits] of the cell file, and design again",
        ),
    )


_CORRECT = (
    "correct the cause, by [limits] or [drive_train] of the cell file, or what the simulated arm"
    " is made from ([nominal], [controller], [simulation])"
)


def of_motions(cell: Cell, folder: CampaignFolder, name: str, failure: str) -> Criterion:
    """Judge whether all motions were completed (`failure` is ""), within the speed limits."""
    entries = folder.manifest()
    if failure:
        place = folder.archives / entries[-1].name if entries else None
        remedy = "" if place is None else _motion_remedy(cell, name, place, None, _CORRECT)
        text = f"{name}: {failure}"
        return criterion(f"motions ({name})", 1.0, 0.0, text, remedy)
    shares = [_speed_shares(cell, folder.archives / entry.name) for entry in entries]
    fastest = int(np.argmax([share.max() for share in shares]))
    joint = int(np.argmax(shares[fastest]))
    share = float(shares[fastest][joint])
    where = entries[fastest].name
    if share <= MOST_SPEED:
        text = f"{name}: every motion was completed, at up to {percentage(share)} of a speed limit"
        return criterion(f"motions ({name})", 0.0, 0.0, text)
    return criterion(
        f"motions ({name})",
        1.0,
        0.0,
        f"{name}: {cell.joint_names[joint]} moved at {percentage(share)} of its speed limit "
        f"({where}), at most {percentage(MOST_SPEED)} is allowed",
        _motion_remedy(
            cell,
            name,
            folder.archives / where,
            joint,
            "lower velocity_deg in [limits] of the cell file, and design again",
        ),
    )


def _speed_shares(cell: Cell, path: Path) -> Array:
    """Return the largest measured speed of each joint over its limit (n,).

    Two encoder counts between two packets may be noise and do not count.
    """
    columns = open_archive(path).columns
    noise = 2.0 * _encoder_resolution(cell)
    cycles = np.diff(columns["cycle"].astype(np.float64))[:, np.newaxis]
    steps = np.maximum(np.abs(np.diff(columns["position"], axis=0)) - noise, 0.0)
    speeds = np.divide(
        steps,
        cell.period * cycles,
        out=np.zeros_like(steps),
        where=np.isfinite(steps) & (cycles > 0),
    )
    shares: Array = speeds.max(axis=0, initial=0.0) / cell.joint_limits.velocity
    return shares


def _encoder_resolution(cell: Cell) -> Array:
    """Return the motion of each joint (n,) [rad] in an encoder count of all its motors."""
    count = 2.0 * np.pi / cell.drive_table.encoder_counts_per_revolution
    return np.asarray(count * np.abs(cell.drive_train.joint_from_motor).sum(axis=1))


def _motion_remedy(cell: Cell, name: str, path: Path, joint: int | None, remedy: str) -> str:
    """Return what to do about a motion of the run `name`, and the command that plots it.

    An oscillation that grows has another cause than the motion: `remedy` does not apply to it.
    """
    causes = "current_delay_cycles in [controller]"
    if name == EFFECTS:
        causes = "delay and elasticity in [simulation]"
    columns = open_archive(path).columns
    error = columns["commanded_position"] - columns["position"]
    error = error[np.isfinite(error).all(axis=1)]
    oscillation = growing_oscillation(error, cell.period, _encoder_resolution(cell))
    if oscillation is not None:
        joint = oscillation.joint
        remedy = (
            f"{oscillation.sentence(cell.joint_names)}: the control of the simulated arm is "
            f"unstable, the motion is not at fault; correct {causes} or rotor_inertia in [nominal] "
            "of the cell file"
        )
    command = ["hil", "plot", str(path)]
    if joint is not None:
        command += ["--joint", cell.joint_names[joint]]
    return f"{remedy}; see `{shlex.join(command)}`"


def of_estimate(twin: Twin, folder: CampaignFolder, reporter: Reporter) -> list[Criterion]:
    """Judge an identification from the archives: determined, correct, predictive."""
    # Slow to import, and not needed by those who read a rehearsal.
    from hil.pipeline.estimating import estimate_with
    from hil.pipeline.options import FIXED
    from hil.pipeline.prepared import prepare_sources
    from hil.pipeline.sources import gather_sources

    bounds = {"excitation": 0.0, "parameters": MOST_SIGMA, "unseen motion": MOST_ERROR}
    kinds = ("excitation", "validation", "standstill")
    paths = [path for kind in kinds for path in folder.completed(kind)]
    try:
        prepared = prepare_sources(gather_sources(paths, FIXED.split), FIXED, reporter)
        estimation = estimate_with(prepared, FIXED, reporter)
    except (InputError, IdentificationError, RecordingError) as error:
        problem = f"cannot be determined: the identification failed ({error})"
        return [
            criterion(name, None, bound, f"{name}: {problem}") for name, bound in bounds.items()
        ]
    model = twin.cell.model
    estimate = estimation.result.pooled
    undetermined = estimate.undetermined
    deviation = estimate.interval_factor / normal_limit(0.025) * estimate.std
    apart = np.abs(estimate.values - twin.truth) / deviation
    finite = np.isfinite(apart)
    farthest = int(np.argmax(np.where(finite, apart, 0.0)))
    ours, theirs = (
        pooled_error(prediction_error(model, values, prepared.held_out)).rms
        for values in (estimate.values, twin.truth)
    )
    ratio = ours / np.maximum(theirs, np.finfo(np.float64).tiny)
    joint = int(np.argmax(np.where(np.isfinite(ratio), ratio, np.inf)))
    return [
        criterion(
            "excitation",
            float(len(undetermined)),
            bounds["excitation"],
            f"parameters not determined by the excitation: {', '.join(undetermined) or 'none'}",
            "design a motion that moves every joint",
        ),
        criterion(
            "parameters",
            float(apart[farthest]),
            MOST_SIGMA,
            f"the errors of {finite.sum()} parameters are at most {apart[farthest]:.3g} standard "
            f"deviations ({estimate.names[farthest]}), {MOST_SIGMA:g} are allowed",
            "the drive train or the model of the cell file is not that of the arm",
        ),
        criterion(
            "unseen motion",
            float(ratio[joint]),
            MOST_ERROR,
            f"on unseen motion the torque error is {ratio[joint]:.2f} times what noise leaves "
            f"({twin.cell.joint_names[joint]}), at most {MOST_ERROR:g} is allowed",
            "design a better excitation (`hil design`)",
        ),
    ]
