"""Estimates of disturbed and undisturbed campaigns agree within the intervals of both.

The limit of the difference of two estimates with standard deviations s and s' is q hypot(s, s'),
q the quantile of Student's t with which a false alarm among all parameters of all `SEEDS` seeds has
the probability `FALSE_ALARM` (Bonferroni). The degrees of freedom are the sum of those of both
intervals (Welch, equal variances); half a 95 % interval is `interval_factor` s.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.stats import t as student

from identification import Estimate
from identification.distributions import student_freedom

SEEDS: Final = 10_000
FALSE_ALARM: Final = 1e-3


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


@lru_cache(maxsize=64)
def degrees_of_freedom(interval_factor: float) -> float:
    """Return those of the t distribution with this 97.5 % quantile; infinite for the normal one."""
    return student_freedom(0.025, interval_factor)


@lru_cache(maxsize=64)
def bound(freedom: float, n_parameters: int) -> float:
    """Return the bound in deviations that any parameter of any seed exceeds with `FALSE_ALARM`."""
    return float(student.isf(FALSE_ALARM / (2.0 * n_parameters * SEEDS), freedom))
