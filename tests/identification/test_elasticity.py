"""Intervals of parameters allow for elastic gears, whose errors no residual shows."""

from dataclasses import replace

import numpy as np
import pytest

from identification.estimators import elasticity
from identification.estimators.elasticity import (
    EXPECTED_RESONANCE,
    ElasticTorque,
    elastic_torque,
    expected_compliance,
    expected_square,
    fitted_gears,
    lost_torque,
    open_compliance,
    with_elastic_gears,
)
from identification.estimators.least_squares import fit_least_squares
from identification.factor.estimate import inverse_variance
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve
from identification.model.motion import Motion
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from tests.identification.two_link import (
    MODEL,
    NOISE,
    as_samples,
    four_sines,
    sine_motion,
    truth,
)

STEP = 0.002
COMPLIANCE = np.array([2e-5, 2e-4])
"""Of the planted gears [rad/(N m)]: the links resonate at 14 and 12 Hz."""


def recorded(compliance, noise=0.0, seed=0):
    """Samples of an arm whose links lag its motors; the positions are those of the motors."""
    motor = four_sines(np.arange(0.0, 12.0, STEP))
    sag = np.zeros_like(motor.position)
    for _ in range(4):  # a fixed point: what the gears transmit is that of the links
        rate = np.gradient(sag, STEP, axis=0)
        bend = np.gradient(rate, STEP, axis=0)
        links = Motion(
            motor.time, motor.position - sag, motor.velocity - rate, motor.acceleration - bend
        )
        transmitted = MODEL.gear_torque(truth(), links)
        sag = compliance * transmitted
    at_motors = MODEL.torque(truth(), motor)
    torque = at_motors + transmitted - MODEL.gear_torque(truth(), motor)
    torque += noise * np.random.default_rng(seed).standard_normal(torque.shape)
    inside = slice(50, -50)  # differences are one-sided at the ends
    return as_samples(MODEL, motor.rows(inside), torque[inside])


def elastic(samples, compliance):
    """The same samples with the torque of elastic gears."""
    each = elastic_torque(MODEL, samples, truth(), compliance)
    return replace(samples, torque=samples.torque + each.sum(axis=2))


def fitted(samples):
    """The estimate of rigid gears, and the same with elastic ones allowed for."""
    estimate = fit_least_squares(MODEL, [samples])
    factor = Factor.by_time(MODEL, samples)
    torque = ElasticTorque.of(MODEL, samples, estimate.values)
    return estimate, with_elastic_gears(estimate, fitted_gears(estimate, factor, torque, 1.0))


def deviation(estimate):
    """Errors (p,) in halves of 95 % intervals."""
    return np.abs(estimate.values - truth()) / (estimate.interval_factor * estimate.std)


def test_the_torque_is_that_of_links_that_lag_their_motors():
    elastic = recorded(COMPLIANCE / 10.0)
    rigid = recorded(np.zeros(2))
    each = elastic_torque(MODEL, rigid, truth(), COMPLIANCE / 10.0)
    added = elastic.torque - rigid.torque
    error = (each.sum(axis=2) - added)[200:-200]  # its low-pass turns round at the ends
    assert np.linalg.norm(error) < 0.05 * np.linalg.norm(added[200:-200])


def test_elastic_gears_mislead_rigid_intervals_alone():
    estimate, wider = fitted(recorded(COMPLIANCE, NOISE))
    assert np.max(deviation(estimate)) > 2.0
    assert np.max(deviation(wider)) < 1.0
    np.testing.assert_array_equal(wider.values, estimate.values)


def test_data_of_rigid_gears_widen_intervals_little():
    """The expected compliances alone would make them three times as wide."""
    samples = recorded(np.zeros(2), NOISE)
    estimate, wider = fitted(samples)
    expected = expected_compliance(MODEL, samples, estimate.values)
    alone = fit_least_squares(MODEL, [elastic(samples, expected)]).values - estimate.values
    assert np.max(np.abs(alone) / estimate.std) > 3.0
    assert np.max(wider.std / estimate.std) < 1.5


def smoothed(bandwidth, noise):
    """A fast motion of rigid gears, and its samples."""
    time = np.arange(0.0, 12.0, STEP)
    rates = 2.0 * np.pi * np.array([[0.5, 0.7], [3.0, 4.0], [5.0, 6.0]])
    motion = sine_motion(time, np.array([[0.3], [0.02], [0.01]]), rates, rates)
    torque = MODEL.torque(truth(), motion)
    torque += noise * np.random.default_rng(0).standard_normal(torque.shape)
    recording = Recording(time, motion.position, MODEL.joint_names, torque)
    how = Preprocessing(rigid_bandwidth=bandwidth)
    return motion, prepare(recording, MODEL, noise_variance=np.full(2, 1e-14), options=how)


@pytest.mark.parametrize("bandwidth", [10.0, 14.0, 20.0])
def test_the_torque_that_smoothing_takes_is_known(bandwidth):
    motion, samples = smoothed(bandwidth, 0.0)
    inertial = np.where(MODEL.friction_columns, 0.0, truth())
    exact, left = (MODEL.torque(inertial, each) for each in (motion, samples.motion))
    missing = (exact - left - lost_torque(MODEL, samples, truth()))[500:-500]
    assert np.linalg.norm(missing) < 0.2 * np.linalg.norm((exact - left)[500:-500])


@pytest.mark.parametrize("bandwidth", [10.0, 14.0])
def test_smoothing_makes_no_gears_elastic(bandwidth, monkeypatch):
    """It takes more of the torque at higher frequencies, where elastic gears add."""
    _, samples = smoothed(bandwidth, NOISE)
    estimate, wider = fitted(samples)
    monkeypatch.setattr(elasticity, "lost_torque", lambda *_: np.zeros_like(samples.torque))
    _, unaware = fitted(samples)
    assert np.max(wider.std / estimate.std) < 2.0 < np.max(unaware.std / estimate.std)


def test_the_noise_of_rigid_gears_makes_none_elastic():
    """Where two gears add nearly the same torque, one of which cannot have a negative share."""
    samples = recorded(np.zeros(2), NOISE)
    estimate = fit_least_squares(MODEL, [samples])
    factor = Factor.by_time(MODEL, samples)
    weights = inverse_variance(estimate.noise_std**2)
    each = elastic_torque(
        MODEL, samples, estimate.values, expected_compliance(MODEL, samples, estimate.values)
    )
    each[:, :, 1] = each[:, :, 0] + 0.01 * each[:, :, 1]
    opposed = replace(samples, torque=samples.torque + 3.0 * (each[:, :, 0] - each[:, :, 1]))
    sums = _sums(opposed, each)
    products, squares, measured = sums.weighted(weights, 1.0)
    inverse = solve(factor.weighted(weights)).inverse
    moved, covariance = open_compliance(inverse, products, squares)
    errors = measured - products.T @ estimate.values
    wider = with_elastic_gears(estimate, fitted_gears(estimate, factor, sums, 1.0))
    added = wider.covariance - estimate.covariance - moved @ covariance @ moved.T
    # The most likely ones without negative shares, among all on a grid.
    shares = np.linspace(0.0, 1.0, 201)
    grid = np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2)
    curvature = np.linalg.inv(covariance)
    costs = 0.5 * np.einsum("gi,ij,gj->g", grid, curvature, grid) - grid @ errors
    best = moved @ grid[np.argmin(costs)]
    step = np.abs(moved).sum(axis=1) * (shares[1] - shares[0])
    assert np.all(np.abs(np.sqrt(np.maximum(np.diag(added), 0.0)) - np.abs(best)) <= step)


def _sums(samples, each):
    products = np.zeros((2, MODEL.n_parameters, 2))
    squares = np.zeros((2, 2, 2))
    measured = np.zeros((2, 2))
    for joint, (block, used) in enumerate(zip(*samples.regressor(MODEL), strict=True)):
        some = samples.usable[:, joint]
        effect = each[some, joint]
        products[joint][used] = block[some].T @ effect
        squares[joint] = effect.T @ effect
        measured[joint] = effect.T @ samples.torque[some, joint]
    lost = np.zeros((2, MODEL.n_parameters))
    return ElasticTorque(products, squares, measured, lost, compliance=np.ones(2))


def test_repetitions_count_like_more_rows():
    samples = recorded(COMPLIANCE, NOISE)
    estimate, _ = fitted(samples)
    weights = np.array([1.0, 2.0])
    single = ElasticTorque.of(MODEL, samples, estimate.values)
    double = single.plus(single)
    for once, twice in zip(
        single.weighted(weights, 2.0), double.weighted(weights, 1.0), strict=True
    ):
        np.testing.assert_allclose(once, twice)


def test_links_resonate_on_the_expected_gears():
    """One joint alone is an inertia on a spring."""
    samples = recorded(np.zeros(2))
    still = as_samples(
        MODEL, replace(samples.motion, position=np.zeros_like(samples.torque)), samples.torque
    )
    rest = Motion.at_rest(np.zeros((2, 2)))
    inertia = MODEL.gear_torque(truth(), replace(rest, acceleration=np.eye(2)))
    inertia -= MODEL.gear_torque(truth(), rest)
    expected = expected_compliance(MODEL, still, truth())
    np.testing.assert_allclose(1.0 / np.sqrt(expected * np.diag(inertia)), EXPECTED_RESONANCE)


def test_a_link_without_inertia_has_no_expected_compliance():
    samples = recorded(np.zeros(2))
    assert expected_compliance(MODEL, samples, 0.0 * truth()).tolist() == [0.0, 0.0]


def test_an_undetermined_parameter_stays_so():
    samples = recorded(COMPLIANCE, NOISE)
    estimate, _ = fitted(samples)
    covariance = estimate.covariance.copy()
    covariance[0, :] = covariance[:, 0] = 0.0
    covariance[0, 0] = np.inf
    unknown = replace(estimate, covariance=covariance)
    torque = ElasticTorque.of(MODEL, samples, estimate.values)
    gears = fitted_gears(unknown, Factor.by_time(MODEL, samples), torque, 1.0)
    wider = with_elastic_gears(unknown, gears)
    assert np.isinf(wider.covariance[0, 0])
    np.testing.assert_array_equal(wider.covariance[0, 1:], 0.0)


def test_expected_square_is_the_mean_over_estimates():
    """Of estimates about what recordings have shown, none negative, with what stays open."""
    mean = np.array([0.6, 0.0, 0.2])
    scatter = np.array([0.05, 0.7, 0.0])
    covariance = np.diag([0.01, 0.4, 0.09])
    shown = mean + scatter * np.random.default_rng(1).standard_normal((400_000, 3))
    shown = np.maximum(shown, 0.0)
    expected = covariance + shown.T @ shown / len(shown)
    np.testing.assert_allclose(expected_square(covariance, mean, scatter), expected, atol=3e-3)
