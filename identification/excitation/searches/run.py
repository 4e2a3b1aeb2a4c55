"""Searching for the motion that excites the parameters best: the paper's methods, and others.

Method A and method B of the paper are a genetic search for the largest determinant and for the
largest fitness of eq. 7; which motions they search among is the genome's affair. The same seed
gives the same design to the last bit, for any number of processes, and whether or not it was
interrupted and resumed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

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

from identification.excitation.criteria import Criteria, fitness_of
from identification.excitation.errors import DesignError, NoFeasibleMotionError
from identification.excitation.excitation import Excitation
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.polish import dominating, polish
from identification.excitation.searches.population import Population, SearchSettings
from identification.excitation.searches.scores import SAMPLE_COUNT, Front, Scale, Scores
from identification.excitation.violation import KINDS, Violation

Array = NDArray[np.float64]
Phase = Literal["sample", "search", "polish"]


class Progress(NamedTuple):
    """How far a search is.

    Attributes:
        phase: "sample" of random motions that give the scale, "search", "polish".
        generation: generations scored so far, of `generations`.
        generations: of the search.
        evaluated: motions scored so far in all phases, of `total`.
        total: how many there are going to be at most.
        feasible: how many of them keep every constraint.
        log10_det: of the best motion so far; nan before there is one.
        coupling_index: of the same motion. With the method "front" it is the knee so far.
    """

    phase: Phase
    generation: int
    generations: int
    evaluated: int
    total: int
    feasible: int
    log10_det: float
    coupling_index: float


@dataclass(frozen=True, eq=False)
class Design:
    """The motion that a search chose, and what it chose from.

    Attributes:
        settings: of the search.
        genes: (n_genes,) of the chosen motion.
        excitation: the motion, with its criteria at 1 ms.
        front: the best compromises of everything that the search itself scored, with measures at
            the search's own period. A polish looks for one motion, not for compromises, and is
            left out.
        chosen: which motion of the front it is; None where the polish found a better one.
        origin: which motion of the front it is or, polished, grew from.
        origin_criteria: those of that motion, at 1 ms as well. The chosen motion is not worse: in
            its fitness, with the method "front" in neither measure. A polished one that is, at
            1 ms and against what the search saw at its own period, is not chosen.
        history: (g, 3) after each generation: fitness, log10 det and coupling index of the best
            motion so far, nan before there is one. With the method "front" the fitness is nan
            and the measures are the best of either, of different motions.
        evaluated: how many motions were scored.
        infeasible: how many of them broke a constraint, by kind; one may count for several.
        complete: whether the search ran to its end.
        exhausted: whether that end came before its last generation, as mating brought nothing new.
        scale: units of the balanced fitness and of the knee; None where they play no part.
    """

    settings: SearchSettings
    genes: Array
    excitation: Excitation
    front: Front
    chosen: int | None
    origin: int
    origin_criteria: Criteria
    history: Array
    evaluated: int
    infeasible: Mapping[str, int]
    complete: bool
    exhausted: bool
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
        unexciting = np.where(scores.exciting, 0.0, _UNEXCITING)
        excess = np.column_stack((scores.excess, unexciting))
        # Objectives decide among feasible motions only, and must be finite for their distances.
        finite = np.nan_to_num(np.where(scores.usable[:, None], objectives, 0.0))
        self._asked.set("F", finite, "G", excess)
        self._algorithm.advance(infills=self._asked)


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
        self._history: list[tuple[float, float, float]] = []
        self._front = Front.empty(self._genome.n_genes)
        self._evaluated = self._feasible = 0
        self._infeasible: Counter[str] = Counter()
        # The smallest excess but zero of each kind, and of all together, and whose it is.
        self._mildest: dict[str, tuple[float, Array]] = {}

    def run(self) -> Design:
        goal = self._goal = self._chosen_goal()
        self._evolve(goal)
        front = self._front
        if len(front) == 0:
            raise self._failure()
        winner = goal.choice(front)
        genes = start = front.genes[winner]
        origin = trajectory, criteria = self._population.judged(start, RESCORE_PERIOD)
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
            excitation=Excitation(
                trajectory=trajectory,
                criteria=criteria,
                method=self._settings.method,
                seed=self._settings.seed,
                tried=self._evaluated,
                rejected=dict(self._infeasible),
                **self._genome.recorded(genes),
            ),
            front=front,
            chosen=winner if genes is start else None,
            origin=winner,
            origin_criteria=origin[1],
            history=np.array(self._history).reshape(-1, 3),
            evaluated=self._evaluated,
            infeasible=dict(self._infeasible),
            complete=not self._stopped,
            exhausted=self._exhausted,
            scale=goal.scale,
        )

    def _chosen_goal(self) -> Goal:
        """Return what decides, after a look at random motions where it needs a scale."""
        p = self._population.problem.objective.n_parameters
        if not _needs_scale(self._settings):
            return Goal(self._settings, p, None)
        scores = self._score(self._genome.sample(np.random.default_rng(_SCALE), SAMPLE_COUNT))
        try:
            return Goal(self._settings, p, Scale.of(scores))
        except DesignError:
            # Random motions excite hardly anything. A front does without a scale.
            if self._settings.method == "front":
                return Goal(self._settings, p, None)
            raise self._failure() from None

    def _evolve(self, goal: Goal) -> None:
        self._phase = "search"
        random = np.random.default_rng((_FIRST, self._settings.seed))
        first = self._genome.sample(random, self._settings.population)
        evolution = Evolution(self._settings, first, n_objectives=1 if goal.single else 2)
        while len(self._history) < self._settings.generations and not self._halted():
            genes = evolution.ask()
            if genes is None:
                self._exhausted = True
                return
            scores = self._score(genes)
            evolution.tell(scores, goal.objectives(scores))

    def _polished(self, goal: Goal, front: Front, winner: int) -> Array:
        """Return the genes of the best motion near the winner, or its own."""
        self._phase = "polish"
        start = front.scores(winner)
        return polish(
            self._score,
            front.genes[winner],
            start,
            goal.polished_by(start),
            evaluations=self._settings.polish,
            seed=self._settings.seed,
            stop=self._halted,
        ).genes

    def _score(self, genes: Array) -> Scores:
        """Return the scores of genes (m, n_genes), from the journal where it has them."""
        scores = None if self._journal is None else self._journal.recall(genes)
        if scores is None:
            scores = self._population.score(genes, self._scored)
            if self._journal is not None:
                self._journal.record(genes, scores)
        self._evaluated += len(genes)
        self._feasible += int(np.count_nonzero(scores.feasible))
        excess = dict(zip(KINDS, scores.excess.T, strict=True))
        for kind, each in excess.items():
            if count := int(np.count_nonzero(each)):
                self._infeasible[kind] += count
        for kind, each in {**excess, "all": scores.excess.sum(axis=1)}.items():
            broken = np.flatnonzero(each)
            if len(broken) > 0:
                index = int(broken[np.argmin(each[broken])])
                if kind not in self._mildest or each[index] < self._mildest[kind][0]:
                    self._mildest[kind] = float(each[index]), genes[index].copy()
        self._front = self._front.merge(Front.of(genes, scores))
        self._report()
        return scores

    def _report(self) -> None:
        """Extend the history and report how far the search is."""
        goal, front, best = self._goal, self._front, (np.nan, np.nan)
        if self._phase == "search" and goal is not None:
            self._history.append(goal.best(front))
        if self._progress is None:
            return
        if goal is not None and len(front) > 0:
            k = goal.choice(front)
            best = float(front.log10_det[k]), float(front.coupling_index[k])
        self._progress(
            Progress(
                self._phase,
                len(self._history),
                self._settings.generations,
                self._evaluated,
                most_evaluations(self._settings),
                self._feasible,
                *best,
            )
        )

    def _failure(self) -> NoFeasibleMotionError:
        """Return the error that says what forbids every motion, where, and by how much."""
        mildest, violations = self._mildest, self._population.violations
        closest = violations(mildest["all"][1]) if "all" in mildest else ()

        def worst(kind: str) -> Violation:
            found = violations(mildest[kind][1])
            # Only a process that ended for other reasons breaks something else the second time.
            alike = [violation for violation in found if violation.kind == kind]
            return max(alike or found, key=lambda violation: violation.excess)

        return NoFeasibleMotionError(
            self._infeasible,
            {kind: worst(kind) for kind in sorted(self._infeasible)},
            closest=closest,
            tried=self._evaluated,
            unexciting=self._feasible,
            stopped=self._stopped,
        )

    def _halted(self) -> bool:
        self._stopped = self._stopped or self._stop()
        return self._stopped


def _needs_scale(settings: SearchSettings) -> bool:
    return settings.method in ("balanced", "front")
