"""Search methods: the criteria and the fitness that each of them maximises."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.excitation.criteria import OF_PAPER, fitness_eq7

Method = Literal["a", "b", "gradient"]


class SearchMethod(NamedTuple):
    """A search method; its default settings are `hil/design/presets/NAME.toml`."""

    help: str  #: in `docs/commands.md`
    label: str  #: in the report
    #: fitness (m,) to maximise, for finite values (m,) of `criteria` by name, the weights of the
    #: settings, and the number of parameters; it must not fall where one of the criteria improves
    fitness: Callable[[Mapping[str, Array], tuple[float, float], int], Array]
    #: of the Pareto front that is stored and drawn; the second one is the horizontal axis
    criteria: tuple[str, str] = OF_PAPER
    #: fractions of their distance from home (or the middle) at which motions of the first
    #: generation have their via points, in turn: closer motions are shorter and clear of obstacles
    reach: tuple[float, ...] = (1.0,)


def _eq7(values: Mapping[str, Array], weights: tuple[float, float], p: int) -> Array:
    pairs = zip(values["log10_det"].tolist(), values["coupling_index"].tolist(), strict=True)
    return np.array([fitness_eq7(size, coupled, p, weights) for size, coupled in pairs])


def _weighted(values: Mapping[str, Array], weights: tuple[float, float], _: int) -> Array:
    return weights[0] * values["log10_det"] - weights[1] * values["coupling_index"]


METHODS: Final[Mapping[Method, SearchMethod]] = {
    "a": SearchMethod(
        "method A of the paper, sines of largest determinant",
        "designed by method A of the paper",
        lambda values, _weights, _p: values["log10_det"],
    ),
    "b": SearchMethod(
        "method B of the paper, via points by the fitness of eq. 7",
        "designed by method B of the paper",
        _eq7,
    ),
    "gradient": SearchMethod(
        "log det less I_c by weights, a short search improved by the gradient",
        "designed by the gradient of log det and I_c",
        _weighted,
        reach=(1.0, 0.85, 0.7, 0.55, 0.4, 0.25),
    ),
}
