"""The problem of a search, and its motions scored in child processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.constraints import SAMPLE_PERIOD, Constraints, midpoints, sampled
from identification.excitation.criteria import Criteria, Objective
from identification.excitation.genomes import Genome, Motion
from identification.excitation.searches.scores import Scores, unplanned
from identification.excitation.violation import Violation, excess_by_kind
from planner import PlannerCrashed, PlannerError, PlanningTimedOut
from planner.worker import WorkerProcess, chunks_of, load, map_in_children, pack

Array = NDArray[np.float64]

Method = Literal["a", "b", "balanced", "front"]


@dataclass(frozen=True)
class SearchSettings:
    """Method and effort of a search."""

    #: "a": largest log10 det (D-optimal, eq. 9); "b": largest fitness of eq. 7; "balanced": both
    #: measures in units of their spread over random motions; "front": Pareto front of the two
    #: (NSGA-II), of which the knee is chosen
    method: Method = "front"
    population: int = 150  #: individuals in a generation
    generations: int = 120  #: number of generations, the random first one included
    crossover: float = 0.9  #: probability that two parents are crossed (Table 1)
    mutation: float = 0.01  #: probability that a gene of a child is mutated (Table 1)
    #: lambda_1 of log10 det and lambda_2 of the coupling index ("b" and "balanced")
    weights: tuple[float, float] = (0.7, 0.3)
    seed: int = 0  #: the same seed gives the same design bit for bit
    polish: int = 0  #: evaluations of a local search from the best motion; 0: none
    crossover_eta: float = 15.0  #: distribution index of SBX; larger: children closer to parents
    mutation_eta: float = 20.0  #: distribution index of the mutation; larger: smaller changes


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
                measures = self.objective.measures(midpoints(motion, self.period))
                excess = excess_by_kind(self._violations(motion))
                rows.append(np.array((*measures.values(), motion.duration, *excess)))
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

    def _violations(self, motion: Motion) -> tuple[Violation, ...]:
        return self.constraints.violations(motion, sampled(motion, self.period))


def _unplannable(error: PlannerError) -> Violation:
    return Violation("planning", f"the motion ({error})", np.inf, 0.0, None)


CHUNK: Final = 8
"""Motions per call to a child process; few, so that all children finish a generation together."""


class Population:
    """Scores motions of one problem in child processes.

    Scores do not depend on the number of workers, to the last bit: each child has one thread for
    linear algebra. A motion that alone crashes its process twice, or exceeds the timeout [s] (of
    `CHUNK` motions, then of one alone), is scored as unplannable.

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
            chunks_of(len(genes), CHUNK),
            lambda chunk: (self._packed, genes[list(chunk)]),
            done=scored,
        )
        rows = [unplanned() if isinstance(row, Exception) else row for row in results]
        return Scores.of_rows(np.array(rows))

    def violations(self, genes: Array) -> tuple[Violation, ...]:
        """Return the violations of the motion of genes (n_genes,)."""
        try:
            found: tuple[Violation, ...] = self._call("violations", genes)
        except (PlannerCrashed, PlanningTimedOut) as error:
            return (_unplannable(error),)
        return found

    def evaluate(self, genes: Array, period: float) -> tuple[Motion, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: the motion cannot be planned.
        """
        found: tuple[Motion, Criteria] = self._call("evaluate", genes, period)
        return found

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


def _apply(packed: bytes, method: str, *arguments: Any) -> list[Any]:
    return [getattr(_problem(packed), method)(*arguments)]


@lru_cache(maxsize=1)
def _problem(packed: bytes) -> Problem:
    """Return the unpacked problem, cached in each process."""
    problem: Problem = load(packed)
    return problem
