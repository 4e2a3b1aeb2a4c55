r"""The physically consistent estimate: full standard parameters that some machine can have.

Over the standard parameters :math:`\pi_s` and the friction f, one semidefinite program on the
torque objective itself (never a projection of an estimate, link by link):

.. math:: \min\; \|R\,[G\pi_s;\, f] - z\|^2
          + w \left( \sum_i D(J_i \,\|\, J_i^0) + \ldots \right)
          \quad\text{s.t.}\quad J_i \succ 0,\; I_{im} \ge 0,\; f_0, f_1 \ge 0

R is the square root of the weighted normal equations, G the grouping of the base parameters, J
the pseudo-inertia of a link (Wensing, Kim and Slotine 2018). D is the log-det divergence from the
nominal (CAD) bodies (Lee, Wensing and Park 2020), the dots are squares of rotor inertias (from the
nominal, where there is one) and friction in units that make them small. The data alone leave many
standard parameters open; there the nominal decides, elsewhere it weighs as much as `prior_weight`
rows of data: next to nothing. D is infinite at the edge of what is possible, so the result is
strictly inside.

Where motors turn with several joints, the rotors' inertia matrix, coupling inertias beside the
diagonal, has to be positive definite in place of I_im >= 0. What friction needs to take energy says
:mod:`identification.model.friction`: signs of the third friction term and of the offset are left
open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.consistent_program import (
    Consistency,
    InfeasibleError,
    Program,
    SolverError,
    SquareRoot,
    link_parameters,
    solve_program,
    square_root,
)
from identification.factor.factor import Estimate, Factor, joint_weights
from identification.model.pseudo_inertia import margin
from identification.model.robot import RobotModel

__all__ = [
    "Consistency",
    "ConsistentEstimate",
    "InfeasibleError",
    "SolverError",
    "SquareRoot",
    "consistent_estimate",
    "square_root",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ConsistentEstimate:
    """Parameters that a machine can have, and what it cost the fit.

    Attributes:
        standard_names: (s,).
        standard: standard parameters (s,), every pseudo-inertia positive definite, no rotor
            inertia negative. Where the data leave a choice they are close to the nominal ones.
        friction: coefficients (k,), see `RobotModel.friction_part`.
        estimate: the parameters (p,) that follow from them, with springs and balancers. Its
            covariance is the one of the unconstrained estimate: an inequality that holds has no
            covariance of its own, and one that binds makes the true spread smaller.
        unconstrained: the estimate without inequalities, as it was given.
        margin: smallest eigenvalue of each link's pseudo-inertia (n,), SI units, positive.
        excess: weighted squared torque error above the unconstrained minimum, in units in which
            a row of pure noise has 1.
        residual_rms: torque error per joint on the fitted samples (n,) [N·m or N].
        unconstrained_rms: the same of the unconstrained estimate.
        relative_error: ||tau - tau_hat|| / ||tau|| over all fitted rows.
        unconstrained_relative_error: the same of the unconstrained estimate.
        reference: per link, what stood for its nominal body, in words (n,).
        status: "optimal", and how, where the conic solver alone did not get there.
        solution: in the coordinates of the program (v,).
    """

    standard_names: tuple[str, ...]
    standard: Array
    friction: Array
    estimate: Estimate
    unconstrained: Estimate
    margin: Array
    excess: float
    residual_rms: Array
    unconstrained_rms: Array
    relative_error: float
    unconstrained_relative_error: float
    reference: tuple[str, ...]
    status: str
    solution: Array

    @property
    def cost(self) -> float:
        """What consistency costs on the fitted rows: difference of the relative errors."""
        return self.relative_error - self.unconstrained_relative_error

    @property
    def shift(self) -> Array:
        """How far each parameter was moved, in its standard deviations (p,); 0 if infinite."""
        moved = self.estimate.values - self.unconstrained.values
        std = self.unconstrained.std
        known = np.isfinite(std) & (std > 0.0)
        return np.where(known, moved / np.where(known, std, 1.0), 0.0)


def consistent_estimate(
    model: RobotModel,
    factor: Factor,
    unconstrained: Estimate,
    *,
    weights: Array | None = None,
    options: Consistency = Consistency(),  # noqa: B008 - frozen
    near: Array | None = None,
) -> ConsistentEstimate:
    """Fit physically consistent standard parameters and friction to the samples.

    Args:
        model: the robot.
        factor: the samples.
        unconstrained: the least-squares estimate of the same samples, to compare with.
        weights: per joint (n,); by default the inverse residual variance of an ordinary fit.
        options: prior and bounds.
        near: `solution` of much the same samples, see :func:`solve_program`.

    Raises:
        InfeasibleError: the mass bounds contradict each other.
        SolverError: the solver found no usable answer.
        ShapeError: an array does not have the shape it should have.
    """
    if unconstrained.names != model.parameter_names:
        raise IdentificationError("the unconstrained estimate is of other parameters")
    if weights is None:
        weights = joint_weights(factor)
    equations = factor.weighted(weights)
    root = square_root(equations)
    program = Program.of(model, root, options)
    solution, status = solve_program(program, options, equations.n, near)
    standard, others = program.physical(solution)
    found = margin(link_parameters(model, standard))
    if not np.all(found > 0.0):
        worst = model.joint_names[int(np.argmin(found))]
        raise SolverError(
            f"the solver ({status}) left the link of joint {worst!r} impossible, its pseudo-inertia"
            f" has the eigenvalue {found.min():.3g}",
            status=status,
        )
    values = np.concatenate([model.base.grouping @ standard, others])
    rms, relative = _errors(factor, values)
    free_rms, free_relative = _errors(factor, unconstrained.values)
    return ConsistentEstimate(
        standard_names=model.standard_names,
        standard=standard,
        friction=values[model.friction_part],
        estimate=replace(
            unconstrained,
            values=values,
            noise_std=np.where(factor.samples > 0, rms, np.nan),
            method="physically consistent (pseudo-inertia, rotor inertia and friction);"
            f" covariance of the unconstrained estimate: {unconstrained.method}",
        ),
        unconstrained=unconstrained,
        margin=found,
        excess=root.excess(values),
        residual_rms=rms,
        unconstrained_rms=free_rms,
        relative_error=relative,
        unconstrained_relative_error=free_relative,
        reference=program.bodies.words,
        status=status,
        solution=solution,
    )


def _errors(factor: Factor, values: Array) -> tuple[Array, float]:
    """Return the RMS torque error per joint (n,), and the relative error over all rows."""
    augmented = np.append(-values, 1.0)
    squares = np.maximum(np.einsum("i,jik,k->j", augmented, factor.gram, augmented), 0.0)
    torque = float(factor.gram[:, -1, -1].sum())
    rms = np.sqrt(squares / np.maximum(factor.samples, 1))
    return rms, float(np.sqrt(squares.sum() / torque)) if torque > 0.0 else 0.0
