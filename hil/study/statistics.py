"""Statistics of a study: intervals of ratios of errors, and ranges over repetitions.

The noise of an estimate acts on all motions that it predicts, so that a scatter over motions alone
underestimates the uncertainty of a comparison.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import comb
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .records import ClassForms
from .results import ALPHA, SMALL, ChanceRange, ComparisonResult, Quantity, Verdict

Array = NDArray[np.float64]

DRAWS: Final = 4000
MIN_REPETITIONS: Final = 3
"""Repetitions, or blocks of them, needed for their scatter: with two, A differs from A in 1.5 to
3.5 % of cases instead of 0.6 %; with three or more in at most 0.6 %."""
_CHUNK: Final = 500
_SUBSETS: Final = 400
_SEED, _BAND_SEED = 20140901, 20140902


def verdict_of(ratio: float, low: float | None, high: float | None) -> Verdict:
    """Return the verdict on the second of two estimates: significant if the interval excludes 1."""
    if low is None or high is None:
        return "too few"
    if low <= 1.0 <= high:
        return "none"
    if ratio < 1.0:
        return "slightly better" if 1.0 - ratio < SMALL else "better"
    return "slightly worse" if ratio - 1.0 < SMALL else "worse"


def compared_on(
    motion_class: str, keys: tuple[str, str], inner: tuple[Array, Array], *, drifts: bool
) -> ComparisonResult:
    """Compare the errors of two estimates on the motions of one class.

    `inner` are the inner products (m, r, r) of the errors of the r repetitions of each estimate;
    with `drifts` successive repetitions may be correlated.
    """
    # Squared error of the mean estimate: weights 1 / r.
    before, after = (np.sqrt(one.mean(axis=(1, 2))) for one in inner)
    logs = np.log(after / before)
    error, freedom = spread(*inner, drifts=drifts, seed=_SEED) or (None, None)
    (one,) = corrected(
        [
            ComparisonResult(
                motion_class=motion_class,
                first=keys[0],
                second=keys[1],
                motions=len(logs),
                repetitions=[one.shape[1] for one in inner],
                ratio=float(np.exp(logs.mean())),
                wins=int(np.count_nonzero(logs < 0.0)),
                error=error,
                freedom=freedom,
            )
        ]
    )
    return one


def corrected(comparisons: Sequence[ComparisonResult]) -> list[ComparisonResult]:
    """Return the comparisons of a table with simultaneous intervals (Bonferroni) and verdicts."""
    level = 1.0 - ALPHA / max(1, len(comparisons))
    found = []
    for one in comparisons:
        low, high = None, None
        if one.error is not None and one.freedom is not None:
            width = float(stats.t.ppf(0.5 + 0.5 * level, one.freedom)) * one.error
            low, high = (float(bound) for bound in one.ratio * np.exp([-width, width]))
        verdict = verdict_of(one.ratio, low, high)
        update = {"level": level, "low": low, "high": high, "verdict": verdict}
        found.append(one.model_copy(update=update))
    return found


def spread(first: Array, second: Array, *, drifts: bool, seed: int) -> tuple[float, float] | None:
    """Return the standard error of the mean over motions of log(error second / error first).

    Hierarchical bootstrap over repetitions of both and motions. An estimate is the mean over
    repetitions (the paper's Table 2). Of n units n - 1 are sampled, since a mean of n would scatter
    by (n - 1) / n too little. With `drifts` blocks of successive repetitions are resampled.

    `first` (m, r, r) and `second` (m, s, s) are inner products of the errors of the repetitions, by
    motion. Returned with its degrees of freedom; None with fewer than `MIN_REPETITIONS`
    repetitions, or one motion.
    """
    motions = len(first)
    if motions < 2 or min(first.shape[1], second.shape[1]) < MIN_REPETITIONS:
        return None
    random = np.random.default_rng(seed)
    before, left_before, units_before = _resampled(first, drifts, random)
    after, left_after, units_after = _resampled(second, drifts, random)
    weights, _ = _weights(motions, 1, random)
    here_before, here_after = (
        _logs(one, np.full((1, one.shape[1]), 1.0 / one.shape[1])) for one in (first, second)
    )
    together = ((after - before) * weights).sum(axis=1)
    # Variances of each source alone, for the degrees of freedom.
    single = [float(one.mean(axis=1).var(ddof=1)) for one in (before, after)]
    parts = (
        (max(single[0], left_before), units_before - 1),
        (max(single[1], left_after), units_after - 1),
        (float((weights @ (here_after - here_before)[0]).var(ddof=1)), motions - 1),
    )
    total = sum(variance for variance, _ in parts)
    if total <= 0.0:
        return 0.0, float(motions - 1)
    freedom = total**2 / sum(variance**2 / count for variance, count in parts)
    wider = parts[0][0] - single[0] + parts[1][0] - single[1]
    return float(np.sqrt(together.var(ddof=1) + wider)), freedom


def _resampled(
    kernels: Array, drifts: bool, random: np.random.Generator
) -> tuple[Array, float, int]:
    """Return log errors (draws, m) of resampled means, a jackknife variance, the number of units.

    The jackknife variance is larger where the error is mostly noise, which the bootstrap
    underestimates.
    """
    count = kernels.shape[1]
    # Block length: cube root of the number, 1 for fewer than eight.
    length = max(1, int(count ** (1.0 / 3.0) + 1e-9)) if drifts else 1
    weights, units = _weights(count, length, random)
    without = np.ones((units, count))
    for k in range(units):
        without[k, k * length : (k + 1) * length] = 0.0
    logs = _logs(kernels, without / without.sum(axis=1, keepdims=True)).mean(axis=1)
    return _logs(kernels, weights), float((units - 1) * logs.var()), units


def _weights(count: int, length: int, random: np.random.Generator) -> tuple[Array, int]:
    """Return weights (draws, count) of resampled units, with unit row sums; blocks are circular."""
    units = count // length
    starts = random.integers(0, count, (DRAWS, units - 1))
    index = (starts[:, :, None] + np.arange(length)).reshape(DRAWS, -1) % count
    flat = index + count * np.arange(DRAWS)[:, None]
    counts = np.bincount(flat.ravel(), minlength=DRAWS * count).reshape(DRAWS, count)
    return counts / index.shape[1], units


def _logs(kernels: Array, weights: Array) -> Array:
    """Return the log error norms (b, m) for each row of weights (b, r)."""
    found = np.empty((len(weights), len(kernels)))
    for start in range(0, len(weights), _CHUNK):
        rows = weights[start : start + _CHUNK]
        found[start : start + _CHUNK] = ((rows @ kernels) * rows).sum(axis=2).T
    return np.asarray(0.5 * np.log(np.maximum(found, np.finfo(float).tiny)))


def parameter_error(estimate: Array, base: Array, truth: Array) -> float | None:
    """Return the geometric mean of |estimate - truth| / |base - truth| over parameters (p,)."""
    own, reference = np.abs(estimate - truth), np.abs(base - truth)
    usable = (own > 0.0) & (reference > 0.0)
    return float(np.exp(np.mean(np.log(own[usable] / reference[usable])))) if usable.any() else None


def ranges_of(
    method: str,
    values: Array,
    size: int,
    forms: Mapping[str, ClassForms],
    truth: Array,
    reference: Array,
) -> list[ChanceRange]:
    """Return the ranges of errors over subsets of `size` of the repetitions (r, p) of one motion.

    None unless 1 <= size < r; `reference` (p,) is the estimate with a parameter error of 1.
    """
    if not 1 <= size < len(values):
        return []
    weights = _subsets(len(values), size)
    figures: list[tuple[Quantity, str | None, Array]] = []
    for name, one in forms.items():
        errors = one.relative(one.torque_kernels(values), weights)
        own = one.relative(one.own_kernels(values, truth), weights)
        figures.append(("error", name, np.median(errors, axis=0)))
        figures.append(("own", name, np.median(own, axis=0)))
    distances = [parameter_error(one, reference, truth) for one in weights @ values]
    known = np.array([one for one in distances if one is not None])
    figures += [("parameter_error", None, known)] if len(known) else []
    return [
        ChanceRange(
            method=method,
            repetitions=size,
            quantity=quantity,
            motion_class=name,
            # Without interpolation: of few subsets the smallest and the largest.
            low=float(np.percentile(some, 2.5, method="inverted_cdf")),
            high=float(np.percentile(some, 97.5, method="inverted_cdf")),
            subsets=len(some),
        )
        for quantity, name, some in figures
    ]


def _subsets(count: int, size: int) -> Array:
    """Return weights (s, count) of all subsets, or of a random sample if there are many."""
    if comb(count, size) <= _SUBSETS:
        chosen = np.array(list(combinations(range(count), size)), dtype=np.intp)
    else:
        random = np.random.default_rng(_BAND_SEED)
        chosen = np.argsort(random.random((_SUBSETS, count)), axis=1)[:, :size]
    weights = np.zeros((len(chosen), count))
    np.put_along_axis(weights, chosen, 1.0 / size, axis=1)
    return weights
