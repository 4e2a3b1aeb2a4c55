"""Searches for the best excitation, bit-identical for any number of processes and interruptions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.excitation.criteria import SENSE, Criteria, columns
from identification.excitation.errors import NoFeasibleMotionError
from identification.excitation.excitation import Excitation
from identification.excitation.genomes import ViaPointGenome
from identification.excitation.searches.bundle_method import SCORED_STEPS, Ascent, improve
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.methods import METHODS, SearchMethod
from identification.excitation.searches.population import (
    Front,
    Population,
    Scores,
    SearchSettings,
    finite,
)
from identification.excitation.violation import KINDS

Phase = Literal["search", "gradient"]
Fitness = Callable[[Scores], Array]


class SearchProgress(NamedTuple):
    """Progress of a search."""

    phase: Phase  #: the genetic search, or the steps along the gradient after it
    generation: int  #: scored generations
    generations: int  #: all generations
    evaluated: int  #: scored motions of all phases
    feasible: int  #: scored motions that satisfy all constraints
    best: tuple[float, ...]  #: `CRITERIA` of the best motion, nan if there is none


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a search."""

    genes: Array  #: (n_genes,) of the chosen motion
    excitation: Excitation  #: the motion and its criteria, sampled every `RESCORE_PERIOD`
    front: Front  #: of all motions before the gradient, sampled at the search's period
    chosen: int | None  #: index of the motion in the front; None if the gradient improved it
    origin: int  #: index in the front of the motion, or of the one that the gradient started from
    #: criteria of that motion, sampled every `RESCORE_PERIOD`; the chosen motion has no
    #: smaller fitness
    origin_criteria: Criteria
    generations: int  #: number of scored generations
    complete: bool  #: whether the search ran to its end
    exhausted: bool  #: whether it ended early because mating gave no new motions


RESCORE_PERIOD: Final = 0.001
"""Sample period of the criteria of the chosen motion, s."""

# First seeds of independent random streams: evolution and first generation.
_EVOLUTION_STREAM: Final = 6
_FIRST_GENERATION_STREAM: Final = 4
# Excess of a motion that leaves a parameter without excitation: it ranks behind all that excite,
# and before unplannable ones, whose excess is infinite.
_UNEXCITING_EXCESS: Final = 1e6
_MEASURE_STEP: Final = 1e-3  # of criteria, for the derivatives of a fitness


def partials(fitness: Fitness, scores: Scores) -> Array:
    """Return the derivatives (d,) of a fitness by the `CRITERIA` of a motion (m = 1)."""
    steps = _MEASURE_STEP * np.eye(len(SENSE))
    measures = scores.measures + np.concatenate((steps, -steps))
    rows = np.repeat(scores.rows, len(measures), axis=0)
    values = fitness(Scores.of_rows(rows)._replace(measures=measures))
    above, below = np.split(values, 2)
    return np.asarray((above - below) / (2.0 * _MEASURE_STEP))


class Evolution:
    """A genetic algorithm, from a first generation of genes (m, n_genes).

    Feasible motions rank first, infeasible ones by the sum of their excesses. Simulated binary
    crossover, polynomial mutation, binary tournament.
    """

    def __init__(self, settings: SearchSettings, first: Array) -> None:
        # slow to load
        from pymoo.algorithms.soo.nonconvex.ga import GA, FitnessSurvival, comp_by_cv_and_fitness
        from pymoo.config import Config
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM
        from pymoo.operators.selection.tournament import TournamentSelection

        Config.warnings["not_compiled"] = False
        self._algorithm: Any = GA(
            pop_size=settings.population,
            sampling=first,
            selection=TournamentSelection(func_comp=comp_by_cv_and_fitness),
            crossover=SBX(prob=settings.crossover, eta=settings.crossover_eta),
            mutation=PM(prob=1.0, prob_var=settings.mutation, eta=settings.mutation_eta),
            survival=FitnessSurvival(),
        )
        problem = Problem(
            n_var=first.shape[1],
            n_obj=1,
            n_ieq_constr=len(KINDS) + 1,
            xl=np.zeros(first.shape[1]),
            xu=np.ones(first.shape[1]),
        )
        self._algorithm.setup(
            problem, termination=NoTermination(), seed=[_EVOLUTION_STREAM, settings.seed]
        )
        self._asked: Any = None

    def ask(self) -> Array | None:
        """Return the genes (m, n_genes) of the next generation, None if mating gives no new ones.

        No motion comes twice, so there may be fewer than a population.
        """
        self._asked = self._algorithm.infill()
        if self._asked is None or len(self._asked) == 0:
            return None
        return np.array(self._asked.get("X"), dtype=np.float64)

    def tell(self, scores: Scores, costs: Array) -> None:
        """Record scores, and costs to minimise (m,), of the generation that `ask` returned."""
        unexciting = np.where(scores.exciting, 0.0, _UNEXCITING_EXCESS)
        excess = np.column_stack((scores.excess, unexciting))
        finite_costs = np.nan_to_num(np.where(scores.usable, costs, 0.0))
        self._asked.set("F", finite_costs[:, None], "G", excess)
        self._algorithm.advance(infills=self._asked)


@dataclass(frozen=True)
class Goal:
    """Order of motions by the method of a search."""

    settings: SearchSettings  # of the search
    p: int  # number of parameters in the criteria
    precise: bool = False  # whether motions compare by the wanted precision

    @property
    def method(self) -> SearchMethod:
        """The method."""
        return METHODS[self.settings.method]

    def costs(self, scores: Scores) -> Array:
        """Return what is minimised (m,), for scores of m motions."""
        if self.precise:
            with np.errstate(divide="ignore"):
                return np.asarray(np.log(scores.precision))
        return self.costs_of_measures(scores.measures)

    def costs_of_measures(self, measures: Array) -> Array:
        """Return minus the fitness (m,) for measures (m, d); inf without excitation."""
        method = self.method
        exciting = finite(measures)
        values = columns(np.where(exciting[:, None], measures, 0.0), method.criteria)
        by_name = dict(zip(method.criteria, values.T, strict=True))
        fitness = method.fitness(by_name, self.settings.weights, self.p)
        return np.where(exciting, -fitness, np.inf)

    def fitness(self, scores: Scores) -> Array:
        """Return what is maximised (m,), for scores of m motions."""
        return -self.costs(scores)

    def choice(self, front: Front) -> int:
        """Return the index of the best motion of a non-empty front."""
        if self.precise:
            return int(np.argmin(front.precision))
        return int(np.argmin(self.costs_of_measures(front.measures)))

    def is_worse(self, criteria: Criteria, other: Criteria) -> bool:
        """Return whether a motion has a smaller fitness than another."""
        first, second = self.costs_of_measures(np.array((criteria.measures, other.measures)))
        return not bool(first <= second)


def search(
    population: Population,
    settings: SearchSettings,
    *,
    journal: Journal | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
    scored: Callable[[int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Design:
    """Search for the best motion of a population's problem.

    Args:
        population: of the first generation.
        settings: of the search.
        journal: new scores are appended to it.
        progress: called after each generation.
        scored: called with each number of newly scored motions.
        stop: called before each generation; true ends the search with the best motion so far.

    Raises:
        NoFeasibleMotionError: no motion satisfies all constraints and excites every parameter.
        PlannerNotStarted: a process cannot be started.
    """
    return _Search(population, settings, journal, progress, scored, stop).run()


def most_evaluations(settings: SearchSettings) -> int:
    """Return the largest number of motions that a search scores in all its phases."""
    return settings.population * settings.generations + SCORED_STEPS * settings.gradient


class _Search:
    """State of a search."""

    def __init__(
        self,
        population: Population,
        settings: SearchSettings,
        journal: Journal | None,
        progress: Callable[[SearchProgress], None] | None,
        scored: Callable[[int], None] | None,
        stop: Callable[[], bool],
    ) -> None:
        self._population = population
        self._settings = settings
        self._journal = journal
        self._genome = population.problem.genome
        self._progress = progress
        self._scored = scored
        self._stop = stop
        self._stopped = self._exhausted = False
        self._phase: Phase = "search"
        objective = population.problem.objective
        self._goal = Goal(settings, objective.n_parameters, objective.precision is not None)
        self._generations = 0
        self._first: tuple[Array, Scores] | None = None
        self._front = Front.empty(self._genome.n_genes, self._goal.method.criteria)
        self._tried = self._feasible = 0
        self._rejected: Counter[str] = Counter()
        # Smallest positive excess of each kind, with the genes.
        self._nearest: dict[str, tuple[float, Array]] = {}

    def run(self) -> Design:
        settings = self._settings
        goal = self._goal
        random = np.random.default_rng((_FIRST_GENERATION_STREAM, settings.seed))
        first = self._genome.sample(random, settings.population)
        if isinstance(self._genome, ViaPointGenome) and len(goal.method.reach) > 1:
            first = self._genome.contracted(first, goal.method.reach)
        evolution = Evolution(settings, first)
        while self._generations < settings.generations and not self._should_stop():
            children = evolution.ask()
            if children is None:
                self._exhausted = True
                break
            scores = self._score(children)
            if self._first is None:
                self._first = children, scores
            evolution.tell(scores, goal.costs(scores))
        front = self._front
        if len(front) == 0:
            raise self._failure()
        winner = goal.choice(front)
        genes = start = front.genes[winner]
        origin = trajectory, criteria = self._population.evaluate(start, RESCORE_PERIOD)
        genes = self._climbed(start, front.scores(winner))
        if genes.tobytes() != start.tobytes():
            trajectory, criteria = self._population.evaluate(genes, RESCORE_PERIOD)
            # better only at the search's sample period, or other genes of the same motion
            worse = not goal.precise and goal.is_worse(criteria, origin[1])
            if criteria == origin[1] or worse:
                genes = start
                (trajectory, criteria) = origin
        return Design(
            genes=genes.copy(),
            excitation=Excitation(
                trajectory=trajectory,
                criteria=criteria,
                method=settings.method,
                seed=settings.seed,
                tried=self._tried,
                rejected=dict(self._rejected),
                **self._genome.source(genes),
            ),
            front=front,
            chosen=winner if genes.tobytes() == start.tobytes() else None,
            origin=winner,
            origin_criteria=origin[1],
            generations=self._generations,
            complete=not self._stopped,
            exhausted=self._exhausted,
        )

    def _climbed(self, genes: Array, scores: Scores) -> Array:
        """Return the genes (n_genes,) of the best motion, improved by the gradient.

        With several starts half of the steps are shared by this motion and the best ones of the
        first generation; the other half improve what is best then.
        """
        steps = self._settings.gradient
        if steps == 0 or self._should_stop():
            return genes
        self._phase = "gradient"
        goal = self._goal
        ascent = Ascent(
            self._score,
            lambda genes, scores: self._population.linearise(
                genes, None if goal.precise else partials(goal.fitness, scores)
            ),
            goal.fitness,
            self._should_stop,
        )
        best = (genes, scores)
        starts = self._settings.starts
        if starts > 1:
            each = steps // (2 * starts)
            others = self._first_best(starts - 1, genes)
            climbed = [improve(ascent, *start, each) for start in (best, *others)]
            best = max(climbed, key=lambda motion: float(goal.fitness(motion[1])[0]))
            steps -= each * len(climbed)
        return improve(ascent, *best, steps)[0]

    def _first_best(self, count: int, but: Array) -> list[tuple[Array, Scores]]:
        """Return genes and scores of the best usable motions of the first generation but one."""
        if self._first is None:
            return []
        genes, scores = self._first
        values = np.where(scores.usable, self._goal.fitness(scores), -np.inf)
        order = np.argsort(-values, kind="stable")
        chosen = [k for k in order.tolist() if np.isfinite(values[k])]
        chosen = [k for k in chosen if genes[k].tobytes() != but.tobytes()]
        return [(genes[k].copy(), scores.take(k)) for k in chosen[:count]]

    def _score(self, genes: Array) -> Scores:
        """Return the scores of genes (m, n_genes), from the journal if it has them."""
        scores = None if self._journal is None else self._journal.recall(genes)
        if scores is None:
            scores = self._population.score(genes, self._scored)
            if self._journal is not None:
                self._journal.record(genes, scores)
        self._tried += len(genes)
        self._feasible += int(np.count_nonzero(scores.feasible))
        for kind, excess in zip(KINDS, scores.excess.T, strict=True):
            broken = np.flatnonzero(excess)
            if len(broken) > 0:
                self._rejected[kind] += len(broken)
                index = int(broken[np.argmin(excess[broken])])
                if kind not in self._nearest or excess[index] < self._nearest[kind][0]:
                    self._nearest[kind] = float(excess[index]), genes[index].copy()
        self._front = self._front.merge(Front.of(genes, scores, self._goal.method.criteria))
        self._report()
        return scores

    def _report(self) -> None:
        """Count the generation and report progress."""
        front = self._front
        self._generations += self._phase == "search"
        if self._progress is None:
            return
        best = np.full(len(SENSE), np.nan)
        if len(front) > 0:
            best = front.measures[self._goal.choice(front)]
        self._progress(
            SearchProgress(
                self._phase,
                self._generations,
                self._settings.generations,
                self._tried,
                self._feasible,
                tuple(best.tolist()),
            )
        )

    def _failure(self) -> NoFeasibleMotionError:
        """Return the error with the smallest violations of each kind."""
        nearest = {}
        for kind, (_, genes) in sorted(self._nearest.items()):
            broken = self._population.violations(genes)
            # empty if a process that was killed from outside was scored as unplannable
            same = [violation for violation in broken if violation.kind == kind] or broken
            nearest[kind] = max(same, key=lambda violation: violation.excess)
        return NoFeasibleMotionError(
            self._rejected,
            nearest,
            tried=self._tried,
            unexciting=self._feasible,
            stopped=self._stopped,
        )

    def _should_stop(self) -> bool:
        self._stopped = self._stopped or self._stop()
        return self._stopped
