"""How far the ratio of two errors is known: motions and repetitions both taken as drawn.

A table of errors on many motions does not say how much of a difference is the noise of the two
estimates, which is the same on all of these motions. Other repetitions would have given others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

DRAWS: Final = 4000
FEWEST: Final = 3
"""Repetitions, or blocks of them, below which their scatter says too little: of two, A against A is
told to differ in 1.5 to 3.5 % of cases where 0.6 % is asked for; of three and more, not oftener
than asked."""
_CHUNK: Final = 500


@dataclass(frozen=True)
class Spread:
    """Standard error of a mean log ratio.

    Attributes:
        error: the standard error.
        freedom: its degrees of freedom, after Welch and Satterthwaite.
    """

    error: float
    freedom: float

    def half_width(self, level: float) -> float:
        """Of the interval at a level, by Student's t."""
        return float(stats.t.ppf(0.5 + 0.5 * level, self.freedom)) * self.error


def spread(first: Array, second: Array, *, drifts: bool, seed: int) -> Spread | None:
    """Standard error of the mean over motions of log(error with second / error with first).

    A hierarchical bootstrap: repetitions of the first, repetitions of the second and motions are
    drawn anew together. What is scored is the mean of the repetitions' own estimates (the paper's
    Table 2), so an estimate drawn anew is the mean of the repetitions drawn. Of n units n - 1 are
    drawn: a mean of n drawn would scatter by (n - 1) / n too little.

    Args:
        first: inner products of the errors of the first's repetitions, by motion (m, r, r).
        second: those of the second's repetitions on the same motions (m, s, s).
        drifts: draw blocks of consecutive repetitions, which may be like their neighbours.
        seed: of the draws.

    Returns:
        None where the scatter cannot be known: fewer than `FEWEST` repetitions, or one motion.
    """
    motions = len(first)
    if motions < 2 or min(first.shape[1], second.shape[1]) < FEWEST:
        return None
    random = np.random.default_rng(seed)
    before, left_before, units_before = _drawn_logs(first, drifts, random)
    after, left_after, units_after = _drawn_logs(second, drifts, random)
    weights, _ = _weights(motions, 1, random)
    here_before, here_after = _logs(first, _equal(first)), _logs(second, _equal(second))
    together = ((after - before) * weights).sum(axis=1)
    # Each by itself with the others as they are: what the degrees of freedom are made from.
    drawn = [float(one.mean(axis=1).var(ddof=1)) for one in (before, after)]
    parts = (
        (max(drawn[0], left_before), units_before - 1),
        (max(drawn[1], left_after), units_after - 1),
        (float((weights @ (here_after - here_before)[0]).var(ddof=1)), motions - 1),
    )
    total = sum(variance for variance, _ in parts)
    if total <= 0.0:
        return Spread(0.0, float(motions - 1))
    freedom = total**2 / sum(variance**2 / count for variance, count in parts)
    wider = parts[0][0] - drawn[0] + parts[1][0] - drawn[1]
    return Spread(float(np.sqrt(together.var(ddof=1) + wider)), freedom)


def _drawn_logs(
    kernels: Array, drifts: bool, random: np.random.Generator
) -> tuple[Array, float, int]:
    """Log errors (draws, m) of means of drawn repetitions, and of how many units they are drawn.

    Between them the variance of their mean over the motions by leaving out one unit after the
    other. Where the error is nothing but noise, draws about an estimate that has its share of it
    already scatter by an eighth too little; this is then the larger one, and elsewhere the same.
    """
    count = kernels.shape[1]
    # The usual order of a block's length is the cube root; fewer than eight stay single.
    length = max(1, int(count ** (1.0 / 3.0) + 1e-9)) if drifts else 1
    weights, units = _weights(count, length, random)
    return _logs(kernels, weights), _left_out(kernels, units, length), units


def _left_out(kernels: Array, units: int, length: int) -> float:
    """Variance of the mean log error by the jackknife, a block of repetitions at a time."""
    count = kernels.shape[1]
    weights = np.ones((units, count))
    for k in range(units):
        weights[k, k * length : (k + 1) * length] = 0.0
    logs = _logs(kernels, weights / weights.sum(axis=1, keepdims=True)).mean(axis=1)
    return float((units - 1) * logs.var())


def _weights(count: int, length: int, random: np.random.Generator) -> tuple[Array, int]:
    """Weights (draws, count) of drawn units, each row's sum being 1; blocks may go round."""
    units = count // length
    starts = random.integers(0, count, (DRAWS, units - 1))
    index = (starts[:, :, None] + np.arange(length)).reshape(DRAWS, -1) % count
    flat = index + count * np.arange(DRAWS)[:, None]
    counts = np.bincount(flat.ravel(), minlength=DRAWS * count).reshape(DRAWS, count)
    return counts / index.shape[1], units


def _equal(kernels: Array) -> Array:
    return np.full((1, kernels.shape[1]), 1.0 / kernels.shape[1])


def _logs(kernels: Array, weights: Array) -> Array:
    """Log of the error's length (b, m) for each row of weights (b, r)."""
    found = np.empty((len(weights), len(kernels)))
    for start in range(0, len(weights), _CHUNK):
        rows = weights[start : start + _CHUNK]
        squared = ((rows @ kernels) * rows).sum(axis=2)  # (m, b)
        found[start : start + _CHUNK] = squared.T
    return np.asarray(0.5 * np.log(np.maximum(found, np.finfo(float).tiny)))
