"""The parameter table, and how the four standard deviations compare, as the page shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.report import numbers
from hil.results import ParameterResult, Results

Array = NDArray[np.float64]

_VISCOUS_UNITS = frozenset({"N·m·s/rad", "N·m/(rad/s)", "N m s/rad", "Nms/rad"})


@dataclass(frozen=True)
class Route:
    """One way to a standard deviation; `ratio` is (p,) std over the reported std."""

    key: str
    title: str
    assumes: str
    reported: bool
    symbol: str
    slot: int
    ratio: list[float]
    median_ratio: str
    span: str
    within_2: str
    within_3: str


_ROUTES = {
    "least_squares": (
        "Least squares",
        "residuals white: independent from sample to sample. Too small where they are coloured",
        "●",
    ),
    "independent_repetitions": (
        "Independent repetitions",
        "residuals of any colour within a repetition, none from one repetition to the next",
        "◆",
    ),
    "phase_clustered": (
        "Phase-clustered",
        "residuals may also return at the same place of the motion in every repetition,"
        " as what the model leaves out does",
        "▲",
    ),
    "scatter_of_mean": (
        "Scatter of the mean",
        "nothing but independent repetitions: their scatter over the root of their number."
        " Blind to an error that all of them share",
        "■",
    ),
    "posterior": (
        "Posterior",
        "what was believed before the data, and residuals of the colour they have",
        "▲",
    ),
}
# The posterior stands in for the phase-clustered route, never beside it.
_SLOTS = {
    "least_squares": 0,
    "independent_repetitions": 1,
    "phase_clustered": 2,
    "posterior": 2,
    "scatter_of_mean": 3,
}


def expression(p: ParameterResult) -> str:
    """What the name stands for; viscous friction also in the unit that manufacturers print."""
    text = p.expression if p.expression != p.name else ""
    if p.unit not in _VISCOUS_UNITS:
        return text
    scale = math.pi / 180.0
    per_degree = f"{numbers.beside(scale * p.estimate, scale * p.std)} N·m per °/s"
    return f"{text}; {per_degree}" if text else per_degree


def routes(results: Results) -> list[Route]:
    """The standard-deviation routes that were computed, compared with the reported one."""
    reported = np.array([p.std for p in results.parameters])
    found = []
    for key in _ROUTES:
        values: list[float] | None = getattr(results.uncertainty, key)
        if values is not None:
            found.append(_route(results, key, _SLOTS[key], np.asarray(values, float), reported))
    return found


def _route(
    results: Results,
    key: str,
    slot: int,
    std: Array,
    reported: Array,
) -> Route:
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = std / reported
    usable = ratio[np.isfinite(ratio)]
    title, assumes, symbol = _ROUTES[key]
    within = [_within(results.parameters, std.tolist(), limit) for limit in (2.0, 3.0)]
    return Route(
        key=key,
        title=title,
        assumes=assumes,
        reported=key == results.uncertainty.reported,
        symbol=symbol,
        slot=slot,
        ratio=ratio.tolist(),
        median_ratio=numbers.significant(float(np.median(usable)), 2) if usable.size else "–",
        span=_span(usable.tolist()),
        within_2=within[0],
        within_3=within[1],
    )


def _span(values: Sequence[float]) -> str:
    if not values:
        return numbers.MISSING
    return f"{numbers.significant(min(values), 2)} to {numbers.significant(max(values), 2)}"


def _within(parameters: Sequence[ParameterResult], std: Sequence[float], limit: float) -> str:
    compared = [(p, s) for p, s in zip(parameters, std, strict=True) if p.truth is not None]
    if not compared:
        return numbers.MISSING
    inside = sum(abs(p.estimate - (p.truth or 0.0)) <= limit * s for p, s in compared)
    return f"{inside} of {len(compared)}"


def reported_title(results: Results) -> str:
    """The reported route in words."""
    key = results.uncertainty.reported
    return _ROUTES[key][0] if key in _ROUTES else key
