"""Checks of the residual find injected patterns, and none in coloured noise."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from identification import Thresholds
from identification.validation.residuals import (
    FEWEST_BLOCKS,
    HARMONICS,
    BlockMean,
    FrictionDrift,
    Ripple,
    autocorrelation,
    block_mean,
    check_residuals,
    find_outliers,
)
from tests.identification.test_verdict import finding_of, judged
from tests.identification.two_link import MODEL, as_samples, sine_motion, values_of

STEP = 4e-3
VALUES = values_of(MODEL, [4.0, 2.0, 1.5, 0.8])
GEAR = np.diag([100.0, -80.0])
NOISE = 0.5
MEMORY = 0.05  # s, of the coloured noise


def coloured(rng, shape, memory=MEMORY):
    """Return first-order noise of unit variance, correlated over `memory` seconds."""
    decay = np.exp(-STEP / memory)
    white = np.sqrt(1.0 - decay**2) * rng.standard_normal(shape)
    return np.asarray(lfilter([1.0], [1.0, -decay], white, axis=0))


def a_run(seed, disturbance=None, *, duration=12.0, noise=NOISE):
    time = np.arange(round(duration / STEP)) * STEP
    rng = np.random.default_rng(seed)
    amplitude, rate = rng.uniform(0.3, 0.9, (3, 2)), rng.uniform(0.7, 3.0, (3, 2))
    motion = sine_motion(time, amplitude, rate, rng.uniform(0.0, 6.0, (3, 2)))
    torque = MODEL.torque(VALUES, *motion[1:])
    torque = torque + noise * coloured(rng, torque.shape)
    if disturbance is not None:
        torque = torque + disturbance(motion, seed)
    return as_samples(MODEL, motion, torque)


def checked(disturbance=None, *, first_seed=0, noise=NOISE):
    runs = [a_run(first_seed + k, disturbance, noise=noise) for k in range(6)]
    return check_residuals(MODEL, VALUES, runs[:5], runs[5:], motor_from_joint=GEAR)


class TestCorrelation:
    @pytest.mark.parametrize("memory", [0.01, 0.05])
    def test_its_time_is_that_of_theory(self, memory):
        rng = np.random.default_rng(2)
        residual = coloured(rng, (200_000, 2), memory)
        found = autocorrelation([(residual, np.ones(residual.shape, dtype=bool))], STEP)
        decay = np.exp(-STEP / memory)
        expected = 0.5 * STEP * (1.0 + decay) / (1.0 - decay)
        np.testing.assert_allclose(found.time, expected, rtol=0.15)
        # White noise: half a step, all samples independent.
        rows = 0.5 * STEP * len(residual) / expected
        np.testing.assert_allclose(found.effective_rows, rows, rtol=0.15)

    @given(st.integers(20, 60), st.integers(0, 2**32 - 1), st.integers(1, 3))
    @settings(max_examples=25, deadline=None)
    def test_it_is_that_of_counting_pairs(self, rows, seed, runs):
        rng = np.random.default_rng(seed)
        parts = [(rng.standard_normal((rows, 1)), rng.random((rows, 1)) > 0.3) for _ in range(runs)]
        found = autocorrelation(parts, STEP, longest=10 * STEP)
        masked = [np.where(usable, left, np.nan)[:, 0] for left, usable in parts]
        products = [
            np.concatenate([one[: rows - lag] * one[lag:] for one in masked]) for lag in range(11)
        ]
        expected = [np.nansum(one) / max(1, np.isfinite(one).sum()) for one in products]
        if expected[0] > 0.0:
            np.testing.assert_allclose(
                found.correlation[:, 0], np.array(expected) / expected[0], atol=1e-9
            )

    def test_block_means_cover_unlike_independent_samples(self):
        blocks, per_block, seeds = 60, 125, 400
        inside, naive = 0, 0
        for seed in range(seeds):
            noise = coloured(np.random.default_rng(seed), (blocks * per_block,))
            sums = noise.reshape(blocks, per_block).sum(axis=1, keepdims=True)
            found = block_mean([np.array([sums, np.full((blocks, 1), float(per_block))])])
            inside += abs(found.mean[0]) < 1.96 * found.std[0]
            naive += abs(noise.mean()) < 1.96 * noise.std() / np.sqrt(len(noise))
        assert 0.90 < inside / seeds < 0.98
        assert naive / seeds < 0.6

    def test_repeated_errors_are_not_more_certain(self):
        rng = np.random.default_rng(3)
        motion = np.array([rng.standard_normal((40, 1)), np.ones((40, 1))])
        once, thrice = block_mean([motion]), block_mean([motion] * 3, repeated=3)
        other = block_mean([motion] * 3)
        assert thrice.mean[0] == pytest.approx(once.mean[0])
        assert thrice.std[0] == pytest.approx(once.std[0])
        assert other.std[0] == pytest.approx(once.std[0] / np.sqrt(3.0), rel=0.02)
        assert np.isnan(block_mean([np.ones((2, FEWEST_BLOCKS - 1, 1))]).mean).all()


class TestResidualChecks:
    def test_coloured_noise_is_not_reported(self):
        alarms = np.zeros(4)
        campaigns = 25
        for campaign in range(campaigns):
            checks = checked(first_seed=100 * campaign)
            assert checks.ripple is not None and checks.drift is not None
            for k, check in enumerate((checks.speed, checks.position, checks.ripple, checks.drift)):
                alarms[k] += np.count_nonzero(check.significant)
        # 50 joints at 0.001 each: two findings have a probability of 0.1 %.
        assert (alarms <= 1).all(), alarms

    def test_wrong_friction_shows_over_speed(self):
        def stribeck(motion, _):
            extra = 1.0 * np.sign(motion.velocity) * np.exp(-((motion.velocity / 0.5) ** 2))
            return np.asarray(extra * np.array([0.0, 1.0]))

        checks = checked(stribeck)
        assert checks.speed.significant.tolist() == [False, True]
        at, size = checks.speed.worst(1)
        assert abs(at) < 0.6 and np.sign(size) == np.sign(at)

    def test_a_position_dependent_torque_shows_over_position(self):
        checks = checked(lambda motion, _: 0.6 * np.cos(3.0 * motion.position) * [1.0, 0.0])
        assert checks.position.significant.tolist() == [True, False]
        # RMS of the true wave, within binning and noise.
        assert checks.position.rms[0] == pytest.approx(0.6 / np.sqrt(2.0), rel=0.25)

    @pytest.mark.parametrize("harmonic", HARMONICS)
    def test_ripple_is_found_with_its_harmonic_and_amplitude(self, harmonic):
        planted = np.array([0.0, 0.4])

        def ripple(motion, _):
            return np.asarray(planted * np.sin(harmonic * motion.position @ GEAR.T + 0.7))

        found = checked(ripple).ripple
        assert found.significant.tolist() == [False, True]
        assert found.strongest(1) == harmonic
        amplitude = found.amplitude[1, HARMONICS.index(harmonic)]
        assert amplitude == pytest.approx(0.4, abs=0.05)
        assert found.rms[1] == pytest.approx(0.4 / np.sqrt(2.0), abs=0.05)

    def test_friction_drift_is_measured(self):
        friction = np.where(MODEL.friction_columns, VALUES, 0.0)

        def cooling(motion, seed):
            # Five fitted recordings: from +4 % to -4 % of the second joint's friction.
            change = 0.04 - 0.02 * seed
            return np.asarray(change * MODEL.torque(friction, *motion[1:]) * np.array([0.0, 1.0]))

        drift = checked(cooling, noise=0.1).drift
        assert drift is not None and len(drift.share) == 15
        assert drift.significant.tolist() == [False, True]
        assert drift.change[1] == pytest.approx(-0.08, abs=4.0 * drift.change_std[1])
        assert drift.change_std[1] < 0.02

    def test_drift_is_measured_within_one_recording(self):
        found = check_residuals(MODEL, VALUES, [a_run(1, duration=30.0)])
        assert found.drift is not None and len(found.drift.share) >= 4
        assert found.ripple is None  # without gear ratios

    def test_outliers_are_found_and_removed(self):
        random = np.random.default_rng(5)
        torque, residual = 10.0 * random.standard_normal((2, 5000, 2))
        residual *= 0.01
        hit = random.permutation(5000)[:25]
        residual[hit, 1] += 20.0
        usable = np.ones((5000, 2), dtype=np.bool_)
        usable[hit[:5], 1] = False  # unusable rows are no outliers
        found = find_outliers(torque, residual, usable)
        np.testing.assert_allclose(found.share, [0.0, 20 / 4995])
        assert found.power[0] == 0.0 and found.power[1] > 0.9
        np.testing.assert_allclose(found.without.rms, [0.1, 0.1], rtol=0.05)
        assert found.without.rows.tolist() == [5000, 4975]
        noise = np.random.default_rng(6).standard_normal((20000, 3)) * [1e-6, 1.0, 1e6]
        found = find_outliers(noise, noise, np.ones(noise.shape, dtype=np.bool_))
        np.testing.assert_array_equal(found.share, 0.0)


NAMES = ("shoulder", "elbow")
LIMIT = Thresholds()


def ripple(size):
    mean = np.zeros((2, len(HARMONICS), 2))
    mean[1, HARMONICS.index(4), 0] = np.sqrt(2.0) * size
    std = np.full_like(mean, 1e-6)
    return Ripple(BlockMean(mean, std, np.full(2, 1000.0), np.full(2, 50)))


def drift(*change):
    """Return a drift over ten parts with small scatter."""
    total = np.array(change)
    return FrictionDrift(np.linspace(0.0, 1.0, 10)[:, None] * total, total, np.full(2, 1e-4), 8)


@pytest.fixture(scope="module")
def valid():
    return replace(checked(), ripple=None, drift=None, rms=np.full(2, 0.01))


class TestPatterns:
    """Findings of a verdict on patterns."""

    def found(self, valid, check, **changes):
        return finding_of(check, NAMES, residuals=replace(valid, **changes))

    def test_untested_patterns_have_no_finding(self, valid):
        checks = {one.check for one in judged(NAMES, residuals=valid).findings}
        assert "whiteness" in checks and not {"torque ripple", "friction over time"} & checks

    @pytest.mark.parametrize(
        ("share", "level"),
        [(0.0, "good"), (0.9 * LIMIT.ripple, "information"), (1.1 * LIMIT.ripple, "doubtful")],
    )
    def test_large_ripple_is_doubtful(self, valid, share, level):
        found = self.found(valid, "torque ripple", ripple=ripple(share * valid.torque_rms[1]))
        assert found.level == level and "shoulder" not in found.words
        expected = f"elbow (4 per motor turn, {share:.1%} of its torque)"
        assert (expected in found.words) == (level != "good")

    @pytest.mark.parametrize(
        ("change", "share", "level", "words"),
        [
            ((1e-5, -1e-5), 1.0, "good", "did not change"),
            ((0.02, 0.0), 1.0, "information", "shoulder by +2.0%, at most 2.0% of an axis"),
            ((0.1, 0.0), 0.2, "information", "at most 2.0%"),
            ((0.02, -0.2), 1.0, "doubtful", "during the recordings: elbow by -20.0%"),
        ],
    )
    def test_drift_is_judged_by_its_torque(self, valid, change, share, level, words):
        friction = np.array([share, 1.0])
        found = self.found(
            valid, "friction over time", drift=drift(*change), friction_share=friction
        )
        assert found.level == level and words in found.words
        assert (found.role == "cause") == (level == "doubtful")
