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

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.factor.factor import (
    WORST_CONDITION,
    Estimate,
    Factor,
    NormalEquations,
    joint_weights,
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

Array = NDArray[np.float64]

_STEPS: Final = 200
_HALVINGS: Final = 40
# Of all weights on the way together. Data that machines fit need some hundred; those that none fits
# have ended after 1400 steps, or in none of 40 000.
_PATH_STEPS: Final = 3000
# Of a variable whose reference is one: on the bound, for a solver with a tolerance of 1e-8.
_ON_BOUND: Final = 1e-6
_CONVERGED: Final = 1e-13
# How far above the minimum, as a share of the prior's weight and of the objective.
_SMALL: Final = 1e-6
# Ratio of Cholesky pivots at which a matrix counts as singular: its inverse would be rounding.
_SINGULAR: Final = 1e-7
_ROUNDING: Final = 1e-12
_ENOUGH: Final = 1e-2  # share of the decrease that a linear model promises
_WEIGHT_STEP: Final = 10.0
_SAME_WEIGHT: Final = 1e-9
_N_LINK: Final = len(LINK_SYMBOLS)
# Factor of -log det of the rotors' coupled inertia matrix, in units in which all the torque there
# is makes a one: keeps it positive definite, and moves a rotor that is larger than its standard
# deviation by less than half a per cent of that.
_ROTOR_BARRIER: Final = 1e-2
# Smallest eigenvalue of a pseudo-inertia in axes in which the reference's is the unit matrix: far
# more than the solver's error, so that the result can be relied on to be inside.
_INSIDE: Final = 1e-6
# Rows beyond which the prior's weight no longer falls behind the data's, when no machine fits:
# a pseudo-inertia at the edge is singular to rounding then.
_MOST_ROWS: Final = 100_000
# A solution outside by more than this is no solution.
_TOLERANCE: Final = 1e-4
# From a near solution: steps of the weight of the prior; of Newton for each, for where it is not
# so near the conic solver is quicker; and the change of that weight at which they end.
_NEAR_STEPS: Final = 10
_NEAR_NEWTON: Final = 20
_NEAR_WEIGHT: Final = 0.01


class SolverError(IdentificationError):
    """The semidefinite program has no usable solution."""


class Cone(NamedTuple):
    """Variables that are entries of symmetric matrices, which have to be positive definite.

    Attributes:
        places: indices of the d variables of each of b matrices (b, d).
        entries: symmetric matrices E_k, S_i = sum_k u_k E_k over the variables of matrix i
            (d, k, k).
        pull: factor of tr S in the objective.
        barrier: factor of -log det S.
    """

    places: NDArray[np.intp]
    entries: Array
    pull: float = 1.0
    barrier: float = 1.0

    def matrices(self, u: Array) -> Array:
        """Return the S_i (b, k, k)."""
        return np.asarray(np.tensordot(u[self.places], self.entries, axes=1))

    @property
    def unit(self) -> Array:
        """Variables of the unit matrix (d,)."""
        return np.asarray(np.einsum("kaa->k", self.entries))

    def value(self, u: Array) -> float:
        """Return ``sum_i pull tr S_i - barrier log det S_i``, infinite outside."""
        matrices = self.matrices(u)
        try:
            diagonal = np.einsum("ijj->ij", np.linalg.cholesky(matrices))
        except np.linalg.LinAlgError:
            return np.inf
        if np.any(diagonal.min(axis=1) <= _SINGULAR * diagonal.max(axis=1)):
            return np.inf
        trace = np.trace(matrices, axis1=1, axis2=2).sum()
        return float(self.pull * trace - 2.0 * self.barrier * np.log(diagonal).sum())

    def add_derivatives(self, u: Array, weight: float, gradient: Array, hessian: Array) -> None:
        """Add those of ``weight * value`` to gradient (v,) and Hessian (v, v)."""
        pull = self.pull * self.unit
        for places, inverse in zip(self.places, np.linalg.inv(self.matrices(u)), strict=True):
            turned = np.einsum("ab,kbc->kac", inverse, self.entries)
            gradient[places] += weight * (pull - self.barrier * np.einsum("kaa->k", turned))
            curvature = np.einsum("kab,lba->kl", turned, turned)
            hessian[np.ix_(places, places)] += weight * self.barrier * curvature


class Smooth(NamedTuple):
    """``||R u - z||² + w (sum over the cones of their values + ||u_rest - centre||²)``.

    Attributes:
        R: (r, v).
        z: (r,).
        weight: w.
        cones: matrices that stay positive definite.
        centre: of the last variables, those behind the links.
        not_negative: indices of variables behind the links, in no cone.
    """

    R: Array
    z: Array
    weight: float
    cones: tuple[Cone, ...]
    centre: Array
    not_negative: NDArray[np.intp]

    def value(self, u: Array) -> float:
        """Return the objective, infinite outside."""
        prior = sum(cone.value(u) for cone in self.cones)
        rest = u[len(u) - len(self.centre) :] - self.centre
        error = self.R @ u - self.z
        return float(error @ error + self.weight * (prior + rest @ rest))

    def derivatives(self, u: Array) -> tuple[Array, Array]:
        """Return gradient (v,) and Hessian (v, v)."""
        gradient = 2.0 * self.R.T @ (self.R @ u - self.z)
        hessian = 2.0 * self.R.T @ self.R
        for cone in self.cones:
            cone.add_derivatives(u, self.weight, gradient, hessian)
        first = len(u) - len(self.centre)
        gradient[first:] += 2.0 * self.weight * (u[first:] - self.centre)
        rest = np.arange(first, len(u))
        hessian[rest, rest] += 2.0 * self.weight
        return gradient, hessian


class Minimum(NamedTuple):
    """Where Newton's method ended.

    Attributes:
        u: (v,).
        converged: whether the objective can fall no further, but for rounding.
        steps: of Newton's method.
    """

    u: Array
    converged: bool
    steps: int = 0


def polish(problem: Smooth, start: Array, most_steps: int = _STEPS) -> Minimum:
    """Return the minimum, by Newton's method from a `start` (v,) inside."""
    bounded = problem.not_negative
    u = start.copy()
    u[bounded] = np.maximum(u[bounded], 0.0)
    if not np.isfinite(problem.value(u)):
        return Minimum(start, converged=False)
    decrement, steps = np.inf, 0
    while steps < most_steps:
        steps += 1
        gradient, hessian = problem.derivatives(u)
        held = bounded[(u[bounded] <= _ON_BOUND) & (gradient[bounded] > 0.0)]
        u[held] = 0.0
        step = _newton_step(gradient, hessian, held)
        # One that is on its bound, and would leave it by itself but not with the others, stays.
        while len(
            pushed := np.setdiff1d(bounded[(u[bounded] <= 0.0) & (step[bounded] < 0.0)], held)
        ):
            held = np.union1d(held, pushed)
            step = _newton_step(gradient, hessian, held)
        decrement = -float(gradient @ step)
        moved = _descend(problem, u, step, decrement)
        if moved is None:
            break
        change = np.abs(moved - u).max() / max(1.0, float(np.abs(u).max()))
        u = moved
        if change < _CONVERGED:
            break
    allowed = _SMALL * problem.weight + _ROUNDING * abs(problem.value(u))
    return Minimum(u, converged=abs(decrement) <= allowed, steps=steps)


def follow_path(problem: Smooth, start: Array, weight: Callable[[Array], float]) -> Minimum:
    """Return the minimum from far away: the weight of the prior falls in steps (a barrier method).

    With much weight the minimum is near the reference; each of the following is near the one
    before. The weight to end with may depend on where that is.

    Args:
        problem: its own weight does not matter.
        start: inside (v,), as the reference is.
        weight: the weight to end with, from u.
    """
    error = problem.R @ start - problem.z
    now = max(float(error @ error), weight(start))
    found, steps = Minimum(start, converged=False), 0
    while steps < _PATH_STEPS:
        found = polish(problem._replace(weight=now), found.u)
        steps += max(found.steps, 1)
        last = weight(found.u)
        if found.converged and abs(last - now) <= _SAME_WEIGHT * now:
            return found
        now = max(last, now / _WEIGHT_STEP)
    return found._replace(converged=False)


def _newton_step(gradient: Array, hessian: Array, held: NDArray[np.intp]) -> Array:
    """Return the step to the minimum of the quadratic model, variables in `held` at rest."""
    free = np.setdiff1d(np.arange(len(gradient)), held)
    scale = 1.0 / np.sqrt(np.diag(hessian)[free])
    curvature = hessian[np.ix_(free, free)] * np.outer(scale, scale)
    step = np.zeros(len(gradient))
    with suppress(np.linalg.LinAlgError):
        step[free] = scale * np.linalg.solve(curvature, -scale * gradient[free])
    return step


def _descend(problem: Smooth, u: Array, step: Array, decrement: float) -> Array | None:
    """Return the first of u + step, u + step / 2, ... that is better by enough (Armijo), if any."""
    value = problem.value(u)
    for halving in range(_HALVINGS):
        share = 0.5**halving
        moved = u + share * step
        moved[problem.not_negative] = np.maximum(moved[problem.not_negative], 0.0)
        if problem.value(moved) <= value - _ENOUGH * share * decrement + _ROUNDING * abs(value):
            return moved
    return None


@dataclass(frozen=True, eq=False)
class Consistency:
    """What a consistent estimate is drawn to where the data leave it open.

    Attributes:
        prior_weight: how many rows of data (each at its noise) the nominal parameters count for.
        nominal: standard parameters to stay close to, shape (s,), those of the model without it.
            Rotor inertias count; a URDF has none, so the model's are zero.
    """

    prior_weight: float = 1.0
    nominal: Array | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.prior_weight) and self.prior_weight > 0.0):
            raise IdentificationError(
                f"the prior weight is {self.prior_weight!r}; it must be finite and positive, for"
                " the data alone leave standard parameters open"
            )

    def of(self, model: RobotModel) -> Array:
        """The nominal standard parameters (s,) for a model."""
        return model.nominal if self.nominal is None else model.layout.checked(self.nominal)


class SquareRoot(NamedTuple):
    """``||R x - z||²`` is the weighted squared error above its minimum.

    Attributes:
        R: (r, p), one row per direction that the data determine.
        z: (r,).
    """

    R: Array
    z: Array

    def excess(self, values: Array) -> float:
        """Weighted squared error of parameters (p,) above the minimum."""
        return float(np.sum((self.R @ values - self.z) ** 2))


def square_root(equations: NormalEquations) -> SquareRoot:
    """Take the square root of normal equations, without directions they do not determine."""
    length = np.sqrt(np.diag(equations.A))
    scale = np.where(length > 0.0, length, 1.0)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    significant = eigenvalues > eigenvalues[-1] / WORST_CONDITION**2
    basis, root = vectors[:, significant].T, np.sqrt(eigenvalues[significant])
    # Times the length itself: a column without data stays exactly zero, without rounding.
    return SquareRoot(R=root[:, None] * basis * length, z=basis @ (equations.b / scale) / root)


@dataclass(frozen=True, eq=False)
class Program:
    """The semidefinite program in variables u for which the reference is of size one.

    Per link ten entries of the pseudo-inertia in axes in which the reference's is the unit
    matrix; then rotors and coupling inertias; then friction, springs and balancers.

    Attributes:
        bodies: reference of each link.
        to_standard: physical standard parameters from u (s, v).
        to_others: parameters of physical friction, springs and balancers from u (k, v).
        smooth: what is minimised.
    """

    bodies: ReferenceBodies
    to_standard: Array
    to_others: Array
    smooth: Smooth

    @classmethod
    def of(cls, model: RobotModel, root: SquareRoot, options: Consistency) -> Program:
        """Set up the program for weighted normal equations.

        Raises:
            ShapeError: nominal parameters do not fit the model.
        """
        nominal = options.of(model)
        bodies = reference_bodies(nominal[model.layout.links], model.chain.translation)
        n, b = model.n_joints, model.base.rank
        layout, losses = model.layout, dissipation(model.friction)
        others = np.concatenate([layout.rotors, layout.couplings])
        s, k = layout.size, model.n_parameters - b
        v = s + k
        to_standard, to_others = np.zeros((s, v)), np.zeros((k, v))
        for link, (places, frame) in enumerate(zip(layout.links, bodies.frames, strict=True)):
            entries = np.einsum("ab,kbc,dc->kad", frame, _SYMMETRIC, frame)
            span = slice(_N_LINK * link, _N_LINK * (link + 1))
            to_standard[places, span] = inertial_from_pseudo(entries).T
        rotors = np.arange(_N_LINK * n, s)
        unit = _rotor_units(model, root, nominal)
        to_standard[others, rotors] = unit
        rest = np.arange(s, v)
        combine = np.eye(k)  # springs and balancers are free
        combine[: len(losses.combine), : len(losses.combine)] = losses.combine
        directions = np.vstack([np.zeros((b, k)), combine])
        to_others[:, rest] = combine * _whole_torque_units(root, directions)
        mapping = np.vstack([model.base.grouping @ to_standard, to_others])
        coupled = _coupled_rotors(model, _N_LINK * n)
        alone = rotors[: len(layout.rotors)]
        if coupled is not None:
            alone = np.setdiff1d(alone, coupled.places)
        links = Cone(np.arange(_N_LINK * n).reshape(n, _N_LINK), _SYMMETRIC)
        positive = rest[: len(losses.combine)][losses.not_negative]
        smooth = Smooth(
            R=root.R @ mapping,
            z=root.z,
            weight=options.prior_weight,
            cones=(links,) if coupled is None else (links, coupled),
            centre=np.concatenate([nominal[others] / unit, np.zeros(k)]),
            not_negative=np.concatenate([alone, positive]),
        )
        return cls(bodies, to_standard, to_others, smooth)

    def physical(self, u: Array) -> tuple[Array, Array]:
        """Return standard parameters (s,) and those of friction, springs and balancers (k,).

        A solver holds inequalities to its tolerance. What is left beyond them is moved back.
        """
        u, (links, *coupled) = u.copy(), self.smooth.cones
        u[self.smooth.not_negative] = np.maximum(u[self.smooth.not_negative], 0.0)
        smallest = np.linalg.eigvalsh(links.matrices(u))[:, :1]
        lift = np.where(smallest > -_TOLERANCE, np.maximum(_INSIDE - smallest, 0.0), 0.0)
        u[links.places] += lift * links.unit
        for cone in coupled:
            below = -np.linalg.eigvalsh(cone.matrices(u))[:, :1]
            lift = np.where(below < _TOLERANCE, np.maximum(below, 0.0), 0.0)
            u[cone.places] += lift * cone.unit
        return self.to_standard @ u, self.to_others @ u


def _symmetric_basis() -> Array:
    """Unit entries of a symmetric 4x4 matrix, shape (10, 4, 4)."""
    rows, columns = np.triu_indices(4)
    basis = np.zeros((_N_LINK, 4, 4))
    basis[np.arange(_N_LINK), rows, columns] = 1.0
    basis[np.arange(_N_LINK), columns, rows] = 1.0
    return basis


_SYMMETRIC: Final = _symmetric_basis()


def solve_program(program: Program, rows: int, near: Array | None = None) -> tuple[Array, str]:
    """Return the solution u to rounding, and how it was found: a status in words.

    The prior counts for its weight of rows at their noise. Where no machine fits the data to
    their noise, the error of the best one is the noise, and the weight grows with it.

    Args:
        program: what to solve.
        rows: number of rows in the weighted normal equations.
        near: solution of much the same program (v,): Newton's method starts there, and ends when
            the prior's weight has settled to a hundredth; quick, and good for comparisons.

    Raises:
        SolverError: neither the solver nor Newton's method found an answer.
    """
    smooth = program.smooth

    def weight(u: Array) -> float:
        excess = float(np.sum((smooth.R @ u - smooth.z) ** 2)) / min(max(rows, 1), _MOST_ROWS)
        return smooth.weight * max(1.0, excess)

    if near is not None:
        found = Minimum(near, converged=True)
        for _ in range(_NEAR_STEPS):
            last = weight(found.u)
            found = polish(smooth._replace(weight=last), found.u, _NEAR_NEWTON)
            if not found.converged:
                break
            if abs(weight(found.u) - last) <= _NEAR_WEIGHT * last:
                return found.u, "optimal (Newton, from a near solution)"
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
        return found.u, "optimal (Newton: no machine fits these data to their noise)"
    raise SolverError(
        f"no solution was found, the conic solver stopped with: {status}; with a prior weight"
        f" above {smooth.weight:g} there may be one"
    )


def _solve_cone(smooth: Smooth) -> tuple[Array | None, str]:
    """Return the conic solver's solution u, if it has one, and its word for it."""
    import cvxpy  # a third of a second to import, and only this estimate needs it

    cp: Any = cvxpy  # its names come from star imports, which a type checker does not follow
    u = cp.Variable(smooth.R.shape[1])
    first = len(smooth.centre)
    prior: Any = cp.sum_squares(u[smooth.R.shape[1] - first :] - smooth.centre)
    constraints: list[Any] = [u[smooth.not_negative] >= 0.0]
    for cone in smooth.cones:
        size = cone.entries.shape[1]
        for places in cone.places:
            entries = cone.entries.reshape(-1, size * size).T @ u[places]
            matrix = cp.reshape(entries, (size, size), order="C")
            prior = prior - cone.barrier * cp.log_det(matrix)
            if cone.pull:
                prior = prior + cone.pull * cp.trace(matrix)
                constraints.append(matrix >> _INSIDE * np.eye(size))
    error = cp.sum_squares(smooth.R @ u - smooth.z)
    problem = cp.Problem(cp.Minimize(error + smooth.weight * prior), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is named by its status
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.error.SolverError as failure:
            return None, f"failed ({failure})"
    usable = problem.status in ("optimal", "optimal_inaccurate") and u.value is not None
    return (np.asarray(u.value, dtype=np.float64) if usable else None), str(problem.status)


def _rotor_units(model: RobotModel, root: SquareRoot, nominal: Array) -> Array:
    """Return the unit of each rotor and coupling inertia, in which it is small.

    A nominal rotor of zero says that nobody knows it: whatever moves the joint is allowed. A
    coupling's unit is the mean of its joints', so that the matrix of the rotors is only scaled.
    """
    layout = model.layout
    unknown = _whole_torque_units(root, model.base.grouping[:, layout.rotors])
    known = nominal[layout.rotors]
    own = np.where(known > 0.0, known, unknown)
    between = [np.sqrt(own[i] * own[j]) for i, j in layout.pairs]
    return np.concatenate([own, between])


def _coupled_rotors(model: RobotModel, first: int) -> Cone | None:
    """Return the inertia matrix of the rotors of coupled joints; variables from `first` on."""
    layout = model.layout
    if not layout.pairs:
        return None
    joints = sorted({joint for pair in layout.pairs for joint in pair})
    n, c, size = layout.n_joints, len(layout.pairs), len(joints)
    places = np.concatenate([first + np.array(joints), first + n + np.arange(c)])
    entries = np.zeros((size + c, size, size))
    entries[np.arange(size), np.arange(size), np.arange(size)] = 1.0
    for k, pair in enumerate(layout.pairs):
        i, j = (joints.index(joint) for joint in pair)
        entries[size + k, i, j] = entries[size + k, j, i] = 1.0
    return Cone(places[None], entries, pull=0.0, barrier=_ROTOR_BARRIER)


def _whole_torque_units(root: SquareRoot, directions: Array) -> Array:
    """Multiples of `directions` (p or b, k) that would make all the torque there is.

    In such units the parameters are far below one, and a prior on their squares says little.
    """
    columns = np.linalg.norm(root.R[:, : len(directions)] @ directions, axis=0)
    whole = float(np.linalg.norm(root.z))
    usable = (columns > 0.0) & (whole > 0.0)
    return np.where(usable, whole / np.where(usable, columns, 1.0), 1.0)


@dataclass(frozen=True, eq=False)
class ConsistentEstimate:
    """Parameters that a machine can have, and what it cost the fit.

    Attributes:
        standard: standard parameters (s,), every pseudo-inertia positive definite, no rotor
            inertia negative. Where the data leave a choice they are close to the nominal ones.
        friction: coefficients (k,), see `RobotModel.friction_part`.
        estimate: the parameters (p,) that follow from them, with springs and balancers. Its
            covariance is the one of the unconstrained estimate: an inequality that holds has no
            covariance of its own, and one that binds makes the true spread smaller.
        unconstrained: the estimate without inequalities, as it was given.
        margin: smallest eigenvalue of each link's pseudo-inertia (n,), SI units, positive.
        relative_error: ||tau - tau_hat|| / ||tau|| over all fitted rows.
        unconstrained_relative_error: the same of the unconstrained estimate.
        reference: per link, what stood for its nominal body, in words (n,).
        status: "optimal", and how, where the conic solver alone did not get there.
        solution: in the coordinates of the program (v,).
    """

    standard: Array
    friction: Array
    estimate: Estimate
    unconstrained: Estimate
    margin: Array
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
    options: Consistency = Consistency(),
    near: Array | None = None,
) -> ConsistentEstimate:
    """Fit physically consistent standard parameters and friction to the samples.

    Args:
        model: the robot.
        factor: the samples.
        unconstrained: the least-squares estimate of the same samples, to compare with.
        weights: per joint (n,); by default the inverse residual variance of an ordinary fit.
        options: the prior.
        near: `solution` of much the same samples, see :func:`solve_program`.

    Raises:
        SolverError: the solver found no usable answer.
        ShapeError: an array does not have the shape it should have.
    """
    if unconstrained.names != model.parameter_names:
        raise IdentificationError("the unconstrained estimate is of other parameters")
    if weights is None:
        weights = joint_weights(factor)
    equations = factor.weighted(weights)
    program = Program.of(model, square_root(equations), options)
    solution, status = solve_program(program, equations.n, near)
    standard, others = program.physical(solution)
    found = margin(standard[model.layout.links])
    if not np.all(found > 0.0):
        worst = model.joint_names[int(np.argmin(found))]
        raise SolverError(
            f"the solver ({status}) left the link of joint {worst!r} impossible, its pseudo-inertia"
            f" has the eigenvalue {found.min():.3g}"
        )
    values = np.concatenate([model.base.grouping @ standard, others])
    rms = np.sqrt(factor.squared_errors(values) / np.maximum(factor.samples, 1))
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
        margin=found,
        relative_error=float(np.nan_to_num(factor.relative_error(values))),
        unconstrained_relative_error=float(
            np.nan_to_num(factor.relative_error(unconstrained.values))
        ),
        reference=program.bodies.words,
        status=status,
        solution=solution,
    )
