"""What a step in either measure is worth: its spread over random motions.

Eq. 7 adds two terms of different size (0.7 of the first is about 75 on a six-axis arm, 0.3 of the
second about 5), so that its weights decide nothing. Here either measure is counted from its
median over random motions of the same genome, in units of their interquartile range: with equal
weights both matter alike. Other units of the parameters, or another normalisation by N, add a
constant to log10 det, which drops out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.excitation.errors import DesignError

if TYPE_CHECKING:
    from identification.excitation.searches.problem import Scores

Array = NDArray[np.float64]

SAMPLE_COUNT: Final = 200
"""How many random motions to draw for a scale."""

# Fewer feasible motions than this tell little of a spread; all motions are used then, feasible
# or not: what a step is worth is a matter of the arm rather than of its surroundings.
_FEWEST_FEASIBLE: Final = 20
_FEWEST: Final = 2


class Scale(NamedTuple):
    """Median and interquartile range of the two measures over random motions.

    Attributes:
        log10_det_centre, log10_det_spread: of log10 det (eq. 9).
        coupling_index_centre, coupling_index_spread: of I_c (eq. 5).
    """

    log10_det_centre: float
    log10_det_spread: float
    coupling_index_centre: float
    coupling_index_spread: float

    @classmethod
    def of(cls, scores: Scores) -> Self:
        """Measure the scale on scores of random motions, some `SAMPLE_COUNT` of them.

        Raises:
            DesignError: fewer than two different motions that excite all parameters.
        """
        log10_det = np.asarray(scores.log10_det, dtype=np.float64)
        coupling_index = np.asarray(scores.coupling_index, dtype=np.float64)
        judged = np.isfinite(log10_det) & np.isfinite(coupling_index)
        feasible = judged & scores.feasible
        chosen = feasible if np.count_nonzero(feasible) >= _FEWEST_FEASIBLE else judged
        if np.count_nonzero(chosen) >= _FEWEST:
            scale = cls(*_spread(log10_det[chosen]), *_spread(coupling_index[chosen]))
            if scale.log10_det_spread > 0.0 and scale.coupling_index_spread > 0.0:
                return scale
        raise DesignError(
            "random motions that excite all parameters",
            int(np.count_nonzero(chosen)),
            f"at least {_FEWEST} different ones",
        )

    def gains(self, log10_det: ArrayLike, coupling_index: ArrayLike) -> tuple[Array, Array]:
        """Return how much better than the median random motion either measure is, in spreads."""
        return (
            (np.asarray(log10_det) - self.log10_det_centre) / self.log10_det_spread,
            (self.coupling_index_centre - np.asarray(coupling_index)) / self.coupling_index_spread,
        )

    def fitness(
        self, log10_det: ArrayLike, coupling_index: ArrayLike, weights: tuple[float, float]
    ) -> Array:
        """Return the balanced fitness, the larger the better.

        Args:
            log10_det: of the motions, (m,).
            coupling_index: of the same motions, (m,).
            weights: lambda_1 of log10 det and lambda_2 of the coupling index.

        Returns:
            (m,); -inf for a motion that leaves a parameter without excitation.
        """
        judged = np.isfinite(log10_det) & np.isfinite(coupling_index)
        size, decoupling = self.gains(
            np.where(judged, log10_det, 0.0), np.where(judged, coupling_index, 0.0)
        )
        return np.where(judged, weights[0] * size + weights[1] * decoupling, -np.inf)


def _spread(values: Array) -> tuple[float, float]:
    """Return median and interquartile range."""
    lower, median, upper = np.quantile(values, (0.25, 0.5, 0.75))
    return float(median), float(upper - lower)
