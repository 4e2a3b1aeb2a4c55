"""What a rehearsal is judged by: its motions, currents and estimate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

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
from identification.validation.prediction import pooled_error, prediction_error

from .folder import CampaignFolder
from .oscillation import Oscillation, growing_oscillation
from .twin import Twin

FALSE_ALARM: Final = 1e-3
"""Probability that any estimate of a correct cell file is farther from the truth than allowed."""
MAX_ERROR_RATIO: Final = 1.2
"""Largest error on unseen motion, as a multiple of the simulated parameters' error."""
MAX_SPEED_SHARE: Final = 1.05
"""Largest measured speed, as a share of the limit that a plan keeps; the rest is control error."""
SATURATION_SHARE: Final = 0.99  # Share of the current limit from which a motor is saturated


@dataclass(frozen=True)
class WorstMotion:
    """The motion in which a criterion has its largest value."""

    archive: Path
    joint: int | None = None  #: or motor, from 0
    #: that grows in it: then the control of the simulated arm is at fault, not the motion
    oscillation: Oscillation | None = None


@dataclass(frozen=True)
class CurrentShare:
    """Largest current of any motor, as a share of its limit."""

    run: str
    share: float
    allowed: float
    worst: WorstMotion


@dataclass(frozen=True)
class SpeedShare:
    """Largest speed of any joint in motions that were all completed, as a share of its limit."""

    run: str
    share: float
    worst: WorstMotion


@dataclass(frozen=True)
class FailedMotion:
    """A motion that was not completed."""

    run: str
    failure: str  #: as its error states it
    last: WorstMotion | None  #: the last one that was archived


@dataclass(frozen=True)
class Undetermined:
    """Parameters that the excitation does not determine."""

    parameters: tuple[str, ...]


@dataclass(frozen=True)
class ParameterErrors:
    """Largest error of the determined parameters [standard deviations]."""

    count: int
    largest: float
    parameter: str  #: that has it
    allowed: float


@dataclass(frozen=True)
class UnseenError:
    """Torque error on unseen motion over the true parameters' error, of the worst joint."""

    ratio: float
    joint: int


@dataclass(frozen=True)
class UndeterminedCriterion:
    """A criterion of an identification that failed."""

    criterion: str
    allowed: float
    problem: str  #: as its error states it


Judged = (
    CurrentShare
    | SpeedShare
    | FailedMotion
    | Undetermined
    | ParameterErrors
    | UnseenError
    | UndeterminedCriterion
)


class Judgement(NamedTuple):
    """A criterion's name, value and largest value that passes; no value if undetermined."""

    name: str
    value: float | None
    bound: float

    @property
    def passed(self) -> bool:
        """Whether it is met."""
        return self.value is not None and self.value <= self.bound


def judgement_of(judged: Judged) -> Judgement:
    """Return whether a criterion is met; a value that is not finite is undetermined."""
    match judged:
        case CurrentShare(run, share, allowed):
            return _judgement(f"current ({run})", share, allowed)
        case SpeedShare(run, share):
            return _judgement(f"motions ({run})", float(share > MAX_SPEED_SHARE), 0.0)
        case FailedMotion(run):
            return _judgement(f"motions ({run})", 1.0, 0.0)
        case Undetermined(parameters):
            return _judgement("excitation", float(len(parameters)), 0.0)
        case ParameterErrors(_, largest, _, allowed):
            return _judgement("parameters", largest, allowed)
        case UnseenError(ratio):
            return _judgement("unseen motion", ratio, MAX_ERROR_RATIO)
        case UndeterminedCriterion(name, allowed):
            return Judgement(name, None, allowed)


def _judgement(name: str, value: float, bound: float) -> Judgement:
    return Judgement(name, value if np.isfinite(value) else None, bound)


def of_currents(cell: Cell, folder: CampaignFolder, run: str, bound: float) -> CurrentShare:
    """Judge the largest current of any motor, as a share of its limit.

    The two cycles after a lost packet, in which the controller comes back from its extrapolation to
    the set-points, count only if a motor is saturated.

    Args:
        cell: of the campaign.
        folder: of the rehearsal.
        run: name of the run.
        bound: margin of the motion.
    """
    largest = -1.0
    motor = 0
    where = folder.archives
    limit = cell.drive_train.current_limit
    for entry in folder.manifest():
        columns = open_archive(folder.archives / entry.name).columns
        shares = np.nan_to_num(np.abs(columns["target_current"])) / limit
        after_loss = columns["gap"] > 0
        after_loss[1:] |= after_loss[:-1].copy()
        shares[after_loss[:, None] & (shares <= SATURATION_SHARE)] = 0.0
        share = shares.max(axis=0, initial=0.0)
        if share.max() > largest:
            largest = float(share.max())
            motor = int(share.argmax())
            where = folder.archives / entry.name
    worst = WorstMotion(where, motor, _oscillation(cell, where) if largest > bound else None)
    return CurrentShare(run, largest, bound, worst)


def of_motions(
    cell: Cell, folder: CampaignFolder, run: str, failure: str
) -> SpeedShare | FailedMotion:
    """Judge whether all motions were completed, within the speed limits.

    Args:
        cell: of the campaign.
        folder: of the rehearsal.
        run: name of the run.
        failure: of a motion, as its error states it; "" if there was none.
    """
    paths = [folder.archives / entry.name for entry in folder.manifest()]
    if failure:
        last = WorstMotion(paths[-1], None, _oscillation(cell, paths[-1])) if paths else None
        return FailedMotion(run, failure, last)
    shares = [_speed_shares(cell, path) for path in paths]
    fastest = int(np.argmax([share.max() for share in shares]))
    joint = int(np.argmax(shares[fastest]))
    share = float(shares[fastest][joint])
    path = paths[fastest]
    oscillation = _oscillation(cell, path) if share > MAX_SPEED_SHARE else None
    return SpeedShare(run, share, WorstMotion(path, joint, oscillation))


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


def _oscillation(cell: Cell, path: Path) -> Oscillation | None:
    """Return an oscillation that grows in a motion, None without one."""
    columns = open_archive(path).columns
    error = columns["commanded_position"] - columns["position"]
    error = error[np.isfinite(error).all(axis=1)]
    return growing_oscillation(error, cell.period, _encoder_resolution(cell))


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


def of_estimate(twin: Twin, folder: CampaignFolder, reporter: Reporter) -> list[Judged]:
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
        return [UndeterminedCriterion(name, bound, str(error)) for name, bound in bounds.items()]
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
        Undetermined(undetermined),
        ParameterErrors(int(finite.sum()), float(apart[farthest]), estimate.names[farthest], bound),
        UnseenError(float(ratio[joint]), joint),
    ]
