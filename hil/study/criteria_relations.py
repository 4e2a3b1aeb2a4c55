"""How the criteria of excitations go with what they are meant to foretell, over all designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from hil.base.arrays import Array
from hil.study.settings import BOOTSTRAP_DRAWS
from identification.excitation import Method

from .model_errors import NONE, Condition
from .results import Criterion, DesignPoint, Quantity, Relation
from .searches import Search

_SEED: Final = 20140902


def design_points(
    searches: Sequence[Search],
    conditions: Sequence[Condition],
    values: Mapping[str, Array],
    errors: Mapping[str, Array],
) -> list[DesignPoint]:
    """Return a point for each search.

    Args:
        searches: c searches and their criteria.
        conditions: c conditions, of which the first is without errors of the model.
        values: estimates of each search (c, r, p).
        errors: relative torque errors of the mean estimate on all held-out motions (c, m).
    """
    scatter = {key: estimates[0].std(axis=0, ddof=1) for key, estimates in values.items()}
    unit = np.sqrt(np.mean([std**2 for std in scatter.values()], axis=0))
    unit = np.where(unit > 0.0, unit, 1.0)
    points = []
    for search in searches:
        of_search = values[search.key].mean(axis=1)
        criteria = search.excitation.criteria
        shift = (of_search - of_search[0]) / unit
        points.append(
            DesignPoint(
                key=search.key,
                method=search.method,
                criteria={name: getattr(criteria, name) for name in get_args(Criterion)},
                variance=_rms(scatter[search.key] / unit),
                bias={
                    condition.key: _rms(row)
                    for condition, row in zip(conditions, shift, strict=True)
                    if condition != NONE
                },
                error={
                    condition.key: float(np.exp(np.log(row).mean()))
                    for condition, row in zip(conditions, errors[search.key], strict=True)
                },
            )
        )
    return points


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def relations_of(points: Sequence[DesignPoint], conditions: Sequence[Condition]) -> list[Relation]:
    """Return the rank correlation of each criterion with each quantity.

    The variance is that without errors of the model; bias and error are under each condition.
    """
    rows: list[tuple[Quantity, str, list[float]]] = [
        ("variance", NONE.key, [point.variance for point in points])
    ]
    for condition in conditions:
        if condition != NONE:
            rows.append(("bias", condition.key, [point.bias[condition.key] for point in points]))
        rows.append(("error", condition.key, [point.error[condition.key] for point in points]))
    groups = _groups([point.method for point in points])
    draws = _draws(groups)
    relations = []
    for criterion in get_args(Criterion):
        x = np.array([point.criteria[criterion] for point in points])
        for quantity, key, figures in rows:
            y = np.array(figures)
            over_all, within = _correlations(x, y, np.arange(len(x))[None], groups)
            many, many_within = _correlations(x, y, draws, groups)
            low, high = np.nanpercentile(many, (2.5, 97.5)).tolist()
            within_low, within_high = np.nanpercentile(many_within, (2.5, 97.5)).tolist()
            relations.append(
                Relation(
                    criterion=criterion,
                    quantity=quantity,
                    condition=key,
                    correlation=float(over_all[0]),
                    low=low,
                    high=high,
                    within=float(within[0]),
                    within_low=within_low,
                    within_high=within_high,
                )
            )
    return relations


def _groups(methods: Sequence[Method]) -> list[NDArray[np.intp]]:
    """Return the places of the designs of each method."""
    return [
        np.array([place for place, one in enumerate(methods) if one == method])
        for method in dict.fromkeys(methods)
    ]


def _draws(groups: Sequence[NDArray[np.intp]]) -> NDArray[np.intp]:
    """Return designs that are resampled within their methods, (draws, d)."""
    random = np.random.default_rng(_SEED)
    return np.concatenate(
        [group[random.integers(0, len(group), (BOOTSTRAP_DRAWS, len(group)))] for group in groups],
        axis=1,
    )


def _correlations(
    x: Array, y: Array, draws: NDArray[np.intp], groups: Sequence[NDArray[np.intp]]
) -> tuple[Array, Array]:
    """Return rank correlations over all designs and in the mean over methods, (draws,) each."""
    parts = []
    start = 0
    for group in groups:
        part = draws[:, start : start + len(group)]
        parts.append(_spearman(x[part], y[part]))
        start += len(group)
    return _spearman(x[draws], y[draws]), np.mean(parts, axis=0)


def _spearman(x: Array, y: Array) -> Array:
    """Return Spearman's rank correlation of rows (k, d); zero for equal values."""
    a, b = (rankdata(values, axis=1) for values in (x, y))
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    norm = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return np.asarray((a * b).sum(axis=1) / np.where(norm > 0.0, norm, 1.0))
