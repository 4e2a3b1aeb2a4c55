"""Searching for the motion that excites the parameters best: the paper's methods, and others.

Method A and method B of the paper are a genetic search for the largest determinant and for the
largest fitness of eq. 7; which motions they search among is the genome's affair. The same seed
gives the same design to the last bit, for any number of processes, and whether or not it was
interrupted and resumed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.criteria import Criteria
from identification.excitation.errors import DesignError
from identification.excitation.excitation import Excitation
from identification.excitation.searches.design import Design
from identification.excitation.searches.front import Front
from identification.excitation.searches.goal import Goal
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.ledger import Ledger, Phase, Progress
from identification.excitation.searches.polish import polish
from identification.excitation.searches.population import Population
from identification.excitation.searches.scale import SAMPLE_COUNT, Scale
from identification.excitation.searches.scores import Scores
from identification.excitation.searches.settings import SearchSettings
from planner import FourierSeries, PiecewiseCubic

Array = NDArray[np.float64]

RESCORE_PERIOD: Final = 0.001
"""s; the chosen motion is judged once more at the rate of a servo loop."""

# Random numbers of the first generation, by seed, and of the motions that give the scale. The
# latter are the same for all seeds, so that a balanced fitness is.
_FIRST: Final = 4
_SCALE: Final = (5, 0)


def search(
    population: Population,
    settings: SearchSettings,
    *,
    journal: Journal | None = None,
    progress: Callable[[Progress], None] | None = None,
    scored: Callable[[int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Design:
    """Return the best motion of a search.

    Args:
        population: scores motions; its problem says what they are and must keep.
        settings: how to search, and what for.
        journal: scores already known, and where new ones are kept.
        progress: called after each generation.
        scored: called with a number of motions whenever so many more of a generation are scored
            (those that the journal knows are not).
        stop: asked before each generation; true ends the search with the best so far. The one
            under way is finished first, which a motion that hangs delays by the population's
            timeout.

    Raises:
        NoFeasibleMotionError: no motion tried keeps every constraint and excites every parameter.
        PlannerNotStarted: a process could not be started.
        KeyboardInterrupt: as it comes; the generation under way is lost, no other.
    """
    return _Search(population, settings, journal, progress, scored, stop).run()


def most_evaluations(settings: SearchSettings) -> int:
    """Return how many motions a search is going to score at most, in all its phases."""
    sampled = SAMPLE_COUNT if _needs_scale(settings) else 0
    return sampled + settings.population * settings.generations + settings.polish


class _Search:
    """One search under way."""

    def __init__(
        self,
        population: Population,
        settings: SearchSettings,
        journal: Journal | None,
        progress: Callable[[Progress], None] | None,
        scored: Callable[[int], None] | None,
        stop: Callable[[], bool],
    ) -> None:
        self._population, self._settings = population, settings
        self._genome = population.problem.genome
        self._progress, self._stop = progress, stop
        self._stopped = self._exhausted = False
        self._phase: Phase = "sample"
        self._goal: Goal | None = None
        self._history: list[tuple[float, float, float]] = []
        self._ledger = Ledger(population, journal, self._entered, scored)

    def run(self) -> Design:
        goal = self._goal = self._chosen_goal()
        self._evolve(goal)
        front = self._ledger.front
        if len(front) == 0:
            raise self._ledger.failure(stopped=self._stopped)
        winner = goal.choice(front)
        start = front.genes[winner]
        origin = trajectory, criteria = self._population.judged(start, RESCORE_PERIOD)
        genes = start
        if self._settings.polish > 0 and not self._halted():
            genes = self._polished(goal, front, winner)
        if genes.tobytes() != start.tobytes():
            trajectory, criteria = self._population.judged(genes, RESCORE_PERIOD)
            # Better only as the search samples, or other genes of the same motion.
            if criteria == origin[1] or goal.is_worse(criteria, origin[1]):
                genes, (trajectory, criteria) = start, origin
        return Design(
            settings=self._settings,
            genes=genes.copy(),
            excitation=self._excitation(genes, trajectory, criteria),
            front=front,
            chosen=winner if genes is start else None,
            origin=winner,
            origin_criteria=origin[1],
            history=np.array(self._history).reshape(-1, 3),
            evaluated=self._ledger.evaluated,
            infeasible=dict(self._ledger.infeasible),
            complete=not self._stopped,
            exhausted=self._exhausted,
            scale=goal.scale,
        )

    def _chosen_goal(self) -> Goal:
        """Return what decides, after a look at random motions where it needs a scale."""
        p = self._population.problem.objective.n_parameters
        if not _needs_scale(self._settings):
            return Goal(self._settings, p, None)
        drawn = self._genome.sample(np.random.default_rng(_SCALE), SAMPLE_COUNT)
        scores = self._ledger.score(drawn)
        try:
            return Goal(self._settings, p, Scale.of(scores))
        except DesignError:
            # Random motions excite hardly anything. A front does without a scale.
            if self._settings.method == "front":
                return Goal(self._settings, p, None)
            raise self._ledger.failure(stopped=False) from None

    def _evolve(self, goal: Goal) -> None:
        from identification.excitation.searches.evolution import Evolution  # pymoo: slow to import

        self._phase = "search"
        random = np.random.default_rng((_FIRST, self._settings.seed))
        first = self._genome.sample(random, self._settings.population)
        evolution = Evolution(self._settings, first, n_objectives=1 if goal.single else 2)
        while len(self._history) < self._settings.generations and not self._halted():
            genes = evolution.ask()
            if genes is None:
                self._exhausted = True
                return
            scores = self._ledger.score(genes)
            evolution.tell(scores, goal.objectives(scores))

    def _polished(self, goal: Goal, front: Front, winner: int) -> Array:
        """Return the genes of the best motion near the winner, or its own."""
        self._phase = "polish"
        start = _scores_on(front, winner)
        result = polish(
            self._ledger,
            front.genes[winner],
            start,
            goal.polished_by(start),
            evaluations=self._settings.polish,
            seed=self._settings.seed,
            stop=self._halted,
        )
        return result.genes

    def _excitation(
        self, genes: Array, trajectory: PiecewiseCubic | FourierSeries, criteria: Criteria
    ) -> Excitation:
        return self._genome.excitation(
            genes,
            trajectory,
            criteria,
            method=self._settings.method,
            seed=self._settings.seed,
            tried=self._ledger.evaluated,
            rejected=self._ledger.infeasible,
        )

    def _entered(self) -> None:
        """Keep the history and tell how far the search is."""
        ledger, settings = self._ledger, self._settings
        if self._phase == "search" and self._goal is not None:
            self._history.append(self._goal.best(ledger.front))
        if self._progress is None:
            return
        best = (np.nan, np.nan)
        if self._goal is not None and len(ledger.front) > 0:
            k = self._goal.choice(ledger.front)
            best = float(ledger.front.log10_det[k]), float(ledger.front.coupling_index[k])
        self._progress(
            Progress(
                self._phase,
                len(self._history),
                settings.generations,
                ledger.evaluated,
                most_evaluations(settings),
                ledger.feasible,
                *best,
            )
        )

    def _halted(self) -> bool:
        self._stopped = self._stopped or self._stop()
        return self._stopped


def _needs_scale(settings: SearchSettings) -> bool:
    return settings.method in ("balanced", "front")


def _scores_on(front: Front, index: int) -> Scores:
    """Return the scores (m = 1) of a motion of a front, which keeps every constraint."""
    one = slice(index, index + 1)
    return Scores.feasible_ones(
        front.log10_det[one], front.coupling_index[one], front.duration[one]
    )
