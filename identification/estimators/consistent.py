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
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
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
        pull = self.pull * np.einsum("kaa->k", self.entries)
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
        equal: rows of equations on variables of the links, ``equal u = 1`` (e, v).
    """

    R: Array
    z: Array
    weight: float
    cones: tuple[Cone, ...]
    centre: Array
    not_negative: NDArray[np.intp]
    equal: Array

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
    u = start.copy()
    u[problem.not_negative] = np.maximum(u[problem.not_negative], 0.0)
    u += np.linalg.pinv(problem.equal) @ (1.0 - problem.equal @ u)
    if not np.isfinite(problem.value(u)):
        return Minimum(start, converged=False)
    decrement, steps = np.inf, 0
    while steps < most_steps:
        steps += 1
        gradient, hessian = problem.derivatives(u)
        bounded = problem.not_negative
        held = bounded[(u[bounded] <= _ON_BOUND) & (gradient[bounded] > 0.0)]
        u[held] = 0.0
        step = _newton_step(problem, gradient, hessian, held)
        # One that is on its bound, and would leave it by itself but not with the others, stays.
        while len(
            pushed := np.setdiff1d(bounded[(u[bounded] <= 0.0) & (step[bounded] < 0.0)], held)
        ):
            held = np.union1d(held, pushed)
            step = _newton_step(problem, gradient, hessian, held)
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


def _newton_step(problem: Smooth, gradient: Array, hessian: Array, held: NDArray[np.intp]) -> Array:
    """Return the step to the minimum of the quadratic model, variables in `held` at rest."""
    free = np.setdiff1d(np.arange(len(gradient)), held)
    scale = 1.0 / np.sqrt(np.diag(hessian)[free])
    curvature = hessian[np.ix_(free, free)] * np.outer(scale, scale)
    rows = problem.equal[:, free] * scale
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(float).tiny)
    e = len(rows)
    system = np.block([[curvature, rows.T], [rows, np.zeros((e, e))]])
    right = np.concatenate([-scale * gradient[free], np.zeros(e)])
    step = np.zeros(len(gradient))
    try:
        step[free] = scale * np.linalg.solve(system, right)[: len(free)]
    except np.linalg.LinAlgError:
        return step
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


class InfeasibleError(IdentificationError):
    """No physically consistent parameters meet the bounds that were asked for."""


class SolverError(IdentificationError):
    """The solver of the semidefinite program gave no usable answer.

    Attributes:
        status: what the solver called it.
    """

    def __init__(self, message: str, *, status: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, eq=False)
class Consistency:
    """What a consistent estimate is asked for beyond consistency.

    Attributes:
        prior_weight: how many rows of data (each at its noise) the nominal parameters count for.
        total_mass: of all moving links together [kg], if it is known.
        largest_mass: upper bound per link [kg], shape (n,), infinite for none.
        nominal: standard parameters to stay close to, shape (s,), those of the model without it.
            Rotor inertias count; a URDF has none, so the model's are zero.
    """

    prior_weight: float = 1.0
    total_mass: float | None = None
    largest_mass: Array | None = None
    nominal: Array | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.prior_weight) and self.prior_weight > 0.0):
            raise IdentificationError(
                f"the prior weight is {self.prior_weight!r}; it must be finite and positive, for"
                " the data alone leave standard parameters open"
            )
        if self.total_mass is not None and not (0.0 < self.total_mass < math.inf):
            raise InfeasibleError(f"a total mass of {self.total_mass!r} kg is no mass")


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
        rows: R and z in u.
        cones: pseudo-inertias, and the rotors' inertia matrix where joints are coupled.
        centre: what squares of the variables behind the links are counted from (v - 10 n,).
        not_negative: indices into u.
        masses: mass of each link from u (n, v).
    """

    bodies: ReferenceBodies
    to_standard: Array
    to_others: Array
    rows: SquareRoot
    cones: tuple[Cone, ...]
    centre: Array
    not_negative: NDArray[np.intp]
    masses: Array

    @classmethod
    def of(cls, model: RobotModel, root: SquareRoot, options: Consistency) -> Program:
        """Set up the program for weighted normal equations.

        Raises:
            ShapeError: nominal parameters or bounds do not fit the model.
            InfeasibleError: the bounds on the masses contradict each other.
        """
        _check_bounds(model, options)
        nominal = model.nominal if options.nominal is None else np.asarray(options.nominal)
        bodies = reference_bodies(link_parameters(model, nominal), model.chain.translation)
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
        links = np.arange(_N_LINK * n).reshape(n, _N_LINK)
        return cls(
            bodies=bodies,
            to_standard=to_standard,
            to_others=to_others,
            rows=SquareRoot(root.R @ mapping, root.z),
            cones=(Cone(links, _SYMMETRIC),) + (() if coupled is None else (coupled,)),
            centre=np.concatenate([nominal[others] / unit, np.zeros(k)]),
            not_negative=np.concatenate([alone, rest[: len(losses.combine)][losses.not_negative]]),
            masses=to_standard[layout.links[:, -1]],
        )

    def reference(self, options: Consistency, largest: Array) -> Array:
        """Return the u of the reference bodies, as heavy as the bounds ask for."""
        u = np.zeros(self.rows.R.shape[1])
        links = u[: _N_LINK * len(self.masses)].reshape(-1, _N_LINK)  # a view
        links[:] = _UNIT_ENTRIES
        mass = np.minimum(self.masses @ u, largest)
        if options.total_mass is not None:
            free = mass < largest
            rest = options.total_mass - mass[~free].sum()
            mass[free] *= rest / mass[free].sum()
        links *= (mass / (self.masses @ u))[:, None]
        for cone in self.cones[1:]:
            u[cone.places] = np.einsum("kaa->k", cone.entries)  # the unit matrix
        return u

    def physical(self, u: Array) -> tuple[Array, Array]:
        """Return standard parameters (s,) and those of friction, springs and balancers (k,).

        A solver holds inequalities to its tolerance. What is left beyond them is moved back.
        """
        u = u.copy()
        u[self.not_negative] = np.maximum(u[self.not_negative], 0.0)
        links = u[: _N_LINK * len(self.masses)].reshape(-1, _N_LINK)  # a view
        smallest = np.linalg.eigvalsh(np.tensordot(links, _SYMMETRIC, axes=1))[:, 0]
        lift = np.where(smallest > -_TOLERANCE, np.maximum(_INSIDE - smallest, 0.0), 0.0)
        links += lift[:, None] * _UNIT_ENTRIES
        for cone in self.cones[1:]:
            below = -np.linalg.eigvalsh(cone.matrices(u))[:, :1]
            lift = np.where(below < _TOLERANCE, np.maximum(below, 0.0), 0.0)
            u[cone.places] += lift * np.einsum("kaa->k", cone.entries)
        return self.to_standard @ u, self.to_others @ u


def _symmetric_basis() -> Array:
    rows, columns = np.triu_indices(4)
    basis = np.zeros((_N_LINK, 4, 4))
    basis[np.arange(_N_LINK), rows, columns] = 1.0
    basis[np.arange(_N_LINK), columns, rows] = 1.0
    return basis


# Unit entries of a symmetric 4x4 matrix, shape (10, 4, 4).
_SYMMETRIC: Final = _symmetric_basis()
# The entries of the unit matrix, shape (10,).
_UNIT_ENTRIES: Final = np.eye(4)[np.triu_indices(4)]


def solve_program(
    program: Program, options: Consistency, rows: int, near: Array | None = None
) -> tuple[Array, str]:
    """Return the solution u to rounding, and how it was found: a status in words.

    The prior counts for `prior_weight` rows at their noise. Where no machine fits the data to
    their noise, the error of the best one is the noise, and the weight grows with it.

    Args:
        program: what to solve.
        options: prior and bounds.
        rows: number of rows in the weighted normal equations.
        near: solution of much the same program (v,): Newton's method starts there, and ends when
            the prior's weight has settled to a hundredth; quick, and good for comparisons.

    Raises:
        SolverError: neither the solver nor Newton's method found an answer.
    """

    def weight(u: Array) -> float:
        excess = program.rows.excess(u) / min(max(rows, 1), _MOST_ROWS)
        return options.prior_weight * max(1.0, excess)

    largest = np.full(len(program.masses), np.inf)
    if options.largest_mass is not None:
        largest = options.largest_mass
    if near is not None and options.largest_mass is None:
        free = _smooth(program, options, largest, np.zeros(len(largest), dtype=np.bool_))
        found = Minimum(near, converged=True)
        for _ in range(_NEAR_STEPS):
            last = weight(found.u)
            found = polish(free._replace(weight=last), found.u, _NEAR_NEWTON)
            if not found.converged:
                break
            if abs(weight(found.u) - last) <= _NEAR_WEIGHT * last:
                return found.u, "optimal (Newton, from a near solution)"
    start, status = _solve_cone(program, options)
    if start is not None:
        at_bound = program.masses @ start >= largest * (1.0 - _ON_BOUND)
        found = polish(_smooth(program, options, largest, at_bound), start)
        if found.converged and weight(found.u) == options.prior_weight:
            return found.u, "optimal"
    at_bound = np.zeros(len(largest), dtype=np.bool_)
    for _ in range(len(largest) + 1):
        reference = program.reference(options, np.where(at_bound, largest, np.inf))
        found = follow_path(_smooth(program, options, largest, at_bound), reference, weight)
        beyond = program.masses @ found.u > largest * (1.0 + _ON_BOUND)
        if not np.any(beyond):
            if found.converged:
                return found.u, "optimal (Newton: no machine fits these data to their noise)"
            break
        at_bound = at_bound | beyond
    raise SolverError(
        f"no solution was found, the conic solver stopped with: {status}; with a prior weight"
        f" above {options.prior_weight:g} there may be one",
        status=status,
    )


def _solve_cone(program: Program, options: Consistency) -> tuple[Array | None, str]:
    """Return the conic solver's solution u, if it has one, and its word for it."""
    import cvxpy  # a third of a second to import, and only this estimate needs it

    cp: Any = cvxpy  # its names come from star imports, which a type checker does not follow
    u = cp.Variable(program.rows.R.shape[1])
    n = len(program.masses)
    first = _N_LINK * n
    prior: Any = cp.sum_squares(u[first:] - program.centre)
    constraints: list[Any] = [u[program.not_negative] >= 0.0]
    for link in range(n):
        entries = _SYMMETRIC.reshape(_N_LINK, 16).T @ u[_N_LINK * link : _N_LINK * (link + 1)]
        matrix = cp.reshape(entries, (4, 4), order="C")
        prior = prior + cp.trace(matrix) - cp.log_det(matrix)
        constraints.append(matrix >> _INSIDE * np.eye(4))
    for cone in program.cones[1:]:
        size = cone.entries.shape[1]
        entries = cone.entries.reshape(-1, size * size).T @ u[cone.places[0]]
        prior = prior - cone.barrier * cp.log_det(cp.reshape(entries, (size, size), order="C"))
    error = cp.sum_squares(program.rows.R @ u - program.rows.z)
    if options.total_mass is not None:
        constraints.append(program.masses.sum(axis=0) @ u / options.total_mass == 1.0)
    if options.largest_mass is not None:
        bounded = np.isfinite(options.largest_mass)
        constraints.append(program.masses[bounded] @ u <= options.largest_mass[bounded])
    problem = cp.Problem(cp.Minimize(error + options.prior_weight * prior), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is told by its status
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.error.SolverError as failure:
            return None, f"failed ({failure})"
    # "Infeasible" cannot be true: bounds that contradict each other were refused before.
    usable = problem.status in ("optimal", "optimal_inaccurate") and u.value is not None
    return (np.asarray(u.value, dtype=np.float64) if usable else None), str(problem.status)


def _smooth(
    program: Program, options: Consistency, largest: Array, at_bound: NDArray[np.bool_]
) -> Smooth:
    """Return the program for Newton's method, with some links (n,) as heavy as they may be."""
    equal = list(program.masses[at_bound] / largest[at_bound, None])
    if options.total_mass is not None:
        equal.append(program.masses.sum(axis=0) / options.total_mass)
    return Smooth(
        R=program.rows.R,
        z=program.rows.z,
        weight=options.prior_weight,
        cones=program.cones,
        centre=program.centre,
        not_negative=program.not_negative,
        equal=np.array(equal).reshape(-1, program.rows.R.shape[1]),
    )


def link_parameters(model: RobotModel, standard: Array) -> Array:
    """Return the ten parameters of each link (n, 10).

    Raises:
        ShapeError: the standard parameters are not (s,).
    """
    return np.asarray(model.layout.checked(standard)[model.layout.links])


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


def _check_bounds(model: RobotModel, options: Consistency) -> None:
    """Raise `InfeasibleError` for bounds that no set of masses can meet."""
    largest = options.largest_mass
    if largest is None:
        return
    if largest.shape != (model.n_joints,):
        raise ShapeError("largest_mass", largest.shape, f"({model.n_joints},)")
    for joint, bound in zip(model.joint_names, largest, strict=True):
        if not bound > 0.0:
            raise InfeasibleError(f"the link of joint {joint!r} may weigh {bound} kg at most")
    if options.total_mass is not None and float(largest.sum()) <= options.total_mass:
        raise InfeasibleError(
            f"links of at most {float(largest.sum()):g} kg together cannot weigh"
            f" {options.total_mass:g} kg"
        )


__all__ = [
    "Consistency",
    "ConsistentEstimate",
    "InfeasibleError",
    "SolverError",
    "SquareRoot",
    "consistent_estimate",
    "square_root",
]


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
    options: Consistency = Consistency(),
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
