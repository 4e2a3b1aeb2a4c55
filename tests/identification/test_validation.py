"""Prediction errors, and coverage of intervals of held-out torque."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from identification import (
    Factor,
    IdentificationError,
    PredictionError,
    Samples,
    estimate_repetitions,
    prediction_error,
)
from identification.factor.factor import joint_weights, solve
from identification.signals.masks import EDGE, SATURATED, STANDSTILL, RowMask
from identification.validation.calibration import TorqueMeans, calibrate, inner_errors
from identification.validation.evidence import repetition_noise
from identification.validation.prediction import pooled_error, slow_error
from tests.identification.two_link import (
    MODEL,
    NOISE,
    a_motion,
    as_samples,
    coloured,
    one_sine,
    recording,
    truth,
)

torques = arrays(np.float64, (20, 2), elements=st.floats(-100, 100, width=32))


def samples_with(error, *, origin=0.0):
    """Return a motion with the torque of unit parameters plus an error (m, 2)."""
    time = np.arange(len(error)) * 2e-3
    motion = one_sine(time)._replace(time=time + origin)
    torque = MODEL.torque(np.ones(MODEL.n_parameters), *motion[1:]) + error
    return as_samples(MODEL, motion, torque, origin=origin)


class TestPredictionError:
    def test_its_measures_are_correct(self):
        measured = np.array([[3.0, 1.0], [-4.0, 2.0]])
        error = PredictionError.between(measured, np.array([[2.0, 1.0], [-2.0, 2.0]]))
        np.testing.assert_allclose(error.mean_absolute, [1.5, 0.0])
        np.testing.assert_allclose(error.mean, [-0.5, 0.0])
        np.testing.assert_allclose(error.rms, [np.sqrt(2.5), 0.0])
        np.testing.assert_allclose(error.relative, [np.sqrt(5.0) / 5.0, 0.0])
        assert error.overall == pytest.approx(np.sqrt(5.0 / 30.0))

    @given(torques, torques, arrays(np.bool_, (20, 2)))
    def test_unusable_rows_have_no_effect(self, measured, predicted, usable):
        spoilt = np.where(usable, measured, np.nan)
        one = PredictionError.between(measured, predicted, usable)
        two = PredictionError.between(spoilt, predicted, usable)
        np.testing.assert_array_equal(one.squared, two.squared)
        np.testing.assert_array_equal(one.torque_squared, two.torque_squared)
        assert (one.rows == usable.sum(axis=0)).all()

    @given(torques, torques, torques, torques)
    def test_errors_of_two_recordings_add(self, m1, p1, m2, p2):
        both = pooled_error([PredictionError.between(m1, p1), PredictionError.between(m2, p2)])
        joined = PredictionError.between(np.concatenate([m1, m2]), np.concatenate([p1, p2]))
        np.testing.assert_allclose(both.rms, joined.rms, rtol=1e-12)
        assert both.overall == pytest.approx(joined.overall, rel=1e-12, nan_ok=True)

    def test_it_is_of_usable_or_all_rows(self):
        values = np.ones(MODEL.n_parameters)
        samples = samples_with(np.zeros((2000, 2)))
        torque = samples.torque.copy()
        torque[~samples.usable] += 50.0  # stiction
        stuck = Samples(**{**samples.__dict__, "torque": torque})
        (error,) = prediction_error(MODEL, values, [stuck])
        assert error.overall < 1e-12
        (error,) = prediction_error(MODEL, values, [stuck], all_rows=True)
        assert error.overall > 0.05

    def test_friction_change_is_separated(self):
        """Measured without limit, compensated up to a tenth."""
        values = np.ones(MODEL.n_parameters)
        motion = samples_with(np.zeros((5000, 2))).motion
        friction = MODEL.torque(np.where(MODEL.friction_columns, values, 0.0), *motion[1:])
        other = 0.2 * np.sin(2.0 * np.pi * 1.3 * motion.time)[:, None] * np.array([1.0, 0.0])
        warm = samples_with(np.array([0.05, -0.08]) * friction + other)
        left, change, apart = slow_error(MODEL, values, warm, 10.0)
        np.testing.assert_allclose(change, [0.05, -0.08], atol=0.01)
        np.testing.assert_allclose(left.rms, [0.2 / np.sqrt(2.0), 0.0], atol=0.01)
        np.testing.assert_allclose(apart.rms, left.rms)
        left, change, apart = slow_error(MODEL, values, samples_with(0.5 * friction), 10.0)
        np.testing.assert_allclose(change, 0.5, atol=0.01)
        assert (left.rms > 0.3 * np.std(friction, axis=0)).all()
        assert (apart.rms < 0.05 * np.std(friction, axis=0)).all()

    def test_noise_is_measured_between_repetitions(self):
        """With different clock offsets."""
        rng, sizes = np.random.default_rng(2), np.array([1.0, 2.0])
        common = np.array([0.5, 0.4]) * rng.standard_normal((3000, 2))
        values = np.ones(MODEL.n_parameters)
        runs = [
            samples_with(common + sizes * rng.standard_normal((3000, 2)), origin=k)
            for k in range(12)
        ]
        np.testing.assert_allclose(repetition_noise(MODEL, values, runs), sizes, rtol=0.05)
        later = replace(runs[1], origin=runs[1].origin - 1e3)  # no time in common
        assert np.isnan(repetition_noise(MODEL, values, [runs[0], later])).all()

    def test_a_joint_without_torque_has_no_relative_error(self):
        measured = np.column_stack([np.ones(5), np.zeros(5)])
        error = PredictionError.between(measured, measured + 0.1)
        np.testing.assert_allclose(error.relative, [0.1, np.nan])
        assert error.overall == pytest.approx(np.sqrt(2.0) * 0.1)
        nothing = PredictionError.between(measured, measured, np.zeros((5, 2), dtype=np.bool_))
        assert np.isnan([nothing.overall, *nothing.relative]).all()


MOTION = a_motion(20.0)
LENGTH = len(MOTION.time)
CUT = 2800  # of 4000 rows: what is fitted


def least_squares(factor):
    return solve(factor.weighted(joint_weights(factor))).values


def calibrated(fitted, held_out):
    result = estimate_repetitions(MODEL, [fitted])
    means = [TorqueMeans.of(MODEL, [one]) for one in (fitted, held_out)]
    return calibrate(result.pooled, result.factor, means[0], means[1], least_squares)


def split(error):
    """Fit the beginning of a motion, hold out the rest."""
    samples = recording(error, MOTION)
    return calibrated(samples.between(0, CUT), samples.between(CUT, LENGTH))


def shares(correlation, model_error=0.0, seeds=50):
    """Return share inside, with white residuals, and half width over noise."""
    systematic = model_error * NOISE * np.sin(6.0 * MOTION.position)
    found = []
    for seed in range(seeds):
        noise = coloured(np.random.default_rng(seed), LENGTH, 5e-3, correlation)
        one = split(noise + systematic)
        found.append((one.overall, one.white_overall, float(np.mean(one.half_width / NOISE))))
    return tuple(np.mean(found, axis=0).tolist())


class TestIntervals:
    """Held-out mean torques are inside their 95 % intervals."""

    @pytest.mark.parametrize("correlation", [0.0, 0.02, 0.05, 0.1, 0.2])
    def test_they_cover_for_white_and_coloured_noise(self, correlation):
        """93 to 98 % inside; intervals of white residuals fail for coloured noise."""
        inside, white, _ = shares(correlation)
        assert 0.93 <= inside <= 0.98
        assert (white < 0.7) == (correlation > 0.0)

    def test_they_cover_with_a_model_error(self):
        """Unmodelled torque as large as the noise: 93 to 98 % inside."""
        _, _, without = shares(0.02)
        inside, white, half_width = shares(0.02, model_error=1.0)
        assert 0.93 <= inside <= 0.98
        assert half_width > 1.3 * without
        assert white < 0.7

    def test_repeated_errors_do_not_shrink_them(self):
        """An error equal in all repetitions counts once."""
        noise = coloured(np.random.default_rng(1), LENGTH, 5e-3, 0.05)
        one = recording(noise, MOTION).between(0, CUT)
        rest = TorqueMeans.of(MODEL, [recording(noise, MOTION).between(CUT, LENGTH)])
        widths = []
        for runs in ([one], [one] * 4):
            result = estimate_repetitions(MODEL, runs)
            found = calibrate(
                result.pooled, result.factor, TorqueMeans.of(MODEL, runs), rest, least_squares
            )
            widths.append(found.half_width)
        np.testing.assert_allclose(widths[1], widths[0], rtol=1e-6)


class TestHeldOutTorque:
    def test_it_does_not_change_the_intervals(self):
        noise = coloured(np.random.default_rng(2), LENGTH, 5e-3, 0.05)
        spoiled = noise.copy()
        spoiled[CUT:] += 20.0 * NOISE
        sound, off = split(noise), split(spoiled)
        np.testing.assert_array_equal(off.half_width, sound.half_width)
        assert off.overall == 0.0 < 0.8 < sound.overall


class TestInnerFolds:
    def test_each_fold_is_predicted_from_the_others(self):
        """Equal to leaving out the first fold by hand."""
        noise = coloured(np.random.default_rng(4), LENGTH, 5e-3, 0.05)
        samples = replace(recording(noise, MOTION), usable=np.ones((LENGTH, 2), dtype=np.bool_))
        phase, means = Factor.by_time(MODEL, samples), TorqueMeans.of(MODEL, [samples])
        errors = inner_errors(phase, means, least_squares)
        rest = least_squares(Factor.of(MODEL, samples.between(800, LENGTH)))
        left = samples.torque[:800] - samples.predicted_torque(MODEL, rest)[:800]
        np.testing.assert_allclose(errors[:8], left.reshape(8, 100, 2).mean(axis=1), atol=1e-8)

    def test_two_seconds_are_too_short(self):
        samples = recording(np.zeros((LENGTH, 2)), MOTION)
        with pytest.raises(IdentificationError, match="too short"):
            calibrated(samples.between(0, 400), samples.between(CUT, LENGTH))


class TestTorqueMeans:
    def test_edges_are_excluded_and_rest_included(self):
        """Motion or torque are unknown at edges."""
        ends, slow = np.zeros((2, LENGTH, 2), dtype=np.bool_)
        ends[:20], slow[40:60] = True, True
        reasons = {EDGE: ends, SATURATED: np.zeros_like(ends), STANDSTILL: slow}
        mask = RowMask(reasons, (LENGTH, 2), ~(ends | slow))
        error = np.where(ends, 1e3, np.where(slow, 1.0, 0.0))
        samples = replace(recording(error, MOTION), usable=mask.usable, mask=mask)
        means = TorqueMeans.of(MODEL, [samples])
        np.testing.assert_array_equal(means.count[:2], [[80, 80], [100, 100]])
        np.testing.assert_allclose(means.errors(truth())[:2], [[0.25] * 2, [0.0] * 2], atol=1e-9)
