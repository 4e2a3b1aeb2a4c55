"""How a search goes about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Method = Literal["a", "b", "balanced", "front"]


@dataclass(frozen=True)
class SearchSettings:
    """What is sought, and with how much effort.

    Attributes:
        method: "a": the largest log10 det (D-optimal, eq. 9); "b": the largest fitness by eq. 7
            as printed; "balanced": both measures in units of their spread over random motions;
            "front": all compromises between the two at once (NSGA-II), the knee is chosen.
        population: individuals in a generation.
        generations: how many generations are scored, the first, random one among them:
            150 x 120 are 18 000 individuals.
        crossover: probability that a pair of parents is crossed (Table 1: "cross-over rate").
        mutation: probability that a gene of a child is changed (Table 1: "mutation").
        weights: lambda_1 of log10 det and lambda_2 of the coupling index ("b" and "balanced").
        seed: the same seed gives the same design, to the last bit.
        polish: evaluations of a local search from the winner; 0 for none.
        crossover_eta: how close children stay to their parents (SBX), the larger the closer.
        mutation_eta: how close a changed gene stays to what it was, the larger the closer.
    """

    method: Method = "front"
    population: int = 150
    generations: int = 120
    crossover: float = 0.9
    mutation: float = 0.01
    weights: tuple[float, float] = (0.7, 0.3)
    seed: int = 0
    polish: int = 0
    crossover_eta: float = 15.0
    mutation_eta: float = 20.0
