"""Parameters that differ significantly between campaigns of one arm; see `docs/batch.md`.

The variance of a value is the larger of that of the estimate and that of the repetitions, whose
effective number is n (1 - ρ) / (1 + ρ) (Bayley and Hammersley 1946) with ρ corrected for bias
(Marriott and Pope 1954). Differences are tested by Welch's t test with Holm's procedure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os.path import commonpath
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import scipy

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.progress import Reporter
from hil.batch import graph as run
from hil.batch.archive_discovery import ArchiveRef, Discovery, cell_in, open_ref
from hil.batch.cluster import Cluster
from hil.batch.estimates import BatchArm, BatchEstimate
from hil.pipeline.notes import Note
from hil.pipeline.options import Options
from hil.pipeline.sources import arm_differences
from identification import RobotModel
from identification.distributions import student_limit, student_tail
from identification.factor.estimate import Estimate

from .notes import (
    CampaignName,
    OfCampaign,
    OtherSetups,
    SingleRepetition,
    UnknownDailyVariation,
    UnusableArchive,
)

MIN_REPETITIONS: Final = 15
"""Repetitions needed to estimate their correlation. With fewer the effective number is 1, as all
may have been recorded while the arm warmed up."""
CONFIDENCE: Final = 0.95  #: Of each interval
FALSE_ALARM_RATE: Final = 0.01
"""Probability of any change where there is none: of an arm, or in a fleet at one time of asking."""
MIN_RELATIVE_CHANGE: Final = 0.05  #: Smallest relevant change, as a share of the first value
FRICTION_SPEEDS: Final = np.geomspace(0.02, 5.0, 40)  # rad/s or m/s
_MAX_CORRELATION: Final = 0.95
_NORMAL_95: Final = float(student_limit(0.025, 1e6))
_TWO: Final = "give two or more campaigns of one arm"


class Figure(NamedTuple):
    """A value of one campaign, its variance and the degrees of freedom of the variance."""

    value: float
    variance: float
    freedom: float


class ComparedQuantity(NamedTuple):
    """What is compared: an inertial parameter, or the friction of an axis."""

    name: str
    axis: str  #: joint; "" if it is none of one axis
    kind: str  #: "friction" or "inertia"
    unit: str
    weights: Array  #: (p,); its product with the parameters is the value


@dataclass(frozen=True)
class QuantityChange:
    """A quantity in a campaign against the first one; NaN if unknown."""

    parameter: str
    axis: str  #: joint; "" if it is none of one axis
    kind: str  #: "friction" or "inertia"
    unit: str
    campaign: CampaignName
    before: float
    before_std: float
    after: float
    after_std: float
    change: float
    half: float  #: half width of the 95 % interval of the change
    p_value: float  #: of no change, adjusted for all quantities and campaigns
    changed: (
        bool  #: whether it is significant and at least `MIN_RELATIVE_CHANGE` of the first value
    )

    @property
    def relative_half(self) -> float:
        """Half width of the interval, as a share of the first value; NaN without one."""
        return self.half / abs(self.before) if self.before else math.nan


@dataclass(frozen=True, eq=False)
class ArmComparison:
    """Changes of the campaigns of one arm from the first."""

    arm: str  #: name
    simulated: bool
    dated: bool  #: whether campaigns are in chronological order
    campaigns: tuple[BatchEstimate, ...]
    names: tuple[CampaignName, ...]  #: of the campaigns
    changes: tuple[QuantityChange, ...]  #: of all quantities, by campaign
    warnings: tuple[Note, ...]

    @property
    def changed(self) -> tuple[QuantityChange, ...]:
        """Significant and relevant changes."""
        return tuple(change for change in self.changes if change.changed)

    @property
    def known_friction(self) -> tuple[QuantityChange, ...]:
        """Changes of friction with an interval, the narrowest in relation to the friction first."""
        known = (
            change
            for change in self.changes
            if change.kind == "friction" and math.isfinite(change.relative_half)
        )
        return tuple(sorted(known, key=lambda change: change.relative_half))


def compare(places: Sequence[str], cluster: Cluster, reporter: Reporter) -> ArmComparison:
    """Identify campaigns, given as folders or `results.json`, by unregularised least squares.

    They are compared in chronological order if the times of all are known, else as given.

    Raises:
        InputError: there is only one campaign, or they are of different arms.
    """
    paths = [Path(place) for place in places]
    roots = [path.parent if path.name == "results.json" else path for path in paths]
    refs: list[ArchiveRef] = []

    def check(discovery: Discovery) -> None:
        _require_campaigns_of_one_arm(discovery)
        refs.extend(discovery.refs)

    options = Options(estimator="wls")
    result = run.reidentify([str(root) for root in roots], options, cluster, reporter, check=check)
    campaigns = list(result.campaigns)
    if len(campaigns) < 2:
        reason = "".join(f"; {unused.path}: {unused.reason}" for unused in result.broken[:1])
        only = campaigns[0].campaign if campaigns else None
        raise InputError(only, f"is the only campaign that can be estimated{reason}", remedy=_TWO)
    given = [root.resolve() for root in roots]

    def order(campaign: BatchEstimate) -> tuple[str, int, str]:
        campaign_path = Path(campaign.campaign)
        inside = [campaign_path.is_relative_to(root) for root in given]
        return (
            campaign.when if dated else "",
            inside.index(True) if any(inside) else 0,
            campaign.campaign,
        )

    dated = all(campaign.when for campaign in campaigns)
    campaigns.sort(key=order)
    repetitions = [
        [
            each
            for each in result.repetitions
            if (each.campaign, each.setup) == (campaign.campaign, campaign.setup)
        ]
        for campaign in campaigns
    ]
    comparison = compare_campaigns(result.arms[campaigns[0].arm], campaigns, repetitions)
    lost = map(UnusableArchive, result.broken)
    # All archives of an arm are simulated, or none.
    return replace(comparison, simulated=refs[0].simulated, warnings=(*lost, *comparison.warnings))


def _require_campaigns_of_one_arm(discovery: Discovery) -> None:
    campaigns = {ref.key: ref for ref in discovery.refs if ref.use == "excitation"}
    if not campaigns:
        return  # reidentify raises the error
    first = next(iter(campaigns.values()))
    for campaign in campaigns.values():
        if campaign.arm != first.arm:
            here, there = (BatchArm(ref.arm, cell_in(open_ref(ref))) for ref in (campaign, first))
            other = ["simulation or the controller's drive train"]
            differing = arm_differences(here.cell, there.cell) or other
            raise InputError(
                campaign.campaign,
                f"belongs to another arm ({here.name}) than {first.campaign} ({there.name}): they"
                f" differ in {' and '.join(differing)}",
                remedy="compare campaigns of one arm",
            )
    if len(campaigns) < 2:
        unused = [
            f", as {each.path} {each.message}"
            for each in discovery.skipped
            if each.copy_of and not Path(each.path).is_relative_to(first.campaign)
        ]
        unused += [f"; {each.path}: {each.reason}" for each in discovery.broken]
        problem = f"is the only campaign given{unused[0] if unused else ''}"
        raise InputError(first.campaign, problem, remedy=_TWO)


def compare_campaigns(
    arm: BatchArm,
    campaigns: Sequence[BatchEstimate],
    repetitions: Sequence[Sequence[BatchEstimate]],
) -> ArmComparison:
    """Compare the parameters of campaigns of one arm, with their repetitions, with the first."""
    names = _names(campaigns)
    compared = quantities(arm.cell.model, campaigns[0])
    pairs = zip(campaigns, repetitions, strict=True)
    figures = np.array([_figures(compared, *pair) for pair in pairs])
    value, variance, _ = np.moveaxis(figures, 2, 0)
    change, half, p_value = against_first(figures)
    std = np.sqrt(variance)
    changes = tuple(
        QuantityChange(
            parameter=quantity.name,
            axis=quantity.axis,
            kind=quantity.kind,
            unit=quantity.unit,
            campaign=names[c],
            before=float(value[0, k]),
            before_std=float(std[0, k]),
            after=float(value[c, k]),
            after_std=float(std[c, k]),
            change=float(change[c, k]),
            half=float(half[c, k]),
            p_value=float(p_value[c, k]),
            changed=bool(
                p_value[c, k] < FALSE_ALARM_RATE
                and abs(change[c, k]) >= MIN_RELATIVE_CHANGE * abs(value[0, k])
            ),
        )
        for c in range(1, len(campaigns))
        for k, quantity in enumerate(compared)
    )
    return ArmComparison(
        arm=arm.name,
        simulated=False,
        dated=all(campaign.when for campaign in campaigns),
        campaigns=tuple(campaigns),
        names=names,
        changes=changes,
        warnings=tuple(_notes(names, campaigns, repetitions)),
    )


def quantities(model: RobotModel, first: BatchEstimate) -> list[ComparedQuantity]:
    """Return what is compared: all parameters but friction, and the friction of each axis.

    That is the mean of both directions at the speed at which the first campaign determines it best:
    single coefficients are correlated, and their changes much less certain.
    """
    layout = model.layout
    joints = model.joint_names
    terms = model.friction.terms
    columns = [(*links, *layout.rotors[j : j + 1]) for j, links in enumerate(layout.links)]
    axes = {layout.names[k]: joints[j] for j, places in enumerate(columns) for k in places}
    rank = model.base.rank
    single = np.eye(model.n_parameters)
    rows = [*range(rank), *range(rank + len(terms), model.n_parameters)]
    names = model.parameter_names
    units = model.units
    compared = [
        ComparedQuantity(names[k], axes.get(names[k], ""), "inertia", units[k], single[k])
        for k in rows
    ]
    table = friction_weights(model, FRICTION_SPEEDS)
    for j, (joint, turns) in enumerate(zip(joints, model.chain.revolute, strict=True)):
        if not table[:, j].any():
            continue
        value, variance = projected(first.estimate, table[:, j])
        with np.errstate(divide="ignore", invalid="ignore"):
            best = int(np.argmax(np.nan_to_num(np.abs(value) / np.sqrt(variance))))
        unit, speed = ("N·m", "rad/s") if turns else ("N", "m/s")
        name = f"friction of {joint} at {FRICTION_SPEEDS[best]:.2g} {speed}"
        compared.append(ComparedQuantity(name, joint, "friction", unit, table[best, j]))
    return compared


def friction_weights(model: RobotModel, speeds: Array) -> Array:
    """Return weights (s, n, p) that give the friction of each joint, mean of both directions.

    The `speeds` (s,) are in rad/s or m/s and not negative; at 0 it is that of a joint that begins
    to move.
    """
    rank = model.base.rank
    weights = np.zeros((len(speeds), model.n_joints, model.n_parameters))
    for k, term in enumerate(model.friction.terms):
        forwards, backwards = (
            term.term.column(sign * speeds, np.full(len(speeds), sign)) for sign in (1.0, -1.0)
        )
        weights[:, term.owner, rank + k] = 0.5 * (forwards - backwards)
    return weights


def projected(estimate: Estimate, weights: Array) -> tuple[Array, Array]:
    """Return values and variances (k,) of weighted sums (k, p) of parameters; NaN if unknown."""
    covariance = estimate.covariance
    determinable = np.isfinite(estimate.std)
    determined = ~weights[:, ~determinable].any(axis=1)
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    variance = np.einsum("kp,pq,kq->k", weights, finite, weights)
    value = np.where(determined, weights @ estimate.values, np.nan)
    return value, np.where(determined, variance, np.nan)


def _names(campaigns: Sequence[BatchEstimate]) -> tuple[CampaignName, ...]:
    """Return names of campaigns: folder below the common one, setup if ambiguous, and day."""
    folders = [campaign.campaign for campaign in campaigns]
    shared = commonpath([Path(folder).parent for folder in folders])
    return tuple(
        CampaignName(
            str(Path(campaign.campaign).relative_to(shared)),
            campaign.setup if folders.count(campaign.campaign) > 1 else None,
            campaign.when[:10],
        )
        for campaign in campaigns
    )


def _notes(
    names: Sequence[CampaignName],
    campaigns: Sequence[BatchEstimate],
    repetitions: Sequence[Sequence[BatchEstimate]],
) -> Iterator[Note]:
    """Yield what limits a comparison of campaigns with these names."""
    setups = dict(zip(names, (campaign.setup for campaign in campaigns), strict=True))
    if len(set(setups.values())) > 1:
        yield OtherSetups(tuple(setups.items()))
    for name, estimates in zip(names, repetitions, strict=True):
        if len(estimates) < 2:
            yield SingleRepetition(name)
    for name, campaign in zip(names, campaigns, strict=True):
        yield from (OfCampaign(name, note) for note in campaign.warnings)
    yield UnknownDailyVariation()


# Statistics


def freedom_of(level: BatchEstimate) -> float:
    """Return the degrees of freedom of the covariance, from the Student factor of its intervals."""
    factor = level.estimate.interval_factor
    if factor <= _NORMAL_95:
        return 1e6
    return float(
        scipy.optimize.brentq(lambda freedom: student_limit(0.025, freedom) - factor, 0.5, 1.1e6)
    )


def _figures(
    compared: Sequence[ComparedQuantity],
    campaign: BatchEstimate,
    repetitions: Sequence[BatchEstimate],
) -> list[Figure]:
    """Return the figure of each quantity of a campaign."""
    weights = np.array([each.weights for each in compared])
    freedom = freedom_of(campaign)
    singles = np.array([projected(each.estimate, weights)[0] for each in repetitions])
    columns = singles.reshape(len(repetitions), len(compared)).T
    rows = zip(*projected(campaign.estimate, weights), columns, strict=True)
    return [
        figure(float(value), float(variance), freedom, column) for value, variance, column in rows
    ]


def figure(value: float, variance: float, freedom: float, repetitions: Array) -> Figure:
    """Combine a pooled estimate with repetitions.

    Args:
        value: pooled.
        variance: of it, NaN if undetermined.
        freedom: degrees of freedom.
        repetitions: values (m,).
    """
    if not np.isfinite(variance):
        return Figure(math.nan, math.nan, 1.0)
    finite = repetitions[np.isfinite(repetitions)]
    if len(finite) < 2:
        return Figure(value, variance, freedom)
    count = effective_count(finite)
    scatter = float(np.var(finite, ddof=1)) / count
    if scatter <= variance:
        return Figure(value, variance, freedom)
    few = len(finite) < MIN_REPETITIONS
    return Figure(value, scatter, len(finite) - 1.0 if few else max(1.0, count - 1.0))


def effective_count(repetitions: Array) -> float:
    """Return the effective number of independent repetitions (m,), between 1 and m."""
    m = len(repetitions)
    if m < MIN_REPETITIONS:
        return 1.0
    centred = repetitions - repetitions.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return float(m)
    raw = float(centred[:-1] @ centred[1:]) / power
    rho = min(max(raw + (1.0 + 4.0 * raw) / (m - 1), 0.0), _MAX_CORRELATION)
    return max(1.0, m * (1.0 - rho) / (1.0 + rho))


def against_first(figures: Array) -> tuple[Array, Array, Array]:
    """Test all campaigns against the first: a `Figure` per campaign and parameter (c, k, 3).

    Returns the changes, half widths of their intervals and adjusted p values, (c, k) each; NaN for
    the first campaign, and where unknown.
    """
    value, variance, freedom = np.moveaxis(figures, 2, 0)
    change = value - value[0]
    total = variance + variance[0]
    change[0] = np.nan
    change[~(total > 0.0)] = np.nan
    squares = variance**2 / freedom
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.where(np.isfinite(change), total**2 / (squares + squares[0]), np.nan)
        std = np.where(np.isfinite(change), np.sqrt(total), np.nan)
        p_value = holm(2.0 * student_tail(np.abs(change) / std, both))
    return change, student_limit(0.5 - 0.5 * CONFIDENCE, both) * std, p_value


def holm(p_values: Array) -> Array:
    """Return p values of any shape adjusted for multiple tests (Holm 1979); NaN stays NaN."""
    flat = np.asarray(p_values, dtype=np.float64).ravel()
    adjusted = np.full(flat.shape, np.nan)
    places = np.flatnonzero(np.isfinite(flat))
    order = places[np.argsort(flat[places], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * flat[order]))
    return adjusted.reshape(np.shape(p_values))
