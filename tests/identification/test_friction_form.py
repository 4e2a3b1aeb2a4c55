"""Intervals allow for a friction law that lacks a term, and for friction that changes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from identification.estimators.friction_drift import with_drift
from identification.estimators.friction_form import (
    FORMS,
    FormUncertainty,
    form_factor,
    form_uncertainty,
    with_uncertain_form,
)
from identification.estimators.least_squares import fit_least_squares
from identification.factor.columns import friction_factor
from identification.factor.estimate import joint_weights
from identification.factor.factor import Factor
from identification.model.friction import ASYMMETRIC, QUADRATIC, STRIBECK, FrictionLaw
from identification.model.robot import RobotModel
from tests.identification.evidence import found, judged
from tests.identification.two_link import MODEL, NOISE, URDF, P, a_motion, as_samples, truth

MOTION = a_motion(20.0)
COULOMB, VISCOUS = ([MODEL.parameter_names.index(f"{f}_{j}") for j in (1, 2)] for f in ("f0", "f1"))
ELBOW = 1
WIDE = 0.2  # rad/s, over which most of the planted Stribeck friction decays


def stribeck(share, speed, motion=MOTION):
    """Friction of the elbow at low speed (m, 2) [N·m], which the model's law does not have."""
    velocity = motion.velocity[:, ELBOW]
    torque = np.zeros_like(motion.velocity)
    torque[:, ELBOW] = share * 2.0 * np.sign(velocity) * np.exp(-((velocity / speed) ** 2))
    return torque


def recorded(added=0.0, seed=0, motion=MOTION, noise=NOISE):
    """Samples of the planted arm with a torque (m, 2) that no parameter has."""
    random = np.random.default_rng(seed)
    torque = MODEL.torque(truth(), motion) + added
    return as_samples(MODEL, motion, torque + noise * random.standard_normal(torque.shape))


def examined(samples, model=MODEL):
    """The estimate of the law, the uncertainty of that, and the estimate that allows for it."""
    estimate = fit_least_squares(model, [samples])
    factor = Factor.by_time(model, samples)
    uncertainty = form_uncertainty(model, estimate, factor, form_factor(model, samples))
    return estimate, uncertainty, with_uncertain_form(estimate, uncertainty)


def holds(estimate, which):
    """Whether the 95 % intervals of parameters hold the truth."""
    half = estimate.interval_factor * estimate.std[which]
    return np.abs(estimate.values - truth())[which] <= half


@pytest.fixture(scope="module")
def runs():
    """Forty recordings of an arm whose friction is that of the law."""
    return [examined(recorded(seed=seed)) for seed in range(40)]


class TestRightLaw:
    def test_its_intervals_hardly_widen(self, runs):
        ratios = [wider.std / estimate.std for estimate, _, wider in runs]
        assert np.mean(ratios) < 1.05

    def test_it_is_not_uncertain(self, runs):
        """At most one of twenty recordings raises a false alarm."""
        alarms = sum(bool(np.any(uncertainty.probability > 0.99)) for _, uncertainty, _ in runs)
        assert alarms <= len(runs) / 20

    def test_the_estimate_stays(self, runs):
        estimate, _, wider = runs[0]
        assert np.array_equal(estimate.values, wider.values)


class TestWrongLaw:
    @pytest.mark.parametrize("speed", [0.07, 0.15, 0.3])
    def test_its_intervals_hold_the_true_coefficients(self, speed):
        """At any speed over which the friction that it lacks decays, listed or not."""
        runs = [examined(recorded(stribeck(0.8, speed), seed)) for seed in range(12)]
        which = [COULOMB[ELBOW], VISCOUS[ELBOW]]
        before = np.mean([holds(estimate, which) for estimate, _, _ in runs])
        after = np.mean([holds(wider, which) for _, _, wider in runs])
        assert before < 0.75
        assert after >= 0.9

    def test_the_joint_is_uncertain_and_no_other(self):
        for seed in range(5):
            _, uncertainty, _ = examined(recorded(stribeck(0.8, WIDE), seed))
            assert uncertainty.probability[ELBOW] > 0.99
            assert uncertainty.probability[0] < 0.99
            assert uncertainty.forms[ELBOW].symbol == "fs"

    def test_the_shift_is_that_of_the_right_law(self):
        samples = recorded(stribeck(0.8, WIDE), noise=0.1 * NOISE)
        law = FrictionLaw(third=None, stribeck=WIDE)
        right = fit_least_squares(RobotModel.from_urdf(URDF, friction=law), [samples])
        estimate, uncertainty, _ = examined(samples)
        k = COULOMB[ELBOW]
        moved = right.value(MODEL.parameter_names[k]) - estimate.values[k]
        assert np.sqrt(uncertainty.covariance[k, k]) == pytest.approx(abs(moved), rel=0.1)

    @pytest.mark.parametrize(
        ("term", "size"), [(QUADRATIC, 0.4), (ASYMMETRIC, 0.4), (replace(STRIBECK, speed=0.1), 2.0)]
    )
    def test_the_missing_term_is_named(self, term, size):
        velocity = MOTION.velocity
        added = size * term.column(velocity, np.sign(velocity)) * [0.0, 1.0]
        _, uncertainty, _ = examined(recorded(added))
        assert uncertainty.forms[ELBOW].label == term.label
        assert uncertainty.probability[ELBOW] > 0.99

    def test_a_law_that_has_the_term_is_not_uncertain(self):
        model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None, stribeck=0.2))
        _, uncertainty, _ = examined(recorded(stribeck(0.8, 0.2)), model)
        assert np.all(uncertainty.probability < 0.99)

    def test_noise_may_hide_the_term(self):
        _, uncertainty, _ = examined(recorded(stribeck(0.8, WIDE), noise=100.0 * NOISE))
        assert np.all(uncertainty.probability < 0.5)


class TestRecordings:
    def test_one_of_equal_repetitions_shows_the_same(self):
        samples = recorded(stribeck(0.8, WIDE))
        forms = form_factor(MODEL, samples)
        factor = Factor.by_time(MODEL, samples)
        estimate = fit_least_squares(MODEL, [samples] * 3)
        total = factor + factor + factor
        one = form_uncertainty(MODEL, estimate, total, forms)
        every = form_uncertainty(MODEL, estimate, total, forms + forms + forms)
        np.testing.assert_allclose(one.covariance, every.covariance, rtol=1e-6, atol=1e-12)

    @pytest.mark.parametrize("bandwidth", [None, np.array([8.0, 12.0])])
    def test_its_columns_are_those_of_a_model_with_the_term(self, bandwidth):
        """Through the low-pass of the torque, in parts of a recording as well."""
        whole = replace(recorded(), torque_bandwidth=bandwidth)
        model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None, stribeck=0.1))
        for samples in (whole, whole.between(500, 2000)):
            alone = Factor.by_time(model, samples)
            beside = friction_factor(MODEL, samples, [replace(STRIBECK, speed=0.1)])
            order = [model.parameter_names.index(name) for name in MODEL.parameter_names]
            order += [model.parameter_names.index(f"fs_{j}") for j in (1, 2)]
            np.testing.assert_allclose(
                beside.gram, alone.restricted(np.array(order)).gram, rtol=1e-9, atol=1e-9
            )


def drifting(noise=0.0):
    """Samples of an arm whose elbow loses a tenth of its friction, from 105 to 95 %."""
    level = np.linspace(0.05, -0.05, len(MOTION.time))[:, None] * [0.0, 1.0]
    friction = np.where(MODEL.friction_columns, truth(), 0.0)
    return recorded(level * MODEL.torque(friction, MOTION), noise=noise)


def widened(samples, parts=1):
    """Return the least-squares estimate of samples, and the same with drift in its intervals.

    The drift is measured in successive parts, as in several recordings.
    """
    edges = np.linspace(0, len(samples.motion.time), parts + 1).astype(int)
    recordings = [Factor.by_time(MODEL, samples.between(a, b)) for a, b in pairwise(edges)]
    factor = Factor.by_time(MODEL, samples)
    weights = joint_weights(factor)
    estimate = fit_least_squares(MODEL, [samples], factor=factor)
    estimate = replace(estimate, noise_std=weights**-0.5)  # by which it was fitted
    inverse = factor.solve(weights).inverse
    return estimate, with_drift(MODEL, estimate, recordings, inverse)


class TestDrift:
    @pytest.mark.parametrize("parts", [1, 3])
    def test_the_interval_holds_friction_at_any_time(self, parts):
        estimate, wider = widened(drifting(0.1 * NOISE), parts)
        half = wider.interval_factor * wider.std
        for k in (COULOMB[ELBOW], VISCOUS[ELBOW]):
            for level in (0.95, 1.0, 1.05):
                assert abs(estimate.values[k] - level * truth()[k]) <= half[k]
            assert half[k] < 0.075 * truth()[k]

    def test_it_adds_the_mean_square_error_over_time(self):
        """Of the estimate, which noise hardly moves, against the parameters at all times."""
        estimate, wider = widened(drifting(0.01 * NOISE))
        added = np.sqrt(np.diag(wider.covariance - estimate.covariance))
        own = np.zeros(P)
        elbow = [COULOMB[ELBOW], VISCOUS[ELBOW]]
        own[elbow] = truth()[elbow]
        levels = np.linspace(0.05, -0.05, 1001)[:, None]
        errors = estimate.values - (truth() + levels * own)
        expected = np.sqrt(np.mean(errors**2, axis=0))
        np.testing.assert_allclose(added[elbow], expected[elbow], rtol=0.02)
        others = np.flatnonzero(expected > estimate.std)
        assert len(others) > len(elbow)
        np.testing.assert_allclose(added[others], expected[others], rtol=0.2)

    def test_steady_friction_changes_nothing(self):
        estimate, wider = widened(recorded())
        assert wider is estimate

    def test_it_needs_some_time(self):
        estimate, wider = widened(drifting().between(0, 100))
        assert wider is estimate


class TestVerdict:
    @staticmethod
    def uncertainty(probability, share):
        terms = (QUADRATIC, replace(STRIBECK, speed=0.1))
        shifts = np.zeros((4, 2, len(FORMS)))
        return FormUncertainty(np.array([0.0, probability]), terms, shifts, np.array([0.0, share]))

    def test_an_uncertain_law_is_a_reservation(self):
        verdict = judged(form=self.uncertainty(0.999, 0.2))
        assert verdict.good
        assert "well, but the friction law of two is uncertain: " in verdict.line
        finding = found(form=self.uncertainty(0.999, 0.2))["friction law lacks a term"]
        assert (finding.level, finding.joints) == ("doubtful", (1,))
        assert finding.each == {"term": ("Stribeck (0.1 rad/s)",), "friction": (0.2,)}

    def test_nor_is_one_whose_friction_changed(self):
        verdict = judged(friction_change=np.array([0.0, 0.1]))
        assert verdict.good
        assert "well, but friction of two changed: " in verdict.line

    @pytest.mark.parametrize(("probability", "share"), [(0.9, 0.2), (0.999, 0.01)])
    def test_neither_chance_nor_a_trifle_counts(self, probability, share):
        """A term that is not certain, or changes friction by less than temperature does."""
        finding = found(form=self.uncertainty(probability, share))["complete friction law"]
        assert finding.level == "good"
        assert "well: " in judged(form=self.uncertainty(probability, share)).line

    def test_without_a_test_nothing_is_said(self):
        assert not {"complete friction law", "friction law lacks a term"} & found().keys()
