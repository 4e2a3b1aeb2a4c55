"""Campaigns of one arm, and what changed from one to another; the rules are in `docs/compare.md`.

A campaign's variance of a figure is the larger of that of its estimate and that of its repetitions,
of which n correlated by ρ are worth n (1 - ρ) / (1 + ρ) (Bayley and Hammersley 1946), ρ corrected
for bias (Marriott and Pope 1954). Differences: Welch's t, all together by Holm's procedure.
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
    short_names,
)

Array = NDArray[np.float64]

FEWEST: Final = 15
"""Repetitions without which their correlation cannot be estimated. A campaign of fewer is assumed
to be known no better than one of them is: they may all have been made while the arm warmed up."""
CONFIDENCE: Final = 0.95  #: Of intervals, each by itself
_HIGHEST: Final = 0.95
_TWO: Final = "name two campaigns or more of one arm"
_OTHER_SPEED: Final = 1.2
"""Ratio of typical speeds from which two campaigns count as having moved differently."""
_SHARE: Final = FALSE_ALARMS / 2.0  # of comparisons, each for friction and for the payload
_LEAST: Final = f"{100.0 * LEAST_FRICTION:g} %"
_CAVEAT: Final = (
    "A few campaigns do not show how much this arm differs from day to day without anything having "
    "happened to it: a cold arm has tens of per cent more friction. Compare campaigns of an arm "
    "that was equally warm; `hil reidentify` judges each of many by the scatter of those before."
)


class Known(NamedTuple):
    """A figure of one campaign: value, its variance, and degrees of freedom of the variance."""

    value: float
    variance: float
    freedom: float


@dataclass(frozen=True, eq=False)
class Tested:
    """Figures (k) of c campaigns, all others tested against the first; NaN where not known."""

    value: Array  #: (k, c)
    std: Array  #: (k, c)
    change: Array  #: against the first campaign (k, c); NaN of the first itself, as the next ones
    half: Array  #: of the 95 % interval of the change (k, c)
    p_value: Array  #: of no change (k, c), adjusted for all figures and campaigns
    limit: Array  #: smallest change that would count (k, c)
    #: whether the change is more than chance and large enough to count (k, c)
    changed: NDArray[np.bool_]
    slight: NDArray[np.bool_]  #: whether it is more than chance and not large enough (k, c)

    @property
    def shares(self) -> Array:
        """Change and the ends of its interval as shares of the first campaign's value (k, c, 3)."""
        ends = np.stack([self.change, self.change - self.half, self.change + self.half], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(ends / np.abs(self.value[:, :1, None]))


@dataclass(frozen=True, eq=False)
class Gathered:
    """Campaigns of one arm, in order of time; in the order given where not all have one (`dated`).

    `repetitions` are those of each campaign in order, `broken` what could not be used.
    """

    arm: Arm
    campaigns: tuple[LevelEstimate, ...]
    repetitions: tuple[tuple[LevelEstimate, ...], ...]
    dated: bool
    broken: tuple[Unused, ...]
    simulated: bool = False


@dataclass(frozen=True, eq=False)
class Comparison:
    """What changed over the c campaigns of one arm, compared with the first of them."""

    arm: str  #: its name
    simulated: bool  #: whether no robot moved
    dated: bool  #: whether campaigns are in order of time
    changed: bool  #: whether friction, payload or inertial parameters have
    verdict: str  #: one line
    findings: tuple[Finding, ...]  #: everything in sentences, what changed first; never empty
    warnings: tuple[str, ...]  #: what a reader must know of the archives
    campaigns: tuple[LevelEstimate, ...]  #: in order
    names: tuple[str, ...]  #: of the campaigns, with their days if known
    axes: tuple[Axis, ...]  #: of the arm
    friction: Tested  #: of the axes, mean of both directions
    #: friction by each single repetition, campaign by campaign (m, n)
    repetitions: tuple[Array, ...]
    payload: PayloadTrend  #: of the last link
    parameters: tuple[str, ...]  #: names of the parameters, base parameters first
    units: tuple[str, ...]  #: of the parameters
    values: Tested  #: of the parameters, tested
    #: ||e|| / ||tau|| of the model by row on the validation motions by column (c, c), NaN without
    #: one
    prediction: Array

    @property
    def document(self) -> dict[str, Any]:
        """Everything for a script: lists, None for what is not known."""
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


def gather(places: Sequence[str], workers: Workers, reporter: Reporter) -> Gathered:
    """Identify the campaigns below some places, and check that they can be compared.

    By least squares, which draw no change towards anything.

    The `results.json` of a campaign stands for its folder.

    Raises:
        InputError: there is one campaign only, or campaigns are of different arms.
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
        why = "".join(f"; {one.path}: {one.reason}" for one in result.broken[:1])
        only = campaigns[0].campaign if campaigns else None
        raise InputError(only, f"is the only campaign that can be estimated{why}", remedy=_TWO)
    absolute = [f"{_absolute(root)}/" for root in roots]

    def named(one: LevelEstimate) -> tuple[int, str]:
        """Sorts campaigns as their places were named."""
        own = f"{_absolute(one.campaign)}/"
        found = [k for k, root in enumerate(absolute) if own.startswith(root)]
        return found[0] if found else len(absolute), own

    dated = all(one.when for one in campaigns)
    campaigns.sort(key=lambda one: (one.when if dated else "", *named(one)))
    own = {(one.campaign, one.setup): list[LevelEstimate]() for one in campaigns}
    for rep in result.repetitions:
        own.get((rep.campaign, rep.setup), []).append(rep)
    return Gathered(
        arm=result.arms[campaigns[0].arm],
        campaigns=tuple(campaigns),
        repetitions=tuple(tuple(one) for one in own.values()),
        dated=dated,
        broken=result.broken,
        simulated=refs[0].simulated,  # as all of one arm
    )


def _absolute(place: str) -> str:
    return place if "://" in place else Path(place).resolve().as_posix()


def _require_campaigns_of_one_arm(found: Sequence[ArchiveRef]) -> None:
    """Another arm has its own friction and mass, and one campaign has nothing beside it."""
    of = {ref.key: ref for ref in found if ref.use == "excitation"}
    if not of:
        return  # and that is refused
    first = next(iter(of.values()))
    for one in of.values():
        if one.arm != first.arm:
            here, there = (Arm(ref.arm, _cell(ref)) for ref in (one, first))
            why = "one of them is a simulation, or their controllers state other drives"
            if differing := arm_differences(here.cell, there.cell):
                why = f"they differ in {' and '.join(differing)}"
            raise InputError(
                one.campaign,
                f"is of another arm ({here.name}) than {first.campaign} ({there.name}): {why}",
                remedy="compare campaigns of one arm",
            )
    if len(of) < 2:
        raise InputError(first.campaign, "is the only campaign that was named", remedy=_TWO)


def _cell(ref: ArchiveRef) -> Cell:
    with open_ref(ref) as archive:
        return cell_in(archive)


def compare_campaigns(gathered: Gathered) -> Comparison:
    """Compare the campaigns of one arm with the first of them."""
    model, campaigns = gathered.arm.cell.model, gathered.campaigns
    names = campaign_names(campaigns, days=gathered.dated)
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
        # What a model cannot know may be needed there.
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
        verdict = f"No change of {_LEAST} or more; friction of {', '.join(slight)} differs by less"
    return Comparison(
        arm=gathered.arm.name,
        simulated=gathered.simulated,
        dated=gathered.dated,
        changed=bool(parts),
        verdict=verdict,
        findings=tuple(_findings(names, axes, friction, payload, prediction)),
        warnings=(*_warnings(model, gathered), _CAVEAT),
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
    """Figures (k, c, 3): values and standard deviations (k,), single repetitions (m, k)."""
    freedom = [freedom_of(one) for one in campaigns]
    return np.array(
        [
            [
                known(value[k], std[k] ** 2, free, own[:, k])
                for (value, std), free, own in zip(pooled, freedom, repetitions, strict=True)
            ]
            for k in range(len(pooled[0][0]))
        ]
    )


def _warnings(model: RobotModel, gathered: Gathered) -> list[str]:
    """What a reader must know: lost archives, few repetitions, other motions."""
    campaigns = gathered.campaigns
    names = short_names([one.campaign for one in campaigns])
    lost = zip(short_names([one.path for one in gathered.broken]), gathered.broken, strict=True)
    found = [f"{name} could not be used: {one.reason}" for name, one in lost]
    single = [name for name, own in zip(names, gathered.repetitions, strict=True) if len(own) < 2]
    if single:
        found.append(
            f"{', '.join(single)}: one repetition, so what repetitions differ by is not known, and "
            "only noise is allowed for"
        )
    first = campaigns[0].speed_rms
    for name, one in zip(names[1:], campaigns[1:], strict=True):
        if first is None or one.speed_rms is None:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            far = np.abs(np.log(one.speed_rms / first)) > math.log(_OTHER_SPEED)
        if far.any():
            fast = ", ".join(model.joint_names[j] for j in np.flatnonzero(far))
            found.append(
                f"{name} moved differently from {names[0]} (typical speed of {fast}): what the"
                " model leaves out can then look like a change"
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
    """What changed first, then what did not, or by little, or is not known."""
    found = [
        _axis_finding(axes[j], friction, j, k, names)
        for j, k in np.argwhere(friction.changed | friction.slight).tolist()
    ]
    for one in payload_findings(payload, names):
        level: Level = "same" if one.level == "quiet" else "changed"
        found.append(Finding(level, one.words, one.next_step))
    same = []
    known_at_all = np.isfinite(friction.p_value).any(axis=1)
    differs = (friction.changed | friction.slight).any(axis=1)
    if quiet := np.flatnonzero(known_at_all & ~differs).tolist():
        limits = np.nanmax(friction.limit[quiet], axis=1) / np.abs(friction.value[quiet, 0])
        same.append(
            f"Friction of {', '.join(axes[j].joint for j in quiet)} has not changed significantly;"
            f" the detection limit is at most {100.0 * limits.max():.0f} %"
            f" ({axes[quiet[limits.argmax()]].joint})."
        )
    if unknown := np.flatnonzero(~known_at_all).tolist():
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
        same.append(f"Whether it carries the same was not tested: {payload.untested}.")
    elif not any(payload.changed) and not any(payload.other):
        same.append("The payload has not changed significantly.")
    # Stable: "changed" comes first.
    return sorted(found + [Finding("same", words) for words in same], key=lambda one: one.level)


def _axis_finding(axis: Axis, friction: Tested, j: int, k: int, names: list[str]) -> Finding:
    """A difference of friction that is more than chance; less than a change where it is slight."""
    first, value = friction.value[j, [0, k]]
    change, low, high = 100.0 * friction.shares[j, k]
    words = (
        f"{axis.joint}: friction{axis.at} is {abs(change):.1f} %"
        f" {'higher' if change > 0.0 else 'lower'} in {names[k]} than in {names[0]},"
        f" {value:.3g} against {first:.3g} {axis.unit}"
        f" (95 %: {low:+.1f} to {high:+.1f} %)"
    )
    if friction.slight[j, k]:
        less = f"more than chance, and less than the {_LEAST} that count as a change"
        return Finding("same", f"{words}: {less}.")
    colder = "Check this axis' gear, brake and lubrication; was it colder?"
    warmer = "Was it warmer, or has gear or lubricant been changed?"
    return Finding("changed", f"{words}.", colder if change > 0.0 else warmer)


# Statistics


def known(value: float, variance: float, freedom: float, repetitions: Array) -> Known:
    """A figure from its estimate and from the estimates of single repetitions.

    The variance is that of the estimate's covariance, infinite if undetermined, with its degrees of
    freedom; the repetitions (m,) are in order, NaN where one does not determine the figure.
    """
    if not np.isfinite(variance):
        return Known(float("nan"), float("nan"), 1.0)
    own = repetitions[np.isfinite(repetitions)]
    if len(own) < 2:
        return Known(value, variance, freedom)
    worth = effective_count(own)
    scatter = float(np.var(own, ddof=1)) / worth
    if scatter <= variance:
        return Known(value, variance, freedom)
    return Known(value, scatter, len(own) - 1.0 if len(own) < FEWEST else max(1.0, worth - 1.0))


def effective_count(repetitions: Array) -> float:
    """How many independent repetitions these (m,) are worth, between 1 and m."""
    m = len(repetitions)
    if m < FEWEST:
        return 1.0
    centred = repetitions - repetitions.mean()
    size = float(centred @ centred)
    if size == 0.0:
        return float(m)
    raw = float(centred[:-1] @ centred[1:]) / size
    rho = min(max(raw + (1.0 + 4.0 * raw) / (m - 1), 0.0), _HIGHEST)
    return max(1.0, m * (1.0 - rho) / (1.0 + rho))


def against_first(figures: ArrayLike, share: float, least: ArrayLike = 0.0) -> Tested:
    """Test all campaigns but the first against it.

    Args:
        figures: a :class:`Known` for each figure and campaign (k, c, 3).
        share: of cases in which any of the tests finds a change where there is none.
        least: smallest change of each figure that counts (k,).
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
        # What Holm's procedure asks of the first of all tests.
        limit=np.maximum(student.isf(share / tests / 2.0, both) * std, least),
        changed=sure & large,
        slight=sure & ~large,
    )


def holm(p_values: Array) -> Array:
    """P values adjusted for all of them being looked at (Holm 1979); NaN stays NaN, any shape."""
    flat = np.asarray(p_values, dtype=np.float64).ravel()
    adjusted = np.full(flat.shape, np.nan)
    places = np.flatnonzero(np.isfinite(flat))
    order = places[np.argsort(flat[places], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * flat[order]))
    return adjusted.reshape(np.shape(p_values))
