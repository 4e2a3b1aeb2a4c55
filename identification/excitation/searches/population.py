"""The problem of a search, scores of its motions from child processes, and their front."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.excitation.constraints import SAMPLE_PERIOD, Constraints, midpoints, sampled
from identification.excitation.criteria import (
    CRITERIA,
    OF_PAPER,
    SENSE,
    Criteria,
    Objective,
    columns,
)
from identification.excitation.genomes import Genome, Motion
from identification.excitation.searches.methods import Method
from identification.excitation.searches.sensitivity import (
    Linearisation,
    Sensitivity,
    gene_slopes,
    sensitivity_of,
)
from identification.excitation.violation import KINDS, Violation, WholeMotion, excess_by_kind
from planner import PlannerCrashed, PlannerError, PlanningTimedOut
from planner.worker import WorkerProcess, chunks_of, load, map_in_children, pack

_N_MEASURES: Final = len(CRITERIA)

ROW_LENGTH: Final = _N_MEASURES + 2 + len(KINDS)
"""Length of a row of scores: `CRITERIA`, precision, duration, one excess for each of `KINDS`."""


class Scores(NamedTuple):
    """Scores of m motions."""

    measures: Array  #: (m, d) `CRITERIA`; the worst values if unplannable or not exciting
    #: (m,) criterion of the wanted precision, to be minimised; 0 if none is wanted, inf if
    #: unplannable
    precision: Array
    duration: Array  #: (m,) [s]; nan if unplannable
    #: (m, n_kinds) largest excess of each of `KINDS`, 0 if satisfied; inf for "planning" if
    #: unplannable
    excess: Array

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Which motions satisfy all constraints, (m,)."""
        return np.asarray(np.all(self.excess == 0.0, axis=1))

    @property
    def exciting(self) -> NDArray[np.bool_]:
        """Which motions excite every parameter, (m,)."""
        return finite(self.measures)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which motions satisfy all constraints and excite every parameter, (m,)."""
        return self.feasible & self.exciting

    def take(self, index: int) -> Self:
        """Return the scores of one motion, m = 1."""
        return type(self)(*(values[index : index + 1] for values in self))

    @property
    def rows(self) -> Array:
        """The scores as one array, (m, ROW_LENGTH)."""
        return np.column_stack(self)

    @classmethod
    def of_rows(cls, rows: Array) -> Self:
        """Return the scores in an array (m, ROW_LENGTH)."""
        measures = rows[:, :_N_MEASURES]
        (precision, duration) = rows[:, _N_MEASURES : _N_MEASURES + 2].T
        return cls(measures, precision, duration, rows[:, _N_MEASURES + 2 :])


def finite(measures: Array) -> NDArray[np.bool_]:
    """Return which motions excite every parameter (...) by measures (..., d)."""
    return np.asarray(np.all(np.isfinite(measures), axis=-1))


def unplanned() -> Array:
    """Return the row (ROW_LENGTH,) of an unplannable motion."""
    excess = np.where(np.array(KINDS) == "planning", np.inf, 0.0)
    return np.concatenate((-SENSE * np.inf, [np.inf, np.nan], excess))


@dataclass(frozen=True, eq=False)
class Front:
    """Pareto front: the k motions not dominated in some criteria, the best in the last first.

    A wanted precision counts as one more criterion.

    Of motions with equal measures it has one: the shortest, then the one whose genes come first.
    So it does not depend on the order in which motions are added.
    """

    genes: Array  #: (k, n_genes), within [0, 1]
    measures: Array  #: (k, d)
    precision: Array  #: (k,) criterion of the wanted precision, 0 if none is wanted
    duration: Array  #: (k,) [s]
    criteria: tuple[str, ...] = OF_PAPER  #: in which motions compare

    @classmethod
    def empty(cls, n_genes: int, criteria: tuple[str, ...] = OF_PAPER) -> Self:
        """Return the front of no motions."""
        none = np.empty(0)
        return cls(np.empty((0, n_genes)), np.empty((0, _N_MEASURES)), none, none, criteria)

    @classmethod
    def of(cls, genes: Array, scores: Scores, criteria: tuple[str, ...] = OF_PAPER) -> Self:
        """Return the front of the usable motions among genes (m, n_genes)."""
        every = cls(genes, scores.measures, scores.precision, scores.duration, criteria)
        return every._part(scores.usable)._nondominated()

    def __len__(self) -> int:
        return len(self.measures)

    def measure(self, name: str) -> Array:
        """Return one of `CRITERIA` (k,)."""
        return columns(self.measures, (name,))[:, 0]

    def scores(self, index: int) -> Scores:
        """Return the scores of one motion, m = 1."""
        row = slice(index, index + 1)
        met = np.zeros((1, len(KINDS)))
        return Scores(self.measures[row], self.precision[row], self.duration[row], met)

    def merge(self, other: Self) -> Self:
        """Return the front of the motions of both."""
        return replace(
            self,
            genes=np.concatenate((self.genes, other.genes)),
            measures=np.concatenate((self.measures, other.measures)),
            precision=np.concatenate((self.precision, other.precision)),
            duration=np.concatenate((self.duration, other.duration)),
        )._nondominated()

    def _part(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        return replace(
            self,
            genes=self.genes[rows],
            measures=self.measures[rows],
            precision=self.precision[rows],
            duration=self.duration[rows],
        )

    def _nondominated(self) -> Self:
        cost = np.column_stack((columns(-SENSE * self.measures, self.criteria), self.precision))
        remaining = np.lexsort((*self.genes.T[::-1], self.duration, *cost.T))
        nondominated = []
        while len(remaining):  # no other one dominates the first in this order
            nondominated.append(remaining[0])
            remaining = remaining[np.any(cost[remaining] < cost[remaining[0]], axis=1)]
        return self._part(np.array(nondominated, dtype=np.intp))


@dataclass(frozen=True)
class SearchSettings:
    """Method and effort of a search."""

    method: Method = "b"  #: one of `METHODS`
    population: int = 150  #: individuals in a generation
    generations: int = 120  #: number of generations, the random first one included
    crossover: float = 0.9  #: probability that two parents are crossed (Table 1)
    mutation: float = 0.01  #: probability that a gene of a child is mutated (Table 1)
    #: lambda_1 of log10 det and lambda_2 of the coupling index ("gradient" and "b")
    weights: tuple[float, float] = (0.7, 0.3)
    seed: int = 0  #: the same seed gives the same design bit for bit
    crossover_eta: float = 15.0  #: distribution index of SBX; larger: children closer to parents
    mutation_eta: float = 20.0  #: distribution index of the mutation; larger: smaller changes
    gradient: int = 0  #: steps along the gradient from the best motion; 0: none
    starts: int = 1  #: motions that share the first half of these steps


@dataclass(frozen=True, eq=False)
class Problem:
    """Genome, objective and constraints of a search."""

    genome: Genome  #: decodes genes
    objective: Objective  #: evaluates excitation
    constraints: Constraints  #: of every motion
    #: sample period [s]: midpoints of such steps for the objective, ends for the constraints
    period: float = SAMPLE_PERIOD

    def score(self, genes: Array) -> Scores:
        """Score rows of genes (m, n_genes) in this process, which the solver can crash.

        The scores of a motion do not depend on the other rows, to the last bit.
        """
        rows = []
        for motion in self.genome.motions(genes):
            if isinstance(motion, PlannerError):
                rows.append(unplanned())
            else:
                measures, precision = self.objective.scores(midpoints(motion, self.period))
                excess = excess_by_kind(self._violations(motion))
                row = (*measures.values(), precision, motion.duration, *excess)
                rows.append(np.array(row))
        return Scores.of_rows(np.array(rows))

    def violations(self, genes: Array) -> tuple[Violation, ...]:
        """Return the violations of the motion of genes (n_genes,)."""
        (motion,) = self.genome.motions(genes[None])
        if isinstance(motion, PlannerError):
            return (_unplannable(motion),)
        return self._violations(motion)

    def evaluate(self, genes: Array, period: float) -> tuple[Motion, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: the motion cannot be planned.
        """
        (motion,) = self.genome.motions(genes[None])
        if isinstance(motion, PlannerError):
            raise motion
        return motion, self.objective.criteria(motion, period)

    def sensitivity(self, genes: Array, weights: Array | None) -> Sensitivity:
        """Return the slopes of `weights` (d,) times the criteria along the motion of genes.

        Without weights, of minus the logarithm of the precision's criterion.

        Raises:
            PlannerError: the motion cannot be planned.
        """
        return sensitivity_of(self, genes, weights)

    def _violations(self, motion: Motion) -> tuple[Violation, ...]:
        return self.constraints.violations(motion, sampled(motion, self.period))


def _unplannable(error: PlannerError) -> Violation:
    return Violation("planning", WholeMotion(str(error)), np.inf, 0.0, None)


MOTIONS_PER_CHUNK: Final = 8
"""Motions per call to a child process; few, so that all children finish a generation together."""


class Population:
    """Scores motions of one problem in child processes.

    Scores do not depend on the number of workers, to the last bit: each child has one thread for
    linear algebra. A motion that alone crashes its process twice, or exceeds the timeout [s] (of
    `MOTIONS_PER_CHUNK` motions, then of one alone), is scored as unplannable.

    Raises:
        PlannerNotStarted: in `score`: a process cannot be started.
    """

    def __init__(self, problem: Problem, workers: int = 1, timeout: float = 60.0) -> None:
        self.problem = problem
        self._packed = pack(problem)
        self._children = [WorkerProcess(timeout=timeout) for _ in range(workers)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the processes; scoring again starts new ones."""
        for child in self._children:
            child.close()

    def score(self, genes: Array, scored: Callable[[int], None] | None = None) -> Scores:
        """Return the scores of genes (m, n_genes); call `scored` with each number of new ones."""
        results = map_in_children(
            self._children,
            _score,
            chunks_of(len(genes), MOTIONS_PER_CHUNK),
            lambda chunk: (self._packed, genes[list(chunk)]),
            done=scored,
        )
        rows = [unplanned() if isinstance(row, Exception) else row for row in results]
        return Scores.of_rows(np.array(rows))

    def violations(self, genes: Array) -> tuple[Violation, ...]:
        """Return the violations of the motion of genes (n_genes,)."""
        try:
            violations: tuple[Violation, ...] = self._call("violations", genes)
        except (PlannerCrashed, PlanningTimedOut) as error:
            return (_unplannable(error),)
        return violations

    def evaluate(self, genes: Array, period: float) -> tuple[Motion, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: the motion cannot be planned.
        """
        evaluation: tuple[Motion, Criteria] = self._call("evaluate", genes, period)
        return evaluation

    def linearise(self, genes: Array, weights: Array | None) -> Linearisation | None:
        """Return `weights` (d,) times the criteria, and the margins, to first order in the genes.

        Without weights: see `Problem.sensitivity`. None if the motion cannot be planned.
        """
        try:
            sensitivity: Sensitivity = self._call("sensitivity", genes, weights)
        except PlannerError:
            return None
        # As many together as possible: legs and corners that they share are planned once.
        chunks = chunks_of(len(genes), -(-len(genes) // len(self._children)))
        packed = pack(sensitivity)
        rows = map_in_children(
            self._children,
            _slopes,
            chunks,
            lambda chunk: (self._packed, packed, genes, np.array(chunk)),
        )
        none = np.zeros(1 + len(sensitivity.left))
        slopes = np.array([none if isinstance(row, Exception) else row for row in rows])
        return Linearisation(slopes[:, 0], slopes[:, 1:].T.copy(), sensitivity.left)

    def _call(self, method: str, *arguments: object) -> Any:
        """Call a method of the problem in a child, again if another process killed the child."""
        (result,) = map_in_children(
            self._children[:1], _apply, [[0]], lambda _: (self._packed, method, *arguments)
        )
        if isinstance(result, PlannerCrashed | PlanningTimedOut):
            raise result
        return result


def _score(packed: bytes, genes: Array) -> Array:
    return _problem(packed).score(genes).rows


def _slopes(packed: bytes, sensitivity: bytes, genes: Array, which: NDArray[np.intp]) -> Array:
    return gene_slopes(_problem(packed), _sensitivity(sensitivity), genes, which)


@lru_cache(maxsize=1)
def _sensitivity(packed: bytes) -> Sensitivity:
    sensitivity: Sensitivity = load(packed)
    return sensitivity


def _apply(packed: bytes, method: str, *arguments: Any) -> list[Any]:
    return [getattr(_problem(packed), method)(*arguments)]


@lru_cache(maxsize=1)
def _problem(packed: bytes) -> Problem:
    """Return the unpacked problem, cached in each process."""
    problem: Problem = load(packed)
    return problem
