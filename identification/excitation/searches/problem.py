"""A search's question and its answers: which genes, judged by what, within which constraints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.excitation.constraints import SAMPLE_PERIOD, Constraints, midpoints, sampled
from identification.excitation.criteria import Criteria
from identification.excitation.genome import Genome
from identification.excitation.objective import Objective
from identification.excitation.violation import KINDS, Violation, excess_by_kind
from planner import FourierSeries, PiecewiseCubic, PlannerError

Method = Literal["a", "b", "balanced", "front"]


@dataclass(frozen=True)
class SearchSettings:
    """What is sought, and with how much effort.

    Attributes:
        method: "a": the largest log10 det (D-optimal, eq. 9); "b": the largest fitness by eq. 7
            as printed; "balanced": both measures in units of their spread over random motions;
            "front": all compromises between the two at once (NSGA-II), the knee is chosen.
        population: individuals in a generation.
        generations: how many generations are scored, the first, random one among them:
            150 x 120 are 18 000 individuals.
        crossover: probability that a pair of parents is crossed (Table 1: "cross-over rate").
        mutation: probability that a gene of a child is changed (Table 1: "mutation").
        weights: lambda_1 of log10 det and lambda_2 of the coupling index ("b" and "balanced").
        seed: the same seed gives the same design, to the last bit.
        polish: evaluations of a local search from the winner; 0 for none.
        crossover_eta: how close children stay to their parents (SBX), the larger the closer.
        mutation_eta: how close a changed gene stays to what it was, the larger the closer.
    """

    method: Method = "front"
    population: int = 150
    generations: int = 120
    crossover: float = 0.9
    mutation: float = 0.01
    weights: tuple[float, float] = (0.7, 0.3)
    seed: int = 0
    polish: int = 0
    crossover_eta: float = 15.0
    mutation_eta: float = 20.0


Array = NDArray[np.float64]

_MEASURES: Final = 3

ROW: Final = _MEASURES + len(KINDS)
"""Numbers in a row of scores: two measures, a duration, one excess for each of `KINDS`."""


class Scores(NamedTuple):
    """Scores of m motions. `len` is that of a tuple: there are `len(scores.duration)` motions.

    Attributes:
        log10_det: (m,) log10 of det / N^p; -inf without excitation or without a motion.
        coupling_index: (m,) I_c; inf without excitation or without a motion.
        duration: (m,) [s]; nan where there is no motion.
        excess: (m, n_kinds) largest excess of each of `KINDS`, 0 where it is satisfied; inf of the
            first one, "planning", without a motion: anything that moves is nearer to feasible.
    """

    log10_det: Array
    coupling_index: Array
    duration: Array
    excess: Array

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Which motions keep every constraint, (m,)."""
        met: NDArray[np.bool_] = np.all(self.excess == 0.0, axis=1)
        return met

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which motions keep every constraint and excite every parameter, (m,)."""
        return self.feasible & np.isfinite(self.log10_det) & np.isfinite(self.coupling_index)

    def take(self, index: int) -> Self:
        """Return the scores of one motion, m = 1."""
        return type(self)(*(values[index : index + 1] for values in self))

    @property
    def rows(self) -> Array:
        """Return the same as one array, (m, ROW)."""
        return np.column_stack(self)

    @classmethod
    def feasible_ones(cls, log10_det: Array, coupling_index: Array, duration: Array) -> Self:
        """Return the scores of motions (m,) that keep every constraint."""
        return cls(log10_det, coupling_index, duration, np.zeros((len(duration), len(KINDS))))

    @classmethod
    def of_rows(cls, rows: Array) -> Self:
        """Return scores of what `rows` gave, (m, ROW)."""
        return cls(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, _MEASURES:])


def unplanned() -> Array:
    """Return the row (ROW,) of genes for which there is no motion."""
    row = np.zeros(ROW)
    row[:_MEASURES] = -np.inf, np.inf, np.nan
    row[_MEASURES + KINDS.index("planning")] = np.inf
    return row


@dataclass(frozen=True, eq=False)
class Problem:
    """Finds the scores of motions given by genes.

    Attributes:
        genome: what genes mean.
        objective: how good a motion is.
        constraints: what it must keep.
        period: motions are sampled this often [s] while searching: in the middle of such steps
            for the objective, at their ends for the constraints.
    """

    genome: Genome
    objective: Objective
    constraints: Constraints
    period: float = SAMPLE_PERIOD

    def score(self, genes: Array) -> Scores:
        """Score rows of genes (m, n_genes) in this process, which a solver's crash would end.

        The scores of a motion do not depend on its company, to the last bit.
        """
        rows = [self._row(trajectory) for trajectory in self.genome.motions(genes)]
        return Scores.of_rows(np.array(rows))

    def violations(self, genes: Array) -> tuple[Violation, ...]:
        """Return what the motion of genes (n_genes,) breaks, with place and amount."""
        (trajectory,) = self.genome.motions(genes[None])
        if isinstance(trajectory, PlannerError):
            return (unplannable(trajectory),)
        return self._assessed(trajectory)[2]

    def judged(
        self, genes: Array, period: float
    ) -> tuple[PiecewiseCubic | FourierSeries, Criteria]:
        """Return the motion of genes (n_genes,) and its criteria, sampled every `period` [s].

        Raises:
            PlannerError: there is no motion.
        """
        (trajectory,) = self.genome.motions(genes[None])
        if isinstance(trajectory, PlannerError):
            raise trajectory
        return trajectory, self.objective.criteria(trajectory, period)

    def _row(self, trajectory: PiecewiseCubic | FourierSeries | PlannerError) -> Array:
        if isinstance(trajectory, PlannerError):
            return unplanned()
        log10_det, coupling_index, violations = self._assessed(trajectory)
        excess = excess_by_kind(violations)
        return np.array((log10_det, coupling_index, trajectory.duration, *excess))

    def _assessed(
        self, trajectory: PiecewiseCubic | FourierSeries
    ) -> tuple[float, float, tuple[Violation, ...]]:
        # Constraints are looked at where the last check before a motion is sent looks.
        measures = self.objective.measures(midpoints(trajectory, self.period))
        return *measures, self.constraints.violations(trajectory, sampled(trajectory, self.period))


def unplannable(error: PlannerError) -> Violation:
    """Return how it is reported that there is no motion."""
    return Violation("planning", f"the motion ({error})", np.inf, 0.0, None)
