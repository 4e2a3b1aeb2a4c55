"""What is searched for, and its motions scored in processes of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.constraints import SAMPLE_PERIOD, Constraints, midpoints, sampled
from identification.excitation.criteria import Criteria
from identification.excitation.errors import DesignError
from identification.excitation.genomes import Genome, Motion
from identification.excitation.objective import Objective
from identification.excitation.searches.scores import Scores, unplanned
from identification.excitation.violation import Violation, excess_by_kind
from planner import PlannerCrashed, PlannerError, PlanningTimedOut
from planner.worker import WorkerProcess, chunks_of, load, map_in_children, pack

Array = NDArray[np.float64]

Method = Literal["a", "b", "balanced", "front"]


@dataclass(frozen=True)
class SearchSettings:
    """What is sought, and with how much effort."""

    #: "a": the largest log10 det (D-optimal, eq. 9); "b": the largest fitness by eq. 7 as
    #: printed; "balanced": both measures in units of their spread over random motions; "front":
    #: all compromises between the two at once (NSGA-II), the knee is chosen
    method: Method = "front"
    population: int = 150  #: individuals in a generation
    #: how many generations are scored, the first, random one among them: 150 x 120 are 18 000
    #: individuals
    generations: int = 120
    #: probability that a pair of parents is crossed (Table 1: "cross-over rate")
    crossover: float = 0.9
    mutation: float = 0.01  #: probability that a gene of a child is changed (Table 1: "mutation")
    #: lambda_1 of log10 det and lambda_2 of the coupling index ("b" and "balanced")
    weights: tuple[float, float] = (0.7, 0.3)
    seed: int = 0  #: the same seed gives the same design, to the last bit
    polish: int = 0  #: evaluations of a local search from the winner; 0 for none
    #: how close children stay to their parents (SBX), the larger the closer
    crossover_eta: float = 15.0
    #: how close a changed gene stays to what it was, the larger the closer
    mutation_eta: float = 20.0


@dataclass(frozen=True, eq=False)
class Problem:
    """Finds the scores of motions given by genes."""

    genome: Genome  #: what genes mean
    objective: Objective  #: how good a motion is
    constraints: Constraints  #: what it must keep
    #: motions are sampled this often [s] while searching: in the middle of such steps for the
    #: objective, at their ends for the constraints
    period: float = SAMPLE_PERIOD

    def score(self, genes: Array) -> Scores:
        """Score rows of genes (m, n_genes) in this process, which a solver's crash would end.

        The scores of a motion do not depend on its company, to the last bit.
        """
        rows = []
        for motion in self.genome.motions(genes):
            if isinstance(motion, PlannerError):
                rows.append(unplanned())
            else:
                measures = self.objective.measures(midpoints(motion, self.period))
                excess = excess_by_kind(self._broken(motion))
                rows.append(np.array((*measures.values(), motion.duration, *excess)))
        return Scores.of_rows(np.array(rows))

    def violations(self, genes: Array) -> tuple[Violation, ...]:
        """Return what the motion of genes (n_genes,) breaks, with place and amount."""
        (motion,) = self.genome.motions(genes[None])
        return (_unplannable(motion),) if isinstance(motion, PlannerError) else self._broken(motion)

    def judged(self, genes: Array, period: float) -> tuple[Motion, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: there is no motion.
        """
        (motion,) = self.genome.motions(genes[None])
        if isinstance(motion, PlannerError):
            raise motion
        return motion, self.objective.criteria(motion, period)

    def _broken(self, motion: Motion) -> tuple[Violation, ...]:
        # Constraints are looked at where the last check before a motion is sent looks.
        return self.constraints.violations(motion, sampled(motion, self.period))


def _unplannable(error: PlannerError) -> Violation:
    return Violation("planning", f"the motion ({error})", np.inf, 0.0, None)


CHUNK: Final = 8
"""Motions per call to a process, the same for any number of processes.

Few, so that the processes end a generation of a hundred together.
"""


class Population:
    """Scores motions of one problem in child processes; keep one for all generations.

    Every motion is scored in a child, each with one thread for linear algebra, so scores are the
    same to the last bit for any number of workers. Genes whose motion ends its process, alone and
    twice, or holds it up alone for the whole timeout, are scored as having no motion.

    Args:
        problem: what scores mean.
        workers: number of processes, at least 1.
        timeout: longest time [s] for 8 motions, then for each of them alone. Generous, so that
            a busy machine changes no result. A motion that hangs takes twice as long at most, and
            nobody can stop the search meanwhile but by an interrupt.

    Raises:
        DesignError: no workers.
        PlannerNotStarted: in `score`, a process could not even be started, several times.
    """

    def __init__(self, problem: Problem, workers: int = 1, timeout: float = 60.0) -> None:
        if workers < 1:
            raise DesignError("workers", workers, "at least 1")
        self.problem = problem
        self._packed = pack(problem)
        self._children = [WorkerProcess(timeout=timeout) for _ in range(workers)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the processes; scoring again starts new ones."""
        for child in self._children:
            child.close()

    def score(self, genes: Array, scored: Callable[[int], None] | None = None) -> Scores:
        """Return the scores of genes (m, n_genes); `scored` is called with how many more are."""
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
        """Return what the motion of genes (n_genes,) breaks, with place and amount."""
        try:
            found: tuple[Violation, ...] = self._alone("violations", genes)
        except (PlannerCrashed, PlanningTimedOut) as error:
            return (_unplannable(error),)
        return found

    def judged(self, genes: Array, period: float) -> tuple[Motion, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: there is no motion, or its planning ended the process.
        """
        found: tuple[Motion, Criteria] = self._alone("judged", genes, period)
        return found

    def _alone(self, method: str, *arguments: object) -> Any:
        """Return what a method of the problem returns; an outside kill is made good."""
        (result,) = map_in_children(
            self._children[:1], _called, [[0]], lambda _: (self._packed, method, *arguments)
        )
        if isinstance(result, PlannerCrashed | PlanningTimedOut):
            raise result
        return result


def _score(packed: bytes, genes: Array) -> Array:
    return _problem(packed).score(genes).rows


def _called(packed: bytes, method: str, *arguments: Any) -> list[Any]:
    return [getattr(_problem(packed), method)(*arguments)]


@lru_cache(maxsize=1)
def _problem(packed: bytes) -> Problem:
    """Return the problem, unpacked once in each process however often it is sent."""
    problem: Problem = load(packed)
    return problem
