"""What chance alone does to an ablation's figures, from the study's own repetitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import comb
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from .forms import ClassForms
from .results import AblationBand
from .summary import parameter_error

Array = NDArray[np.float64]
Quantity = Literal["error", "own", "parameter_error"]

QUANTITIES: Final[tuple[Quantity, ...]] = ("error", "own", "parameter_error")
_SUBSETS: Final = 400
_SEED: Final = 20140902


def bands_of(
    method: str,
    values: Array,
    size: int,
    forms: Mapping[str, ClassForms],
    truth: Array | None,
    reference: Array,
    quantities: Sequence[Quantity] = QUANTITIES,
) -> list[AblationBand]:
    """Where an ablation's figures lie for other repetitions of the very same motion.

    Args:
        method: whose repetitions they are.
        values: estimates of all its repetitions (r, p).
        size: repetitions of a point of the ablation; bands need more than so many.
        forms: of the held-out motions, by class.
        truth: planted parameters (p,), if known.
        reference: estimate (p,) whose distance from the planted values is 1.
        quantities: that are wanted.
    """
    count = len(values)
    if not 1 <= size < count:
        return []
    chosen = _subsets(count, size)
    weights = np.zeros((len(chosen), count))
    np.put_along_axis(weights, chosen, 1.0 / size, axis=1)
    found: list[tuple[Quantity, str | None, Array]] = []
    for name, one in forms.items():
        scale = one.torque_squared.sum(axis=1)
        found.append(("error", name, _medians(one.torque_kernels(values), weights, scale)))
        if truth is not None:
            found.append(("own", name, _medians(one.own_kernels(values, truth), weights, scale)))
    if truth is not None:
        errors = [parameter_error(estimate, reference, truth) for estimate in weights @ values]
        known = [error for error in errors if error is not None]
        found += [("parameter_error", None, np.array(known))] if known else []
    return [
        AblationBand(
            method=method,
            repetitions=size,
            quantity=quantity,
            motion_class=name,
            # Figures that there are: of few subsets the smallest and the largest.
            low=float(np.percentile(figures, 2.5, method="inverted_cdf")),
            high=float(np.percentile(figures, 97.5, method="inverted_cdf")),
            subsets=len(figures),
        )
        for quantity, name, figures in found
        if quantity in quantities
    ]


def _subsets(count: int, size: int) -> NDArray[np.intp]:
    """All subsets (s, size) where they are few, else so many that are drawn."""
    if comb(count, size) <= _SUBSETS:
        return np.array(list(combinations(range(count), size)), dtype=np.intp)
    random = np.random.default_rng(_SEED)
    return np.argsort(random.random((_SUBSETS, count)), axis=1)[:, :size]


def _medians(kernels: Array, weights: Array, scale: Array) -> Array:
    """Median over the motions of the relative error, for each row of weights."""
    squared = ((weights @ kernels) * weights).sum(axis=2)  # (m, s)
    return np.asarray(np.median(np.sqrt(np.maximum(squared, 0.0) / scale[:, None]), axis=0))
