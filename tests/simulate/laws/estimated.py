"""Estimates with faults agree with those without, within the intervals of both.

The limit of the difference of two estimates with standard deviations s and s' is q hypot(s, s'),
q the quantile of Student's t with which a false alarm among all parameters of all `SEEDS` seeds has
the probability `FALSE_ALARM` (Bonferroni). The degrees of freedom are the sum of those of both
intervals (Welch, equal variances); half a 95 % interval is `interval_factor` s.

They are few, since s comes from some blocks of residuals. If nothing disturbed the arm, the torques
predicted by both models for the motion are compared as well. From m samples with white noise of
standard deviation r, the predictions of models with p parameters differ by r sqrt(2 p / m) (rms);
correlated residuals are in both covariances. `ALLOWED` times both together is the limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import t as student

from identification import Estimate, RobotModel, Samples
from tests.simulate.observed import Estimated, Observed
from tests.simulate.script import DISTURBS_THE_ARM, kind_of

from .folders import WANTED, manifest_of, parsed

Array = NDArray[np.float64]

SEEDS: Final = 10_000
FALSE_ALARM: Final = 1e-3
ALLOWED: Final = 5.0
"""About 1 is to be expected; the largest of some 200 seeds with a calm arm is 1.9."""


def estimate(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    estimated, twin = observed.found, observed.twin_found
    if estimated is not None:
        yield from _pooled(observed)
    if estimated is not None and twin is not None:
        disturbed = any(kind_of(line) in DISTURBS_THE_ARM for line in observed.struck)
        yield from alike(estimated.result.pooled, twin.result.pooled)
        if not disturbed:
            yield from _predicted_alike(estimated, twin)


def _pooled(observed: Observed) -> Iterator[str]:
    """The estimate uses each completed archive once, and no other."""
    entries = manifest_of(observed)[1]
    good = {e.name for e in entries if e.outcome == "completed" and e.unchanged}
    wanted = {name for name in good if parsed(name)[0] in WANTED}
    pooled = observed.pooled
    for name in pooled:
        if name not in good:
            yield f"{name} was pooled although it is not valid"
    if len({*pooled}) < len(pooled):
        yield "an archive was pooled twice"
    if left_out := wanted - {*pooled}:
        yield f"{', '.join(sorted(left_out))} are valid and were not pooled"


def alike(ours: Estimate, theirs: Estimate) -> Iterator[str]:
    """Yield the parameters of two estimates that differ, of those that both determine."""
    if ours.names != theirs.names:
        yield "other parameters than in the undisturbed run"
        return
    freedom = sum(map(degrees_of_freedom, (ours.interval_factor, theirs.interval_factor)))
    quantile = bound(freedom, len(ours.names))
    unknown = {*ours.undetermined, *theirs.undetermined}
    spread = np.hypot(ours.std, theirs.std)
    for j, name in enumerate(ours.names):
        if name in unknown:
            continue
        if not abs(ours.values[j] - theirs.values[j]) <= quantile * spread[j]:
            yield (
                f"{name} is {ours.values[j]:.6g} ± {ours.std[j]:.2g}, undisturbed "
                f"{theirs.values[j]:.6g} ± {theirs.std[j]:.2g}: {quantile:.1f} deviations of "
                "their difference are allowed"
            )


def _predicted_alike(estimated: Estimated, twin: Estimated) -> Iterator[str]:
    ours, theirs = estimated.result.pooled, twin.result.pooled
    if ours.names != theirs.names:
        return
    determined = ~np.isin(ours.names, [*ours.undetermined, *theirs.undetermined])
    change = np.where(determined, ours.values - theirs.values, 0.0)
    scatter = np.where(np.outer(determined, determined), ours.covariance + theirs.covariance, 0.0)
    variances, directions = np.linalg.eigh(scatter)
    deviations = (directions * np.sqrt(np.maximum(variances, 0.0))).T
    noise = np.minimum(ours.noise_std, theirs.noise_std)
    white = noise * np.sqrt(2.0 * len(change) / np.minimum(ours.samples, theirs.samples))
    for number, samples in enumerate(estimated.fitted):
        apart = _rms(samples, estimated.model, change)
        stated = np.linalg.norm(
            [_rms(samples, estimated.model, deviation) for deviation in deviations], axis=0
        )
        allowed = ALLOWED * np.hypot(white, stated)
        for joint in np.flatnonzero(apart > allowed):
            yield (
                f"joint {joint + 1}, repetition {number}: predicted torques differ from those of "
                f"the undisturbed run by {apart[joint]:.2g} (rms), {allowed[joint]:.2g} are allowed"
            )


def _rms(samples: Samples, model: RobotModel, values: Array) -> Array:
    """Return the rms torque of these parameters (n,) over usable samples."""
    torque = np.where(samples.usable, samples.predicted_torque(model, values), np.nan)
    return np.asarray(np.sqrt(np.nanmean(torque**2, axis=0)))


@lru_cache(maxsize=64)
def degrees_of_freedom(interval_factor: float) -> float:
    """Return those of the t distribution with this 97.5 % quantile; infinite for the normal one."""
    least, most = 0.5, 1e7
    if interval_factor <= student.ppf(0.975, most):
        return math.inf
    return float(brentq(lambda k: student.ppf(0.975, k) - interval_factor, least, most))


@lru_cache(maxsize=64)
def bound(freedom: float, n_parameters: int) -> float:
    """Return the bound in deviations that any parameter of any seed exceeds with `FALSE_ALARM`."""
    return float(student.isf(FALSE_ALARM / (2.0 * n_parameters * SEEDS), freedom))
