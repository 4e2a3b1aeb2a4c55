"""Significant changes between campaigns of one arm; see `docs/compare.md`.

The variance of a value is the larger of that of the estimate and that of the repetitions, whose
effective number is n (1 - ρ) / (1 + ρ) (Bayley and Hammersley 1946) with ρ corrected for bias
(Marriott and Pope 1954). Differences are tested by Welch's t test with Holm's procedure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student

from hil.batch import run
from hil.batch.estimates import errors, relative_error
from hil.batch.factors import cell_in, open_ref
from hil.batch.types import ArchiveRef, Arm, LevelEstimate, Unused
from hil.batch.workers import Workers
from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import Options
from hil.identify.sources import arm_differences
from hil.progress import Reporter
from identification import RobotModel

from .payload import Finding, Level, PayloadTrend, freedom_of, payload_findings, payload_trend
from .trend import (
    FALSE_ALARMS,
    LEAST_FRICTION,
    Axis,
    axes_of,
    campaign_names,
    friction_in,
    friction_weights,
)

Array = NDArray[np.float64]

MIN_REPETITIONS: Final = 15
"""Repetitions needed to estimate their correlation. With fewer the effective number is 1, as all
may have been recorded while the arm warmed up."""
CONFIDENCE: Final = 0.95  #: Of each interval
_MAX_CORRELATION: Final = 0.95
_TWO: Final = "give two or more campaigns of one arm"
_SPEED_RATIO: Final = 1.2
"""Ratio of rms speeds above which two campaigns have different motions."""
_SHARE: Final = FALSE_ALARMS / 2.0  # of false alarms, each for friction and for the payload
_MIN_CHANGE: Final = f"{100.0 * LEAST_FRICTION:g} %"
_CAVEAT: Final = (
    "The normal variation from day to day is not known from a few campaigns: friction of a cold arm"
    " is tens of per cent higher. Compare campaigns at the same temperature; `hil reidentify`"
    " compares each of many campaigns with the scatter of the earlier ones."
)


class Figure(NamedTuple):
    """A value of one campaign, its variance and the degrees of freedom of the variance."""

    value: float
    variance: float
    freedom: float


@dataclass(frozen=True, eq=False)
class Tested:
    """Figures (k) of c campaigns tested against the first campaign; NaN if unknown."""

    value: Array  #: (k, c)
    std: Array  #: (k, c)
    change: Array  #: from the first campaign (k, c); as below, NaN for the first
    half: Array  #: half width of the 95 % interval of the change (k, c)
    p_value: Array  #: of no change (k, c), adjusted for multiple tests
    limit: Array  #: detection limit of a change (k, c)
    changed: NDArray[np.bool_]  #: whether the change is significant and relevant (k, c)
    slight: NDArray[np.bool_]  #: whether it is significant, but too small to be relevant (k, c)

    @property
    def shares(self) -> Array:
        """Relative change and the ends of its interval (k, c, 3)."""
        ends = np.stack([self.change, self.change - self.half, self.change + self.half], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(ends / np.abs(self.value[:, :1, None]))


@dataclass(frozen=True, eq=False)
class CampaignSet:
    """Campaigns of one arm."""

    arm: Arm
    campaigns: tuple[
        LevelEstimate, ...
    ]  #: in chronological order if the times of all are known, else as given
    repetitions: tuple[tuple[LevelEstimate, ...], ...]  #: of each campaign
    broken: tuple[Unused, ...]  #: archives that could not be used
    simulated: bool = False


@dataclass(frozen=True, eq=False)
class Comparison:
    """Changes of c campaigns of one arm from the first."""

    arm: str  #: name
    simulated: bool
    dated: bool  #: whether campaigns are in chronological order
    changed: bool  #: whether friction, payload or inertial parameters changed
    verdict: str  #: one line
    findings: tuple[Finding, ...]  #: changes first; never empty
    warnings: tuple[str, ...]  #: about the archives
    campaigns: tuple[LevelEstimate, ...]
    names: tuple[str, ...]  #: of the campaigns, with their days if known
    axes: tuple[Axis, ...]
    friction: Tested  #: of the axes, mean of both directions
    repetitions: tuple[Array, ...]  #: friction of each repetition (m, n), by campaign
    payload: PayloadTrend
    parameters: tuple[str, ...]  #: names, base parameters first
    units: tuple[str, ...]  #: of the parameters
    values: Tested  #: of the parameters
    #: ||e|| / ||tau|| of the model (row) on the validation motions (column) (c, c), NaN without any
    prediction: Array

    @property
    def document(self) -> dict[str, Any]:
        """JSON data, None for unknown values."""
        campaigns = [
            {"folder": one.campaign, "when": one.when or None, "stated": one.setup}
            for one in self.campaigns
        ]
        found: dict[str, Any] = _as_json(vars(self) | {"campaigns": campaigns})
        return found


def _as_json(value: Any) -> Any:
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        return {name: _as_json(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def gather(places: Sequence[str], workers: Workers, reporter: Reporter) -> CampaignSet:
    """Identify campaigns, given as folders or `results.json`, by unregularised least squares.

    Raises:
        InputError: there is only one campaign, or they are of different arms.
    """
    roots = [
        str(Path(place).parent)
        if "://" not in place and Path(place).name == "results.json"
        else place
        for place in places
    ]
    refs: list[ArchiveRef] = []

    def check(found: Sequence[ArchiveRef]) -> None:
        _require_campaigns_of_one_arm(found)
        refs.extend(found)

    result = run.reidentify(roots, Options(estimator="wls"), workers, reporter, check=check)
    campaigns = list(result.campaigns)
    if len(campaigns) < 2:
        reason = "".join(f"; {one.path}: {one.reason}" for one in result.broken[:1])
        only = campaigns[0].campaign if campaigns else None
        raise InputError(only, f"is the only campaign that can be estimated{reason}", remedy=_TWO)
    absolute = [root if "://" in root else Path(root).resolve().as_posix() for root in roots]

    def given_order(one: LevelEstimate) -> int:
        inside = [f"{one.campaign}/".startswith(f"{root}/") for root in absolute]
        return inside.index(True) if any(inside) else len(inside)

    dated = all(one.when for one in campaigns)
    campaigns.sort(key=lambda one: (one.when if dated else "", given_order(one), one.campaign))
    return CampaignSet(
        arm=result.arms[campaigns[0].arm],
        campaigns=tuple(campaigns),
        repetitions=tuple(
            tuple(
                each
                for each in result.repetitions
                if (each.campaign, each.setup) == (one.campaign, one.setup)
            )
            for one in campaigns
        ),
        broken=result.broken,
        simulated=refs[0].simulated,  # as all of one arm
    )


def _require_campaigns_of_one_arm(found: Sequence[ArchiveRef]) -> None:
    campaigns = {ref.key: ref for ref in found if ref.use == "excitation"}
    if not campaigns:
        return  # reidentify raises the error
    first = next(iter(campaigns.values()))
    for one in campaigns.values():
        if one.arm != first.arm:
            here, there = (Arm(ref.arm, _cell(ref)) for ref in (one, first))
            other = ["simulation or the controller's drive train"]
            differing = arm_differences(here.cell, there.cell) or other
            raise InputError(
                one.campaign,
                f"is of another arm ({here.name}) than {first.campaign} ({there.name}): they differ"
                f" in {' and '.join(differing)}",
                remedy="compare campaigns of one arm",
            )
    if len(campaigns) < 2:
        raise InputError(first.campaign, "is the only campaign given", remedy=_TWO)


def _cell(ref: ArchiveRef) -> Cell:
    with open_ref(ref) as archive:
        return cell_in(archive)


def compare_campaigns(gathered: CampaignSet) -> Comparison:
    """Compare the campaigns of one arm with the first of them."""
    model, campaigns = gathered.arm.cell.model, gathered.campaigns
    names = campaign_names(campaigns)
    axes, payload = axes_of(model, campaigns), payload_trend(model, campaigns, _SHARE)
    weights = friction_weights(model, axes)
    repetitions = [
        np.array([friction_in(one, weights)[0] for one in own]).reshape(len(own), model.n_joints)
        for own in gathered.repetitions
    ]
    pooled = [friction_in(one, weights) for one in campaigns]
    size = np.abs(pooled[0][0])
    friction = against_first(_known(campaigns, pooled, repetitions), _SHARE, LEAST_FRICTION * size)
    single = [
        np.array([np.where(np.isfinite(one.std), one.values, np.nan) for one in own])
        for own in gathered.repetitions
    ]
    values = [(one.values, one.std) for one in campaigns]
    prediction = np.full((len(campaigns), len(campaigns)), np.nan)
    for (row, one), (column, motion) in product(enumerate(campaigns), repeat=2):
        # Undetermined parameters may act on the other motion.
        if motion.unseen is not None and np.isfinite(one.std).all():
            left, torque = errors(motion.unseen, one.values)
            prediction[row, column] = relative_error(left, torque, motion.unseen.samples)
    changed = [axes[j].joint for j in np.flatnonzero(friction.changed.any(axis=1))]
    slight = [axes[j].joint for j in np.flatnonzero(friction.slight.any(axis=1))]
    parts = [f"friction of {', '.join(changed)}"] if changed else []
    parts += ["payload"] if any(payload.changed) else []
    parts += ["inertial parameters"] if any(payload.other) else []
    verdict = f"Changed: {'; '.join(parts)}" if parts else "No significant change"
    if slight and not parts:
        verdict = (
            f"No change of {_MIN_CHANGE} or more; friction of {', '.join(slight)} differs by less"
        )
    return Comparison(
        arm=gathered.arm.name,
        simulated=gathered.simulated,
        dated=all(one.when for one in campaigns),
        changed=bool(parts),
        verdict=verdict,
        findings=tuple(_findings(names, axes, friction, payload, prediction)),
        warnings=(*_warnings(model, names, gathered), _CAVEAT),
        campaigns=campaigns,
        names=tuple(names),
        axes=tuple(axes),
        friction=friction,
        repetitions=tuple(repetitions),
        payload=payload,
        parameters=model.parameter_names,
        units=model.units,
        values=against_first(_known(campaigns, values, single), FALSE_ALARMS),
        prediction=prediction,
    )


def _known(
    campaigns: Sequence[LevelEstimate],
    pooled: Sequence[tuple[Array, Array]],
    repetitions: Sequence[Array],
) -> Array:
    """Return `Figure`s (k, c, 3) from values and stds (k,) and single repetitions (m, k)."""
    freedom = [freedom_of(one) for one in campaigns]
    return np.array(
        [
            [
                figure(value[k], std[k] ** 2, free, own[:, k])
                for (value, std), free, own in zip(pooled, freedom, repetitions, strict=True)
            ]
            for k in range(len(pooled[0][0]))
        ]
    )


def _warnings(model: RobotModel, names: Sequence[str], gathered: CampaignSet) -> list[str]:
    campaigns = gathered.campaigns
    found = [f"{path} could not be used: {reason}" for path, reason in gathered.broken]
    for name, own in zip(names, gathered.repetitions, strict=True):
        if len(own) < 2:
            found.append(
                f"{name}: with one repetition, uncertainty includes noise only, not the scatter of"
                " repetitions"
            )
    speeds = np.array([one.speed_rms for one in campaigns], dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        far = np.abs(np.log(speeds / speeds[0])) > math.log(_SPEED_RATIO)
    for k in np.flatnonzero(far.any(axis=1)).tolist():
        fast = ", ".join(model.joint_names[j] for j in np.flatnonzero(far[k]))
        found.append(
            f"{names[k]} has another motion than {names[0]} (rms speed of {fast}): unmodelled"
            " effects may appear as a change"
        )
    each = zip(names, campaigns, strict=True)
    return found + [f"{name}: {warning}" for name, one in each for warning in one.warnings]


# Sentences


def _findings(
    names: list[str],
    axes: Sequence[Axis],
    friction: Tested,
    payload: PayloadTrend,
    prediction: Array,
) -> list[Finding]:
    found = [
        _axis_finding(axes[j], friction, j, k, names)
        for j, k in np.argwhere(friction.changed | friction.slight).tolist()
    ]
    for one in payload_findings(payload, names):
        level: Level = "same" if one.level == "quiet" else "changed"
        found.append(Finding(level, one.words, one.next_step))
    same = []
    tested = np.isfinite(friction.p_value).any(axis=1)
    differs = (friction.changed | friction.slight).any(axis=1)
    if quiet := np.flatnonzero(tested & ~differs).tolist():
        limits = np.nanmax(friction.limit[quiet], axis=1) / np.abs(friction.value[quiet, 0])
        same.append(
            f"Friction of {', '.join(axes[j].joint for j in quiet)} has not changed significantly;"
            f" the detection limit is at most {100.0 * limits.max():.0f} %"
            f" ({axes[quiet[limits.argmax()]].joint})."
        )
    if unknown := np.flatnonzero(~tested).tolist():
        same.append(f"Friction of {', '.join(axes[j].joint for j in unknown)} is not determined.")
    for k in range(1, len(names)):
        own, first = prediction[k, k], prediction[0, k]
        if np.isfinite(first) and own > 0.0:
            same.append(
                f"The model of {names[0]} predicts the validation motions of {names[k]} with"
                f" {first / own:.2g} times the error of that campaign's own model:"
                f" {100.0 * first:.2g} % against {100.0 * own:.2g} % of the torque."
            )
    if payload.untested:
        same.append(f"The payload was not compared: {payload.untested}.")
    elif not any(payload.changed) and not any(payload.other):
        same.append("The payload has not changed significantly.")
    # A stable sort by level: "changed" first.
    return sorted(found + [Finding("same", words) for words in same], key=lambda one: one.level)


def _axis_finding(axis: Axis, friction: Tested, j: int, k: int, names: list[str]) -> Finding:
    """Return the finding about a significant difference of friction."""
    first, value = friction.value[j, [0, k]]
    change, low, high = 100.0 * friction.shares[j, k]
    words = (
        f"{axis.joint}: friction{axis.at} is {abs(change):.1f} %"
        f" {'higher' if change > 0.0 else 'lower'} in {names[k]} than in {names[0]},"
        f" {value:.3g} against {first:.3g} {axis.unit}"
        f" (95 %: {low:+.1f} to {high:+.1f} %)"
    )
    if friction.slight[j, k]:
        return Finding("same", f"{words}: significant, but less than {_MIN_CHANGE}.")
    rise = "Check gear, brake and lubrication of this axis, and whether it was colder."
    fall = "Check whether it was warmer, or gear or lubricant were changed."
    return Finding("changed", f"{words}.", rise if change > 0.0 else fall)


# Statistics


def figure(value: float, variance: float, freedom: float, repetitions: Array) -> Figure:
    """Combine a pooled estimate (variance infinite if undetermined) with repetitions (m,)."""
    if not np.isfinite(variance):
        return Figure(float("nan"), float("nan"), 1.0)
    own = repetitions[np.isfinite(repetitions)]
    if len(own) < 2:
        return Figure(value, variance, freedom)
    count = effective_count(own)
    scatter = float(np.var(own, ddof=1)) / count
    if scatter <= variance:
        return Figure(value, variance, freedom)
    few = len(own) < MIN_REPETITIONS
    return Figure(value, scatter, len(own) - 1.0 if few else max(1.0, count - 1.0))


def effective_count(repetitions: Array) -> float:
    """Return the effective number of independent repetitions (m,), between 1 and m."""
    m = len(repetitions)
    if m < MIN_REPETITIONS:
        return 1.0
    centred = repetitions - repetitions.mean()
    size = float(centred @ centred)
    if size == 0.0:
        return float(m)
    raw = float(centred[:-1] @ centred[1:]) / size
    rho = min(max(raw + (1.0 + 4.0 * raw) / (m - 1), 0.0), _MAX_CORRELATION)
    return max(1.0, m * (1.0 - rho) / (1.0 + rho))


def against_first(figures: ArrayLike, share: float, least: ArrayLike = 0.0) -> Tested:
    """Test all campaigns against the first: a `Figure` per row and campaign (k, c, 3).

    `share` is the family-wise error rate, `least` (k,) the smallest relevant change.
    """
    value, variance, freedom = np.moveaxis(np.asarray(figures, dtype=np.float64), 2, 0)
    change, total = value - value[:, :1], variance + variance[:, :1]
    change[:, 0] = np.nan
    change[~(total > 0.0)] = np.nan
    squares = variance**2 / freedom
    least = np.reshape(least, (-1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.where(np.isfinite(change), total**2 / (squares + squares[:, :1]), np.nan)
        std = np.where(np.isfinite(change), np.sqrt(total), np.nan)
        p_value = holm(2.0 * student.sf(np.abs(change) / std, both))
    tests = max(1, int(np.isfinite(p_value).sum()))
    sure, large = p_value < share, np.abs(change) >= least
    return Tested(
        value=value,
        std=np.sqrt(variance),
        change=change,
        half=student.isf(0.5 - 0.5 * CONFIDENCE, both) * std,
        p_value=p_value,
        # The first step of Holm's procedure is the strictest.
        limit=np.maximum(student.isf(share / tests / 2.0, both) * std, least),
        changed=sure & large,
        slight=sure & ~large,
    )


def holm(p_values: Array) -> Array:
    """Return p values of any shape adjusted for multiple tests (Holm 1979); NaN stays NaN."""
    flat = np.asarray(p_values, dtype=np.float64).ravel()
    adjusted = np.full(flat.shape, np.nan)
    places = np.flatnonzero(np.isfinite(flat))
    order = places[np.argsort(flat[places], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * flat[order]))
    return adjusted.reshape(np.shape(p_values))
