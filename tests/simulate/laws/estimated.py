"""What was found despite the faults is what an undisturbed run finds, within the intervals of both.

A parameter of either estimate has a standard deviation s with k degrees of freedom, which follow
from the interval that `results.json` states (half a 95 % interval is `interval_factor` s). The
difference of two estimates is held against q hypot(s, s'), q the quantile of Student's t with the
smaller k at the level that makes one false alarm among all parameters of all `SEEDS` seeds as
improbable as `FALSE_ALARM` (Bonferroni). Two runs that share their noise differ by less.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t as student

from identification import Estimate
from tests.simulate.observed import Broken, Observed

from .folders import WANTED, manifest_of, parsed

LAW: Final = "estimate"
SEEDS: Final = 10_000
FALSE_ALARM: Final = 1e-3


def estimate(observed: Observed) -> Iterator[Broken]:
    """See above."""
    found, twin = observed.found, observed.twin_found
    if found is not None:
        for text in _pooled(observed):
            yield Broken(LAW, text)
    if found is not None and twin is not None:
        for text in _alike(found.result.pooled, twin.result.pooled):
            yield Broken(LAW, text)
    if found is None and observed.complete and not observed.unidentified and twin is not None:
        yield Broken(LAW, "the campaign is complete, and nothing was identified from it")


def _pooled(observed: Observed) -> Iterator[str]:
    """Only what counts is in the estimate, each once."""
    entries = manifest_of(observed)[1]
    good = {e.name for e in entries if e.outcome == "completed" and e.unchanged}
    wanted = {name for name in good if parsed(name)[0] in WANTED}
    pooled = observed.pooled
    for name in pooled:
        if name not in good:
            yield f"{name} was pooled, though it does not count"
    if len({*pooled}) < len(pooled):
        yield "an archive was pooled twice"
    if left_out := wanted - {*pooled}:
        yield f"{', '.join(sorted(left_out))} count and were not pooled"


def _alike(ours: Estimate, theirs: Estimate) -> Iterator[str]:
    if ours.names != theirs.names:
        yield "other parameters than in the undisturbed run"
        return
    freedom = min(map(degrees_of_freedom, (ours.interval_factor, theirs.interval_factor)))
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


@lru_cache(maxsize=64)
def degrees_of_freedom(interval_factor: float) -> float:
    """Of the t distribution with this 97.5 % quantile."""
    least, most = 0.5, 1e7
    if interval_factor <= student.ppf(0.975, most):
        return most
    return float(brentq(lambda k: student.ppf(0.975, k) - interval_factor, least, most))


@lru_cache(maxsize=64)
def bound(freedom: float, n_parameters: int) -> float:
    """Deviations that no parameter of any seed differs by, but with `FALSE_ALARM`."""
    return float(student.isf(FALSE_ALARM / (2.0 * n_parameters * SEEDS), freedom))
