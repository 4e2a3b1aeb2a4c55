r"""Variants of an arm as far apart as its parameters are uncertain, every one a possible machine.

Least squares knows the parameters up to :math:`\delta \sim N(0, C)`. For each variant one
:math:`\delta` is added to the estimate, and the physically consistent parameters nearest to the sum
are looked for, in the measure :math:`C^{-1}` and with the prior of
:mod:`identification.estimators.consistent` (randomise, then optimise). Where everything within the
intervals is possible the variants have the covariance C; where intervals reach beyond what is
possible, what lies beyond is moved to its edge and the variants are closer together. What the data
say nothing about stays at the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.consistent import (
    Consistency,
    Program,
    SquareRoot,
    solve_program,
)
from identification.factor.factor import Estimate
from identification.model.pseudo_inertia import margin
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

MOST: Final = 10_000
"""Variants; more would fill memories before they say more."""
# Smallest eigenvalue of the covariance in units of standard deviations, over the largest: in
# directions that are known better the measure is as if they were not, lest it be singular.
_BEST_KNOWN: Final = 1e-8
# So many that the prior's weight stays: the covariance holds the errors of the model already.
_ROWS: Final = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Ensemble:
    """N variants of an arm.

    Attributes:
        standard: standard parameters (N, s), every body and every rotor possible.
        values: the parameters (N, p) that follow from them, with friction, springs and balancers.
    """

    standard: Array
    values: Array


def sample_ensemble(model: RobotModel, estimate: Estimate, count: int, seed: int) -> Ensemble:
    """Draw variants of an arm.

    Args:
        model: the robot.
        estimate: of its parameters, with their covariance.
        count: number N of variants.
        seed: of the draws; the same one gives the same variants.

    Raises:
        IdentificationError: the count is not between 1 and `MOST`.
        SolverError: the solver found no possible parameters near some draw.
    """
    if not 1 <= count <= MOST:
        raise IdentificationError(f"{count} variants were asked for; ask for 1 to {MOST}")
    spread, measure = _roots(estimate.covariance)
    program = Program.of(model, SquareRoot(measure, measure @ estimate.values), Consistency())
    near, _ = solve_program(program, _ROWS)
    random = np.random.default_rng(seed)
    standard, values = [], []
    for _ in range(count):
        aim = estimate.values + spread @ random.standard_normal(spread.shape[1])
        one = replace(program, smooth=program.smooth._replace(z=measure @ aim))
        bodies, others = one.physical(solve_program(one, _ROWS, near)[0])
        if not np.all(margin(bodies[model.layout.links]) > 0.0):
            raise IdentificationError("a variant was left with an impossible body")
        standard.append(bodies)
        values.append(np.concatenate([model.base.grouping @ bodies, others]))
    return Ensemble(np.array(standard), np.array(values))


def _roots(covariance: Array) -> tuple[Array, Array]:
    """Return L (p, d) with ``L L'`` the covariance, and R (d, p) with ``R' R`` its inverse.

    Both are zero for parameters of infinite variance.
    """
    known = np.isfinite(np.diag(covariance))
    own = covariance[np.ix_(known, known)]
    scale = np.sqrt(np.diag(own))
    scale = np.where(scale > 0.0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(own / np.outer(scale, scale))
    sizes = np.sqrt(np.maximum(eigenvalues, 0.0))
    least = np.sqrt(_BEST_KNOWN) * sizes.max(initial=0.0)
    spread, measure = np.zeros((2, len(covariance), len(own)))
    spread[known] = scale[:, None] * vectors * sizes
    measure[known] = vectors / np.maximum(sizes, least) / scale[:, None]
    return spread, measure.T
