"""What a rehearsal is judged by: its motions, currents and estimate."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

import numpy as np

from hil.archive import open_archive
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.progress import Reporter
from hil.cell import Cell
from hil.pipeline.estimating import estimate_with
from hil.pipeline.options import FIXED
from hil.pipeline.prepared import prepare_sources
from hil.pipeline.sources import gather_sources
from identification.distributions import NORMAL_95, student_freedom, student_limit
from identification.errors import IdentificationError
from identification.signals.recording import RecordingError
from identification.text import percentage
from identification.validation.prediction import pooled_error, prediction_error

from .folder import CampaignFolder
from .oscillation import growing_oscillation
from .rehearsal_record import EFFECTS, RehearsalCriterion
from .twin import Twin

FALSE_ALARM: Final = 1e-3
"""Probability that any estimate of a correct cell file is farther from the truth than allowed."""
MAX_ERROR_RATIO: Final = 1.2
"""Largest error on unseen motion, as a multiple of the simulated parameters' error."""
MAX_SPEED_SHARE: Final = 1.05
"""Largest measured speed, as a share of the limit that a plan keeps; the rest is control error."""
SATURATION_SHARE: Final = 0.99  # Share of the current limit from which a motor is saturated


def criterion(
    name: str, value: float | None, bound: float, text: str, remedy: str = ""
) -> RehearsalCriterion:
    """Return a criterion that is met by a finite value up to a bound; else with a remedy.

    Args:
        name: of the criterion.
        value: that is judged.
        bound: largest value.
        text: what the value is.
        remedy: where it is not met.
    """
    finite = None if value is None or not np.isfinite(value) else value
    passed = finite is not None and finite <= bound
    sentence = text if passed or not remedy else f"{text}: {remedy}"
    return RehearsalCriterion(
        name=name, value=finite, bound=bound, passed=passed, sentence=sentence
    )


def of_currents(cell: Cell, folder: CampaignFolder, name: str, bound: float) -> RehearsalCriterion:
    """Judge the largest current of any motor, as a share of its limit.

    The two cycles after a lost packet, in which the controller comes back from its extrapolation to
    the set-points, count only if a motor is saturated.

    Args:
        cell: of the campaign.
        folder: of the rehearsal.
        name: of the criterion.
        bound: margin of the motion.
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
        shares[after_loss[:, None] & (shares <= SATURATION_SHARE)] = 0.0
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
    "correct the cause, by [limits] or [drive_train] of the cell file, or the tables of the "
    "simulated arm ([nominal], [controller], [simulation])"
)


def of_motions(cell: Cell, folder: CampaignFolder, name: str, failure: str) -> RehearsalCriterion:
    """Judge whether all motions were completed, within the speed limits.

    Args:
        cell: of the campaign.
        folder: of the rehearsal.
        name: of the criterion.
        failure: of a motion; "" if there was none.
    """
    entries = folder.manifest()
    if failure:
        path = folder.archives / entries[-1].name if entries else None
        remedy = "" if path is None else _motion_remedy(cell, name, path, None, _CORRECT)
        text = f"{name}: {failure}"
        return criterion(f"motions ({name})", 1.0, 0.0, text, remedy)
    shares = [_speed_shares(cell, folder.archives / entry.name) for entry in entries]
    fastest = int(np.argmax([share.max() for share in shares]))
    joint = int(np.argmax(shares[fastest]))
    share = float(shares[fastest][joint])
    where = entries[fastest].name
    if share <= MAX_SPEED_SHARE:
        text = f"{name}: every motion was completed, at up to {percentage(share)} of a speed limit"
        return criterion(f"motions ({name})", 0.0, 0.0, text)
    return criterion(
        f"motions ({name})",
        1.0,
        0.0,
        f"{name}: {cell.joint_names[joint]} moved at {percentage(share)} of its speed limit "
        f"({where}), at most {percentage(MAX_SPEED_SHARE)} is allowed",
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


def largest_deviation(count: int, interval_factor: float = NORMAL_95) -> float:
    """Return the deviation that any of some estimates exceeds with probability `FALSE_ALARM`.

    In standard deviations, 1.96 of which are half a 95 % interval: a quantile of Student's t for
    the two sides of each estimate (Bonferroni), since the variance is estimated, too.

    Args:
        count: of the estimates.
        interval_factor: of the `Estimate`, which has the degrees of freedom of its variance.
    """
    freedom = student_freedom(0.025, interval_factor)
    quantile = float(student_limit(FALSE_ALARM / (2.0 * max(1, count)), freedom))
    return quantile * NORMAL_95 / interval_factor


def of_estimate(twin: Twin, folder: CampaignFolder, reporter: Reporter) -> list[RehearsalCriterion]:
    """Judge an identification from the archives: determined, correct, predictive."""
    bounds = {
        "excitation": 0.0,
        "parameters": largest_deviation(twin.cell.model.n_parameters),
        "unseen motion": MAX_ERROR_RATIO,
    }
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
    deviation = estimate.interval_factor / NORMAL_95 * estimate.std
    apart = np.abs(estimate.values - twin.truth) / deviation
    finite = np.isfinite(apart)
    farthest = int(np.argmax(np.where(finite, apart, 0.0)))
    bound = largest_deviation(int(finite.sum()), estimate.interval_factor)
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
            bound,
            f"the errors of {finite.sum()} parameters are at most {apart[farthest]:.3g} standard "
            f"deviations ({estimate.names[farthest]}), {bound:.3g} are allowed",
            "drive train or model in the cell file do not match the arm, or, just above the limit, "
            "by chance: `--again --seed 2` shows which",
        ),
        criterion(
            "unseen motion",
            float(ratio[joint]),
            MAX_ERROR_RATIO,
            f"on unseen motion the torque error is {ratio[joint]:.2f} times what noise leaves "
            f"({twin.cell.joint_names[joint]}), at most {MAX_ERROR_RATIO:g} is allowed",
            "design a better excitation (`hil design`)",
        ),
    ]
