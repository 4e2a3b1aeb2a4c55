from __future__ import annotations

from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from identification import Factor, FrictionLaw, IdentificationError, Motion, RobotModel, ShapeError
from identification.estimators.consistent import (
    Cone,
    Consistency,
    ConsistentEstimate,
    Smooth,
    consistent_estimate,
    follow_path,
    polish,
    square_root,
)
from identification.factor.factor import Estimate, estimate, joint_weights
from identification.model.pseudo_inertia import pseudo_inertia
from sim_fixtures.ns16 import load_truth, standard_parameters, table2, urdf_text
from tests.identification.two_link import sine_motion

Array = NDArray[np.float64]

TWO_LINK = (Path(__file__).parent / "two_link.urdf").read_text()
ROTORS = np.array([10, 21])


@pytest.fixture(scope="module")
def two_link() -> RobotModel:
    return RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(third=None))


def two_link_truth(model: RobotModel, friction: tuple[float, ...] = (4.0, 2.0, 1.5, 0.8)) -> Array:
    standard = model.nominal.copy()
    standard[ROTORS] = 0.4, 0.1
    return np.concatenate([model.base.grouping @ standard, friction])


def a_motion(model: RobotModel, seed: int, samples: int = 2000, rate: float = 4.0) -> Motion:
    """Five sines per joint; another seed is another motion, about as far and as fast."""
    rng = np.random.default_rng(seed)
    shape = (5, model.n_joints)
    time = np.arange(samples) * 4e-3
    size = np.linspace(1.0, 0.2, 5)[:, None]
    pace = np.linspace(0.5, rate, 5)[:, None] * rng.uniform(0.9, 1.1, shape)
    return sine_motion(time, size, pace, rng.uniform(0.0, 6.0, shape))


def measured(model: RobotModel, motion: Motion, truth: Array, noise: float, seed: int) -> Array:
    """Torque with noise, a share of each joint's RMS."""
    torque = model.torque(truth, *motion[1:])
    rms = np.sqrt((torque**2).mean(axis=0))
    return torque + noise * rms * np.random.default_rng(seed).standard_normal(torque.shape)


def fitted(
    model: RobotModel,
    motion: Motion,
    torque: Array,
    options: Consistency = Consistency(),  # noqa: B008 - frozen
    mask: NDArray[np.bool_] | None = None,
) -> ConsistentEstimate:
    factor = Factor.from_samples(model, motion, torque, mask)
    return consistent_estimate(model, factor, estimate(model, factor), options=options)


def assert_possible(model: RobotModel, found: ConsistentEstimate) -> None:
    """Eigenvalues of what the definition says, nothing of ours in between."""
    rows = found.standard.reshape(model.n_joints, -1)
    for xx, xy, xz, yy, yz, zz, hx, hy, hz, m, *rotor in rows:
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        h = np.array([hx, hy, hz])
        about_centre = tensor - (h @ h * np.eye(3) - np.outer(h, h)) / m
        moments = np.linalg.eigvalsh(about_centre)
        assert m > 0.0
        assert moments[0] > 0.0
        assert moments[0] + moments[1] > moments[2]
        assert all(r >= 0.0 for r in rotor)
    for name, value in zip(found.estimate.names, found.estimate.values, strict=True):
        assert value >= 0.0 or not name.startswith(("f0", "f1"))


def test_from_poor_data_comes_a_possible_machine(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 1, samples=150)
    torque = measured(two_link, motion, two_link_truth(two_link), 0.5, 1)
    found = fitted(two_link, motion, torque)
    assert_possible(two_link, found)
    assert found.status == "optimal"
    assert np.all(found.margin > 0.0)


def test_base_parameters_are_those_of_the_standard_ones(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 1, samples=300)
    found = fitted(two_link, motion, measured(two_link, motion, two_link_truth(two_link), 0.3, 1))
    rank = two_link.base.rank
    np.testing.assert_allclose(
        found.estimate.values[:rank], two_link.base.grouping @ found.standard, atol=1e-12
    )
    np.testing.assert_array_equal(found.estimate.values[rank:], found.friction)


def test_where_least_squares_is_possible_it_is_hardly_moved(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 2)
    found = fitted(two_link, motion, measured(two_link, motion, two_link_truth(two_link), 0.02, 2))
    assert np.abs(found.shift).max() < 0.1
    assert found.cost < 1e-5


def test_exact_data_and_an_exact_nominal_give_every_standard_parameter_back(
    two_link: RobotModel,
) -> None:
    """Also those that no torque depends on: they are the nominal's."""
    standard = two_link.nominal.copy()
    standard[ROTORS] = 0.4, 0.1
    motion = a_motion(two_link, 3)
    torque = measured(two_link, motion, two_link_truth(two_link), 0.0, 3)
    found = fitted(two_link, motion, torque, Consistency(nominal=standard))
    np.testing.assert_allclose(found.standard, standard, atol=1e-4)


def test_friction_that_would_drive_is_none(two_link: RobotModel) -> None:
    truth = two_link_truth(two_link, (-1.0, 2.0, 1.5, -0.3))
    motion = a_motion(two_link, 4)
    found = fitted(two_link, motion, measured(two_link, motion, truth, 0.01, 4))
    assert found.unconstrained.value("f0_1") < 0.0
    assert found.unconstrained.value("f1_2") < 0.0
    assert found.estimate.value("f0_1") == pytest.approx(0.0, abs=1e-3)
    assert found.estimate.value("f1_2") == pytest.approx(0.0, abs=1e-3)
    assert_possible(two_link, found)


def test_the_third_friction_term_may_have_either_sign() -> None:
    model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(offset=True))
    standard = np.concatenate([model.base.grouping @ model.nominal, [4, 4, 2, 2, -0.1, 0.1, -1, 1]])
    motion = a_motion(model, 5)
    found = fitted(model, motion, measured(model, motion, standard, 0.001, 5))
    np.testing.assert_allclose(found.friction, standard[model.base.rank :], rtol=0.05)


LARGE = 1e2  # as many times the nominal bodies, kg m² of rotor, or N·m of friction


def largest_gain(gradient: Array, at: Array, nominal: Array) -> float:
    """How much less than at `at` a convex function can be for any possible machine, at most.

    The function stays above its tangent, and of a machine the tangent is easily bounded: what
    the gradient says of a link is a matrix Z with <Z, J(x)> = gradient x. If Z is positive
    semidefinite, that is never negative, and so is the rest if its gradient is not. Where either
    is so but for a little, the little is multiplied with LARGE.
    """
    upper = np.triu_indices(4)
    basis = np.zeros((10, 4, 4))
    basis[np.arange(10), upper[0], upper[1]] += 0.5
    basis[np.arange(10), upper[1], upper[0]] += 0.5
    products = pseudo_inertia(np.eye(10)).reshape(10, 16) @ basis.reshape(10, 16).T
    missing = 0.0
    n = len(nominal)
    others = np.delete(gradient, [i for f in range(n) for i in range(11 * f, 11 * f + 10)])
    missing += float(np.maximum(-others, 0.0).sum())
    for link, inertial in enumerate(nominal):
        entries = np.linalg.solve(products, gradient[11 * link : 11 * link + 10])
        dual = np.tensordot(entries, basis, axes=1)
        frame = np.linalg.cholesky(pseudo_inertia(inertial))
        missing += max(-float(np.linalg.eigvalsh(frame.T @ dual @ frame)[0]), 0.0)
    return float(gradient @ at) + LARGE * missing


def test_no_other_possible_machine_fits_better(two_link: RobotModel) -> None:
    truth = two_link_truth(two_link, (-1.0, 2.0, 1.5, 0.8))
    truth[two_link.parameter_names.index("I2yy")] = -0.1  # no machine: the constraints bind
    motion = a_motion(two_link, 6)
    torque = measured(two_link, motion, truth, 0.4, 6)
    found = fitted(two_link, motion, torque, Consistency(prior_weight=1e-4))
    # The same objective from the samples, and its gradient.
    factor = Factor.from_samples(two_link, motion, torque)
    weights = joint_weights(factor)
    excess = square_root(factor.weighted(weights)).excess(found.estimate.values)
    assert excess > 100.0
    rank, s = two_link.base.rank, len(two_link.standard_names)
    mapping = np.zeros((two_link.n_parameters, s + 4))
    mapping[:rank, :s] = two_link.base.grouping
    mapping[rank:, s:] = np.eye(4)
    rows = two_link.regressor(*motion[1:]).dense(two_link.n_parameters) @ mapping
    x = np.concatenate([found.standard, found.friction])
    error = rows @ x - torque
    gradient = 2.0 * np.einsum("tj,j,tjk->k", error, weights, rows)
    assert largest_gain(gradient, x, two_link.chain.inertial) < 1e-2 * excess


@pytest.mark.parametrize("noise", [0.1, 0.01, 0.0])
def test_data_that_no_machine_can_make_still_give_the_machine_that_is_closest(
    two_link: RobotModel, noise: float
) -> None:
    """As after a wrong sign of one torque, however exact the data are."""
    truth = two_link_truth(two_link, (-1.0, 2.0, 1.5, 0.8))
    truth[two_link.parameter_names.index("I2yy")] = -0.3
    motion = a_motion(two_link, 6)
    found = fitted(two_link, motion, measured(two_link, motion, truth, noise, 6))
    assert_possible(two_link, found)
    assert "no machine fits" in found.status
    assert found.cost > 0.02


@given(st.integers(0, 2**16))
@settings(max_examples=15)
def test_excess_is_the_weighted_squared_error_above_its_minimum(seed: int) -> None:
    model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(third=None))
    rng = np.random.default_rng(seed)
    motion = a_motion(model, seed, samples=100)
    torque = rng.normal(size=(100, 2))
    weights = rng.uniform(0.1, 10.0, 2)
    factor = Factor.from_samples(model, motion, torque)
    values = rng.normal(size=model.n_parameters)

    def squares(x: Array) -> float:
        return float(np.sum(weights * (model.torque(x, *motion[1:]) - torque) ** 2))

    least = estimate(model, factor, weights).values
    expected = squares(values) - squares(least)
    assert square_root(factor.weighted(weights)).excess(values) == pytest.approx(expected, rel=1e-6)


def test_errors_on_the_fitted_rows_are_those_of_the_samples(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 7, samples=300)
    torque = measured(two_link, motion, two_link_truth(two_link), 0.3, 7)
    found = fitted(two_link, motion, torque)
    error = two_link.torque(found.estimate.values, *motion[1:]) - torque
    np.testing.assert_allclose(
        found.estimate.noise_std, np.sqrt((error**2).mean(axis=0)), rtol=1e-6
    )
    relative = np.linalg.norm(error) / np.linalg.norm(torque)
    assert found.relative_error == pytest.approx(relative, rel=1e-6)


def test_the_covariance_is_said_to_be_that_of_the_unconstrained(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 8, samples=300)
    found = fitted(two_link, motion, measured(two_link, motion, two_link_truth(two_link), 0.3, 8))
    assert "covariance of the unconstrained estimate" in found.estimate.method
    np.testing.assert_array_equal(found.estimate.covariance, found.unconstrained.covariance)


def test_one_chunk_or_many_are_the_same(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 9, samples=600)
    torque = measured(two_link, motion, two_link_truth(two_link), 0.3, 9)
    whole = Factor.from_samples(two_link, motion, torque)
    parts = Factor.zero(two_link)
    for start in range(0, 600, 50):
        cut = slice(start, start + 50)
        chunk = motion.rows(cut)
        parts = parts + Factor.from_samples(two_link, chunk, torque[cut])
    one, other = (consistent_estimate(two_link, f, estimate(two_link, f)) for f in (whole, parts))
    np.testing.assert_allclose(one.estimate.values, other.estimate.values, rtol=1e-9)
    np.testing.assert_allclose(one.standard, other.standard, rtol=1e-9, atol=1e-9)


def test_a_joint_that_never_moved_keeps_its_nominal_link() -> None:
    model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(third=None), gravity=(0, 0, 0))
    motion = a_motion(model, 10)
    for array in motion[1:4]:
        array[:, 1] = 0.0
    values = np.concatenate([model.base.grouping @ model.nominal, [4.0, 2.0, 1.5, 0.8]])
    torque = measured(model, motion, values, 0.01, 10)
    mask = np.zeros(torque.shape, dtype=np.bool_)
    mask[:, 0] = True
    found = fitted(model, motion, torque, mask=mask)
    assert_possible(model, found)
    assert {"f0_2", "f1_2"} <= set(found.estimate.undetermined)
    assert np.all(np.isfinite(found.standard))
    np.testing.assert_allclose(found.standard[20], model.nominal[20], rtol=0.5)  # m2


def test_a_prior_without_weight_is_refused() -> None:
    with pytest.raises(IdentificationError, match="prior weight"):
        Consistency(prior_weight=0.0)


def test_nominal_parameters_of_another_robot_are_refused(two_link: RobotModel) -> None:
    motion = a_motion(two_link, 11, samples=100)
    torque = measured(two_link, motion, two_link_truth(two_link), 0.05, 11)
    with pytest.raises(ShapeError):
        fitted(two_link, motion, torque, Consistency(nominal=np.ones(3)))


def test_a_description_without_inertia_says_that_bodies_were_assumed() -> None:
    bare = TWO_LINK
    while "<inertial>" in bare:
        start, end = bare.index("<inertial>"), bare.index("</inertial>") + len("</inertial>")
        bare = bare[:start] + bare[end:]
    model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(third=None))
    empty = RobotModel.from_urdf(bare, friction=FrictionLaw(third=None))
    motion = a_motion(model, 12)
    torque = measured(model, motion, two_link_truth(model), 0.02, 12)
    found = fitted(empty, motion, torque)
    assert all(words.startswith("assumed") for words in found.reference)
    assert_possible(empty, found)
    assert found.cost < 1e-3


# NS 16: the truth is known, and the paper's estimates are in print.


def ns16() -> tuple[RobotModel, Array, Array]:
    """Return the model, its true parameters, and a nominal that is 5 to 20 % wrong, no rotors."""
    model = RobotModel.from_urdf(urdf_text())
    named, truth = standard_parameters(), load_truth()
    standard = np.array([named[name] for name in model.standard_names])
    values = np.concatenate(
        [model.base.grouping @ standard, truth.coulomb, truth.viscous, truth.third]
    )
    rng = np.random.default_rng(0)
    nominal = standard.reshape(6, 11).copy()
    nominal *= 1.0 + rng.uniform(0.05, 0.2, (6, 1)) * rng.choice([-1.0, 1.0], (6, 1))
    nominal[:, 10] = 0.0
    return model, values, nominal.reshape(-1)


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.3])
def test_ns16_is_possible_and_predicts_unseen_motion_as_well(noise: float) -> None:
    model, truth, nominal = ns16()
    motion, other = a_motion(model, 1), a_motion(model, 2)
    torque = measured(model, motion, truth, noise, 3)
    found = fitted(model, motion, torque, Consistency(nominal=nominal))
    assert_possible(model, found)
    unseen = measured(model, other, truth, noise, 4)

    def error(values: Array) -> float:
        wrong = model.torque(values, *other[1:]) - unseen
        return float(np.linalg.norm(wrong) / np.linalg.norm(unseen))

    assert error(found.estimate.values) < error(found.unconstrained.values) + 1e-3


def nearest_consistent(column: str) -> tuple[float, float]:
    """Distance of a column of Table 2 from the possible machines, and a lower bound of it."""
    model = RobotModel.from_urdf(
        urdf_text(), friction=FrictionLaw(coulomb=False, viscous=False, third=None)
    )
    rows = {row.pivot: row for row in table2()[:40]}
    values = np.array([rows[n].sign * getattr(rows[n], column) for n in model.base.names])
    # Forty "measurements", each of one base parameter.
    gram = np.zeros((6, 41, 41))
    gram[0] = np.eye(41)
    gram[0, :40, 40] = gram[0, 40, :40] = values
    gram[0, 40, 40] = values @ values
    factor = Factor(gram, np.array([40, 0, 0, 0, 0, 0]), model.parameter_names)
    weights = np.ones(6)
    found = consistent_estimate(
        model,
        factor,
        estimate(model, factor, weights),
        weights=weights,
        options=Consistency(prior_weight=1e-6),
    )
    assert_possible(model, found)
    # From here on Table 2's own grouping.
    names = model.standard_names
    grouping = np.zeros((40, len(names)))
    for i, row in enumerate(table2()[:40]):
        for name, value in row.terms.items():
            grouping[i, names.index(name)] = value
    error = grouping @ found.standard - [getattr(row, column) for row in table2()[:40]]
    gap = largest_gain(2.0 * grouping.T @ error, found.standard, model.chain.inertial)
    distance = float(np.linalg.norm(error))
    return distance, float(np.sqrt(max(distance**2 - gap, 0.0)))


def test_the_makers_parameters_are_possible() -> None:
    distance, _ = nearest_consistent("pi_c")
    assert distance < 1e-3


def test_the_papers_method_b_is_not_possible() -> None:
    distance, at_least = nearest_consistent("pi_b")
    assert 1.4 < at_least <= distance < 1.43


# Robots of other makers, whose nominal parameters are partly no bodies.


@pytest.mark.parametrize(
    "path", ["ur_description/urdf/ur10_robot.urdf", "panda_description/urdf/panda.urdf"]
)
def test_other_robots(path: str) -> None:
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("the example-robot-data package is not installed")
    root = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    model = RobotModel.from_urdf((root / path).read_text(encoding="utf-8"))
    friction = np.tile(np.array([2.0, 1.0, 0.0]), (model.n_joints, 1)).T.reshape(-1)
    standard = model.nominal.reshape(model.n_joints, -1).copy()
    standard[:, 10] = 0.5
    truth = np.concatenate([model.base.grouping @ standard.reshape(-1), friction])
    motion = a_motion(model, 1)
    found = fitted(model, motion, measured(model, motion, truth, 0.1, 1))
    assert_possible(model, found)
    assert found.cost < 1e-3


def test_an_estimate_of_other_parameters_is_refused(two_link: RobotModel) -> None:
    other = RobotModel.from_urdf(TWO_LINK)
    motion = a_motion(two_link, 1, samples=200)
    torque = measured(two_link, motion, two_link_truth(two_link), 0.1, 1)
    wrong: Estimate = estimate(other, Factor.from_samples(other, motion, torque))
    with pytest.raises(IdentificationError, match="other parameters"):
        consistent_estimate(two_link, Factor.from_samples(two_link, motion, torque), wrong)


def a_problem(seed: int) -> Smooth:
    """Two links, three further variables of which two may not be negative; few data."""
    rng = np.random.default_rng(seed)
    rows, columns = np.triu_indices(4)
    entries = np.zeros((10, 4, 4))
    entries[np.arange(10), rows, columns] = entries[np.arange(10), columns, rows] = 1.0
    return Smooth(
        R=rng.normal(size=(12, 23)),
        z=rng.normal(scale=5.0, size=12),
        weight=10.0 ** rng.uniform(-1, 1),
        cones=(Cone(np.arange(20).reshape(2, 10), entries),),
        centre=np.zeros(3),
        not_negative=np.array([20, 21]),
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


@given(st.integers(0, 2**16))
@settings(max_examples=20)
def test_every_start_and_the_path_end_at_the_same_minimum(seed: int) -> None:
    problem = a_problem(seed)
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
