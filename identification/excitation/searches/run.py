"""Searching for the motion that excites the parameters best: the paper's methods, and others.

The same seed gives the same design to the last bit, for any number of processes, and whether or not
it was interrupted and resumed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.excitation.criteria import SENSE, Criteria, fitness_eq7
from identification.excitation.errors import DesignError
from identification.excitation.excitation import Excitation
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.population import CHUNK, Population, SearchSettings
from identification.excitation.searches.scores import SAMPLE_COUNT, Front, Scale, Scores
from identification.excitation.violation import KINDS, NoFeasibleMotionError, Violation

Array = NDArray[np.float64]
Phase = Literal["sample", "search", "polish"]
Fitness = Callable[[Scores], Array]


class Progress(NamedTuple):
    """How far a search is."""

    phase: Phase  #: "sample" of random motions that give the scale, "search", "polish"
    generation: int  #: generations scored so far, of `generations`
    generations: int  #: of the search
    evaluated: int  #: motions scored so far in all phases, of `total`
    total: int  #: how many there are going to be at most
    feasible: int  #: how many of them keep every constraint
    #: `CRITERIA` of the best motion so far, nan before there is one. With the method "front" it
    #: is the knee so far
    best: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Design:
    """The motion that a search chose, and what it chose from."""

    settings: SearchSettings  #: of the search
    genes: Array  #: (n_genes,) of the chosen motion
    #: the motion, with its criteria at 1 ms, and how many motions were scored
    excitation: Excitation
    #: the best compromises of everything that the search itself scored, with measures at the
    #: search's own period. A polish looks for one motion, not for compromises, and is left out
    front: Front
    chosen: int | None  #: which motion of the front it is; None where the polish found a better one
    origin: int  #: which motion of the front it is or, polished, grew from
    #: those of that motion, at 1 ms as well. The chosen motion is not worse: in its fitness, with
    #: the method "front" in neither measure. A polished one that is, at 1 ms and against what the
    #: search saw at its own period, is not chosen
    origin_criteria: Criteria
    #: (g, 1 + d) after each generation: fitness and `CRITERIA` of the best motion so far, nan
    #: before there is one. With the method "front" the fitness is nan and the measures are the
    #: best of each, of different motions
    history: Array
    complete: bool  #: whether the search ran to its end
    #: whether that end came before its last generation, as mating brought nothing new
    exhausted: bool
    #: units of the balanced fitness and of the knee; None where they play no part
    scale: Scale | None


RESCORE_PERIOD: Final = 0.001
"""s; the chosen motion is judged once more at the rate of a servo loop."""

# Random numbers that are no other part's, whatever the seeds: of the evolution, of its first
# generation, and of the motions that give the scale, which are the same for all seeds, so that a
# balanced fitness is.
_STREAM: Final = 6
_FIRST: Final = 4
_SCALE: Final = (5, 0)
# Added to the excess of a motion that cannot be judged: it ranks behind all that can, however much
# they exceed, and before those that cannot even be planned, whose excess is infinite.
_UNEXCITING: Final = 1e6
_ALL: Final = "all"


# A polish improves a motion by CMA-ES (Hansen 2016, "The CMA Evolution Strategy: A Tutorial"). It
# looks at ranks alone: whatever satisfies all constraints ranks before whatever breaks one. Its
# covariance is diagonal (Ros and Hansen 2008): a full one has more entries than a polish has
# evaluations, and its eigenvectors differ in their last bits with the threads of linear algebra.

# First steps, as a share of each gene's range: the search has left the motion near something good.
_STEP: Final = 0.03
# Steps below this change no motion that anybody could tell from the one before.
_SMALLEST_STEP: Final = 1e-7
# Random numbers that are no other search's, whatever the seeds.
_POLISH_STREAM: Final = 3
# How much the largest gain counts where none is a loss.
_SECOND: Final = 1e-3


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
    """Return the best motion found near a start, its genes (n_genes,) and scores (m = 1).

    Those of the start, two genes or more within [0, 1], bit for bit, where nothing better was
    found. "Better" is: nearer to keeping the constraints by their summed excess, then the fitness,
    of which -inf is the worst. The same seed gives the same motion to the last bit, whatever else
    draws random numbers meanwhile. A whole generation (m, n_genes) is scored at once, `evaluations`
    motions at most; `stop`, asked before each, ends the polish with the best so far. The start is
    not scored again: were that to fail for a reason that is not its own, anything would be better.
    """
    best = genes.copy(), scores
    least, most = (float(each[0]) for each in _merits(scores, fitness))
    size = generation_size(len(genes))
    strategy = _strategy(best[0], size, seed)
    evaluated = 0
    while evaluated + size <= evaluations and not stop():
        asked = np.array(strategy.ask())
        found = score(asked.copy())
        excess, values = _merits(found, fitness)
        strategy.tell(list(asked), _ranks(excess, values).tolist())
        # The first of those that are alike.
        index = int(np.lexsort((-values, excess))[0])
        if (excess[index], -values[index]) < (least, -most):
            least, most = float(excess[index]), float(values[index])
            best = asked[index].copy(), found.take(index)
        evaluated += size
        if not _SMALLEST_STEP < float(np.max(strategy.stds)) < np.inf:
            break
    return best


def dominating(reference: Scores, scale: Scale | None = None) -> Fitness:
    """Return a fitness that no motion can have above 0 unless it is as good as a reference (m = 1).

    The smallest of its gains, in units of the scale if there is one, counts (Wierzbicki 1980);
    where none is a loss the largest one counts a little too.
    """
    spread = 1.0 if scale is None else np.array(scale.spread)

    def fitness(scores: Scores) -> Array:
        gains = SENSE * (scores.measures - reference.measures) / spread
        least = gains.min(axis=1)
        merit: Array = np.where(least < 0.0, least, least + _SECOND * gains.max(axis=1))
        return merit

    return fitness


def generation_size(n_genes: int) -> int:
    """Return how many motions make a generation: the usual 4 + 3 ln n, in whole chunks."""
    return CHUNK * int(np.ceil((4.0 + 3.0 * np.log(n_genes)) / CHUNK))


def _merits(scores: Scores, fitness: Fitness) -> tuple[Array, Array]:
    """Return what motions are ranked by: excess (m,), the less the better, then fitness (m,)."""
    excess = np.where(scores.feasible, 0.0, np.sum(scores.excess, axis=1))
    values = np.asarray(fitness(scores), dtype=np.float64)
    # A motion that cannot be judged is the worst of its kind.
    return np.nan_to_num(excess, nan=np.inf), np.nan_to_num(values, nan=-np.inf)


def _ranks(excess: Array, fitness: Array) -> Array:
    """Return ranks from 1 for the best (m,), alike for motions that are alike."""
    pairs = np.stack((excess, -fitness))
    _, place = np.unique(pairs, axis=1, return_inverse=True)
    ranks: Array = scipy.stats.rankdata(place.ravel(), method="average")
    return ranks


def _strategy(start: Array, size: int, seed: int) -> Any:
    """Return a CMA-ES that draws from a generator of its own and neither prints nor writes."""
    import cma  # here, because it takes longer to load than many a command to run

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
            # nan: the package does not touch numpy's global generator
            "seed": np.nan,
            # below -9 nothing is shown, and no file of options is looked for
            "verbose": -10,
            "verb_log": 0,
        },
    )


class Evolution:
    """A GA with one objective, NSGA-II with more; both rank feasible motions before all others.

    From a first generation of genes (m, n_genes). Infeasible ones are ranked by the sum of their
    excesses, so constraints need no weights. Crossover is simulated binary, mutation polynomial,
    selection a binary tournament. Random numbers come from the seed alone.
    """

    def __init__(self, settings: SearchSettings, first: Array, n_objectives: int) -> None:
        # Some 0.2 s to load, which only a search needs.
        from pymoo.algorithms.moo.nsga2 import NSGA2, binary_tournament
        from pymoo.algorithms.soo.nonconvex.ga import GA, FitnessSurvival, comp_by_cv_and_fitness
        from pymoo.config import Config
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM
        from pymoo.operators.selection.tournament import TournamentSelection
        from pymoo.operators.survival.rank_and_crowding import RankAndCrowding

        Config.warnings["not_compiled"] = False  # it would be printed
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
        unexciting = np.where(scores.exciting, 0.0, _UNEXCITING)
        excess = np.column_stack((scores.excess, unexciting))
        # Objectives decide among feasible motions only, and must be finite for their distances.
        finite = np.nan_to_num(np.where(scores.usable[:, None], objectives, 0.0))
        self._asked.set("F", finite, "G", excess)
        self._algorithm.advance(infills=self._asked)


@dataclass(frozen=True)
class Goal:
    """Which of two motions is the better one, or that all measures count (method "front")."""

    settings: SearchSettings  # of the search
    p: int  # number of parameters that are judged
    scale: Scale | None  # units of the measures; None where it plays no part

    @property
    def single(self) -> bool:
        """Whether one number decides."""
        return self.settings.method != "front"

    def objectives(self, measures: Array) -> Array:
        """Return what is to be minimised, (m, 1) or (m, d), of measures (m, d)."""
        return -self.fitness(measures)[:, None] if self.single else -SENSE * measures

    def fitness(self, measures: Array) -> Array:
        """Return the one number of each motion (m,), the larger the better, of measures (m, d).

        -inf for a motion that leaves a parameter without excitation.
        """
        settings = self.settings
        if self.scale is not None:
            return self.scale.fitness(measures, settings.weights)
        if settings.method == "a":
            return np.asarray(measures[:, 0])
        return np.array(
            [
                fitness_eq7(size, coupled, self.p, settings.weights)
                for size, coupled, *_ in measures.tolist()
            ]
        )

    def choice(self, front: Front) -> int:
        """Return which motion of a front (at least one) is the winner.

        No fitness gets worse when all measures get better, so its best motion is on the front.
        """
        if self.single:
            return int(np.argmax(self.fitness(front.measures)))
        return front.knee(self.scale)

    def best(self, front: Front) -> Array:
        """Return fitness and measures (1 + d,) of the winner so far; nan without one."""
        if len(front) == 0:
            return np.full(1 + len(SENSE), np.nan)
        if not self.single:
            return np.append(np.nan, SENSE * np.max(SENSE * front.measures, axis=0))
        k = self.choice(front)
        return np.append(self.fitness(front.measures)[k], front.measures[k])

    def is_worse(self, one: Criteria, other: Criteria) -> bool:
        """Return whether a motion is worse than another, with "front" in any measure."""
        ours, theirs = self.objectives(np.array((one.measures, other.measures)))
        return not bool(np.all(ours <= theirs))

    def polished_by(self, start: Scores) -> Fitness:
        """Return what a polish from a motion (scores, m = 1) makes larger."""
        if self.single:
            return lambda scores: self.fitness(scores.measures)
        return dominating(start, self.scale)


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
        journal: scores already known, and where new ones are stored.
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
    """One search under way, and what it has seen so far."""

    def __init__(
        self,
        population: Population,
        settings: SearchSettings,
        journal: Journal | None,
        progress: Callable[[Progress], None] | None,
        scored: Callable[[int], None] | None,
        stop: Callable[[], bool],
    ) -> None:
        self._population, self._settings, self._journal = population, settings, journal
        self._genome = population.problem.genome
        self._progress, self._scored, self._stop = progress, scored, stop
        self._stopped = self._exhausted = False
        self._phase: Phase = "sample"
        self._goal: Goal | None = None
        self._history: list[Array] = []
        self._front = Front.empty(self._genome.n_genes)
        self._tried = self._feasible = 0
        self._rejected: Counter[str] = Counter()
        # The smallest excess but zero of each kind, and of all together, and whose it is.
        self._mildest: dict[str, tuple[float, Array]] = {}

    def run(self) -> Design:
        settings = self._settings
        goal = self._goal = self._chosen_goal()
        self._phase = "search"
        random = np.random.default_rng((_FIRST, settings.seed))
        first = self._genome.sample(random, settings.population)
        evolution = Evolution(settings, first, 1 if goal.single else len(SENSE))
        while len(self._history) < settings.generations and not self._halted():
            asked = evolution.ask()
            if asked is None:
                self._exhausted = True
                break
            scores = self._score(asked)
            evolution.tell(scores, goal.objectives(scores.measures))
        front = self._front
        if len(front) == 0:
            raise self._failure()
        winner = goal.choice(front)
        genes = start = front.genes[winner]
        origin = trajectory, criteria = self._population.judged(start, RESCORE_PERIOD)
        if settings.polish > 0 and not self._halted():
            self._phase = "polish"
            known = front.scores(winner)
            genes, _ = polish(
                self._score,
                start,
                known,
                goal.polished_by(known),
                evaluations=settings.polish,
                seed=settings.seed,
                stop=self._halted,
            )
        if genes.tobytes() != start.tobytes():
            trajectory, criteria = self._population.judged(genes, RESCORE_PERIOD)
            # Better only as the search samples, or other genes of the same motion.
            if criteria == origin[1] or goal.is_worse(criteria, origin[1]):
                genes, (trajectory, criteria) = start, origin
        return Design(
            settings=settings,
            genes=genes.copy(),
            excitation=Excitation(
                trajectory=trajectory,
                criteria=criteria,
                method=settings.method,
                seed=settings.seed,
                tried=self._tried,
                rejected=dict(self._rejected),
                **self._genome.recorded(genes),
            ),
            front=front,
            chosen=winner if genes.tobytes() == start.tobytes() else None,
            origin=winner,
            origin_criteria=origin[1],
            history=np.array(self._history).reshape(-1, 1 + len(SENSE)),
            complete=not self._stopped,
            exhausted=self._exhausted,
            scale=goal.scale,
        )

    def _chosen_goal(self) -> Goal:
        """Return what decides, after a look at random motions where it needs a scale."""
        scale, settings = None, self._settings
        if _needs_scale(settings):
            scores = self._score(self._genome.sample(np.random.default_rng(_SCALE), SAMPLE_COUNT))
            try:
                scale = Scale.of(scores)
            except DesignError:
                # Random motions excite hardly anything. A front does without a scale.
                if settings.method != "front":
                    raise self._failure() from None
        return Goal(settings, self._population.problem.objective.n_parameters, scale)

    def _score(self, genes: Array) -> Scores:
        """Return the scores of genes (m, n_genes), from the journal where it has them."""
        scores = None if self._journal is None else self._journal.recall(genes)
        if scores is None:
            scores = self._population.score(genes, self._scored)
            if self._journal is not None:
                self._journal.record(genes, scores)
        self._tried += len(genes)
        self._feasible += int(np.count_nonzero(scores.feasible))
        sums = scores.excess.sum(axis=1)
        for kind, excess in zip((*KINDS, _ALL), (*scores.excess.T, sums), strict=True):
            broken = np.flatnonzero(excess)
            if len(broken) > 0:
                if kind != _ALL:
                    self._rejected[kind] += len(broken)
                index = int(broken[np.argmin(excess[broken])])
                if kind not in self._mildest or excess[index] < self._mildest[kind][0]:
                    self._mildest[kind] = float(excess[index]), genes[index].copy()
        self._front = self._front.merge(Front.of(genes, scores))
        self._report()
        return scores

    def _report(self) -> None:
        """Extend the history and report how far the search is."""
        goal, front = self._goal, self._front
        if self._phase == "search" and goal is not None:
            self._history.append(goal.best(front))
        if self._progress is None:
            return
        best = np.full(len(SENSE), np.nan)
        if goal is not None and len(front) > 0:
            best = front.measures[goal.choice(front)]
        self._progress(
            Progress(
                self._phase,
                len(self._history),
                self._settings.generations,
                self._tried,
                most_evaluations(self._settings),
                self._feasible,
                tuple(best.tolist()),
            )
        )

    def _failure(self) -> NoFeasibleMotionError:
        """Return the error that says what forbids every motion, where, and by how much."""
        broken = {
            kind: self._population.violations(genes) for kind, (_, genes) in self._mildest.items()
        }

        def worst(kind: str) -> Violation:
            # Only a process that ended for other reasons breaks something else the second time.
            alike = [violation for violation in broken[kind] if violation.kind == kind]
            return max(alike or broken[kind], key=lambda violation: violation.excess)

        return NoFeasibleMotionError(
            self._rejected,
            {kind: worst(kind) for kind in sorted(self._rejected)},
            closest=broken.get(_ALL, ()),
            tried=self._tried,
            unexciting=self._feasible,
            stopped=self._stopped,
        )

    def _halted(self) -> bool:
        self._stopped = self._stopped or self._stop()
        return self._stopped


def _needs_scale(settings: SearchSettings) -> bool:
    return settings.method in ("balanced", "front")
