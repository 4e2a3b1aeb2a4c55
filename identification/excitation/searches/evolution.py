"""Genetic search by pymoo, asked for genes and told their scores, generation by generation."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pymoo.algorithms.moo.nsga2 import NSGA2, binary_tournament
from pymoo.algorithms.soo.nonconvex.ga import GA, FitnessSurvival, comp_by_cv_and_fitness
from pymoo.config import Config
from pymoo.core.problem import Problem
from pymoo.core.termination import NoTermination
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.selection.tournament import TournamentSelection
from pymoo.operators.survival.rank_and_crowding import RankAndCrowding

from identification.excitation.searches.scores import Scores
from identification.excitation.searches.settings import SearchSettings
from identification.excitation.violation import KINDS

Array = NDArray[np.float64]

# Random numbers that are no other part's, whatever the seeds.
_STREAM: Final = 6
# Added to the excess of a motion that cannot be judged: it ranks behind all that can, however much
# they exceed, and before those that cannot even be planned, whose excess is infinite.
_UNEXCITING: Final = 1e6


class Evolution:
    """A GA with one objective, NSGA-II with two; both rank feasible motions before all others.

    Infeasible ones are ranked by the sum of their excesses, so constraints need no weights.
    Crossover is simulated binary, mutation polynomial, selection a binary tournament. Random
    numbers come from the seed alone.

    Args:
        settings: rates and sizes.
        first: genes (m, n_genes) of the first generation.
        n_objectives: 1 or 2.
    """

    def __init__(self, settings: SearchSettings, first: Array, n_objectives: int) -> None:
        Config.warnings["not_compiled"] = False  # it would be printed
        self._algorithm = _algorithm(settings, first, n_objectives)
        self._algorithm.setup(
            Problem(
                n_var=first.shape[1],
                n_obj=n_objectives,
                n_ieq_constr=len(KINDS) + 1,
                xl=np.zeros(first.shape[1]),
                xu=np.ones(first.shape[1]),
            ),
            termination=NoTermination(),
            seed=[_STREAM, settings.seed],
        )
        self._asked: Any = None

    def ask(self) -> Array | None:
        """Return the genes (m, n_genes) of the next generation.

        There may be fewer than a population, as no motion is asked for twice; None where mating
        brings nothing new at all, which ends the search.
        """
        self._asked = self._algorithm.infill()
        if self._asked is None or len(self._asked) == 0:
            return None
        return np.array(self._asked.get("X"), dtype=np.float64)

    def tell(self, scores: Scores, objectives: Array) -> None:
        """Take the scores of what was asked for, and its objectives (m, n_objectives)."""
        judged = scores.usable
        exciting = np.isfinite(scores.log10_det) & np.isfinite(scores.coupling_index)
        unexciting = np.where(exciting, 0.0, _UNEXCITING)
        excess = np.column_stack((scores.excess, unexciting))
        # Objectives decide among feasible motions only, and must be finite for their distances.
        finite = np.nan_to_num(np.where(judged[:, None], objectives, 0.0))
        self._asked.set("F", finite, "G", excess)
        self._algorithm.advance(infills=self._asked)


def _algorithm(settings: SearchSettings, first: Array, n_objectives: int) -> Any:
    common = {
        "pop_size": settings.population,
        "sampling": first,
        "crossover": SBX(prob=settings.crossover, eta=settings.crossover_eta),
        "mutation": PM(prob=1.0, prob_var=settings.mutation, eta=settings.mutation_eta),
    }
    if n_objectives == 1:
        return GA(
            selection=TournamentSelection(func_comp=comp_by_cv_and_fitness),
            survival=FitnessSurvival(),
            **common,
        )
    return NSGA2(
        selection=TournamentSelection(func_comp=binary_tournament),
        survival=RankAndCrowding(),
        **common,
    )
