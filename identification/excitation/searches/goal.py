"""What a search makes as large as it can, by method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.excitation.criteria import Criteria, fitness_of
from identification.excitation.searches.front import Front
from identification.excitation.searches.polish import dominating
from identification.excitation.searches.scale import Scale
from identification.excitation.searches.scores import Scores
from identification.excitation.searches.settings import SearchSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Goal:
    """Which of two motions is the better one, or that both measures count (method "front").

    Attributes:
        settings: of the search.
        p: number of parameters that are judged.
        scale: units of the two measures; None where it plays no part.
    """

    settings: SearchSettings
    p: int
    scale: Scale | None

    @property
    def single(self) -> bool:
        """Whether one number decides."""
        return self.settings.method != "front"

    def objectives(self, scores: Scores) -> Array:
        """Return what is to be minimised, (m, 1) or (m, 2)."""
        if self.single:
            return -self.fitness(scores.log10_det, scores.coupling_index)[:, None]
        return np.stack((-scores.log10_det, scores.coupling_index), axis=1)

    def fitness(self, log10_det: Array, coupling_index: Array) -> Array:
        """Return the one number of each motion (m,), the larger the better.

        -inf for a motion that leaves a parameter without excitation.
        """
        weights = self.settings.weights
        if self.settings.method == "a":
            return np.where(np.isfinite(coupling_index), log10_det, -np.inf)
        if self.scale is not None:
            return self.scale.fitness(log10_det, coupling_index, weights)
        pairs = zip(log10_det.tolist(), coupling_index.tolist(), strict=True)
        return np.array([fitness_of(*pair, self.p, weights=weights) for pair in pairs])

    def choice(self, front: Front) -> int:
        """Return which motion of a front (at least one) is the winner.

        No fitness gets worse when both measures get better, so its best motion is on the front.
        """
        if self.single:
            return int(np.argmax(self.fitness(front.log10_det, front.coupling_index)))
        return front.knee(self.scale)

    def best(self, front: Front) -> tuple[float, float, float]:
        """Return fitness, log10 det and coupling index of the winner so far; nan without one.

        Method "front" has no fitness (nan); its measures are the best of either on the front.
        """
        if len(front) == 0:
            return (np.nan, np.nan, np.nan)
        if not self.single:
            return (np.nan, float(np.max(front.log10_det)), float(np.min(front.coupling_index)))
        k = self.choice(front)
        values = self.fitness(front.log10_det, front.coupling_index)
        return float(values[k]), float(front.log10_det[k]), float(front.coupling_index[k])

    def is_worse(self, one: Criteria, other: Criteria) -> bool:
        """Return whether a motion is worse than another, with "front" in either measure."""
        log10_det = np.array((one.log10_det, other.log10_det))
        coupling_index = np.array((one.coupling_index, other.coupling_index))
        if self.single:
            fitness = self.fitness(log10_det, coupling_index)
            return not bool(fitness[0] >= fitness[1])
        return not bool(log10_det[0] >= log10_det[1] and coupling_index[0] <= coupling_index[1])

    def polished_by(self, start: Scores) -> Callable[[Scores], Array]:
        """Return what a polish from a motion (scores, m = 1) makes larger."""
        if self.single:
            return lambda scores: self.fitness(scores.log10_det, scores.coupling_index)
        return dominating(start, self.scale)
