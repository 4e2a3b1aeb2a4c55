"""What a search has seen so far: how many motions, the best compromises, what forbids the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.errors import NoFeasibleMotionError
from identification.excitation.searches.front import Front
from identification.excitation.searches.journal import Journal
from identification.excitation.searches.population import Population
from identification.excitation.searches.problem import Scores
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


class Ledger:
    """Scores motions, from the journal where it has them, and keeps the books.

    Args:
        population: scores what the journal does not know.
        journal: where scores are looked up and stored.
        entered: called after each lot of motions.
        scored: called with a number of motions whenever so many more of a lot are scored.

    Attributes:
        front: of everything scored.
        evaluated: how many motions were scored.
        feasible: how many of them keep every constraint.
        infeasible: how many break it, by kind of constraint; a motion may count for several.
    """

    def __init__(
        self,
        population: Population,
        journal: Journal | None,
        entered: Callable[[], None] | None = None,
        scored: Callable[[int], None] | None = None,
    ) -> None:
        self._population = population
        self._journal = journal
        self._entered, self._scored = entered, scored
        self.front = Front.empty(population.problem.genome.n_genes)
        self.evaluated = 0
        self.feasible = 0
        self.infeasible: dict[str, int] = {}
        self._mildest: dict[str, tuple[float, Array]] = {}
        self._closest: tuple[float, Array] | None = None

    def score(self, genes: Array) -> Scores:
        """Return the scores of genes (m, n_genes)."""
        scores = None if self._journal is None else self._journal.recall(genes)
        if scores is None:
            scores = self._population.score(genes, self._scored)
            if self._journal is not None:
                self._journal.record(genes, scores)
        self._enter(genes, scores)
        return scores

    def failure(self, *, stopped: bool) -> NoFeasibleMotionError:
        """Return the error that tells what forbids every motion, where, and by how much."""
        nearest = {
            kind: self._again(kind, genes) for kind, (_, genes) in sorted(self._mildest.items())
        }
        return NoFeasibleMotionError(
            self.infeasible,
            nearest,
            closest=() if self._closest is None else self._population.violations(self._closest[1]),
            tried=self.evaluated,
            unexciting=self.feasible,
            stopped=stopped,
        )

    def _enter(self, genes: Array, scores: Scores) -> None:
        self.evaluated += len(genes)
        self.feasible += int(np.count_nonzero(scores.feasible))
        for kind, excess in zip(KINDS, scores.excess.T, strict=True):
            if count := int(np.count_nonzero(excess)):
                self.infeasible[kind] = self.infeasible.get(kind, 0) + count
                self._mildest[kind] = _milder(self._mildest.get(kind), genes, excess)
        summed = scores.excess.sum(axis=1)
        if np.any(summed):
            self._closest = _milder(self._closest, genes, summed)
        self.front = self.front.merge(Front.of(genes, scores))
        if self._entered is not None:
            self._entered()

    def _again(self, kind: str, genes: Array) -> Violation:
        """Return the violation that genes (n_genes,) were scored for."""
        found = self._population.violations(genes)
        alike = [violation for violation in found if violation.kind == kind]
        # Only a process that ended for other reasons breaks something else the second time.
        return max(alike or found, key=lambda violation: violation.excess)


def _milder(known: tuple[float, Array] | None, genes: Array, excess: Array) -> tuple[float, Array]:
    """Return the smallest excess but zero, and its genes (n_genes,); the known one where alike."""
    broken = np.flatnonzero(excess)
    index = int(broken[np.argmin(excess[broken])])
    if known is not None and known[0] <= excess[index]:
        return known
    return float(excess[index]), genes[index].copy()
