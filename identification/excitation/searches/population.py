"""Scoring populations in processes of their own, where a motion's crash costs that motion."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.criteria import Criteria
from identification.excitation.errors import DesignError
from identification.excitation.searches.problem import Problem, Scores, unplannable, unplanned
from identification.excitation.violation import Violation
from planner import FourierSeries, PiecewiseCubic, PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess, chunks_of, load, map_in_children, pack

Array = NDArray[np.float64]

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
        """Return the scores of rows of genes (m, n_genes).

        Args:
            genes: what to score.
            scored: called with a number of motions whenever so many more are scored.
        """
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
            found: tuple[Violation, ...] = self._alone(_violations, genes)
        except (PlannerCrashed, PlanningTimedOut) as error:
            return (unplannable(error),)
        return found

    def judged(
        self, genes: Array, period: float
    ) -> tuple[PiecewiseCubic | FourierSeries, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: there is no motion, or its planning ended the process.
        """
        found: tuple[PiecewiseCubic | FourierSeries, Criteria] = self._alone(_judged, genes, period)
        return found

    def _alone(self, function: Callable[..., list[Any]], *arguments: object) -> Any:
        """Return the one result of a function of the problem; an outside kill is made good."""
        (result,) = map_in_children(
            self._children[:1], function, [[0]], lambda _: (self._packed, *arguments)
        )
        if isinstance(result, PlannerCrashed | PlanningTimedOut):
            raise result
        return result


def _score(packed: bytes, genes: Array) -> Array:
    return _problem(packed).score(genes).rows


def _violations(packed: bytes, genes: Array) -> list[tuple[Violation, ...]]:
    return [_problem(packed).violations(genes)]


def _judged(
    packed: bytes, genes: Array, period: float
) -> list[tuple[PiecewiseCubic | FourierSeries, Criteria]]:
    return [_problem(packed).judged(genes, period)]


@lru_cache(maxsize=1)
def _problem(packed: bytes) -> Problem:
    """Return the problem, unpacked once in each process however often it is sent."""
    problem: Problem = load(packed)
    return problem
