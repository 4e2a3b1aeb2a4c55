"""Newton's method for the program of :mod:`identification.consistent_program`.

A solver stops at its tolerance, some 1e-6 of the parameters, and where exactly depends on rounding
in what it is given. With the log-det term the objective is smooth inside; a few steps of Newton's
method from the solver's answer end at the minimum itself, the same for the same data however
they were summed. They also stand in for the solver where it gives up, as it does on data that are
far from any machine (a torque with the wrong sign).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEPS: Final = 200
_HALVINGS: Final = 40
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
    """

    u: Array
    converged: bool


def polish(problem: Smooth, start: Array) -> Minimum:
    """Return the minimum, by Newton's method from a `start` (v,) inside."""
    u = start.copy()
    u[problem.not_negative] = np.maximum(u[problem.not_negative], 0.0)
    u += np.linalg.pinv(problem.equal) @ (1.0 - problem.equal @ u)
    if not np.isfinite(problem.value(u)):
        return Minimum(start, converged=False)
    decrement = np.inf
    for _ in range(_STEPS):
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
    return Minimum(u, converged=abs(decrement) <= allowed)


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
    found = Minimum(start, converged=False)
    for _ in range(_STEPS):
        found = polish(problem._replace(weight=now), found.u)
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
