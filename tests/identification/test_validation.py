"""Prediction errors, intervals of held-out torque, patterns of residuals, signs, consistency."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.signal import lfilter

from identification.arrays import Array
from identification.estimators.covariance import with_block_covariance
from identification.estimators.least_squares import estimate_repetitions
from identification.estimators.prior import NOMINAL_STD_SHARE
from identification.factor.estimate import Estimate, estimate, joint_weights
from identification.factor.estimation_method import EstimationMethod
from identification.factor.factor import Factor, total_factor
from identification.factor.normal_equations import solve
from identification.hypotheses.explanation import Explanation
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.unseen_changes import UnseenChange, beyond_constants, find_changes
from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.mass_matrix import mass_matrices
from identification.model.robot import RobotModel
from identification.selection.folds import FOLDS
from identification.signals.block_mean import block_mean
from identification.signals.masks import RowMask, RowReason
from identification.signals.position_steps import position_jumps, position_steps
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.validation.calibration import TorqueMeans, calibrate, inner_errors
from identification.validation.consistency import ImpossibleParameter, check_consistency
from identification.validation.controller_inertia import inertia_ratio
from identification.validation.evidence import repetition_noise
from identification.validation.finding_messages import consistency_words
from identification.validation.nominal_friction import with_fitted_friction
from identification.validation.nominal_scale import nominal_scale
from identification.validation.physical_signs import Implausible, implausibilities
from identification.validation.prediction import (
    PredictionError,
    noise_floor,
    pooled_error,
    prediction_error,
    slow_error,
)
from identification.validation.residuals import (
    autocorrelation,
    check_residuals,
    find_outliers,
    folded_noise,
)
from identification.validation.ripple import HARMONICS
from tests.hil.identified_arm import a_motion as sines
from tests.hil.identified_arm import packaged_urdf
from tests.identification.evidence import an_error, found, judged
from tests.identification.three_sines import ARM_NOISE, three_sines
from tests.identification.two_link import (
    MODEL,
    NOISE,
    URDF,
    a_motion,
    as_samples,
    coloured,
    four_sines,
    gaussian,
    one_sine,
    recording,
    simulated,
    sine_motion,
    truth,
    values_of,
)

torques = arrays(np.float64, (20, 2), elements=st.floats(-100, 100, width=32))


def samples_with(error, *, origin=0.0, time=None, rows=slice(None)):
    """Return rows of a motion with the torque of unit parameters plus an error (m, 2)."""
    time = (np.arange(len(error)) * 2e-3 if time is None else time)[rows]
    motion = replace(one_sine(time), time=time + origin)
    torque = MODEL.torque(np.ones(MODEL.n_parameters), motion) + error[rows]
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
        of_measured = PredictionError.between(measured, predicted, usable)
        of_spoilt = PredictionError.between(spoilt, predicted, usable)
        np.testing.assert_array_equal(of_measured.squared, of_spoilt.squared)
        np.testing.assert_array_equal(of_measured.torque_squared, of_spoilt.torque_squared)
        assert (of_measured.rows == usable.sum(axis=0)).all()

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
        stuck = replace(samples, torque=torque)
        (error,) = prediction_error(MODEL, values, [stuck])
        assert error.overall < 1e-12
        (error,) = prediction_error(MODEL, values, [stuck], all_rows=True)
        assert error.overall > 0.05

    def test_friction_change_is_separated(self):
        """Measured without limit, compensated up to a tenth."""
        values = np.ones(MODEL.n_parameters)
        motion = samples_with(np.zeros((5000, 2))).motion
        friction = MODEL.torque(np.where(MODEL.friction_columns, values, 0.0), motion)
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
        rng = np.random.default_rng(2)
        sizes = np.array([1.0, 2.0])
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


def split(error):
    """Fit the beginning of a motion, hold out the rest."""
    samples = recording(error, MOTION)
    parts = samples.between(0, CUT), samples.between(CUT, LENGTH)
    result = estimate_repetitions(MODEL, parts[:1])
    means = [TorqueMeans.of(MODEL, [part]) for part in parts]
    return calibrate(result.pooled, result.factor, means[0], means[1], least_squares)


def shares(correlation, model_error=0.0, seeds=50):
    """Return share inside, with white residuals, and half width over noise."""
    systematic = model_error * NOISE * np.sin(6.0 * MOTION.position)
    figures = []
    for seed in range(seeds):
        noise = coloured(np.random.default_rng(seed), LENGTH, 5e-3, correlation)
        calibration = split(noise + systematic)
        figures.append(
            (
                calibration.inside,
                calibration.white_inside,
                float(np.mean(calibration.half_width / NOISE)),
            )
        )
    return tuple(np.mean(figures, axis=0).tolist())


@pytest.mark.long
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
        fitted_run = recording(noise, MOTION).between(0, CUT)
        held_out_means = TorqueMeans.of(MODEL, [recording(noise, MOTION).between(CUT, LENGTH)])
        widths = []
        for runs in ([fitted_run], [fitted_run] * 4):
            result = estimate_repetitions(MODEL, runs)
            calibration = calibrate(
                result.pooled,
                result.factor,
                TorqueMeans.of(MODEL, runs),
                held_out_means,
                least_squares,
            )
            widths.append(calibration.half_width)
        # Up to the degrees of freedom of the joints' weights.
        np.testing.assert_allclose(widths[1], widths[0], rtol=MODEL.n_parameters / CUT)


class TestHeldOutTorque:
    def test_it_does_not_change_the_intervals(self):
        noise = coloured(np.random.default_rng(2), LENGTH, 5e-3, 0.05)
        spoiled = noise.copy()
        spoiled[CUT:] += 20.0 * NOISE
        sound = split(noise)
        off = split(spoiled)
        np.testing.assert_array_equal(off.half_width, sound.half_width)
        assert off.inside == 0.0 < 0.8 < sound.inside


class TestInnerFolds:
    def test_each_fold_is_predicted_from_the_others(self):
        """Equal to leaving out the first fold by hand."""
        noise = coloured(np.random.default_rng(4), LENGTH, 5e-3, 0.05)
        samples = replace(recording(noise, MOTION), usable=np.ones((LENGTH, 2), dtype=np.bool_))
        phase = Factor.by_time(MODEL, samples)
        means = TorqueMeans.of(MODEL, [samples])
        errors = inner_errors(phase, means, least_squares)
        first = LENGTH // FOLDS
        other_folds = least_squares(Factor.of(MODEL, samples.between(first, LENGTH)))
        left = samples.torque[:first] - samples.predicted_torque(MODEL, other_folds)[:first]
        means = left.reshape(-1, 100, 2).mean(axis=1)  # of half a second
        np.testing.assert_allclose(errors[: len(means)], means, atol=1e-8)


class TestTorqueMeans:
    def test_edges_are_excluded_and_rest_included(self):
        """Motion or torque are unknown at edges."""
        ends, slow = np.zeros((2, LENGTH, 2), dtype=np.bool_)
        ends[:20] = True
        slow[40:60] = True
        reasons = {
            RowReason.EDGE: ends,
            RowReason.SATURATED: np.zeros_like(ends),
            RowReason.UNMEASURED: np.zeros_like(ends),
            RowReason.STANDSTILL: slow,
        }
        mask = RowMask(reasons, (LENGTH, 2), ~(ends | slow))
        error = np.where(ends, 1e3, np.where(slow, 1.0, 0.0))
        samples = replace(recording(error, MOTION), usable=mask.usable, mask=mask)
        means = TorqueMeans.of(MODEL, [samples])
        np.testing.assert_array_equal(means.count[:2], [[80, 80], [100, 100]])
        np.testing.assert_allclose(means.errors(truth())[:2], [[0.25] * 2, [0.0] * 2], atol=1e-9)


STEP = 4e-3
VALUES = values_of(MODEL, [4.0, 2.0, 1.5, 0.8])
GEAR = np.diag([100.0, -80.0])
RESIDUAL_NOISE = 0.5
MEMORY = 0.05  # s, of the noise


def unit_noise(rng, shape, memory=MEMORY):
    """Return first-order noise of unit variance, correlated over `memory` seconds."""
    decay = np.exp(-STEP / memory)
    white = np.sqrt(1.0 - decay**2) * rng.standard_normal(shape)
    return np.asarray(lfilter([1.0], [1.0, -decay], white, axis=0))


def a_run(seed, disturbance=None, *, duration=12.0, noise=RESIDUAL_NOISE):
    time = np.arange(round(duration / STEP)) * STEP
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.3, 0.9, (3, 2))
    rate = rng.uniform(0.7, 3.0, (3, 2))
    motion = sine_motion(time, amplitude, rate, rng.uniform(0.0, 6.0, (3, 2)))
    torque = MODEL.torque(VALUES, motion)
    torque = torque + noise * unit_noise(rng, torque.shape)
    if disturbance is not None:
        torque = torque + disturbance(motion, seed)
    return as_samples(MODEL, motion, torque)


def patterns_of(disturbance=None, *, first_seed=0, noise=RESIDUAL_NOISE):
    runs = [a_run(first_seed + k, disturbance, noise=noise) for k in range(6)]
    return check_residuals(MODEL, VALUES, runs[:5], runs[5:], motor_from_joint=GEAR)


class TestCorrelation:
    @pytest.mark.parametrize("memory", [0.01, 0.05])
    def test_its_time_is_that_of_theory(self, memory):
        rng = np.random.default_rng(2)
        residual = unit_noise(rng, (200_000, 2), memory)
        correlation = autocorrelation([(residual, np.ones(residual.shape, dtype=bool))], STEP)
        decay = np.exp(-STEP / memory)
        expected = 0.5 * STEP * (1.0 + decay) / (1.0 - decay)
        np.testing.assert_allclose(correlation.time, expected, rtol=0.15)
        # White noise: half a step, all samples independent.
        rows = 0.5 * STEP * len(residual) / expected
        np.testing.assert_allclose(correlation.effective_rows, rows, rtol=0.15)

    @given(st.integers(20, 60), st.integers(0, 2**32 - 1), st.integers(1, 3))
    @settings(max_examples=25, deadline=None)
    def test_it_is_that_of_counting_pairs(self, rows, seed, runs):
        rng = np.random.default_rng(seed)
        parts = [(rng.standard_normal((rows, 1)), rng.random((rows, 1)) > 0.3) for _ in range(runs)]
        correlation = autocorrelation(parts, STEP, longest=10 * STEP)
        masked = [np.where(usable, left, np.nan)[:, 0] for left, usable in parts]
        products = [
            np.concatenate(
                [run_residual[: rows - lag] * run_residual[lag:] for run_residual in masked]
            )
            for lag in range(11)
        ]
        expected = [
            np.nansum(pair_products) / max(1, np.isfinite(pair_products).sum())
            for pair_products in products
        ]
        if expected[0] > 0.0:
            np.testing.assert_allclose(
                correlation.correlation[:, 0], np.array(expected) / expected[0], atol=1e-9
            )

    def test_block_means_cover_unlike_independent_samples(self):
        blocks = 60
        per_block = 125
        seeds = 400
        inside = 0
        naive = 0
        for seed in range(seeds):
            noise = unit_noise(np.random.default_rng(seed), (blocks * per_block,))
            sums = noise.reshape(blocks, per_block).sum(axis=1, keepdims=True)
            block_average = block_mean([np.array([sums, np.full((blocks, 1), float(per_block))])])
            inside += abs(block_average.mean[0]) < 1.96 * block_average.std[0]
            naive += abs(noise.mean()) < 1.96 * noise.std() / np.sqrt(len(noise))
        assert 0.90 < inside / seeds < 0.98
        assert naive / seeds < 0.6


class TestFoldedNoise:
    BANDWIDTH = 10.0  # Hz

    def measured(self, noise, *, every=1, values=None):
        """Return what is folded in each `every`-th of 1 kHz rows; model error is below 1 Hz."""
        time = np.arange(0.0, 20.0, 1e-3)
        rows = slice(None, None, every)
        error = noise * np.random.default_rng(1).standard_normal((len(time), 2))
        error += np.sin(5.0 * time)[:, None]
        return folded_noise(
            MODEL, np.ones(MODEL.n_parameters), [samples_with(error, time=time, rows=rows)],
            self.BANDWIDTH,
        )  # fmt: skip

    def test_it_grows_with_the_step(self):
        """Of 50 Hz two fifths are below 10 Hz, of 1 kHz a fiftieth."""
        fast = self.measured(2.0)
        slow = self.measured(2.0, every=20)
        assert slow.share == pytest.approx(4.0 * 0.4 / (4.0 * 0.4 + 0.5), abs=0.1)
        assert fast.share == pytest.approx(4.0 * 0.02 / (4.0 * 0.02 + 0.5), abs=0.05)

    def test_an_error_of_the_model_has_none(self):
        assert self.measured(0.0, every=20).share < 0.01

    def test_half_a_rate_below_an_octave_shows_none(self):
        assert self.measured(2.0, every=60).share == 0.0


class TestResidualChecks:
    @pytest.mark.long
    def test_coloured_noise_is_not_reported(self):
        alarms = np.zeros(4)
        campaigns = 25
        for campaign in range(campaigns):
            checks = patterns_of(first_seed=100 * campaign)
            assert checks.drift is not None
            for k, check in enumerate((checks.speed, checks.position, checks.ripple, checks.drift)):
                alarms[k] += np.count_nonzero(check.significant)
        # 50 joints at 0.001 each: two findings have a probability of 0.1 %.
        assert (alarms <= 1).all(), alarms

    def test_wrong_friction_shows_over_speed(self):
        def stribeck(motion, _):
            extra = 1.0 * np.sign(motion.velocity) * np.exp(-((motion.velocity / 0.5) ** 2))
            return np.asarray(extra * np.array([0.0, 1.0]))

        checks = patterns_of(stribeck)
        assert checks.speed.significant.tolist() == [False, True]
        at, size = checks.speed.worst(1)
        assert abs(at) < 0.6 and np.sign(size) == np.sign(at)

    def test_a_position_dependent_torque_shows_over_position(self):
        checks = patterns_of(lambda motion, _: 0.6 * np.cos(3.0 * motion.position) * [1.0, 0.0])
        assert checks.position.significant.tolist() == [True, False]
        # RMS of the true wave, within binning and noise.
        assert checks.position.rms[0] == pytest.approx(0.6 / np.sqrt(2.0), rel=0.25)

    @pytest.mark.parametrize("harmonic", HARMONICS)
    def test_ripple_is_found_with_its_harmonic_and_size(self, harmonic):
        planted = np.array([0.0, 0.4])

        def ripple(motion, _):
            return np.asarray(planted * np.sin(harmonic * motion.position @ GEAR.T + 0.7))

        detected = patterns_of(ripple).ripple
        assert detected.significant.tolist() == [False, True]
        assert detected.periods[1] == harmonic
        assert detected.rms[1] == pytest.approx(0.4 / np.sqrt(2.0), abs=0.05)

    def test_friction_drift_is_measured(self):
        friction = np.where(MODEL.friction_columns, VALUES, 0.0)

        def cooling(motion, seed):
            # Five fitted recordings: from +4 % to -4 % of the second joint's friction.
            change = 0.04 - 0.02 * seed
            return np.asarray(change * MODEL.torque(friction, motion) * np.array([0.0, 1.0]))

        drift = patterns_of(cooling, noise=0.1).drift
        assert drift is not None and len(drift.share) == 15
        assert drift.significant.tolist() == [False, True]
        assert drift.change[1] == pytest.approx(-0.08, abs=4.0 * drift.change_std[1])
        assert drift.change_std[1] < 0.02

    def test_drift_is_measured_within_one_recording(self):
        checks = check_residuals(MODEL, VALUES, [a_run(1, duration=30.0)])
        assert checks.drift is not None and len(checks.drift.share) >= 4
        assert checks.ripple.turn == "joint"  # without gear ratios

    @pytest.mark.parametrize("of_positions", [False, True])
    def test_a_jump_is_of_the_torque_or_of_the_positions(self, of_positions):
        """The measured torque jumps, or the one that was predicted by the positions."""
        time = np.linspace(0.0, 20.0, 2000)
        predicted, jumps = 10.0 * np.sin(time)[:, None], np.zeros((2000, 1))
        jumps[100::400] = 5.0
        noise = 0.1 * np.random.default_rng(7).standard_normal(jumps.shape)
        measured = predicted + noise + (0.0 if of_positions else jumps)
        residual = measured - predicted - (jumps if of_positions else 0.0)
        outliers = find_outliers(measured, residual, np.ones(jumps.shape, dtype=np.bool_))
        assert outliers.share == pytest.approx(5 / 2000)
        assert outliers.of_positions.tolist() == [of_positions]

    def test_outliers_are_found_and_removed(self):
        random = np.random.default_rng(5)
        torque, residual = 10.0 * random.standard_normal((2, 5000, 2))
        residual *= 0.01
        hit = random.permutation(5000)[:25]
        residual[hit, 1] += 20.0
        usable = np.ones((5000, 2), dtype=np.bool_)
        usable[hit[:5], 1] = False  # unusable rows are no outliers
        outliers = find_outliers(torque, residual, usable)
        np.testing.assert_allclose(outliers.share, [0.0, 20 / 4995])
        assert outliers.power[0] == 0.0 and outliers.power[1] > 0.9
        np.testing.assert_allclose(outliers.without.rms, [0.1, 0.1], rtol=0.05)
        assert outliers.without.rows.tolist() == [5000, 4975]
        noise = np.random.default_rng(6).standard_normal((20000, 3)) * [1e-6, 1.0, 1e6]
        outliers = find_outliers(noise, noise, np.ones(noise.shape, dtype=np.bool_))
        np.testing.assert_array_equal(outliers.share, 0.0)


def parameters(model=MODEL, **changes):
    """Parameters of the URDF with rotors and friction, and with changes by name."""
    standard = dict(zip(model.layout.names, model.nominal, strict=True))
    standard |= {"I1m": 0.4, "I2m": 0.1}
    names = model.parameter_names[model.base.rank :]
    friction = dict(zip(names, [4, 2, 1.5, 0.8, 1.0, 1.0], strict=False))
    for name, value in changes.items():
        (friction if name in friction else standard)[name] = value
    return np.concatenate([model.base.grouping @ list(standard.values()), list(friction.values())])


def known(values, model=MODEL, std=0.01):
    """Estimate with a relative standard deviation."""
    return Estimate(
        names=model.parameter_names, units=model.units, values=values,
        covariance=np.diag((std * np.maximum(np.abs(values), 0.1)) ** 2), noise_std=np.ones(2),
        samples=np.full(2, 1000), method=EstimationMethod(), condition=10.0,
    )  # fmt: skip


def with_value(name, value, std=0.01):
    """Estimate of the arm with another value of one parameter."""
    values = parameters()
    values[MODEL.parameter_names.index(name)] = value
    return replace(known(parameters(), std=std), values=values)


def signs(estimated, model=MODEL, *, error=0.1):
    motion = one_sine(np.arange(2000) * 2e-3)
    return implausibilities(
        model,
        estimated,
        Factor.from_samples(model, motion, np.zeros((2000, 2))),
        np.full(2, error),
        speed=np.abs(motion.velocity).max(axis=0),
    )


class TestSigns:
    @pytest.mark.parametrize(
        ("estimated", "kind", "name"),
        [
            (with_value("f0_1", -4.0), "negative Coulomb friction", "shoulder"),
            (with_value("f1_2", -1.0), "little friction at speed", "elbow"),
            (with_value("I2m", -0.1), "negative parameter", "I2m"),
        ],
    )
    def test_impossible_signs_are_named(self, estimated, kind, name):
        assert (kind, name) in {(sign.kind, sign.name) for sign in signs(estimated).impossible}

    def test_signs_within_the_uncertainty_are_possible(self):
        """So are undetermined parameters, and friction that falls from 2 to 1.3 N·m."""
        unknown = with_value("I2m", -0.1)
        index = unknown.names.index("I2m")
        covariance = unknown.covariance.copy()
        covariance[index, index] = np.inf
        assert signs(replace(unknown, covariance=covariance)) == Implausible((), ())
        assert signs(with_value("I2m", -0.1, std=1.0)) == Implausible((), ())
        assert signs(with_value("f1_2", -0.15)).impossible == ()
        assert signs(known(parameters())) == Implausible((), ())

    def test_signs_of_a_torque_below_the_error_are_doubtful(self):
        implausible = signs(with_value("I2m", -0.01), error=5.0)
        assert implausible.impossible == ()
        assert "I2m" in {sign.name for sign in implausible.doubtful}

    def test_a_term_that_nobody_stated_is_no_reason(self):
        """It follows friction within the fitted speeds; a stated one is."""
        model = RobotModel.from_urdf(URDF, friction=FrictionLaw(third="quadratic"))
        falling = known(parameters(model, f2_1=-3.0), model)
        motion = one_sine(np.arange(2000) * 2e-3)
        factor = Factor.from_samples(model, motion, np.zeros((2000, 2)))
        speed = np.abs(motion.velocity).max(axis=0)

        def with_added(*added):
            return implausibilities(
                model, falling, factor, np.full(2, 0.1), speed=speed, added=added
            )

        (stated,) = with_added().impossible
        assert stated.kind == "little friction at speed"
        assert with_added("f2").impossible == with_added("f2").doubtful == ()
        (chosen,) = with_added("f2").added
        assert chosen.kind == "little friction at speed by a chosen term"

    def test_negative_friction_of_a_coupled_motor_is_named(self):
        coupling = Coupling(np.array([[1.0, 0.0], [0.5, 1.0]]), inertia=False)
        coupled = RobotModel.from_urdf(URDF, friction=MODEL.friction.laws[0], coupling=coupling)
        arm = partial(parameters, coupled)
        (sign,) = signs(known(arm(f1_m2=-1.0), coupled), coupled).impossible
        assert (sign.name, sign.figures["value"]) == ("friction f1_m2 of motor 2", -1.0)
        assert signs(known(arm(), coupled), coupled) == Implausible((), ())


def runs(**changes):
    return [simulated(MODEL, parameters(**changes), three_sines(k), ARM_NOISE, k) for k in (1, 2)]


def consistency_of(recordings):
    training, unseen = (Factor.by_time(MODEL, run) for run in recordings)
    weights = joint_weights(training)
    free = with_block_covariance(estimate(MODEL, training, weights), training, weights)
    return check_consistency(MODEL, training, unseen, free, weights=weights)


class TestConsistencyCheck:
    """Rise of the held-out error by physical consistency, and the active bounds."""

    def test_consistent_data_cost_nothing(self):
        check = consistency_of(runs())
        assert abs(check.cost) < 0.001
        assert not check.costly and not check.impossible
        assert check.violations == () and np.all(check.margin > 0.1)
        assert not check.predicts_better

    def test_the_cost_is_the_rise_of_the_error(self):
        recordings = runs(I2m=-0.1)
        check = consistency_of(recordings)
        run = recordings[1]
        torque = np.where(run.usable, run.torque, 0.0)
        both = check.consistent.estimate.values, check.consistent.unconstrained.values
        errors = [
            torque - np.where(run.usable, MODEL.torque(values, run.motion), 0.0) for values in both
        ]
        ours, free = (np.linalg.norm(error) / np.linalg.norm(torque) for error in errors)
        assert check.cost == pytest.approx(ours - free, rel=1e-6)
        size = np.linalg.norm(torque, axis=0)
        ours, free = (np.linalg.norm(error, axis=0) / size for error in errors)
        np.testing.assert_allclose(check.held_out_rise, ours - free, rtol=1e-6)

    @pytest.mark.parametrize(
        ("change", "quantity", "joint"),
        [
            ({"I2m": -0.6}, "rotor inertia", "elbow"),
            ({"f0_2": -2.0}, "Coulomb friction", "elbow"),
            ({"f1_1": -1.5}, "viscous friction", "shoulder"),
        ],
    )
    def test_active_bounds_are_named_with_their_joint(self, change, quantity, joint):
        check = consistency_of(runs(**change))
        assert check.costly
        assert (quantity, joint) in [(each.quantity, each.joint) for each in check.violations]

    def test_a_torque_of_the_wrong_sign_is_impossible(self):
        check = consistency_of([replace(run, torque=run.torque * [-1.0, 1.0]) for run in runs()])
        assert check.impossible
        assert "shoulder" in {violation.joint for violation in check.violations}

    def test_a_spring_is_named_for_one_axis_that_gravity_loads(self):
        """Of 20 N·m/rad at the elbow."""
        sprung = [
            replace(run, torque=run.torque + [0.0, 20.0] * run.motion.position) for run in runs()
        ]
        check = consistency_of(sprung)
        assert check.impossible and check.overloaded == "elbow"
        finding = found(consistency=check)["no consistent parameters"]
        assert (finding.level, finding.remedy) == ("wrong", "describe a balancer")
        (reason,) = judged(consistency=check).reasons
        assert reason.startswith(consistency_words(check))
        assert "[[robot.elements]]" in reason and "elbow" in reason
        assert not consistency_of(runs()).is_balanced

    def test_a_negative_second_moment_is_an_active_bound(self):
        """That of the elbow's link about its own centre."""
        check = consistency_of(runs(I2yy=0.05, I2m=0.0))
        assert check.margin[1] < 0.01
        assert ImpossibleParameter("body", "elbow") in check.violations


def uneven(rate, *, jitter=0.0, seed=0):
    rng = np.random.default_rng(seed)
    time = np.cumsum((1.0 + jitter * rng.uniform(-1.0, 1.0, int(12 * rate))) / rate)
    q = np.column_stack([0.8 * np.sin(w * time + w) + 0.3 * np.sin(3.1 * w * time) for w in (2, 3)])
    q += 2e-5 * rng.standard_normal(q.shape)
    return Recording(time, q, ("hip", "knee"), torque=np.zeros_like(q))


def with_jump(recording, size, rows):
    position = recording.position.copy()
    position[rows, 1] += size
    return replace(recording, position=position)


def sudden_stop():
    """From 1 rad/s to rest within one sample."""
    time = np.arange(0.0, 8.0, 0.002)
    q = np.column_stack([np.minimum(time, 4.0), np.sin(time)])
    q += 1e-5 * np.random.default_rng(1).standard_normal(q.shape)
    return Recording(time, q, ("a", "b"), torque=np.zeros_like(q))


def jump_in_a_gap():
    jumping = with_jump(uneven(500.0), 0.3, slice(2500, None))
    return replace(jumping, gap_before=np.arange(len(jumping.time)) == 2500)


class TestPositionJumps:
    @pytest.mark.parametrize("rate", [100.0, 125.0, 500.0, 1000.0])
    @pytest.mark.parametrize("size", [0.2, 0.02, -0.02])
    def test_a_lasting_jump_is_found(self, rate, size):
        smooth = uneven(rate)
        at = int(5 * rate)
        (jump,) = position_jumps(with_jump(smooth, size, slice(at, None)), "log.mcap")
        assert (jump.recording, jump.joint) == ("log.mcap", "knee")
        assert jump.time == pytest.approx(smooth.time[at] - smooth.time[0])
        assert jump.size == pytest.approx(size, abs=2e-3)
        finding = found(jumps=(jump,))["position jumps"]
        assert (finding.level, finding.values["jumping"]) == ("wrong", ("knee",))

    @pytest.mark.parametrize("rate", [100.0, 500.0, 5000.0])
    @pytest.mark.parametrize("jitter", [0.0, 0.3])
    def test_motion_with_an_uneven_clock_has_no_jump(self, rate, jitter):
        assert position_jumps(uneven(rate, jitter=jitter, seed=3)) == []

    @pytest.mark.parametrize(
        "recording",
        [sudden_stop(), jump_in_a_gap(), with_jump(uneven(500.0), 0.2, slice(2500, 2501))],
        ids=["sudden stop", "gap", "glitch of one sample"],
    )
    def test_other_steps_are_no_jumps(self, recording):
        assert position_jumps(recording) == []


def frozen(recording, rows):
    """The knee's samples repeat the last one before the rows, which are measured again after."""
    position = recording.position.copy()
    position[rows, 1] = position[rows.start - 1, 1]
    return replace(recording, position=position)


def slipping(recording, rows):
    """The knee's samples are one older from each of the rows on: one repeats."""
    number = np.arange(len(recording.time))
    late = number - np.searchsorted(rows, number, side="right")
    return replace(
        recording, position=np.column_stack([recording.position[:, 0], recording.position[late, 1]])
    )


def without_rows(recording, rows, rate):
    """Rows are missing, and the stamps do not show it."""
    remaining = recording.rows(np.delete(np.arange(len(recording.time)), rows))
    return replace(remaining, time=np.arange(len(remaining.time)) / rate)


class TestStepsOfTheLog:
    """Steps that a logger makes are not those of an encoder."""

    @pytest.mark.parametrize(
        "recording",
        [
            frozen(uneven(1000.0), slice(5000, 5030)),
            slipping(uneven(1000.0), np.array([4000, 5200, 6100, 7003])),
            without_rows(uneven(1000.0), slice(5000, 5150), 1000.0),
        ],
        ids=["frozen samples", "repeated samples", "rows missing of all joints"],
    )
    def test_they_are_separate(self, recording):
        steps = position_steps(recording, "log.mcap")
        assert steps.logged and steps.jumps == ()

    def test_a_repetition_whose_row_is_lost_is_of_the_log(self):
        """The step across the gap is that of one row, not of two."""
        repeating = slipping(uneven(1000.0), np.arange(500, 11500, 500))
        lost = repeating.rows(np.delete(np.arange(len(repeating.time)), [6000, 8500]))
        assert position_steps(lost).jumps == ()

    def test_an_encoder_that_slips_while_frozen_has_jumped(self):
        stalled = frozen(uneven(1000.0), slice(5000, 5030))
        steps = position_steps(with_jump(stalled, 0.2, slice(5030, None)))
        assert [jump.joint for jump in steps.jumps] == ["knee"]


def arm_with(measured, seed=0, duration=20.0):
    """Samples of the planted arm with another torque (motion, torque) -> (m, 2), and noise."""
    motion = four_sines(np.arange(0.0, duration, 0.005), seed=seed)
    torque = MODEL.torque(truth(), motion)
    torque = measured(motion, torque) + gaussian(np.random.default_rng(seed), motion)
    return as_samples(MODEL, motion, torque)


def as_it_is(_, torque):
    return torque


EVERY = np.ones(MODEL.n_joints, dtype=bool)


def with_friction(factor):
    friction = np.where(MODEL.friction_columns, truth(), 0.0)

    def measured(motion, torque):
        return torque + (factor - 1.0) * MODEL.torque(friction, motion)

    return measured


def changes_between(fitted, unseen, moved=EVERY):
    training = [arm_with(fitted, 1)]
    held_out = [arm_with(unseen, 2)]
    estimate = estimate_repetitions(MODEL, training).pooled
    unseen = total_factor(MODEL, held_out)
    return find_changes(MODEL, estimate, training, held_out, unseen, moved)


class TestChangesToUnseenMotion:
    """What differs for a joint between fitted and unseen motion, with its factor."""

    def test_equal_motions_have_none(self):
        assert changes_between(as_it_is, as_it_is) == ()

    @pytest.mark.parametrize(
        ("fitted", "unseen", "ratio"),
        [([1.0, 1.3], [1.0, 1.0], 1 / 1.3), ([1.0, 1.0], [1.0, 1.3], 1.3)],
    )
    def test_the_torque_of_one_joint(self, fitted, unseen, ratio):
        (change,) = changes_between(
            lambda _, torque: fitted * torque, lambda _, torque: unseen * torque
        )
        assert (change.kind, change.joint) == ("gain", 1)
        assert change.ratio == pytest.approx(ratio, abs=0.02)

    @pytest.mark.parametrize(
        ("ratio", "size", "is_left"),
        [(1.03, 0.25, False), (0.97, 0.25, False), (0.8, 0.25, True), (1.3, 0.25, True)],
    )
    def test_a_constant_of_all_motions_is_no_change(self, ratio, size, is_left):
        """It leaves other motion an error of a part of it; one of the fitted motion, all of it."""
        change = UnseenChange("gain", 1, ratio, 0.001, 0.01)
        constant = Explanation(Change("scale", (1,)), 0.4, size)
        assert beyond_constants((change,), (constant,)) == ((change,) if is_left else ())
        of_other_joint = constant._replace(change=Change("scale", (0,)))
        assert beyond_constants((change,), (of_other_joint,)) == (change,)
        friction = change._replace(kind="friction")
        assert beyond_constants((friction,), (constant,)) == (friction,)

    def test_a_joint_that_stood_has_none(self):
        more = with_friction(np.array([1.0, 2.0]))
        assert changes_between(as_it_is, more, moved=np.array([True, False])) == ()

    @pytest.mark.parametrize("factor", [0.5, 2.0])
    def test_friction(self, factor):
        changes = changes_between(as_it_is, with_friction(np.array([1.0, factor])))
        assert [(change.kind, change.joint) for change in changes] == [("friction", 1)]
        assert changes[0].ratio == pytest.approx(factor, abs=0.05)

    def test_gain_and_friction_alike_within_the_usual_error(self):
        """Of a joint of little weight, with an error of the fit that hides which of them it is."""

        def waved(factor):
            def measured(motion, torque):
                wave = 0.4 * torque.std(axis=0) * np.sin(7.0 * motion.time)[:, None]
                return with_friction(np.array([1.0, factor]))(motion, torque) + wave * [0.0, 1.0]

            return measured

        (change,) = changes_between(waved(8.0), waved(9.6))
        assert (change.kind, change.joint, change.alike) == ("friction", 1, True)
        assert change.ratio == pytest.approx(1.2, abs=0.02)

    def test_a_torque_beside_an_error_of_the_fit(self):
        """The error on unseen motion is not twice that of the fitted one."""

        def waved(factor):
            def measured(motion, torque):
                wave = 0.1 * torque.std(axis=0) * np.sin(3.0 * motion.time)[:, None]
                return torque * [1.0, factor] + wave * [0.0, 1.0]

            return measured

        (change,) = changes_between(waved(0.9), waved(1.0))
        assert (change.kind, change.joint) == ("gain", 1)
        assert change.ratio == pytest.approx(1.0 / 0.9, abs=0.02)

    def test_a_torque_beside_an_error_of_unseen_motion(self):
        """What is left may be more than twice the error of a good fit."""

        def waved(motion, torque):
            wave = 0.05 * torque.std(axis=0) * np.sin(7.0 * motion.time)[:, None]
            return torque * [1.0, 1.1] + wave

        (change,) = changes_between(as_it_is, waved)
        assert (change.kind, change.joint) == ("gain", 1)
        assert change.ratio == pytest.approx(1.1, abs=0.02)

    def test_an_uncertain_friction_is_no_change(self):
        """What the fitted motion leaves open differs on unseen motion by no fault of it."""
        training = [arm_with(as_it_is, 1)]
        held_out = [arm_with(with_friction(np.array([1.0, 1.3])), 2)]
        estimate = estimate_repetitions(MODEL, training).pooled
        unseen = total_factor(MODEL, held_out)
        friction = np.diag(MODEL.friction_columns * (0.3 * estimate.values) ** 2)
        doubted = replace(estimate, covariance=estimate.covariance + friction)
        (change,) = find_changes(MODEL, estimate, training, held_out, unseen, EVERY)
        assert change.joint == 1
        assert find_changes(MODEL, doubted, training, held_out, unseen, EVERY) == ()

    def test_another_error_is_no_change(self):
        def waved(motion, torque):
            return torque + 3.0 * np.sin(40.0 * motion.time)[:, None]

        assert changes_between(as_it_is, waved) == ()

    def test_a_prediction_that_has_failed_is_no_change(self):
        """Without it the error is less, but not that of the fitted motion."""

        def other(motion, torque):
            wave = np.sin(40.0 * motion.time)[:, None]
            return 0.05 * torque + 0.3 * torque.std(axis=0) * wave

        assert changes_between(as_it_is, other) == ()

    def test_a_torque_of_the_other_sign_is_no_change(self):
        assert changes_between(as_it_is, lambda _, torque: torque * [1.0, -1.0]) == ()


LOADED_AXES = range(1, 4)  # of the UR5, whose rigid torque exceeds their friction


def findings(model, **context):
    """Findings that follow from this context."""
    error = an_error(0.05, joints=model.n_joints)
    usual = found(held_out=error, training=error)
    of_context = found(held_out=error, training=error, **context)
    return [finding for key, finding in of_context.items() if finding != usual.get(key)]


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(packaged_urdf("ur5_robot.urdf"), friction=FrictionLaw(offset=True))


def standard(model, wrong, seed):
    """Nominal parameters with every link off by its own share, and rotors."""
    values = model.nominal.copy()
    rng = np.random.default_rng(seed)
    for link in range(model.n_joints):
        rows = model.layout.links[link]
        values[rows] *= 1.0 + wrong * rng.uniform(-1.0, 1.0)
    values[model.layout.rotors] = 0.2
    return values


def runs_of(model, values, seed):
    friction = [{"f0": 3.0, "f1": 2.0, "fo": 0.2}.get(t.symbol, 0.3) for t in model.friction.terms]
    truth = np.concatenate([model.base.grouping @ values, friction])
    motions = [sines(model.n_joints, 10 * seed + number) for number in range(2)]
    noise = [0.02 * model.torque(truth, motion).std(axis=0) for motion in motions]
    return [
        simulated(model, truth, *motion_and_noise, seed)
        for motion_and_noise in zip(motions, noise, strict=True)
    ]


def nominal(model):
    return values_of(model, np.zeros(model.n_parameters - model.base.rank))


class TestNominalScale:
    @pytest.mark.parametrize("seed", range(10))
    def test_links_off_by_a_tenth_are_no_finding(self, model, seed):
        scale = nominal_scale(
            model,
            nominal(model),
            runs_of(model, standard(model, 0.1, seed), seed),
            share=NOMINAL_STD_SHARE,
        )
        assert np.isfinite(scale.scale[2])
        assert findings(model, nominal_scale=scale) == []

    @pytest.mark.parametrize("seed", range(10))
    def test_links_as_uncertain_as_a_makers_description_are_none(self, model, seed):
        """Masses and inertias of neighbouring links deviate by a quarter, in one direction."""
        heavier = standard(model, 0.1, seed) * np.where(seed % 2, 1.25, 0.75)
        scale = nominal_scale(model, nominal(model), runs_of(model, heavier, seed))
        assert np.isfinite(scale.scale[2])
        assert findings(model, nominal_scale=scale) == []

    @pytest.mark.parametrize("axis", LOADED_AXES)
    @pytest.mark.parametrize("factor", [0.6, 1.5])
    def test_a_wrong_torque_constant_is_a_finding(self, model, axis, factor):
        scaled = []
        for run in runs_of(model, standard(model, 0.05, axis), axis):
            torque = run.torque.copy()
            torque[:, axis] *= factor
            scaled.append(replace(run, torque=torque))
        scale = nominal_scale(model, nominal(model), scaled, share=NOMINAL_STD_SHARE)
        assert np.flatnonzero(scale.off).tolist() == [axis]
        assert scale.scale[axis] == pytest.approx(factor, rel=0.1)
        (finding,) = findings(model, nominal_scale=scale)
        assert (finding.key, finding.level) == ("scale of the torque", "doubtful")
        assert finding.joints == (axis,)

    @pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
    def test_only_torques_of_bodies_show_their_unit(self, model, factor):
        """Of a scale that is zero but for noise none is a thousandth."""
        runs = runs_of(model, standard(model, 0.05, 1), 1)
        in_unit = [replace(run, torque=factor * run.torque) for run in runs]
        scale = nominal_scale(model, nominal(model), in_unit)
        assert scale.nonzero[2]
        friction = runs_of(model, 0.0 * standard(model, 0.05, 1), 1)
        without = [replace(run, torque=factor * run.torque) for run in friction]
        assert not nominal_scale(model, nominal(model), without).nonzero[2]

    @pytest.mark.parametrize("factor", [0.01, 1000.0, -1.0])
    def test_torques_with_another_factor_are_wrong(self, model, factor):
        """Another unit, motor torques, or all of them negated; nothing is known without masses."""
        runs = runs_of(model, standard(model, 0.05, 1), 1)
        scaled = [replace(run, torque=factor * run.torque) for run in runs]
        (finding,) = findings(model, nominal_scale=nominal_scale(model, nominal(model), scaled))
        assert finding.level == "wrong"
        expected = "scale of the torque" if factor > 0.0 else "all torques opposite"
        assert finding.key == expected
        massless = nominal_scale(model, 0.0 * nominal(model), scaled)
        assert np.isnan(massless.scale).all() and findings(model, nominal_scale=massless) == []


@cache
def arm():
    """Model, parameters, postures, and the diagonal by pinocchio, rotors of 0.2 included."""
    urdf = packaged_urdf("ur5_robot.urdf")
    model = RobotModel.from_urdf(urdf)
    values = values_of(model, np.full(model.n_parameters - model.base.rank, 3.0), 0.2)
    position = np.random.default_rng(1).uniform(-2.0, 2.0, (20, 6))
    reference = pin.buildModelFromXML(urdf)
    data = reference.createData()
    diagonal = np.array([np.diag(pin.crba(reference, data, q)) for q in position]) + 0.2
    return model, values, position, diagonal


class TestInertia:
    def test_mass_matrices_are_those_of_pinocchio(self):
        model, values, position, diagonal = arm()
        matrices = mass_matrices(model, values, position)
        np.testing.assert_allclose(np.diagonal(matrices, axis1=1, axis2=2), diagonal, rtol=1e-9)

    def test_another_inertia_of_the_controller_is_a_finding(self):
        """A joint without one is not."""
        model, values, position, diagonal = arm()
        theirs = diagonal * np.array([1.0, 1.1, 0.9, 1.0, 0.0, 1.0 / 0.7])
        ratio = inertia_ratio(model, values, position, theirs)
        np.testing.assert_allclose(ratio.ratio, [1.0, 1.1, 0.9, 1.0, np.nan, 1.0 / 0.7], rtol=1e-9)
        np.testing.assert_allclose(ratio.spread[:4], 0.0, atol=1e-9)
        (finding,) = findings(model, controller_inertia=ratio)
        assert (finding.level, finding.joints) == ("doubtful", (5,))
        assert finding.each["ratio"] == pytest.approx((1.0 / 0.7,))
        assert inertia_ratio(model, values, position, 0.0 * diagonal) is None


def test_nominal_friction_stays_small_where_its_terms_are_one() -> None:
    """A joint at one speed tells Coulomb friction, viscous friction and offset not apart."""
    model = RobotModel.from_urdf(URDF, friction=FrictionLaw())
    motion = four_sines(np.arange(0.0, 4.0, 0.005))
    velocity = motion.velocity.copy()
    velocity[:, 1] = 0.5 + 1e-7 * np.sin(motion.time)
    motion = replace(motion, velocity=velocity)
    friction = values_of(model, [4.0, 2.0, 1.5, 0.8, 0.0, 0.0])
    noise = NOISE * np.random.default_rng(0).standard_normal(velocity.shape)
    samples = as_samples(model, motion, model.torque(friction, motion) + noise)
    nominal = values_of(model, np.zeros(6))
    fitted = with_fitted_friction(model, nominal, Factor.of(model, samples))
    faster = replace(motion, velocity=2.0 * velocity)
    fitted[~model.friction_columns] = 0.0
    friction[~model.friction_columns] = 0.0
    largest = np.abs(model.torque(friction, motion)[:, 1]).max()
    assert np.abs(model.torque(fitted, faster)[:, 1]).max() < 3.0 * largest


class TestNoiseFloor:
    """What no fault raises: 1.4 % of each torque."""

    NOISE = 0.014

    def floor(self, position: Array | float = 0.0, torque: Array | float = 0.0) -> Array:
        """The floor of an arm whose recorded position and torque have more in them (m, 2)."""
        motion = four_sines(np.arange(0.0, 12.0, 0.004), 0.5)
        clean = MODEL.torque(truth(), motion)
        noise = self.NOISE * clean.std(axis=0) * np.random.default_rng(0).normal(size=clean.shape)
        recording = Recording(
            motion.time, motion.position + position, MODEL.joint_names, clean + noise + torque
        )
        samples = prepare(recording, MODEL, options=Preprocessing(14.0))
        values = estimate(MODEL, Factor.of(MODEL, samples)).values
        floor = noise_floor(MODEL, values, [samples])
        assert floor is not None
        return np.asarray(floor / clean.std(axis=0))

    def test_it_is_that_of_the_noise(self) -> None:
        assert self.floor() == pytest.approx(self.NOISE, rel=0.1)

    def test_play_does_not_raise_it(self) -> None:
        """A fifth of a degree, taken up where the torque of the second joint reverses."""
        motion = four_sines(np.arange(0.0, 12.0, 0.004), 0.5)
        torque = MODEL.torque(truth(), motion)[:, 1]
        side = np.tanh(torque / (0.05 * torque.std()))
        play = np.radians(0.1) * side[:, None] * [0.0, 1.0]
        assert self.floor(position=play) == pytest.approx(self.NOISE, rel=0.15)

    def test_spikes_do_not_raise_it(self) -> None:
        random = np.random.default_rng(1)
        spikes = 50.0 * random.normal(size=(3000, 2)) * (random.random((3000, 2)) < 0.002)
        assert self.floor(torque=spikes) == pytest.approx(self.NOISE, rel=0.2)
