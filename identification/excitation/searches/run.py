"""Searches for the best excitation, bit-identical for any number of processes and interruptions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import scipy

from identification.arrays import Array
from identification.excitation.criteria import OF_PAPER, SENSE, Criteria, columns
from identification.excitation.errors import DesignError
from identification.excitation.excitation import Excitation
from identification.excitation.genomes import ViaPointGenome
from identification.excitation.searches.bundle_method import TRIED, Ascent, improve
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.methods import METHODS, SearchMethod
from identification.excitation.searches.population import (
    CHUNK,
    SAMPLE_COUNT,
    Front,
    Population,
    Scale,
    Scores,
    SearchSettings,
    finite,
)
from identification.excitation.violation import KINDS, NoFeasibleMotionError

Phase = Literal["sample", "search", "gradient", "polish"]
Fitness = Callable[[Scores], Array]


class Progress(NamedTuple):
    """Progress of a search."""

    phase: Phase  #: "sample" (random motions for the scale), "search", "gradient", "polish"
    generation: int  #: scored generations
    generations: int  #: all generations
    evaluated: int  #: scored motions of all phases
    feasible: int  #: scored motions that satisfy all constraints
    #: `CRITERIA` of the best motion (of the knee for "front"), nan if there is none
    best: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a search."""

    genes: Array  #: (n_genes,) of the chosen motion
    excitation: Excitation  #: the motion and its criteria, sampled every `RESCORE_PERIOD`
    front: Front  #: of all motions before the polish, sampled at the search's period
    chosen: int | None  #: index of the motion in the front; None if the polish improved it
    origin: int  #: index in the front of the motion, or of the one that the polish started from
    #: criteria of that motion, sampled every `RESCORE_PERIOD`; the chosen motion is not worse in
    #: its fitness or, with "front", in either criterion
    origin_criteria: Criteria
    generations: int  #: number of scored generations
    complete: bool  #: whether the search ran to its end
    exhausted: bool  #: whether it ended early because mating gave no new motions


RESCORE_PERIOD: Final = 0.001
"""Sample period of the criteria of the chosen motion, s."""

# First seeds of independent random streams: evolution, first generation, and scale (the same for
# all seeds, so that balanced fitnesses compare).
_STREAM: Final = 6
_FIRST: Final = 4
_SCALE: Final = (5, 0)
# Excess of a motion that leaves a parameter without excitation: it ranks behind all that excite,
# and before unplannable ones, whose excess is infinite.
_UNEXCITING: Final = 1e6


# The polish is CMA-ES (Hansen 2016, "The CMA Evolution Strategy: A Tutorial") on ranks; feasible
# motions rank first. Its covariance is diagonal (Ros and Hansen 2008): a full one has more entries
# than a polish has evaluations, and its eigenvectors depend on the threads of linear algebra.
_STEP: Final = 0.03  # first step, fraction of each gene's range
_SMALLEST_STEP: Final = 1e-7
_POLISH_STREAM: Final = 3
_MEASURE_STEP: Final = 1e-3  # of criteria, for the derivatives of a fitness
_SECOND: Final = 1e-3  # weight of the largest gain if none is negative


def polish(
    score: Callable[[Array], Scores],
    genes: Array,
    scores: Scores,
    fitness: Fitness,
    *,
    evaluations: int,
    seed: int,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Array, Scores]:
    """Improve a motion by local search; return genes (n_genes,) and scores (m = 1) of the best.

    Motions compare by their summed excess, then by fitness, of which -inf is the worst. Without
    an improvement the start is returned unchanged. Generations (m, n_genes) are scored until
    `evaluations` motions, or until `stop` is true. The start needs at least two genes.
    """
    best = genes.copy(), scores
    least, most = (float(each[0]) for each in _merits(scores, fitness))
    size = generation_size(len(genes))
    strategy = _strategy(best[0], size, seed)
    evaluated = 0
    while evaluated + size <= evaluations and not stop():
        asked = np.array(strategy.ask())
        asked_scores = score(asked.copy())
        excess, values = _merits(asked_scores, fitness)
        strategy.tell(list(asked), _ranks(excess, values).tolist())
        index = int(np.lexsort((-values, excess))[0])  # the first of equal ones
        if (excess[index], -values[index]) < (least, -most):
            least = float(excess[index])
            most = float(values[index])
            best = asked[index].copy(), asked_scores.take(index)
        evaluated += size
        if not _SMALLEST_STEP < float(np.max(strategy.stds)) < np.inf:
            break
    return best


def dominating(
    reference: Scores, scale: Scale | None = None, criteria: tuple[str, ...] = OF_PAPER
) -> Fitness:
    """Return a fitness above 0 only for motions that dominate a reference (m = 1).

    It is the smallest gain, in units of the scale if given (Wierzbicki 1980); if no gain is
    negative, plus a small share of the largest.
    """
    spread = 1.0 if scale is None else np.array(scale.spread)

    def fitness(scores: Scores) -> Array:
        gains = columns(SENSE * (scores.measures - reference.measures), criteria) / spread
        least = gains.min(axis=1)
        merit: Array = np.where(least < 0.0, least, least + _SECOND * gains.max(axis=1))
        return merit

    return fitness


def partials(fitness: Fitness, scores: Scores) -> Array:
    """Return the derivatives (d,) of a fitness by the `CRITERIA` of a motion (m = 1)."""
    steps = _MEASURE_STEP * np.eye(len(SENSE))
    measures = scores.measures + np.concatenate((steps, -steps))
    rows = np.repeat(scores.rows, len(measures), axis=0)
    values = fitness(Scores.of_rows(rows)._replace(measures=measures))
    above, below = np.split(values, 2)
    return np.asarray((above - below) / (2.0 * _MEASURE_STEP))


def generation_size(n_genes: int) -> int:
    """Return the size of a generation: 4 + 3 ln n, rounded up to chunks."""
    return CHUNK * int(np.ceil((4.0 + 3.0 * np.log(n_genes)) / CHUNK))


def _merits(scores: Scores, fitness: Fitness) -> tuple[Array, Array]:
    """Return what motions rank by: summed excess (m,), then fitness (m,); nan is the worst."""
    excess = np.where(scores.feasible, 0.0, np.sum(scores.excess, axis=1))
    values = np.asarray(fitness(scores), dtype=np.float64)
    return np.nan_to_num(excess, nan=np.inf), np.nan_to_num(values, nan=-np.inf)


def _ranks(excess: Array, fitness: Array) -> Array:
    """Return ranks from 1 for the best (m,), equal for equal motions."""
    pairs = np.stack((excess, -fitness))
    _, place = np.unique(pairs, axis=1, return_inverse=True)
    ranks: Array = scipy.stats.rankdata(place.ravel(), method="average")
    return ranks


def _strategy(start: Array, size: int, seed: int) -> Any:
    """Return a CMA-ES with its own random generator, without output."""
    import cma  # slow to load

    random = np.random.default_rng([_POLISH_STREAM, seed])

    def normal(count: int, length: int | None = None) -> Array:
        return random.standard_normal(count if length is None else (count, length))

    return cma.CMAEvolutionStrategy(
        start,
        _STEP,
        {
            "bounds": [0.0, 1.0],
            "popsize": size,
            "CMA_diagonal": True,
            "randn": normal,
            "seed": np.nan,  # leaves numpy's global generator unchanged
            "verbose": -10,  # no output, no options file
            "verb_log": 0,
        },
    )


class Evolution:
    """A GA for one objective, NSGA-II for more, from a first generation of genes (m, n_genes).

    Feasible motions rank first, infeasible ones by the sum of their excesses. Simulated binary
    crossover, polynomial mutation, binary tournament.
    """

    def __init__(self, settings: SearchSettings, first: Array, n_objectives: int) -> None:
        # slow to load
        from pymoo.algorithms.moo.nsga2 import NSGA2, binary_tournament
        from pymoo.algorithms.soo.nonconvex.ga import GA, FitnessSurvival, comp_by_cv_and_fitness
        from pymoo.config import Config
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM
        from pymoo.operators.selection.tournament import TournamentSelection
        from pymoo.operators.survival.rank_and_crowding import RankAndCrowding

        Config.warnings["not_compiled"] = False
        kind, compare, survival = (
            (GA, comp_by_cv_and_fitness, FitnessSurvival())
            if n_objectives == 1
            else (NSGA2, binary_tournament, RankAndCrowding())
        )
        self._algorithm: Any = kind(
            pop_size=settings.population,
            sampling=first,
            selection=TournamentSelection(func_comp=compare),
            crossover=SBX(prob=settings.crossover, eta=settings.crossover_eta),
            mutation=PM(prob=1.0, prob_var=settings.mutation, eta=settings.mutation_eta),
            survival=survival,
        )
        problem = Problem(
            n_var=first.shape[1],
            n_obj=n_objectives,
            n_ieq_constr=len(KINDS) + 1,
            xl=np.zeros(first.shape[1]),
            xu=np.ones(first.shape[1]),
        )
        self._algorithm.setup(problem, termination=NoTermination(), seed=[_STREAM, settings.seed])
        self._asked: Any = None

    def ask(self) -> Array | None:
        """Return the genes (m, n_genes) of the next generation, None if mating gives no new ones.

        No motion comes twice, so there may be fewer than a population.
        """
        self._asked = self._algorithm.infill()
        if self._asked is None or len(self._asked) == 0:
            return None
        return np.array(self._asked.get("X"), dtype=np.float64)

    def tell(self, scores: Scores, objectives: Array) -> None:
        """Record scores and objectives (m, n_objectives) of the generation that `ask` returned."""
        unexciting = np.where(scores.exciting, 0.0, _UNEXCITING)
        excess = np.column_stack((scores.excess, unexciting))
        # Crowding distances need finite objectives.
        finite = np.nan_to_num(np.where(scores.usable[:, None], objectives, 0.0))
        self._asked.set("F", finite, "G", excess)
        self._algorithm.advance(infills=self._asked)


@dataclass(frozen=True)
class Goal:
    """Order of motions by the method of a search."""

    settings: SearchSettings  # of the search
    p: int  # number of parameters in the criteria
    scale: Scale | None  # units of the measures; None if not used
    precise: bool = False  # whether motions compare by the wanted precision

    @property
    def method(self) -> SearchMethod:
        """The method."""
        return METHODS[self.settings.method]

    @property
    def two_objectives(self) -> bool:
        """Whether motions compare by two criteria."""
        return self.method.fitness is None and not self.precise

    def costs(self, scores: Scores) -> Array:
        """Return the objectives to minimise, (m, 1) or (m, 2), for scores of m motions."""
        if self.precise:
            with np.errstate(divide="ignore"):
                return np.log(scores.precision)[:, None]
        return self.objectives(scores.measures)

    def objectives(self, measures: Array) -> Array:
        """Return the objectives to minimise, (m, 1) or (m, 2), for measures (m, d)."""
        method = self.method
        if method.fitness is None:
            return columns(-SENSE * measures, method.criteria)
        exciting = finite(measures)
        values = np.where(exciting[:, None], measures, 0.0)
        values = (
            columns(values, method.criteria) if self.scale is None else self.scale.gains(values)
        )
        by_name = dict(zip(method.criteria, values.T, strict=True))
        fitness = method.fitness(by_name, self.settings.weights, self.p)
        return np.where(exciting, -fitness, np.inf)[:, None]

    def choice(self, front: Front) -> int:
        """Return the index of the best motion of a non-empty front."""
        if self.precise:
            return int(np.argmin(front.precision))
        if self.method.fitness is None:
            return front.knee(self.scale)
        return int(np.argmin(self.objectives(front.measures)[:, 0]))

    def is_worse(self, criteria: Criteria, other: Criteria) -> bool:
        """Return whether a motion is worse than another, without a fitness in any criterion."""
        first, second = self.objectives(np.array((criteria.measures, other.measures)))
        return not bool(np.all(first <= second))

    def polish_fitness(self, start: Scores) -> Fitness:
        """Return the fitness that a polish from a motion (scores, m = 1) maximises."""
        if self.method.fitness is None and not self.precise:
            return dominating(start, self.scale, self.method.criteria)
        return lambda scores: -self.costs(scores)[:, 0]


def search(
    population: Population,
    settings: SearchSettings,
    *,
    journal: Journal | None = None,
    progress: Callable[[Progress], None] | None = None,
    scored: Callable[[int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Design:
    """Search for the best motion of a population's problem; new scores are appended to `journal`.

    `progress` is called after each generation, `scored` with each number of newly scored motions,
    `stop` before each generation; true ends the search with the best motion so far.

    Raises:
        NoFeasibleMotionError: no motion satisfies all constraints and excites every parameter.
        PlannerNotStarted: a process cannot be started.
    """
    return _Search(population, settings, journal, progress, scored, stop).run()


def most_evaluations(settings: SearchSettings) -> int:
    """Return the largest number of motions that a search scores in all its phases."""
    sampled = SAMPLE_COUNT if METHODS[settings.method].scaled else 0
    improved = TRIED * settings.gradient + settings.polish
    return sampled + settings.population * settings.generations + improved


class _Search:
    """State of a search."""

    def __init__(
        self,
        population: Population,
        settings: SearchSettings,
        journal: Journal | None,
        progress: Callable[[Progress], None] | None,
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
        self._phase: Phase = "sample"
        self._goal: Goal | None = None
        self._generations = 0
        self._first: tuple[Array, Scores] | None = None
        self._method = METHODS[settings.method]
        self._front = Front.empty(self._genome.n_genes, self._method.criteria)
        self._tried = self._feasible = 0
        self._rejected: Counter[str] = Counter()
        # Smallest positive excess of each kind, with the genes.
        self._nearest: dict[str, tuple[float, Array]] = {}

    def run(self) -> Design:
        settings = self._settings
        goal = self._goal = self._make_goal()
        self._phase = "search"
        random = np.random.default_rng((_FIRST, settings.seed))
        first = self._genome.sample(random, settings.population)
        if isinstance(self._genome, ViaPointGenome) and len(goal.method.reach) > 1:
            first = self._genome.contracted(first, goal.method.reach)
        evolution = Evolution(settings, first, 2 if goal.two_objectives else 1)
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
        genes = self._improved(goal, start, front.scores(winner))
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

    def _improved(self, goal: Goal, genes: Array, scores: Scores) -> Array:
        """Return the genes (n_genes,) of the best motion, improved by gradient and polish."""
        settings = self._settings
        if settings.gradient > 0 and not self._should_stop():
            self._phase = "gradient"
            genes, scores = self._climbed(goal, genes, scores)
        if settings.polish > 0 and not self._should_stop():
            self._phase = "polish"
            genes, _ = polish(
                self._score,
                genes,
                scores,
                goal.polish_fitness(scores),
                evaluations=settings.polish,
                seed=settings.seed,
                stop=self._should_stop,
            )
        return genes

    def _climbed(self, goal: Goal, genes: Array, scores: Scores) -> tuple[Array, Scores]:
        """Return genes and scores of the best motion, improved by the gradient.

        With several starts half of the steps are shared by this motion and the best ones of the
        first generation; the other half improve what is best then.
        """
        settings = self._settings
        fitness = goal.polish_fitness(scores)
        ascent = Ascent(
            self._score,
            lambda genes, scores: self._population.linearise(
                genes, None if goal.precise else partials(fitness, scores)
            ),
            fitness,
            self._should_stop,
        )
        steps = settings.gradient
        best = (genes, scores)
        if settings.starts > 1:
            each = steps // (2 * settings.starts)
            others = self._first_best(fitness, settings.starts - 1, genes)
            climbed = [improve(ascent, *start, each) for start in (best, *others)]
            best = max(climbed, key=lambda motion: float(fitness(motion[1])[0]))
            steps -= each * len(climbed)
        return improve(ascent, *best, steps)

    def _first_best(self, fitness: Fitness, count: int, but: Array) -> list[tuple[Array, Scores]]:
        """Return genes and scores of the best usable motions of the first generation but one."""
        if self._first is None:
            return []
        genes, scores = self._first
        values = np.where(scores.usable, fitness(scores), -np.inf)
        order = np.argsort(-values, kind="stable")
        chosen = [k for k in order.tolist() if np.isfinite(values[k])]
        chosen = [k for k in chosen if genes[k].tobytes() != but.tobytes()]
        return [(genes[k].copy(), scores.take(k)) for k in chosen[:count]]

    def _make_goal(self) -> Goal:
        """Return the goal, with a scale from random motions if the method needs one."""
        scale = None
        method = self._method
        settings = self._settings
        if method.scaled:
            scores = self._score(self._genome.sample(np.random.default_rng(_SCALE), SAMPLE_COUNT))
            try:
                scale = Scale.of(scores, method.criteria)
            except DesignError:  # a front can do without a scale
                if method.fitness is not None:
                    raise self._failure() from None
        objective = self._population.problem.objective
        return Goal(settings, objective.n_parameters, scale, objective.precision is not None)

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
        self._front = self._front.merge(Front.of(genes, scores, self._method.criteria))
        self._report()
        return scores

    def _report(self) -> None:
        """Count the generation and report progress."""
        goal = self._goal
        front = self._front
        self._generations += self._phase == "search"
        if self._progress is None:
            return
        best = np.full(len(SENSE), np.nan)
        if goal is not None and len(front) > 0:
            best = front.measures[goal.choice(front)]
        self._progress(
            Progress(
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
