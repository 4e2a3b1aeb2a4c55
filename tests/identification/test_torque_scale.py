"""Uncertainty of estimates by the scale of the torques, against draws of that scale."""

from dataclasses import replace

import numpy as np
import pytest

from identification.estimators.payload_estimate import NAMES, identify_payload
from identification.estimators.payload_problem import Run
from identification.estimators.torque_scale import (
    absolute,
    described,
    scale_covariance,
    scale_sensitivity,
    with_torque_scale,
)
from identification.factor.estimate import estimate, joint_weights
from identification.factor.factor import Factor
from identification.model.known_payload import Load, Payload
from tests.identification.two_link import MODEL, a_motion, as_samples, four_sines, truth

pytestmark = pytest.mark.long

SCALE_STD = np.array([0.03, 0.05])
DRAWS = 2000
LOAD = Payload(4.0, (0.2, 0.0, 0.1), (0.02, 0.0, 0.0, 0.03, 0.0, 0.04))


@pytest.fixture(scope="module")
def torque():
    rng = np.random.default_rng(1)
    motion = a_motion()
    clean = MODEL.torque(truth(), motion)
    return motion, clean + 0.5 * rng.standard_normal(clean.shape)


def solved(motion, torque, weights, prior):
    """Return the posterior mean and the inverse of its information."""
    factor = Factor.by_time(MODEL, as_samples(MODEL, motion, torque))
    equations = factor.weighted(weights)
    inverse = np.linalg.inv(equations.A + prior)
    return factor, inverse @ (equations.b + prior @ truth()), inverse


class TestScaleCovariance:
    @pytest.mark.parametrize("strength", [0.0, 0.3])
    def test_it_is_the_scatter_over_draws_of_the_scale(self, torque, strength):
        """With and without a Gaussian prior at the truth."""
        motion, measured = torque
        weights = np.array([0.5, 2.0])
        whole = Factor.by_time(MODEL, as_samples(MODEL, motion, measured)).weighted(weights)
        prior = strength * np.diag(np.diag(whole.A))
        factor, _, inverse = solved(motion, measured, weights, prior)
        claimed = scale_covariance(scale_sensitivity(factor, weights, inverse), SCALE_STD)
        rng = np.random.default_rng(2)
        scales = 1.0 + SCALE_STD * rng.standard_normal((DRAWS, 2))
        pulls = []
        for joint in range(2):
            alone = np.zeros_like(measured)
            alone[:, joint] = measured[:, joint]
            pulls.append(
                Factor.by_time(MODEL, as_samples(MODEL, motion, alone)).weighted(weights).b
            )
        draws = (scales @ np.array(pulls) + prior @ truth()) @ inverse
        scatter = np.cov(draws.T)
        # The standard deviation of 2000 draws has an error of 1.6 %.
        spread = np.sqrt(np.diag(scatter))
        assert np.sqrt(np.diag(claimed)) == pytest.approx(spread, rel=5 * 0.016)
        correlation = scatter / np.outer(spread, spread)
        expected = claimed / np.sqrt(np.outer(np.diag(claimed), np.diag(claimed)))
        np.testing.assert_allclose(expected, correlation, atol=5 / np.sqrt(DRAWS))

    def test_a_common_scale_scales_every_parameter(self, torque):
        motion, measured = torque
        weights = np.ones(2)
        factor, values, inverse = solved(motion, measured, weights, 0.0 * np.eye(len(truth())))
        sensitivity = scale_sensitivity(factor, weights, inverse)
        np.testing.assert_allclose(sensitivity.sum(axis=1), values, rtol=1e-6, atol=1e-9)

    def test_intervals_in_units_of_the_arms_torque_do_not_have_it(self, torque):
        motion, measured = torque
        factor = Factor.by_time(MODEL, as_samples(MODEL, motion, measured))
        weights = joint_weights(factor)
        inverse = factor.solve(weights).inverse
        estimated = estimate(MODEL, factor, weights)
        widths = []
        for std in (0.0 * SCALE_STD, SCALE_STD, 10.0 * SCALE_STD):
            uncertain = with_torque_scale(estimated, factor, weights, inverse, std)
            np.testing.assert_array_equal(uncertain.covariance, estimated.covariance)
            widths.append(absolute(uncertain).std)
        np.testing.assert_array_equal(widths[0], estimated.std)
        assert np.all(widths[0] <= widths[1])
        assert np.all(widths[1] <= widths[2])
        assert np.any(widths[2] > 2.0 * widths[0])

    def test_it_is_added_once(self, torque):
        motion, measured = torque
        factor = Factor.by_time(MODEL, as_samples(MODEL, motion, measured))
        weights = joint_weights(factor)
        inverse = factor.solve(weights).inverse
        uncertain = with_torque_scale(
            estimate(MODEL, factor, weights), factor, weights, inverse, SCALE_STD
        )
        once = absolute(uncertain)
        np.testing.assert_array_equal(absolute(once).covariance, once.covariance)

    def test_absolute_intervals_are_wider_by_the_normal_factor(self, torque):
        """Student's factor of the residual is not applied to a stated uncertainty."""
        motion, measured = torque
        factor = Factor.by_time(MODEL, as_samples(MODEL, motion, measured))
        weights = joint_weights(factor)
        inverse = factor.solve(weights).inverse
        estimated = replace(estimate(MODEL, factor, weights), interval_factor=2.5)
        wider = absolute(with_torque_scale(estimated, factor, weights, inverse, SCALE_STD))
        added = scale_covariance(scale_sensitivity(factor, weights, inverse), SCALE_STD)
        half = (2.5 * estimated.std) ** 2 + 1.96**2 * np.diag(added)
        np.testing.assert_allclose((2.5 * wider.std) ** 2, half)
        assert wider.method == estimated.method.widened("torque_scale")

    def test_undetermined_parameters_stay_undetermined(self, torque):
        motion, measured = torque
        factor = Factor.by_time(MODEL, as_samples(MODEL, motion, measured))
        weights = joint_weights(factor)
        estimated = estimate(MODEL, factor, weights)
        open_ended = estimated.covariance.copy()
        open_ended[0], open_ended[:, 0] = 0.0, 0.0
        open_ended[0, 0] = np.inf
        inverse = factor.solve(weights).inverse
        wider = absolute(
            with_torque_scale(
                replace(estimated, covariance=open_ended), factor, weights, inverse, SCALE_STD
            )
        )
        assert np.isinf(wider.covariance[0, 0])
        assert not wider.covariance[0, 1:].any()
        assert np.all(wider.std[1:] > estimated.std[1:])


def test_what_is_assumed_is_said():
    assert described(np.array([0.03, 0.03]), "torque constants") == "torque constants to 3 %"
    assert described(np.array([0.005, 0.02])) == "the scale of torques to 0.5 to 2 %"


class TestPayload:
    def weighed(self, scales, std):
        """Weigh the load with noise-free torques of wrong scale."""
        motion = four_sines(np.arange(2000) * 5e-3)
        bare = MODEL.torque(truth(), motion)
        carried = bare + Load(MODEL.chain, MODEL.gravity, LOAD).torque(motion)
        noise = np.random.default_rng(3).standard_normal((2, *bare.shape))
        runs = [
            Run.of(
                name,
                MODEL,
                as_samples(MODEL, motion, (torque + 0.3 * run_noise) * scales),
                None,
                loaded=kind,
            )
            for name, kind, torque, run_noise in (
                ("bare", False, bare, noise[0]),
                ("loaded", True, carried, noise[1]),
            )
        ]
        return identify_payload(MODEL, runs, std)

    def test_intervals_cover_under_wrong_torque_constants(self):
        """Of 60 draws at 95 % fewer than 52 inside have a probability of 0.5 %."""
        figures = {"mass": 4.0, "cx": 0.2, "cz": 0.1, "Iyy": 0.03}
        places = [NAMES.index(name) for name in figures]
        values = np.array([*figures.values()])
        rng = np.random.default_rng(4)
        std = np.full(2, 0.03)
        inside = np.zeros(4)
        without = np.zeros(4)
        for _ in range(60):
            scales = 1.0 + std * rng.standard_normal(2)
            for counts, assumed in ((inside, std), (without, None)):
                low, high = self.weighed(scales, assumed).intervals[places].T
                counts += (low <= values) & (values <= high)
        assert np.all(inside >= 52), dict(zip(figures, inside, strict=True))
        assert without[0] < 30, "otherwise nothing is tested"

    def test_a_common_scale_does_not_move_the_centre(self):
        exact, scaled = (self.weighed(np.full(2, scale), None) for scale in (1.0, 1.1))
        assert scaled.body.mass == pytest.approx(1.1 * exact.body.mass, rel=1e-3)
        assert scaled.body.centre == pytest.approx(exact.body.centre, abs=1e-4)
