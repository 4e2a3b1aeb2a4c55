r"""Physically consistent estimates: standard parameters that a robot can have.

Over the standard parameters :math:`\pi_s` and the friction f, one convex program

.. math:: \min\; \|R\,[G\pi_s;\, f] - z\|^2
          + w \left( \sum_i D(J_i \,\|\, J_i^0) + \ldots \right)
          \quad\text{s.t.}\quad J_i \succ 0,\; I_{im} \ge 0,\; f_0, f_1 \ge 0

R is the square root of the weighted normal equations, G the grouping of the base parameters, J the
pseudo-inertia of a link (Wensing, Kim and Slotine 2018). D is the log-det divergence from the
nominal bodies (Lee, Wensing and Park 2020); the dots are squares of rotor inertias (minus nominal
ones) and friction, scaled to be small. The prior weighs as much as `prior_weight` rows of data. D
is infinite at the boundary, so the solution is strictly inside. A conic solver approximates it,
Newton's method refines it; if no consistent parameters fit the data, Newton's method follows a path
of falling prior weights.

Where motors turn with several joints, the rotors' inertia matrix with coupling inertias has to be
positive definite instead of I_im >= 0.

:class:`Shrinkage` shrinks least squares towards this solution :math:`\pi_c`, as a Gaussian prior
with the share :math:`\lambda` of each column's information:

.. math:: \hat\pi = \pi_c + (A + \lambda D)^{-1}\,(b - A\,\pi_c), \qquad D = \mathrm{diag}(A)
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.covariance import block_covariance
from identification.factor.factor import (
    Estimate,
    Factor,
    NormalEquations,
    estimate,
    joint_weights,
    rows_of,
    solve,
    total_factor,
    undetermined_names,
)
from identification.model.friction import dissipation
from identification.model.pseudo_inertia import (
    ReferenceBodies,
    inertial_from_pseudo,
    margin,
    reference_bodies,
)
from identification.model.regressor import LINK_SYMBOLS
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

_STEPS: Final = 200
_HALVINGS: Final = 40
_PATH_STEPS: Final = 3000  # over all weights; fits without a solution ended within 1400 steps
_ON_BOUND: Final = 1e-6  # tolerance of an active bound, in units of the reference
_CONVERGED: Final = 1e-13
# Distance to the minimum as a share of the prior's weight, and of the objective.
_SMALL: Final = 1e-6
_SINGULAR: Final = 1e-7  # ratio of Cholesky pivots of a singular matrix
_ROUNDING: Final = 1e-12
_VANISHING: Final = 1e-30
_ENOUGH: Final = 1e-2  # required share of the predicted decrease
_WEIGHT_STEP: Final = 10.0
_SAME_WEIGHT: Final = 1e-9
_N_LINK: Final = len(LINK_SYMBOLS)
# Factor of -log det of the rotors' coupled inertia matrix, in units of the total torque: keeps it
# positive definite and moves well-determined rotors by less than 0.5 % of their deviation.
_ROTOR_BARRIER: Final = 1e-2
_INSIDE: Final = 1e-6  # smallest eigenvalue of a pseudo-inertia relative to the reference's
# Rows beyond which the prior's weight is constant if no consistent parameters fit: the solution
# would be singular to rounding.
_MOST_ROWS: Final = 100_000
# From a similar solution: steps of the prior weight, Newton steps of each, and final relative
# change of the weight. Otherwise the conic solver is faster.
_NEAR_STEPS: Final = 10
_NEAR_NEWTON: Final = 20
_NEAR_WEIGHT: Final = 0.01


class SolverError(IdentificationError):
    """No physically consistent parameters were found."""


class Cone(NamedTuple):
    """Variables that are entries of symmetric matrices, which have to be positive definite."""

    places: NDArray[np.intp]  # indices of the d variables of each of b matrices (b, d)
    entries: Array  # symmetric E_k (d, k, k): S_i = sum_k u_k E_k over the variables of matrix i
    trace_weight: float = 1.0  # factor of tr S in the objective
    barrier_weight: float = 1.0  # factor of -log det S

    @property
    def unit(self) -> Array:
        """Variables of the unit matrix (d,)."""
        return np.asarray(np.einsum("kaa->k", self.entries))

    def matrices(self, u: Array) -> Array:
        """Return the S_i (b, k, k)."""
        return np.asarray(np.tensordot(u[self.places], self.entries, axes=1))

    def value(self, u: Array) -> float:
        """Return ``sum_i trace_weight tr S_i - barrier_weight log det S_i``, infinite outside."""
        matrices = self.matrices(u)
        try:
            diagonal = np.einsum("ijj->ij", np.linalg.cholesky(matrices))
        except np.linalg.LinAlgError:
            return np.inf
        if np.any(diagonal.min(axis=1) <= _SINGULAR * diagonal.max(axis=1)):
            return np.inf
        trace = np.trace(matrices, axis1=1, axis2=2).sum()
        return float(self.trace_weight * trace - 2.0 * self.barrier_weight * np.log(diagonal).sum())

    def add_derivatives(self, u: Array, weight: float, gradient: Array, hessian: Array) -> None:
        """Add the derivatives of ``weight * value`` to gradient (v,) and Hessian (v, v)."""
        trace_weight = self.trace_weight * self.unit
        for places, inverse in zip(self.places, np.linalg.inv(self.matrices(u)), strict=True):
            product = np.einsum("ab,kbc->kac", inverse, self.entries)
            gradient[places] += weight * (
                trace_weight - self.barrier_weight * np.einsum("kaa->k", product)
            )
            curvature = np.einsum("kab,lba->kl", product, product)
            hessian[np.ix_(places, places)] += weight * self.barrier_weight * curvature


class Smooth(NamedTuple):
    """``||R u - z||² + w (sum over the cones of their values + ||u_rest - centre||²)``."""

    R: Array  # (r, v)
    z: Array  # (r,)
    weight: float  # w
    cones: tuple[Cone, ...]
    centre: Array  # of the variables behind those of the links
    not_negative: NDArray[np.intp]  # indices of non-negative variables, in no cone

    def excess(self, u: Array) -> float:
        """Weighted squared error above that of least squares."""
        error = self.R @ u - self.z
        return float(error @ error)

    def value(self, u: Array) -> float:
        """Return the objective, infinite outside."""
        prior = sum(cone.value(u) for cone in self.cones)
        rest = u[len(u) - len(self.centre) :] - self.centre
        return self.excess(u) + float(self.weight * (prior + rest @ rest))

    def derivatives(self, u: Array) -> tuple[Array, Array]:
        """Return gradient (v,) and Hessian (v, v)."""
        gradient = 2.0 * self.R.T @ (self.R @ u - self.z)
        hessian = 2.0 * self.R.T @ self.R
        for cone in self.cones:
            cone.add_derivatives(u, self.weight, gradient, hessian)
        rest = np.arange(len(u) - len(self.centre), len(u))
        gradient[rest] += 2.0 * self.weight * (u[rest] - self.centre)
        hessian[rest, rest] += 2.0 * self.weight
        return gradient, hessian


class Minimum(NamedTuple):
    """Result of Newton's method."""

    u: Array  # (v,)
    converged: bool  # whether only rounding is left
    steps: int = 1


def polish(problem: Smooth, start: Array, most_steps: int = _STEPS) -> Minimum:
    """Minimise by Newton's method from a feasible `start` (v,)."""
    bounded = problem.not_negative
    u = start.copy()
    u[bounded] = np.maximum(u[bounded], 0.0)
    if not np.isfinite(problem.value(u)):
        return Minimum(start, converged=False)
    decrement, steps, change = np.inf, 0, np.inf
    while steps < most_steps and change >= _CONVERGED:
        steps += 1
        try:
            gradient, hessian = problem.derivatives(u)
            fixed = bounded[(u[bounded] <= _ON_BOUND) & (gradient[bounded] > 0.0)]
            u[fixed] = 0.0
            step = _newton_step(gradient, hessian, fixed)
            # Variables on their bound that the step would push outside stay fixed.
            while len(
                pushed := np.setdiff1d(bounded[(u[bounded] <= 0.0) & (step[bounded] < 0.0)], fixed)
            ):
                fixed = np.union1d(fixed, pushed)
                step = _newton_step(gradient, hessian, fixed)
        except np.linalg.LinAlgError:  # at the boundary
            break
        decrement = -float(gradient @ step)
        moved = _descend(problem, u, step, decrement)
        if moved is None:
            break
        change = np.abs(moved - u).max() / max(1.0, float(np.abs(u).max()))
        u = moved
    allowed = _SMALL * problem.weight + _ROUNDING * abs(problem.value(u))
    return Minimum(u, converged=abs(decrement) <= allowed, steps=steps)


def _newton_step(gradient: Array, hessian: Array, fixed: NDArray[np.intp]) -> Array:
    """Return the step to the minimum of the quadratic model with variables in `fixed` fixed."""
    free = np.setdiff1d(np.arange(len(gradient)), fixed)
    diagonal = np.diag(hessian)[free]
    scale = 1.0 / np.sqrt(np.maximum(diagonal, _VANISHING * diagonal.max()))
    step = np.zeros(len(gradient))
    curvature = hessian[np.ix_(free, free)] * np.outer(scale, scale)
    step[free] = scale * np.linalg.solve(curvature, -scale * gradient[free])
    return step


def _descend(problem: Smooth, u: Array, step: Array, decrement: float) -> Array | None:
    """Return the first of u + step, u + step / 2, ... that decreases enough (Armijo), if any."""
    value = problem.value(u)
    for halving in range(_HALVINGS):
        share = 0.5**halving
        moved = u + share * step
        moved[problem.not_negative] = np.maximum(moved[problem.not_negative], 0.0)
        if problem.value(moved) <= value - _ENOUGH * share * decrement + _ROUNDING * abs(value):
            return moved
    return None


def follow_path(problem: Smooth, start: Array, weight: Callable[[Array], float]) -> Minimum:
    """Minimise from a feasible start (v,) with the prior's weight, a function of u, falling."""
    found, steps = Minimum(start, converged=False), 0
    now = max(problem.excess(start), weight(start))
    while steps < _PATH_STEPS:
        found = polish(problem._replace(weight=now), found.u)
        steps += found.steps
        last = weight(found.u)
        if found.converged and abs(last - now) <= _SAME_WEIGHT * now:
            return found
        now = max(last, now / _WEIGHT_STEP)
    return found._replace(converged=False)


def _symmetric_basis() -> Array:
    """Return the unit entries of a symmetric 4x4 matrix (10, 4, 4)."""
    rows, columns = np.triu_indices(4)
    basis = np.zeros((_N_LINK, 4, 4))
    basis[np.arange(_N_LINK), rows, columns] = 1.0
    basis[np.arange(_N_LINK), columns, rows] = 1.0
    return basis


_SYMMETRIC: Final = _symmetric_basis()


@dataclass(frozen=True, eq=False)
class Program:
    """Convex program in variables u that are of size one for the reference.

    Per link ten entries of the pseudo-inertia in axes in which the reference's is the unit matrix;
    then rotors and coupling inertias; then friction, springs and balancers.
    """

    bodies: ReferenceBodies  # reference of each link
    to_standard: Array  # standard parameters from u (s, v)
    to_others: Array  # friction, springs and balancers from u (k, v)
    smooth: Smooth  # objective

    @classmethod
    def of(cls, model: RobotModel, rows: Array, target: Array, prior_weight: float) -> Program:
        """Set up the program for rows (r, p) of least squares and their target (r,)."""
        n, b = model.n_joints, model.base.rank
        layout, losses, nominal = model.layout, dissipation(model.friction), model.nominal
        bodies = reference_bodies(nominal[layout.links], model.chain.translation)
        others = np.concatenate([layout.rotors, layout.couplings])
        s, k = layout.size, model.n_parameters - b
        v = s + k
        to_standard, to_others = np.zeros((s, v)), np.zeros((k, v))
        for link, (places, frame) in enumerate(zip(layout.links, bodies.frames, strict=True)):
            entries = np.einsum("ab,kbc,dc->kad", frame, _SYMMETRIC, frame)
            span = slice(_N_LINK * link, _N_LINK * (link + 1))
            to_standard[places, span] = inertial_from_pseudo(entries).T

        def units(directions: Array) -> Array:
            """Return multiples of directions (p or b, k) that would produce all the torque.

            In these units the parameters are far below one and a prior on their squares is weak.
            """
            columns = np.linalg.norm(rows[:, : len(directions)] @ directions, axis=0)
            whole = float(np.linalg.norm(target))
            usable = (columns > 0.0) & (whole > 0.0)
            return np.where(usable, whole / np.where(usable, columns, 1.0), 1.0)

        # A nominal rotor inertia of zero is unknown. The unit of a coupling is the mean of its
        # joints', so that the rotors' matrix is only scaled.
        known = nominal[layout.rotors]
        own = np.where(known > 0.0, known, units(model.base.grouping[:, layout.rotors]))
        unit = np.concatenate([own, [np.sqrt(own[i] * own[j]) for i, j in layout.pairs]])
        rotors, rest = np.arange(_N_LINK * n, s), np.arange(s, v)
        to_standard[others, rotors] = unit
        combine = np.eye(k)  # unconstrained springs and balancers
        combine[: len(losses.combine), : len(losses.combine)] = losses.combine
        to_others[:, rest] = combine * units(np.vstack([np.zeros((b, k)), combine]))
        cones = [Cone(np.arange(_N_LINK * n).reshape(n, _N_LINK), _SYMMETRIC)]
        alone = rotors[: len(layout.rotors)]
        if layout.pairs:
            cones.append(_coupled_rotors(model, _N_LINK * n))
            alone = np.setdiff1d(alone, cones[1].places)
        positive = rest[: len(losses.combine)][losses.not_negative]
        smooth = Smooth(
            R=rows @ np.vstack([model.base.grouping @ to_standard, to_others]),
            z=target,
            weight=prior_weight,
            cones=tuple(cones),
            centre=np.concatenate([nominal[others] / unit, np.zeros(k)]),
            not_negative=np.concatenate([alone, positive]),
        )
        return cls(bodies, to_standard, to_others, smooth)

    def physical(self, u: Array) -> tuple[Array, Array]:
        """Return standard parameters (s,) and those of friction, springs and balancers (k,)."""
        u, links = u.copy(), self.smooth.cones[0]
        smallest = np.linalg.eigvalsh(links.matrices(u))[:, :1]
        u[links.places] += np.maximum(_INSIDE - smallest, 0.0) * links.unit
        return self.to_standard @ u, self.to_others @ u

    def solve(self, n_rows: int, near: Array | None = None) -> tuple[Array, str]:
        """Return the solution u and its status for `n_rows` rows in the weighted normal equations.

        If no consistent parameters fit to the noise, the error of the best ones replaces the noise.
        `near` is a similar solution (v,) to start from; the prior's weight is then iterated to 1 %.

        Raises:
            SolverError: neither the conic solver nor Newton's method found one.
        """
        smooth, rows = self.smooth, min(max(n_rows, 1), _MOST_ROWS)

        def weight(u: Array) -> float:
            return smooth.weight * max(1.0, smooth.excess(u) / rows)

        if near is not None:
            now = weight(near)
            for _ in range(_NEAR_STEPS):
                found = polish(smooth._replace(weight=now), near, _NEAR_NEWTON)
                if not found.converged:
                    break
                near, last = found.u, now
                now = weight(near)
                if abs(now - last) <= _NEAR_WEIGHT * last:
                    return near, "near optimal"
        start, status = _solve_cone(smooth)
        if start is not None:
            found = polish(smooth, start)
            if found.converged and weight(found.u) == smooth.weight:
                return found.u, "optimal"
        reference = np.zeros(smooth.R.shape[1])
        for cone in smooth.cones:
            reference[cone.places] = cone.unit
        found = follow_path(smooth, reference, weight)
        if found.converged:
            return found.u, "optimal (no consistent parameters fit the data to their noise)"
        raise SolverError(
            f"no consistent parameters were found (conic solver: {status}); try a prior weight"
            f" above {smooth.weight:g}"
        )


def _solve_cone(smooth: Smooth) -> tuple[Array | None, str]:
    """Return the conic solver's solution u or None, and its status."""
    import cvxpy  # slow import (0.3 s)

    cp: Any = cvxpy  # its star imports are unknown to the type checker
    u = cp.Variable(smooth.R.shape[1])
    prior: Any = cp.sum_squares(u[smooth.R.shape[1] - len(smooth.centre) :] - smooth.centre)
    constraints: list[Any] = [u[smooth.not_negative] >= 0.0]
    for cone in smooth.cones:
        size = cone.entries.shape[1]
        for places in cone.places:
            entries = cone.entries.reshape(-1, size * size).T @ u[places]
            matrix = cp.reshape(entries, (size, size), order="C")
            prior = prior - cone.barrier_weight * cp.log_det(matrix)
            if cone.trace_weight:
                prior = prior + cone.trace_weight * cp.trace(matrix)
                constraints.append(matrix >> _INSIDE * np.eye(size))
    error = cp.sum_squares(smooth.R @ u - smooth.z)
    problem = cp.Problem(cp.Minimize(error + smooth.weight * prior), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the status reports inaccuracy
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.error.SolverError as failure:
            return None, f"failed ({failure})"
    usable = problem.status in ("optimal", "optimal_inaccurate") and u.value is not None
    return (np.asarray(u.value, dtype=np.float64) if usable else None), str(problem.status)


def _coupled_rotors(model: RobotModel, first: int) -> Cone:
    """Return the cone of the rotor inertia matrix of coupled joints, variables from `first`."""
    layout = model.layout
    joints = sorted({joint for pair in layout.pairs for joint in pair})
    n, c, size = layout.n_joints, len(layout.pairs), len(joints)
    places = np.concatenate([first + np.array(joints), first + n + np.arange(c)])
    entries = np.zeros((size + c, size, size))
    entries[np.arange(size), np.arange(size), np.arange(size)] = 1.0
    for k, pair in enumerate(layout.pairs):
        i, j = (joints.index(joint) for joint in pair)
        entries[size + k, i, j] = entries[size + k, j, i] = 1.0
    return Cone(places[None], entries, trace_weight=0.0, barrier_weight=_ROTOR_BARRIER)


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
    status: str  # "optimal", or that no consistent parameters fit the data to their noise
    solution: Array  # of the program (v,)

    @property
    def shift(self) -> Array:
        """Change of each parameter in standard deviations (p,); 0 if they are infinite."""
        moved = self.estimate.values - self.unconstrained.values
        std = self.unconstrained.std
        known = np.isfinite(std) & (std > 0.0)
        return np.where(known, moved / np.where(known, std, 1.0), 0.0)


def consistent_estimate(
    model: RobotModel,
    factor: Factor,
    unconstrained: Estimate | None = None,
    *,
    weights: Array | None = None,
    prior_weight: float = 1.0,
    near: Array | None = None,
) -> ConsistentEstimate:
    """Fit physically consistent standard parameters and friction to the samples.

    An `unconstrained` estimate of the same samples is for comparison; weights (n,) are by default
    the inverse residual variances of an ordinary fit; the nominal parameters count for
    `prior_weight` rows of data; `near` is the `solution` of similar samples.

    Raises:
        IdentificationError: no rows.
        SolverError: no such parameters were found.
    """
    if weights is None:
        weights = joint_weights(factor)
    if unconstrained is None:
        unconstrained = estimate(model, factor, weights)
    equations = factor.weighted(weights)
    program = Program.of(model, *rows_of(equations), prior_weight)
    solution, status = program.solve(equations.n, near)
    standard, others = program.physical(solution)
    values = np.concatenate([model.base.grouping @ standard, others])
    rms = np.sqrt(factor.squared_errors(values) / np.maximum(factor.samples, 1))
    free = factor.relative_error(unconstrained.values)
    return ConsistentEstimate(
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
        margin=margin(standard[model.layout.links]),
        relative_error=float(np.nan_to_num(factor.relative_error(values))),
        unconstrained_relative_error=float(np.nan_to_num(free)),
        reference=program.bodies.origins,
        status=status,
        solution=solution,
    )


@dataclass(frozen=True)
class Shrinkage:
    """Strength of the shrinkage towards the consistent solution."""

    # prior information as a share of the data; 0: least squares, inf: consistent solution
    strength: float = 0.0
    prior_weight: float = 0.1  # rows of data that the nominal bodies count for

    def describe(self) -> str:
        """Return the name of the estimator."""
        if self.strength == 0.0:
            return "least squares"
        nominal = f"nominal bodies weigh {self.prior_weight:g} rows"
        if math.isinf(self.strength):
            return f"physically consistent ({nominal})"
        return f"regularised towards the consistent solution by {self.strength:g} ({nominal})"


def shrunk_values(equations: NormalEquations, centre: Array, strength: float) -> Array:
    """Shrink parameters (p,) towards the centre (p,)."""
    if math.isinf(strength):
        return centre
    prior = strength * np.diag(equations.A)
    moved = equations._replace(A=equations.A + np.diag(prior), b=equations.b - equations.A @ centre)
    return np.asarray(centre + solve(moved).values)


def fitted_values(
    model: RobotModel, factor: Factor, shrinkage: Shrinkage, centre: Array | None = None
) -> Array:
    """Return parameters (p,) shrunk towards a centre, by default the consistent solution.

    Raises:
        IdentificationError: no consistent parameters were found.
    """
    weights = joint_weights(factor)
    equations = factor.weighted(weights)
    if shrinkage.strength == 0.0:
        return solve(equations).values
    if centre is None:
        found = consistent_estimate(
            model, factor, weights=weights, prior_weight=shrinkage.prior_weight
        )
        centre = found.estimate.values
    return shrunk_values(equations, centre, shrinkage.strength)


def fit_shrunk(
    model: RobotModel,
    recordings: Sequence[Samples],
    shrinkage: Shrinkage,
    *,
    centre: Array | None = None,
    factor: Factor | None = None,
) -> Estimate:
    """Fit recordings, shrunk to a centre (p,), by default the consistent solution of the samples.

    The covariance is that of least squares, cluster-robust; `factor` is that of the recordings by
    time, if known.

    Raises:
        IdentificationError: no usable row, or no consistent parameters were found.
    """
    factor = total_factor(model, recordings) if factor is None else factor
    free = estimate(model, factor)
    values = fitted_values(model, factor, shrinkage, centre)
    found = block_covariance(factor, joint_weights(factor), free.values)
    variance = factor.squared_errors(values) / np.maximum(factor.samples, 1)
    return replace(
        free,
        values=values,
        covariance=found.covariance,
        noise_std=np.where(factor.samples > 0, np.sqrt(variance), np.nan),
        interval_factor=found.interval_factor,
        undetermined=undetermined_names(model.parameter_names, found.determined),
        method=f"weighted least squares, {shrinkage.describe()}; {found.words}",
    )
