"""Physically consistent estimates: properties of the result and of the solver."""

import math

import numpy as np
import pytest

from identification import (
    Coupling,
    Factor,
    FrictionLaw,
    RobotModel,
    consistent_estimate,
    fit_least_squares,
    write_urdf,
)
from identification.estimators.consistent import Shrinkage, fit_shrunk, shrunk_values
from identification.export.urdf import NotConsistentError
from identification.factor.factor import joint_weights, rows_of, total_factor
from identification.model.pseudo_inertia import pseudo_inertia
from tests.identification import two_link
from tests.identification.two_link import (
    MODEL,
    URDF,
    gaussian,
    recording,
    sine_motion,
    truth,
    values_of,
)


def with_friction(*friction):
    """Return the true parameters of the two links with other friction."""
    return np.concatenate([truth()[: MODEL.base.rank], friction])


def a_motion(model, seed, samples=2000):
    """Return five sines per joint, similar for all seeds."""
    rng = np.random.default_rng(seed)
    shape = (5, model.n_joints)
    time = np.arange(samples) * 4e-3
    size = np.linspace(1.0, 0.2, 5)[:, None]
    pace = np.linspace(0.5, 4.0, 5)[:, None] * rng.uniform(0.9, 1.1, shape)
    return sine_motion(time, size, pace, rng.uniform(0.0, 6.0, shape))


def measured(model, motion, values, noise, seed):
    """Return torque with noise, a share of each joint's RMS."""
    rms = np.sqrt((model.torque(values, *motion[1:]) ** 2).mean(axis=0))
    return two_link.simulated(model, values, motion, noise * rms, seed).torque


def fitted(model, motion, torque, **options):
    return consistent_estimate(model, Factor.from_samples(model, motion, torque), **options)


def simulated(values, noise, seed, *, model=MODEL, samples=2000):
    """Return the estimate of an arm with these parameters."""
    motion = a_motion(model, seed, samples)
    return fitted(model, motion, measured(model, motion, values, noise, seed))


def error_rise(found):
    """Return the rise of the relative error on the fitted rows."""
    return found.relative_error - found.unconstrained_relative_error


def assert_consistent(model, found):
    """Check the definition of consistency by eigenvalues."""
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


LARGE = 1e2  # times the nominal bodies, kg m² of rotor, or N·m of friction


def largest_gain(gradient, at, nominal):
    """Return a bound on how much consistent parameters can decrease a convex function.

    The function stays above its tangent. The gradient of a link is a matrix Z with <Z, J(x)> =
    gradient x, not negative if Z is positive semidefinite. Small violations are multiplied by
    LARGE.
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


class TestConsistentEstimate:
    @pytest.mark.parametrize(("noise", "samples"), [(0.5, 150), (0.3, 300), (0.02, 2000)])
    def test_base_parameters_follow_from_standard_ones(self, noise, samples):
        """These are consistent with poor data; good data are hardly changed."""
        found, rank = simulated(truth(), noise, 1, samples=samples), MODEL.base.rank
        assert_consistent(MODEL, found)
        assert found.status == "optimal" and np.all(found.margin > 0.0)
        expected = MODEL.base.grouping @ found.standard
        np.testing.assert_allclose(found.estimate.values[:rank], expected, atol=1e-12)
        np.testing.assert_array_equal(found.estimate.values[rank:], found.friction)
        if noise == 0.02:
            assert np.abs(found.shift).max() < 0.1 and error_rise(found) < 1e-5

    def test_exact_nominal_data_return_all_parameters(self):
        """Parameters without effect on the torque are nominal."""
        values = values_of(MODEL, [4.0, 2.0, 1.5, 0.8])
        np.testing.assert_allclose(simulated(values, 0.0, 3).standard, MODEL.nominal, atol=1e-4)

    def test_negative_friction_becomes_zero(self):
        found = simulated(with_friction(-1.0, 2.0, 1.5, -0.3), 0.01, 4)
        for name in ("f0_1", "f1_2"):
            assert found.unconstrained.value(name) < 0.0
            assert found.estimate.value(name) == pytest.approx(0.0, abs=1e-3)
        assert_consistent(MODEL, found)

    def test_no_other_consistent_parameters_fit_better(self):
        values = with_friction(-1.0, 2.0, 1.5, 0.8)
        values[MODEL.parameter_names.index("I2yy")] = -0.1  # active constraints
        motion = a_motion(MODEL, 6)
        torque = measured(MODEL, motion, values, 0.4, 6)
        found = fitted(MODEL, motion, torque, prior_weight=1e-4)
        # The same objective from the samples, and its gradient.
        factor = Factor.from_samples(MODEL, motion, torque)
        weights = joint_weights(factor)
        root, target = rows_of(factor.weighted(weights))
        excess = float(np.sum((root @ found.estimate.values - target) ** 2))
        assert excess > 100.0
        rank, s = MODEL.base.rank, len(MODEL.layout.names)
        mapping = np.zeros((MODEL.n_parameters, s + 4))
        mapping[:rank, :s] = MODEL.base.grouping
        mapping[rank:, s:] = np.eye(4)
        rows = MODEL.regressor(*motion[1:]).dense(MODEL.n_parameters) @ mapping
        x = np.concatenate([found.standard, found.friction])
        gradient = 2.0 * np.einsum("tj,j,tjk->k", rows @ x - torque, weights, rows)
        assert largest_gain(gradient, x, MODEL.chain.inertial) < 1e-2 * excess

    @pytest.mark.parametrize("noise", [0.1, 0.01, 0.0])
    def test_inconsistent_data_give_the_closest_parameters(self, noise):
        """As after a wrong sign of one torque, for any noise."""
        values = with_friction(-1.0, 2.0, 1.5, 0.8)
        values[MODEL.parameter_names.index("I2yy")] = -0.3
        found = simulated(values, noise, 6)
        assert_consistent(MODEL, found)
        assert "no consistent parameters fit" in found.status
        assert error_rise(found) > 0.02

    def test_errors_and_covariance_are_correct(self):
        motion = a_motion(MODEL, 7, samples=300)
        torque = measured(MODEL, motion, truth(), 0.3, 7)
        found = fitted(MODEL, motion, torque)
        error = MODEL.torque(found.estimate.values, *motion[1:]) - torque
        rms = np.sqrt((error**2).mean(axis=0))
        np.testing.assert_allclose(found.estimate.noise_std, rms, rtol=1e-6)
        relative = np.linalg.norm(error) / np.linalg.norm(torque)
        assert found.relative_error == pytest.approx(relative, rel=1e-6)
        assert "covariance of the unconstrained estimate" in found.estimate.method
        np.testing.assert_array_equal(found.estimate.covariance, found.unconstrained.covariance)

    def test_a_resting_joint_keeps_its_nominal_link(self):
        law = FrictionLaw(third=None)
        model = RobotModel.from_urdf(URDF, friction=law, gravity=(0, 0, 0))
        motion = a_motion(model, 10)
        for array in motion[1:4]:
            array[:, 1] = 0.0
        values = values_of(model, [4.0, 2.0, 1.5, 0.8])
        torque = measured(model, motion, values, 0.01, 10)
        mask = np.zeros(torque.shape, dtype=np.bool_)
        mask[:, 0] = True
        found = consistent_estimate(model, Factor.from_samples(model, motion, torque, mask))
        assert_consistent(model, found)
        assert {"f0_2", "f1_2"} <= set(found.estimate.undetermined)
        assert np.all(np.isfinite(found.standard))
        np.testing.assert_allclose(found.standard[20], model.nominal[20], rtol=0.5)  # m2


class TestDrives:
    """Coupled drives, and friction of more than three terms."""

    TURNS = np.array([[1.0, 0.0], [0.5, 1.0]])

    def coupled(self, inertia):
        law = FrictionLaw(third=None)
        model = RobotModel.from_urdf(URDF, friction=law, coupling=Coupling(self.TURNS))
        standard = model.nominal
        standard[model.layout.rotors] = 0.4, 0.1
        standard[model.layout.couplings] = inertia
        return model, standard

    @pytest.mark.parametrize("inertia", [0.12, 0.6, -0.6])
    def test_the_rotor_matrix_is_positive(self, inertia):
        """At no cost if the true one is."""
        model, standard = self.coupled(inertia)
        friction = np.full(len(model.friction.terms), 0.8)
        values = np.concatenate([model.base.grouping @ standard, friction])
        found = simulated(values, 0.01, 1, model=model)
        assert np.linalg.eigvalsh(model.layout.rotor_matrix(found.standard))[0] > 0.0
        assert np.all(found.margin > 0.0)
        assert (error_rise(found) < 1e-4) == (inertia == 0.12)

    def test_inconsistent_coupling_inertias_raise(self):
        model, standard = self.coupled(0.3)
        with pytest.raises(NotConsistentError, match="coupling"):
            write_urdf(URDF, model, standard)

    def test_all_friction_terms_dissipate(self):
        """True friction: larger viscous difference than viscosity, smaller friction at rest."""
        law = FrictionLaw(third=None, asymmetric=True, stribeck=0.3)
        model = RobotModel.from_urdf(URDF, friction=law)
        terms = {"f0": 1.0, "f1": 0.3, "fd": 0.6, "fs": -2.0, "fo": 0.2}
        symbols = [term.symbol for term in model.friction.terms]
        values = values_of(model, [terms[symbol] for symbol in symbols])
        found = simulated(values, 0.01, 1, model=model)
        for own in model.friction.table(found.friction):
            assert own["f0"] >= 0.0
            assert own["f0"] + own["fs"] >= -1e-12
            assert abs(own["fd"]) <= own["f1"] + 1e-12
        # Consistent parameters are recovered.
        friction = [(terms | {"f1": 0.9, "fs": 0.7})[symbol] for symbol in symbols]
        found = simulated(values_of(model, friction), 0.0, 1, model=model)
        np.testing.assert_allclose(found.friction, friction, rtol=0.02)


@pytest.fixture(scope="module")
def samples():
    motion = two_link.a_motion()
    return recording(gaussian(np.random.default_rng(3), motion), motion)


@pytest.fixture(scope="module")
def equations(samples):
    total = total_factor(MODEL, [samples])
    return total.weighted(joint_weights(total))


class TestShrunkEstimate:
    def test_strength_zero_is_least_squares(self, samples):
        shrunk = fit_shrunk(MODEL, [samples], Shrinkage(0.0))
        free = fit_least_squares(MODEL, [samples])
        np.testing.assert_allclose(shrunk.values, free.values, rtol=1e-9)
        np.testing.assert_allclose(shrunk.covariance, free.covariance, rtol=1e-6)

    def test_infinite_strength_is_the_consistent_solution(self, samples):
        total = total_factor(MODEL, [samples])
        centre = consistent_estimate(MODEL, total, prior_weight=0.1).estimate.values
        shrunk = fit_shrunk(MODEL, [samples], Shrinkage(math.inf))
        np.testing.assert_array_equal(shrunk.values, centre)

    def test_it_solves_the_penalised_equations(self, equations):
        """(A + s D) (x - c) = b - A c with D = diag(A), for any centre c."""
        far = truth() + 1.0
        values = shrunk_values(equations, far, 0.3)
        penalised = equations.A + 0.3 * np.diag(np.diag(equations.A))
        residual = equations.b - equations.A @ far - penalised @ (values - far)
        assert np.abs(residual).max() < 1e-8 * np.abs(equations.b).max()
