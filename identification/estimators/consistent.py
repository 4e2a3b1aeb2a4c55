r"""Physically consistent estimates: standard parameters that a robot can have.

Over the standard parameters :math:`\pi_s` and the friction f, one convex program

.. math:: \min\; \tfrac{1}{d} \|R\,[G\pi_s;\, f] - z\|^2 + \|S^{-1}([\pi_s; f] - \mu)\|^2
          \quad\text{s.t.}\quad J_i \succ 0,\; I_{im} \ge 0,\; f_0, f_1 \ge 0

R is the square root of the weighted normal equations, d the rows that count as one, G the grouping
of the base parameters, mu and S mean and deviations of :class:`BodyPrior`, J the pseudo-inertia of
a link (Wensing, Kim and Slotine 2018). It is the most probable point of the posterior among the
arms that can be built, solved by a conic solver (Goulart and Chen 2024).

Where motors turn with several joints, the rotors' inertia matrix with coupling inertias has to be
positive definite instead of I_im >= 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.prior import BodyPrior, body_prior
from identification.factor.estimate import Estimate, estimate, joint_weights
from identification.factor.factor import Factor
from identification.factor.normal_equations import NormalEquations, rows_of
from identification.model.friction import dissipation
from identification.model.link_wrenches import N_LINK
from identification.model.pseudo_inertia import (
    ReferenceBodies,
    inertial_from_pseudo,
    margin,
    reference_bodies,
)
from identification.model.robot import RobotModel

# smallest eigenvalue of a pseudo-inertia relative to the reference's
_MIN_EIGENVALUE_RATIO: Final = 1e-6
_MIN_ROTOR_EIGENVALUE: Final = 1e-6  # of the rotors' matrix, relative to its scale
_SOLVED: Final = ("Solved", "AlmostSolved")
_SOLVER_TOLERANCE: Final = 1e-9  # of the conic solver
# share of the way to the border of a cone, where the usual 0.99 fails
_SHORT_STEP_FRACTION: Final = 0.9
_MAX_REFINEMENTS: Final = 50  # of each linear system then, at most
# the constraints have solutions: any bodies of the references
_INFEASIBILITY_TOLERANCE: Final = 1e-16
# distance of a column from those before it, relative to its length
_DEPENDENCE_TOLERANCE: Final = 1e-15


class SolverError(IdentificationError):
    """No physically consistent parameters were found."""


class Cone(NamedTuple):
    """Symmetric matrices ``sum_k u[places_k] entries_k - inside`` that are positive definite."""

    places: NDArray[np.intp]  # indices of the d variables of a matrix (d,)
    entries: Array  # symmetric, of each (d, k, k)
    inside: Array  # (k, k)


@dataclass(frozen=True, eq=False)
class Program:
    """Convex program in variables u of size one for the reference.

    Per link ten entries of the pseudo-inertia in axes in which the reference's is the unit matrix;
    then rotors and coupling inertias; then friction, springs and balancers.
    """

    bodies: ReferenceBodies  # reference of each link
    to_parameters: Array  # standard parameters, then the others, from u (s + k, v)
    cones: tuple[Cone, ...]
    positive: Array  # rows (r, v) whose product with u is not negative

    @classmethod
    @lru_cache(maxsize=4)  # the folds of a recording have one model and prior
    def of(cls, model: RobotModel, prior: BodyPrior) -> Program:
        """Set up the constraints of a model; the prior gives the size of drives and friction."""
        layout = model.layout
        b = model.base.rank
        links = layout.links
        s = layout.size
        k = model.n_parameters - b
        bodies = reference_bodies(model.nominal[links], model.chain.translation)
        scale = np.where(np.isfinite(prior.std) & (prior.std > 0.0), prior.std, 1.0)
        transform = np.diag(scale)
        cones = []
        for places, frame in zip(links, bodies.frames, strict=True):
            entries = np.einsum("ab,kbc,dc->kad", frame, _SYMMETRIC, frame)
            transform[np.ix_(places, places)] = inertial_from_pseudo(entries).T
            cones.append(Cone(places, _SYMMETRIC, _MIN_EIGENVALUE_RATIO * np.eye(4)))
        alone = layout.rotors
        if layout.pairs:
            coupled = _coupled_rotors(model, scale)
            cones.append(coupled)
            alone = np.setdiff1d(alone, coupled.places)
        # The layout of u is that of the parameters: a link's ten places hold its entries.
        losses = dissipation(model.friction)
        count = len(losses.combine)
        friction = np.zeros((count, s + k))
        friction[:, s : s + count] = np.linalg.inv(losses.combine) * scale[s : s + count]
        rows = np.concatenate([np.eye(s + k)[alone], friction[losses.not_negative]])
        return cls(bodies, transform, tuple(cones), rows)

    def solve(self, rows: Array, target: Array) -> Array:
        """Return the parameters (s + k,) that minimise ``||rows x - target||`` (r, s + k), (r,).

        Raises:
            SolverError: the conic solver found none.
        """
        import clarabel  # slow import of what most identifications do not need

        # In variables y = R u - Q' z the objective is |y|²: as exact where the prior alone counts
        # as where the data are many orders of magnitude more precise.
        q, triangle = np.linalg.qr(_of_full_rank(rows @ self.to_parameters))
        middle = np.linalg.solve(triangle, q[: len(target)].T @ target)
        constraints, bounds, cones = self._constraints
        size = len(middle)
        problem = (
            scipy.sparse.eye_array(size, format="csc"),
            np.zeros(size),
            scipy.sparse.csc_matrix(np.linalg.solve(triangle.T, constraints.T).T),
            bounds - constraints @ middle,
            cones,
        )
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _SOLVER_TOLERANCE
        # Exact data of an arm that cannot be are far from all that can: no certificate by rounding.
        settings.tol_infeas_abs = settings.tol_infeas_rel = _INFEASIBILITY_TOLERANCE
        solution = clarabel.DefaultSolver(*problem, settings).solve()
        if str(solution.status) not in _SOLVED:
            # Rounding ended it; shorter steps stay further from the borders of the cones.
            settings.max_step_fraction = _SHORT_STEP_FRACTION
            settings.iterative_refinement_max_iter = _MAX_REFINEMENTS
            solution = clarabel.DefaultSolver(*problem, settings).solve()
        if str(solution.status) not in _SOLVED:
            raise SolverError(
                f"no physically consistent parameters were found (conic solver: {solution.status})"
            )
        u = middle + np.linalg.solve(triangle, np.array(solution.x))
        return self.to_parameters @ self._inside(u)

    @cached_property
    def _constraints(self) -> tuple[Array, Array, list[Any]]:
        """A, b and the cones K of ``b - A u in K``."""
        import clarabel

        blocks = [-self.positive]
        bounds = [np.zeros(len(self.positive))]
        cones = [clarabel.NonnegativeConeT(len(self.positive))] if len(self.positive) else []
        for cone in self.cones:
            block = np.zeros((_triangle_size(cone.inside), self.positive.shape[1]))
            block[:, cone.places] = -_triangles(cone.entries).T
            blocks.append(block)
            bounds.append(-_triangles(cone.inside[None])[0])
            cones.append(clarabel.PSDTriangleConeT(len(cone.inside)))
        return np.concatenate(blocks), np.concatenate(bounds), cones

    def _inside(self, u: Array) -> Array:
        """Return u moved inside all constraints, by what the solver's tolerance left outside."""
        u = u.copy()
        for cone in self.cones:
            matrix = np.tensordot(u[cone.places], cone.entries, axes=1) - cone.inside
            lowest = float(np.linalg.eigvalsh(matrix)[0])
            if lowest < 0.0:
                unit = np.einsum("kaa->k", cone.entries)
                u[cone.places] -= lowest * unit
        return u


def consistent_parameters(
    model: RobotModel, equations: NormalEquations, prior: BodyPrior, design_effect: float = 1.0
) -> tuple[Array, Array]:
    """Return the most probable consistent standard parameters (s,) and others (k,).

    Args:
        model: of the arm.
        equations: normal equations of the data.
        prior: of the bodies.
        design_effect: rows of data that count as one.

    Raises:
        SolverError: the conic solver found none.
    """
    program = Program.of(model, prior)
    s = model.layout.size
    rows, target = rows_of(equations)
    informative = np.isfinite(prior.std) & (prior.std > 0.0)
    weight = 1.0 / prior.std[informative]
    data = rows @ prior.combinations / np.sqrt(design_effect)
    x = program.solve(
        np.concatenate([data, weight[:, None] * np.eye(len(prior.std))[informative]]),
        np.concatenate([target / np.sqrt(design_effect), weight * prior.mean[informative]]),
    )
    x = without_rounding(model, x)
    return x[:s], x[s:]


def without_rounding(model: RobotModel, parameters: Array) -> Array:
    """Return parameters (s + k,) with zero where rounding made drives or friction negative."""
    x = parameters.copy()
    s = model.layout.size
    layout = model.layout
    friction = dissipation(model.friction)
    part = slice(s, s + len(friction.combine))
    shares = np.linalg.solve(friction.combine, x[part])
    shares[friction.not_negative] = np.maximum(shares[friction.not_negative], 0.0)
    x[part] = friction.combine @ shares
    alone = np.setdiff1d(layout.rotors, [joint for pair in layout.pairs for joint in pair])
    x[alone] = np.maximum(x[alone], 0.0)
    return x


def is_consistent(model: RobotModel, parameters: Array) -> bool:
    """Return whether bodies, drives and friction (s + k,) can exist."""
    s = model.layout.size
    layout = model.layout
    losses = dissipation(model.friction)
    friction = parameters[s : s + len(losses.combine)]
    shares = np.linalg.solve(losses.combine, friction)[losses.not_negative]
    rotors = layout.rotor_matrix(parameters[:s])
    return bool(
        np.all(margin(parameters[layout.links]) > 0.0)
        and np.all(shares >= 0.0)
        and float(np.linalg.eigvalsh(rotors)[0]) >= 0.0
    )


def consistent_values(
    model: RobotModel,
    factor: Factor,
    weights: Array,
    values: Array,
    prior: BodyPrior,
    design_effect: float = 1.0,
) -> Array:
    """Return a posterior's parameters (p,), or the most probable consistent ones.

    Args:
        model: of the arm.
        factor: of the data.
        weights: of the joints (n,).
        values: parameters of the free posterior (p,).
        prior: of the bodies.
        design_effect: rows of data that count as one.

    Raises:
        SolverError: the conic solver found none.
    """
    if is_consistent(model, prior.most_probable(values)):
        return values
    parts = consistent_parameters(model, factor.weighted(weights), prior, design_effect)
    return np.asarray(prior.combinations @ np.concatenate(parts))


def _of_full_rank(matrix: Array) -> Array:
    """Return rows (r, v), with a unit row for each variable that depends on previous ones."""
    identity = np.eye(matrix.shape[1])
    square = np.concatenate([matrix, np.zeros_like(identity)])
    distance = np.abs(np.diag(np.linalg.qr(square, mode="r")))
    dependent = distance <= _DEPENDENCE_TOLERANCE * np.linalg.norm(matrix, axis=0)
    return np.concatenate([matrix, identity[dependent]])


def _symmetric_basis() -> Array:
    """Return the unit entries of a symmetric 4x4 matrix (10, 4, 4)."""
    rows, columns = np.triu_indices(4)
    basis = np.zeros((N_LINK, 4, 4))
    basis[np.arange(N_LINK), rows, columns] = 1.0
    basis[np.arange(N_LINK), columns, rows] = 1.0
    return basis


_SYMMETRIC: Final = _symmetric_basis()


def _triangle_size(matrix: Array) -> int:
    return len(matrix) * (len(matrix) + 1) // 2


def _triangles(matrices: Array) -> Array:
    """Return upper triangles of symmetric matrices (d, k, k) by columns, as the solver has them.

    Entries off the diagonal are multiplied by the root of two, which keeps scalar products.
    """
    k = matrices.shape[1]
    columns, rows = np.tril_indices(k)
    scale = np.where(rows == columns, 1.0, np.sqrt(2.0))
    return np.asarray(matrices[:, rows, columns] * scale)


def _coupled_rotors(model: RobotModel, size: Array) -> Cone:
    """Return the cone of the coupled joints' rotor inertia matrix in units of `size` (s + k,)."""
    layout = model.layout
    joints = sorted({joint for pair in layout.pairs for joint in pair})
    places = np.concatenate([layout.rotors[joints], layout.couplings])
    entries = np.zeros((len(places), len(joints), len(joints)))
    for k in range(len(joints)):
        entries[k, k, k] = 1.0
    for k, pair in enumerate(layout.pairs, len(joints)):
        i, j = (joints.index(joint) for joint in pair)
        entries[k, i, j] = entries[k, j, i] = 1.0
    # In units of the rotors, so that the margin is relative.
    unit = np.sqrt(size[layout.rotors[joints]])
    entries = entries * size[places][:, None, None] / np.outer(unit, unit)
    return Cone(places, entries, _MIN_ROTOR_EIGENVALUE * np.eye(len(joints)))


@dataclass(frozen=True, eq=False)
class ConsistentEstimate:
    """Physically consistent parameters, compared with the unconstrained estimate."""

    standard: Array  # standard parameters (s,); close to the nominal ones where undetermined
    friction: Array  # coefficients (k,), see `RobotModel.friction_part`
    # parameters (p,) with springs and balancers; the covariance is that of `unconstrained`
    estimate: Estimate
    unconstrained: Estimate
    margin: Array  # smallest eigenvalue of each link's pseudo-inertia (n,), SI units, positive
    relative_error: float  # ||tau - tau_hat|| / ||tau|| over all fitted rows
    unconstrained_relative_error: float
    reference: tuple[str, ...]  # description of the nominal body of each link (n,)
    fits: bool  # whether these parameters fit the data to their noise, as the unconstrained do

    @property
    def shift(self) -> Array:
        """Change of each parameter in standard deviations (p,); 0 if they are infinite."""
        moved = self.estimate.values - self.unconstrained.values
        std = self.unconstrained.std
        determined = np.isfinite(std) & (std > 0.0)
        return np.where(determined, moved / np.where(determined, std, 1.0), 0.0)


def consistent_estimate(
    model: RobotModel,
    factor: Factor,
    unconstrained: Estimate | None = None,
    *,
    weights: Array | None = None,
    prior: BodyPrior | None = None,
    design_effect: float = 1.0,
) -> ConsistentEstimate:
    """Fit physically consistent standard parameters and friction to the samples.

    Args:
        model: of the arm.
        factor: of the samples.
        unconstrained: estimate from the same samples, for comparison.
        weights: of the joints (n,); by default the inverse residual variances of an ordinary fit.
        prior: by default :func:`identification.estimators.prior.body_prior`.
        design_effect: rows of data that count as one against the prior.

    Raises:
        IdentificationError: no rows.
        SolverError: no such parameters were found.
    """
    if weights is None:
        weights = joint_weights(factor)
    if unconstrained is None:
        unconstrained = estimate(model, factor, weights)
    prior = prior or body_prior(model, factor)
    equations = factor.weighted(weights)
    standard, others = consistent_parameters(model, equations, prior, design_effect)
    values = prior.combinations @ np.concatenate([standard, others])
    rows, target = rows_of(equations)
    excess = float(np.square(rows @ values - target).sum())
    free = factor.relative_error(unconstrained.values)
    links = model.layout.links
    bodies = reference_bodies(model.nominal[links], model.chain.translation)
    return ConsistentEstimate(
        standard=standard,
        friction=values[model.friction_part],
        estimate=replace(
            unconstrained,
            values=values,
            noise_std=factor.residual_rms(values),
            method=replace(unconstrained.method, is_consistent=True),
        ),
        unconstrained=unconstrained,
        margin=margin(standard[links]),
        relative_error=float(np.nan_to_num(factor.relative_error(values))),
        unconstrained_relative_error=float(np.nan_to_num(free)),
        reference=bodies.origins,
        fits=excess <= equations.n,
    )
