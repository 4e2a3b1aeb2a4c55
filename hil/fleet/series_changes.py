"""Changes of one quantity over time, in the series of robots of one type.

A series is a level, steps and slopes that begin at some time, an effect of covariates, and noise
from one recording to the next. What robots of one type have in common is estimated from all of
them: the noise, its correlation from one recording to the next, the effect of covariates (with its
spread between robots, DerSimonian and Laird 1986, always from the siblings of a robot), and what
moves all of them at once, as a season does. The begin of a change is that of the greatest
likelihood; its p value is Student's for this one, times the number of begins that were tried.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from identification.distributions import fisher_tail, student_limit, student_tail

Kind = Literal["step", "slope"]

MIN_RECORDINGS: Final = 4
"""Recordings below which a series has no model."""
MIN_ON_EACH_SIDE: Final = 2
"""Recordings on either side of a change, and between two: one alone may be an outlier."""
MIN_SIBLINGS: Final = 4
"""Other robots from which on their common course is subtracted."""
_MAX_CHANGES: Final = 3
_NOISE_ROUNDS: Final = 3  # of models and noise
_BEGIN_STEP_MONTHS: Final = 0.25  # of a month, between begins of a slope that are tried
_OUTLIER_SIGMAS: Final = 4.0  # times the median deviation
_NORMAL_MAD: Final = 0.6745
# recordings as which the noise of the type counts in addition to a robot's own
_TYPE_NOISE_RECORDINGS: Final = 10.0
_MAX_CORRELATION: Final = 0.9
# twice the log-likelihood within which a begin is in its 95 % interval
_CHI_SQUARE_95: Final = 3.84
_MIN_FRICTION_SHARE: Final = 0.1  # of all friction, that heat and season leave
_YEAR_MONTHS: Final = 12.0  # months
# of the whole time, that a robot was there for what all have in common
_MIN_PRESENT_SHARE: Final = 0.8
_MAX_ENTRY_P_VALUE: Final = 1e-3  # p value of one series from which on a change enters its model
# likewise without any one recording, which may be an outlier
_MAX_P_VALUE_WITHOUT_ONE: Final = 0.01


@dataclass(frozen=True, eq=False)
class Series:
    """One quantity of one robot, in order of time.

    Attributes:
        time: of each recording (m,) [months].
        value: relative to the first months (m,).
        variance: of the values, by the recordings alone (m,).
        covariates: such as temperatures (m, c), NaN where unknown.
    """

    time: Array
    value: Array
    variance: Array
    covariates: Array


class ShapeOfChange(NamedTuple):
    """A step at a time, or a slope that begins there [months]."""

    kind: Kind
    begin: float


@dataclass(frozen=True, eq=False)
class SeriesChange:
    """One change in a series.

    Attributes:
        shape: what it is, and when it begins.
        size: of the step, or a month of the slope.
        size_std: its standard deviation.
        earliest, latest: ends of the 95 % interval of its begin [months].
    """

    shape: ShapeOfChange
    size: float
    size_std: float
    earliest: float
    latest: float


@dataclass(frozen=True, eq=False)
class Course:
    """The model of a series.

    Attributes:
        adjusted: values without what covariates and all robots together explain (m,).
        std: standard deviation of each value, from one recording to the next (m,).
        fitted: adjusted values by the model (m,).
        changes: in order of time.
        p_value: of no change at all, for this series alone.
        change, half: of the last value from the level before all changes, and half of its 95 %
            interval.
        rate, rate_half: a month, at the end, likewise.
        level: before all changes.
        effects: of the covariates (c,), for one unit.
        freedom: degrees of freedom of the noise.
        unadjusted_p: the p value if neither covariates nor what moves all robots at once are taken
            into account.
        unadjusted_largest: the largest departure, likewise.
    """

    adjusted: Array
    std: Array
    fitted: Array
    changes: tuple[SeriesChange, ...]
    p_value: float
    change: float
    half: float
    rate: float
    rate_half: float
    level: float
    effects: Array
    freedom: float
    unadjusted_p: float = 1.0
    unadjusted_largest: float = 0.0

    @property
    def largest(self) -> float:
        """The largest departure from the level before all changes."""
        return float(np.max(np.abs(self.fitted - self.level), initial=0.0))


class _Prior(NamedTuple):
    """Of the effects of covariates: mean (c,) and information (c, c)."""

    mean: Array
    information: Array


class _Noise(NamedTuple):
    """Of all series: variance from day to day, correlation of successive values, freedom."""

    day: float
    correlation: float
    freedom: float


def courses(family: Sequence[Series]) -> list[Course | None]:
    """Return the model of each series of robots of one type; None for a series too short."""
    without, priors = _without_effects(family)
    known = [prior.mean for prior in priors]
    rest = [prior._replace(mean=np.zeros_like(prior.mean)) for prior in priors]
    found, noise = _fitted(_without_common(without), rest)
    adjusted: list[Course | None] = []
    for each, course, mean in zip(family, found, known, strict=True):
        if course is None:
            adjusted.append(None)
            continue
        # Without covariates, and without what all robots have in common.
        alone = replace(each, covariates=each.covariates[:, :0])
        unadjusted = _model(alone, _flat(0), noise)
        adjusted.append(
            replace(
                course,
                effects=course.effects + mean,
                unadjusted_p=unadjusted.p_value,
                unadjusted_largest=_largest(alone, unadjusted),
            )
        )
    return adjusted


class CommonCourse(NamedTuple):
    """The common course of robots of one type, and its model with a yearly season."""

    series: Series
    course: Course


def common_course(family: Sequence[Series]) -> CommonCourse | None:
    """Return the common course of the robots that were present all the time.

    A year's season, a sine of any phase, is taken into account. None for fewer robots than show
    what they have in common, and before a year has passed: a season is none until then.
    """
    without, _ = _without_effects(family)
    if not without:
        return None
    begin = min(float(each.time[0]) for each in without)
    end = max(float(each.time[-1]) for each in without)
    lasting = [
        each
        for each in without
        if each.time[-1] - each.time[0] >= _MIN_PRESENT_SHARE * (end - begin)
        and len(each.time) >= MIN_RECORDINGS
    ]
    if len(lasting) <= MIN_SIBLINGS or end - begin < _YEAR_MONTHS:
        return None
    time = max(lasting, key=lambda each: len(each.time)).time
    value, variance, count = _median_of([(each, each.value) for each in lasting], time)
    measured = float(np.mean(np.concatenate([each.variance for each in lasting])))
    enough = count > MIN_SIBLINGS
    angle = 2.0 * np.pi * time[enough] / _YEAR_MONTHS
    season = np.column_stack([np.cos(angle), np.sin(angle)])
    variance = variance[enough] + 0.5 * np.pi * measured / count[enough]
    series = Series(time[enough], value[enough], variance, season)
    (course,) = courses([series])
    return None if course is None else CommonCourse(series, course)


def _without_effects(family: Sequence[Series]) -> tuple[list[Series], list[_Prior]]:
    """Return series without what siblings say of the effects of covariates, and these effects.

    The covariates of these series are deviations from the mean of the robot. Where one is unknown
    it is 0, and what it might explain counts as variance.
    """
    priors = _effects(family)
    centred = [each.covariates - mean_of_known(each.covariates) for each in family]
    squares = sum(np.nansum(each**2, axis=0) for each in centred)
    counts = sum(np.isfinite(each).sum(axis=0) for each in centred)
    scatter = squares / np.maximum(counts, 1)
    without = []
    for each, prior, columns in zip(family, priors, centred, strict=True):
        known = np.nan_to_num(columns)
        unknown = np.isnan(columns) @ (prior.mean**2 * scatter)
        # Heat and season act on the friction that there is, which may have doubled.
        value = (1.0 + each.value) * np.exp(-known @ prior.mean) - 1.0
        variance = each.variance + unknown
        without.append(Series(each.time, value, variance, known))
    return without, priors


def mean_of_known(columns: Array) -> Array:
    """Return the means (c,) of the known values of columns (m, c), 0 without any."""
    counts = np.isfinite(columns).sum(axis=0)
    return np.asarray(np.nansum(columns, axis=0) / np.maximum(counts, 1))


def _divided(value: Array, effect: Array) -> Array:
    """Return relative values (m,) without an effect by which they were multiplied."""
    return (1.0 + value) / np.maximum(1.0 + effect, _MIN_FRICTION_SHARE) - 1.0


def _fitted(
    family: Sequence[Series], priors: Sequence[_Prior]
) -> tuple[list[Course | None], _Noise]:
    """Fit all series with one noise, which is estimated from what their models leave."""
    noise = _noise_of_steps(family)
    long = [len(series.time) >= MIN_RECORDINGS for series in family]
    pairs = [(s, prior) for s, prior, use in zip(family, priors, long, strict=True) if use]
    models: list[_Model] = []
    for number in range(_NOISE_ROUNDS):
        models = [_model(series, prior, noise) for series, prior in pairs]
        if number < _NOISE_ROUNDS - 1:
            noise = _noise_of_residuals(pairs, models, noise)
    found = iter(
        [_described(*pair, model, noise) for pair, model in zip(pairs, models, strict=True)]
    )
    return [next(found) if use else None for use in long], noise


# What robots have in common


def _flat(count: int) -> _Prior:
    return _Prior(np.zeros(count), np.zeros((count, count)))


def _effects(family: Sequence[Series]) -> list[_Prior]:
    """Return for each series what its siblings say of the effects of covariates.

    From differences of successive recordings, in which a step is one and a slope little.
    """
    count = family[0].covariates.shape[1] if family else 0
    if not count:
        return [_flat(0) for _ in family]
    steps = [_steps(each) for each in family]
    value = np.concatenate([y for y, _ in steps])
    columns = np.concatenate([x for _, x in steps])
    effect, within = _common_effect(value, columns)
    variance = (
        float(np.mean((value[within] - columns[within] @ effect) ** 2)) if within.any() else 0.0
    )
    bounds = np.cumsum([0, *(len(y) for y, _ in steps)])
    rows = [np.flatnonzero(within[a:b]) + a for a, b in pairwise(bounds)]
    information = np.array([columns[k].T @ columns[k] for k in rows])
    products = np.array([columns[k].T @ value[k] for k in rows])
    spread = _spread(information, products, effect, variance)
    priors = []
    for number in range(len(family)):
        others = np.delete(np.arange(len(family)), number)
        known = information[others].sum(axis=0)
        if np.linalg.matrix_rank(known) < count or variance <= 0.0:
            priors.append(_flat(count))
            continue
        mean = np.linalg.solve(known, products[others].sum(axis=0))
        covariance = variance * np.linalg.inv(known) + np.diag(spread)
        information_of_siblings = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        priors.append(_Prior(mean, information_of_siblings))
    return priors


def unexplained(family: Sequence[Series]) -> float:
    """Return the mean of the steps of values that an effect of the covariates leaves."""
    steps = [_steps(each) for each in family]
    value = np.concatenate([y for y, _ in steps])
    columns = np.concatenate([x for _, x in steps])
    effect, _ = _common_effect(value, columns)
    return float(np.mean(np.abs(value - columns @ effect))) if len(value) else 0.0


def _common_effect(value: Array, columns: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the effect of columns (m, c) on steps (m,), and which of these are no outliers."""
    within = np.ones(len(value), dtype=bool)
    effect: Array = np.zeros(columns.shape[1])
    for _ in range(5 if len(value) else 0):
        effect = np.asarray(np.linalg.lstsq(columns[within], value[within], rcond=None)[0])
        residual = np.abs(value - columns @ effect)
        within = residual <= _OUTLIER_SIGMAS * np.median(residual) / _NORMAL_MAD
    return effect, within


def _steps(series: Series) -> tuple[Array, Array]:
    """Return steps of the logarithm of values (m - 1,) and of covariates, where all are known."""
    known = np.isfinite(series.covariates).all(axis=1)
    value = np.log(np.maximum(1.0 + series.value[known], _MIN_FRICTION_SHARE))
    return np.diff(value), np.diff(series.covariates[known], axis=0)


def _spread(information: Array, products: Array, effect: Array, variance: float) -> Array:
    """Return the variance of each effect between robots (c,), by moments."""
    count = len(effect)
    spread = np.zeros(count)
    for k in range(count):
        weights = information[:, k, k] / variance if variance > 0.0 else np.zeros(len(information))
        usable = weights > 0.0
        if np.count_nonzero(usable) < 3:
            continue
        weights = weights[usable]
        rest = products[usable, k] - information[usable, k] @ effect
        own = rest / information[usable, k, k]  # of the robot, from the common effect
        excess = float(weights @ own**2) - (len(own) - 1)
        total = weights.sum() - float(weights @ weights) / weights.sum()
        spread[k] = max(0.0, excess / total)
    return spread


def _without_common(family: Sequence[Series]) -> list[Series]:
    """Divide each series by the median course of its siblings, and add its variance."""
    if len(family) <= MIN_SIBLINGS:
        return list(family)
    rest = [_divided(each.value, np.full(1, np.median(each.value))) for each in family]
    subtracted = []
    for number, each in enumerate(family):
        others = [
            (other, rest[k])
            for k, other in enumerate(family)
            if k != number and len(other.time) >= MIN_RECORDINGS
        ]
        common, variance, count = _median_of(others, each.time)
        common = np.where(count >= MIN_SIBLINGS, common, 0.0)
        variance = np.where(count >= MIN_SIBLINGS, variance, 0.0)
        subtracted.append(
            replace(
                each,
                value=_divided(each.value, common),
                variance=each.variance / np.maximum(1.0 + common, _MIN_FRICTION_SHARE) ** 2
                + variance,
            )
        )
    return subtracted


def _median_of(
    robots: Sequence[tuple[Series, Array]], time: Array
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return at some times (m,) the median of values of robots, its variance, and their number."""
    values = np.array([_at(time, each.time, value) for each, value in robots])
    values = values.reshape(len(robots), len(time))
    count = np.isfinite(values).sum(axis=0)
    median = np.zeros(len(time))
    variance = np.zeros(len(time))
    if (some := count > 0).any():
        shown = values[:, some]
        median[some] = np.nanmedian(shown, axis=0)
        deviation = np.nanmedian(np.abs(shown - median[some]), axis=0) / _NORMAL_MAD
        variance[some] = 0.5 * np.pi * deviation**2 / count[some]
    return median, variance, count


def _at(time: Array, known: Array, values: Array) -> Array:
    """Return values at other times (m,), NaN where no known one is within a month."""
    found = np.interp(time, known, values)
    nearest = np.min(np.abs(time[:, None] - known[None, :]), axis=1)
    return np.where(nearest <= 1.0, found, np.nan)


def scattered(family: Sequence[Series]) -> list[Series]:
    """Return series with the variance of values that scatter by a share of themselves.

    As errors of torque do. The share is that of all of them, by the second differences of their
    logarithms.
    """
    logs = [np.log(np.maximum(1.0 + each.value, _MIN_FRICTION_SHARE)) for each in family]
    every = np.concatenate([*(np.diff(each, n=2) for each in logs), np.empty(0)])
    share = float(np.median(np.abs(every))) / _NORMAL_MAD / math.sqrt(6.0) if len(every) else 0.0
    return [
        replace(each, variance=each.variance + (share * (1.0 + each.value)) ** 2) for each in family
    ]


def _noise_of_steps(family: Sequence[Series]) -> _Noise:
    """Return the noise by the median of second differences, which slopes and steps hardly move."""
    steps = [np.diff(each.value, n=2) for each in family]
    every = np.concatenate([*steps, np.empty(0)])
    if not len(every):
        return _Noise(0.0, 0.0, 1.0)
    deviation = float(np.median(np.abs(every))) / _NORMAL_MAD / math.sqrt(6.0)
    measured = float(np.mean(np.concatenate([each.variance for each in family])))
    return _Noise(max(0.0, deviation**2 - measured), 0.0, max(1.0, float(len(every))))


def _noise_of_residuals(
    pairs: Sequence[tuple[Series, _Prior]], models: Sequence[_Model], before: _Noise
) -> _Noise:
    """Return the noise of what the models leave, and the correlation of successive residuals."""
    squares = 0.0
    measured = 0.0
    products = 0.0
    freedom = 0.0
    count = 0
    pieces = 0
    residuals = []
    for (series, prior), model in zip(pairs, models, strict=True):
        coefficients, _, design = _solved(series, prior, model.weights, model.changes)
        residuals.append((series, series.value - design @ coefficients, len(model.changes)))
    if not residuals:
        return before
    every = np.concatenate([rest for _, rest, _ in residuals])
    limit = _OUTLIER_SIGMAS * float(np.median(np.abs(every))) / _NORMAL_MAD
    for series, rest, changes in residuals:
        clipped = np.clip(rest, -limit, limit) if limit > 0.0 else rest
        squares += float(clipped @ clipped)
        products += float(clipped[:-1] @ clipped[1:])
        used = 1 + 2 * changes + (series.covariates.shape[1] if len(pairs) < 2 else 0)
        freedom += max(0.0, len(rest) - used)
        measured += float(series.variance.sum())
        count += len(rest)
        pieces += 1 + changes
    freedom = max(1.0, freedom)
    total = squares / freedom
    day = max(0.0, total - measured / count)
    # A fitted level leaves residuals with a correlation of -1 / m.
    raw = products / squares if squares > 0.0 else 0.0
    correlation = raw + pieces / count * (1.0 + max(raw, 0.0))
    correlation = min(max(correlation, 0.0), _MAX_CORRELATION)
    if correlation < 2.0 / np.sqrt(count):
        correlation = 0.0
    return _Noise(day, correlation, freedom)


# One series


class _Model(NamedTuple):
    """Changes of a series, of the `candidates`: weights of its values (m,), p value of none."""

    weights: Array
    changes: tuple[ShapeOfChange, ...]
    candidates: Sequence[ShapeOfChange]
    p_value: float


def _model(series: Series, prior: _Prior, noise: _Noise) -> _Model:
    """Add the likeliest change, then the next, while they are significant."""
    time = series.time
    candidates = _candidates(time)
    variance = noise.day + series.variance
    variance = np.maximum(variance, 1e-12 + 1e-6 * float(np.median(series.value**2)))
    scale = _own_scale(series, prior, variance, candidates)
    inflation = (1.0 + noise.correlation) / (1.0 - noise.correlation) * scale
    weights = 1.0 / (variance * inflation)
    chosen: list[ShapeOfChange] = []
    p_value = 1.0
    while len(chosen) < _MAX_CHANGES:
        apart = _apart(series.time, candidates, chosen)
        best, statistic = _likeliest(series, prior, weights, chosen, apart)
        if best is None:
            break
        single = 2.0 * float(student_tail(abs(statistic), noise.freedom))
        p = min(1.0, len(candidates) * single)
        added = [best]
        if not chosen:
            # Wear until a repair is two changes, of which neither explains much alone.
            pair, p_of_pair = _likeliest_pair(series, prior, weights, candidates, noise.freedom)
            if p_of_pair < p and p > _MAX_ENTRY_P_VALUE:
                added = pair
            p_value = p = min(1.0, 2.0 * min(p, p_of_pair))
        if p > _MAX_ENTRY_P_VALUE:
            break
        without = _p_without_one(series, prior, weights, chosen, added, noise.freedom)
        if without > _MAX_P_VALUE_WITHOUT_ONE:
            p_value = p_value if chosen else max(p_value, without)
            break
        chosen = _refined(series, prior, weights, [*chosen, *added], candidates)
    return _Model(weights, tuple(chosen), candidates, p_value)


def _largest(series: Series, model: _Model) -> float:
    """Return the largest departure from the level before all changes, without covariates."""
    coefficients, _, _ = _solved(series, _flat(0), model.weights, model.changes)
    departures = _columns(model.changes, series.time) @ coefficients[1:]
    return float(np.max(np.abs(departures), initial=0.0))


def _candidates(time: Array) -> list[ShapeOfChange]:
    """Return the candidate changes: steps between recordings, slopes also inside the intervals."""
    distinct = np.unique(time)
    if len(distinct) < 2 * MIN_ON_EACH_SIDE:
        return []
    middles = 0.5 * (distinct[:-1] + distinct[1:])
    steps = middles[MIN_ON_EACH_SIDE - 1 : len(middles) - MIN_ON_EACH_SIDE + 1]
    last = distinct[-MIN_ON_EACH_SIDE - 1]
    begins = np.arange(
        distinct[0], last + 1e-9, max(_BEGIN_STEP_MONTHS, (last - distinct[0]) / 200.0)
    )
    slopes = [ShapeOfChange("slope", float(begin)) for begin in begins]
    return [*(ShapeOfChange("step", float(begin)) for begin in steps), *slopes]


def _p_without_one(
    series: Series,
    prior: _Prior,
    weights: Array,
    chosen: Sequence[ShapeOfChange],
    added: Sequence[ShapeOfChange],
    freedom: float,
) -> float:
    """Return the p value of changes without the recording that they most depend on."""
    others = weights * (1.0 - np.eye(len(weights)))
    before = _misfits(series, prior, others, _design(series, chosen))
    gains = before - _misfits(series, prior, others, _design(series, [*chosen, *added]))
    return float(fisher_tail(max(0.0, gains.min()) / len(added), len(added), freedom))


def _apart(
    time: Array, candidates: Sequence[ShapeOfChange], chosen: Sequence[ShapeOfChange]
) -> list[ShapeOfChange]:
    """Return the changes at least `MIN_ON_EACH_SIDE` recordings away from the chosen ones."""
    if not chosen:
        return list(candidates)
    near = np.any(_near(time, candidates, chosen), axis=1)
    return [candidates[k] for k in np.flatnonzero(~near).tolist()]


def _near(
    time: Array, shapes: Sequence[ShapeOfChange], others: Sequence[ShapeOfChange]
) -> NDArray[np.bool_]:
    """Return whether fewer than `MIN_ON_EACH_SIDE` recordings separate changes and others (s, o).

    Two so near together can be as large as one outlier asks for.
    """
    distinct = np.unique(time)
    first = np.searchsorted(distinct, [shape.begin for shape in shapes], side="right")
    second = np.searchsorted(distinct, [shape.begin for shape in others], side="right")
    return np.asarray(np.abs(first[:, None] - second[None, :]) < MIN_ON_EACH_SIDE)


def _design(series: Series, chosen: Sequence[ShapeOfChange]) -> Array:
    """Return the columns of the level, the covariates and the changes (m, 1 + c + k)."""
    level = np.ones((len(series.time), 1))
    return np.concatenate([level, series.covariates, _columns(chosen, series.time)], axis=1)


def _columns(shapes: Sequence[ShapeOfChange], time: Array) -> Array:
    """Return the effect of a unit of each change (m, k): 1, or 1 a month."""
    begins = np.array([shape.begin for shape in shapes])
    steps = np.array([shape.kind == "step" for shape in shapes], dtype=bool)
    since = time[:, None] - begins
    return np.asarray(np.where(steps, since > 0.0, np.maximum(since, 0.0)), dtype=np.float64)


def _solved(
    series: Series, prior: _Prior, weights: Array, chosen: Sequence[ShapeOfChange]
) -> tuple[Array, Array, Array]:
    """Return coefficients, their covariance, and the design of a model."""
    design = _design(series, chosen)
    normal = design.T @ (weights[:, None] * design)
    right = design.T @ (weights * series.value)
    count = len(prior.mean)
    normal[1 : 1 + count, 1 : 1 + count] += prior.information
    right[1 : 1 + count] += prior.information @ prior.mean
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True), dtype=np.float64)
    return covariance @ right, covariance, design


def _likeliest(
    series: Series,
    prior: _Prior,
    weights: Array,
    chosen: Sequence[ShapeOfChange],
    candidates: Sequence[ShapeOfChange],
) -> tuple[ShapeOfChange | None, float]:
    """Return the candidate that explains most in addition to the chosen ones, and its statistic."""
    if not candidates:
        return None, 0.0
    coefficients, covariance, design = _solved(series, prior, weights, chosen)
    rest = series.value - design @ coefficients
    columns = _columns(candidates, series.time)
    weighted = weights[:, None] * columns
    crossed = design.T @ weighted
    norm = np.einsum("mk,mk->k", columns, weighted)
    free = norm - np.einsum("pk,pq,qk->k", crossed, covariance, crossed)
    usable = free > 1e-9 * norm
    statistic = np.zeros(len(candidates))
    statistic[usable] = (weighted.T @ rest)[usable] / np.sqrt(free[usable])
    best = int(np.argmax(np.abs(statistic)))
    return (candidates[best], float(statistic[best])) if usable[best] else (None, 0.0)


def _likeliest_pair(
    series: Series,
    prior: _Prior,
    weights: Array,
    candidates: Sequence[ShapeOfChange],
    freedom: float,
) -> tuple[list[ShapeOfChange], float]:
    """Return the step and the other change that explain most together, and their p value."""
    steps = [k for k, shape in enumerate(candidates) if shape.kind == "step"]
    if not steps:
        return [], 1.0
    coefficients, covariance, design = _solved(series, prior, weights, ())
    rest = series.value - design @ coefficients
    columns = _columns(candidates, series.time)
    weighted = weights[:, None] * columns
    crossed = design.T @ weighted
    known = covariance @ crossed
    products = columns[:, steps].T @ weighted - crossed[:, steps].T @ known
    sides = weighted.T @ rest
    own = (columns * weighted).sum(axis=0) - (crossed * known).sum(axis=0)
    first = own[steps, None]
    determinant = first * own - products**2
    gain = (
        sides[steps, None] ** 2 * own
        - 2.0 * sides[steps, None] * sides * products
        + sides**2 * first
    ) / np.where(determinant > 1e-6 * first * own, determinant, np.inf)
    gain[_near(series.time, [candidates[k] for k in steps], candidates)] = 0.0
    step, other = np.unravel_index(int(np.argmax(gain)), gain.shape)
    if not gain[step, other] > 0.0:
        return [], 1.0
    p = float(fisher_tail(0.5 * float(gain[step, other]), 2.0, freedom))
    return [candidates[steps[int(step)]], candidates[int(other)]], min(1.0, gain.size * p)


def _misfits(series: Series, prior: _Prior, weights: Array, designs: Array) -> Array:
    """Return twice the negative log-likelihoods of models (n,), up to a constant.

    Args:
        series: of all.
        prior: of the effects of its covariates.
        weights: of its values, of each model or of all (n, m) or (m,).
        designs: columns of each or of all (n, m, p) or (m, p).
    """
    weighted = np.swapaxes(weights[..., None] * designs, -1, -2)
    normal = weighted @ designs
    right = weighted @ series.value
    own = slice(1, 1 + len(prior.mean))
    normal[..., own, own] += prior.information
    right[..., own] += prior.information @ prior.mean
    coefficients = (np.linalg.pinv(normal, hermitian=True) @ right[..., None])[..., 0]
    rest = series.value - (designs @ coefficients[..., None])[..., 0]
    off = coefficients[..., own] - prior.mean
    return np.asarray(
        (weights * rest**2).sum(axis=-1) + ((off @ prior.information) * off).sum(axis=-1)
    )


def _refined(
    series: Series,
    prior: _Prior,
    weights: Array,
    chosen: Sequence[ShapeOfChange],
    candidates: Sequence[ShapeOfChange],
) -> list[ShapeOfChange]:
    """Choose each change again, given the others."""
    refined = list(chosen)
    for _ in range(2 if len(chosen) > 1 else 1):
        for number in range(len(refined)):
            others = [*refined[:number], *refined[number + 1 :]]
            apart = _apart(series.time, candidates, others)
            best, _ = _likeliest(series, prior, weights, others, apart)
            if best is not None:
                refined[number] = best
    return refined


def _own_scale(
    series: Series,
    prior: _Prior,
    variance: Array,
    candidates: Sequence[ShapeOfChange],
) -> float:
    """Return the ratio of this robot's variance to its type's, at least 1."""
    weights = 1.0 / variance
    pair, _ = _likeliest_pair(series, prior, weights, candidates, 1.0)
    freedom = max(1.0, len(series.time) - 1.0 - 2.0 * len(pair))
    ratio = float(_misfits(series, prior, weights, _design(series, pair))) / freedom
    return max(1.0, (_TYPE_NOISE_RECORDINGS + freedom * ratio) / (_TYPE_NOISE_RECORDINGS + freedom))


def _described(series: Series, prior: _Prior, model: _Model, noise: _Noise) -> Course:
    """Return a model with its changes, and the intervals of what it says of the end."""
    weights, chosen, candidates, p_value = model
    coefficients, covariance, design = _solved(series, prior, weights, chosen)
    first = 1 + len(prior.mean)
    factor = float(student_limit(0.025, noise.freedom))
    (end,) = _columns(chosen, series.time[-1:])
    slope = np.array([float(shape.kind == "slope") for shape in chosen])
    sizes = coefficients[first:]
    of_changes = covariance[first:, first:]

    def half(weights_of_end: Array) -> float:
        variance = float(weights_of_end @ of_changes @ weights_of_end)
        return factor * math.sqrt(max(0.0, variance))

    changes = []
    for number, shape in enumerate(chosen):
        others = [*chosen[:number], *chosen[number + 1 :]]
        earliest, latest = _begin_interval(series, prior, weights, others, shape, candidates)
        std = float(np.sqrt(of_changes[number, number]))
        changes.append(SeriesChange(shape, float(sizes[number]), std, earliest, latest))
    changes.sort(key=lambda change: change.shape.begin)
    explained = series.covariates @ coefficients[1:first]
    whole_half = half(end) if chosen else _half_of_no_change(series, prior, weights, factor)
    return Course(
        adjusted=series.value - explained,
        std=1.0 / np.sqrt(weights),
        fitted=design @ coefficients - explained,
        changes=tuple(changes),
        p_value=p_value,
        change=float(end @ sizes),
        half=whole_half,
        rate=float(slope @ sizes),
        rate_half=half(slope),
        level=float(coefficients[0]),
        effects=coefficients[1:first],
        freedom=noise.freedom,
    )


def _half_of_no_change(series: Series, prior: _Prior, weights: Array, factor: float) -> float:
    """Return half of the interval of the difference between the second and the first half."""
    middle = ShapeOfChange("step", float(np.median(series.time)) - 1e-9)
    _, covariance, _ = _solved(series, prior, weights, (middle,))
    return factor * float(np.sqrt(max(0.0, covariance[-1, -1])))


def _begin_interval(
    series: Series,
    prior: _Prior,
    weights: Array,
    others: Sequence[ShapeOfChange],
    shape: ShapeOfChange,
    candidates: Sequence[ShapeOfChange],
) -> tuple[float, float]:
    """Return the begins of this kind of change within the 95 % interval by likelihood."""
    alike = [each for each in candidates if each.kind == shape.kind]
    begins = _columns([shape, *alike], series.time).T[..., None]
    design = _design(series, others)
    known = np.broadcast_to(design, (len(begins), *design.shape))
    best, *misfits = _misfits(series, prior, weights, np.concatenate([known, begins], axis=2))
    likely = np.array([each.begin for each in alike])[np.array(misfits) <= best + _CHI_SQUARE_95]
    earliest, latest = float(likely.min()), float(likely.max())
    if shape.kind == "step":  # anywhere between two recordings
        earliest = float(series.time[series.time < earliest].max())
        latest = float(series.time[series.time > latest].min())
    return earliest, latest
