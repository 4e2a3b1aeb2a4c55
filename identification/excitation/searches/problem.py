"""A search's question: which genes, judged by what, within which constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.excitation.constraints import SAMPLE_PERIOD, Constraints, midpoints, sampled
from identification.excitation.criteria import Criteria
from identification.excitation.genome import Genome
from identification.excitation.objective import Objective
from identification.excitation.searches.scores import Scores, unplanned
from identification.excitation.violation import Violation, excess_by_kind
from planner import FourierSeries, PiecewiseCubic, PlannerError

Array = NDArray[np.float64]


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
