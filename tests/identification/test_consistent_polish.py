from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from identification.estimators.consistent import Cone, Smooth, follow_path, polish

Array = NDArray[np.float64]


def a_problem(seed: int, *, equations: int = 0) -> Smooth:
    """Two links, three further variables of which two may not be negative; few data."""
    rng = np.random.default_rng(seed)
    rows, columns = np.triu_indices(4)
    entries = np.zeros((10, 4, 4))
    entries[np.arange(10), rows, columns] = entries[np.arange(10), columns, rows] = 1.0
    equal = np.zeros((equations, 23))
    equal[:, [9, 19]] = 0.4  # the lower right entries of both links
    return Smooth(
        R=rng.normal(size=(12, 23)),
        z=rng.normal(scale=5.0, size=12),
        weight=10.0 ** rng.uniform(-1, 1),
        cones=(Cone(np.arange(20).reshape(2, 10), entries),),
        centre=np.zeros(3),
        not_negative=np.array([20, 21]),
        equal=equal,
    )


def start(scale: float = 1.0) -> Array:
    unit = np.eye(4)[np.triu_indices(4)]
    return scale * np.concatenate([unit, unit, np.ones(3)])


@given(st.integers(0, 2**16))
@settings(max_examples=20)
def test_gradient_and_hessian_are_the_derivatives(seed: int) -> None:
    problem = a_problem(seed)
    u = start() + 0.05 * np.random.default_rng(seed).normal(size=23)
    gradient, hessian = problem.derivatives(u)
    scale = np.abs(hessian).max()
    np.testing.assert_allclose(
        gradient, approx_fprime(u, problem.value, 1e-7), atol=1e-4 * np.abs(gradient).max()
    )
    numeric = approx_fprime(u, lambda x: problem.derivatives(x)[0], 1e-7)
    np.testing.assert_allclose(hessian, numeric, atol=1e-4 * scale)


@given(st.integers(0, 2**16), st.integers(0, 1))
@settings(max_examples=20)
def test_every_start_and_the_path_end_at_the_same_minimum(seed: int, equations: int) -> None:
    problem = a_problem(seed, equations=equations)
    found = [
        polish(problem, start()),
        polish(problem, start(3.0)),
        follow_path(problem, start(), lambda _: problem.weight),
    ]
    assert all(one.converged for one in found)
    for one in found[1:]:
        np.testing.assert_allclose(one.u, found[0].u, atol=1e-6)
    u = found[0].u
    assert np.all(u[[20, 21]] >= 0.0)
    np.testing.assert_allclose(problem.equal @ u, 1.0)


@given(st.integers(0, 2**16))
@settings(max_examples=20)
def test_at_the_minimum_no_allowed_direction_leads_down(seed: int) -> None:
    problem = a_problem(seed)
    found = polish(problem, start())
    assert found.converged
    rng = np.random.default_rng(seed)
    value = problem.value(found.u)
    for _ in range(20):
        other = found.u + 10.0 ** rng.uniform(-5, 0) * rng.normal(size=23)
        other[[20, 21]] = np.maximum(other[[20, 21]], 0.0)
        assert problem.value(other) >= value - 1e-9 * abs(value)


def test_a_start_outside_has_not_converged() -> None:
    assert not polish(a_problem(0), start(-1.0)).converged
