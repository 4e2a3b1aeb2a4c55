from dataclasses import replace

import numpy as np
import pytest

from identification.estimators.covariance import (
    cluster_covariance,
    leverage_corrected,
    spread,
    with_block_covariance,
)
from identification.estimators.least_squares import estimate_repetitions
from identification.factor.factor import Factor, NormalEquations, estimate, joint_weights, solve
from tests.identification.two_link import MODEL, NOISE, a_motion, coloured, recording, truth


class TestRepeatedRecordings:
    def test_a_repeated_error_is_not_averaged(self):
        motion = a_motion()
        rng = np.random.default_rng(3)
        repeated = coloured(rng, len(motion.time), 5e-3, 0.05)
        runs = [
            recording(repeated + 0.1 * NOISE * rng.standard_normal(repeated.shape), motion)
            for _ in range(16)
        ]
        one, many = estimate_repetitions(MODEL, runs[:1]), estimate_repetitions(MODEL, runs)
        # Sixteen repetitions of one error count as one, unlike their scatter.
        np.testing.assert_allclose(many.pooled.std, one.pooled.std, rtol=0.35)
        assert np.median(many.std / 4.0 / many.pooled.std) < 0.1
        error = np.abs(many.pooled.values - truth())
        assert np.mean(error < many.pooled.interval_factor * many.pooled.std) > 0.85

    def test_independent_noise_averages(self):
        motion = a_motion()
        rng = np.random.default_rng(4)
        runs = [recording(coloured(rng, len(motion.time), 5e-3, 0.02), motion) for _ in range(16)]
        result = estimate_repetitions(MODEL, runs)
        # Both estimates agree for independent repetitions.
        assert np.median(result.std / 4.0 / result.pooled.std) == pytest.approx(1.0, abs=0.35)
        assert np.median(result.classical_std / result.pooled.std) < 0.75

    def test_they_are_added_at_equal_times_of_the_motion(self):
        """The same motion with another clock."""
        motion = a_motion(4.0)
        early = recording(np.zeros((len(motion.time), 2)), motion)
        late = replace(
            early,
            motion=motion._replace(time=motion.time + 7.3),
            origin=early.origin + 7.3,
        )
        one, two = (Factor.by_time(MODEL, samples) for samples in (early, late))
        for both, own in zip((one + two).gram, one.gram, strict=True):
            np.testing.assert_allclose(both, 2.0 * own, rtol=1e-9, atol=1e-8)


class TestBlocks:
    @pytest.mark.parametrize("correlation", [0.0, 0.02, 0.05, 0.1])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        motion = a_motion()
        honest, classical = [], []
        for seed in range(120):
            noise = coloured(np.random.default_rng(seed), len(motion.time), 5e-3, correlation)
            result = estimate_repetitions(MODEL, [recording(noise, motion)])
            error = np.abs(result.pooled.values - truth())
            honest.append(error < result.pooled.interval_factor * result.pooled.std)
            classical.append(error < 1.96 * result.classical_std)
        assert 0.90 <= np.mean(honest) <= 0.99
        if correlation >= 0.02:
            assert np.mean(classical) < 0.75

    def test_leverage_correction_is_leaving_out_one_block(self):
        # CR3: corrected score is A times the change without the block.
        motion = a_motion(4.0)
        noise = coloured(np.random.default_rng(9), len(motion.time), 5e-3, 0.02)
        phase = Factor.by_time(MODEL, recording(noise, motion))
        weights = 1.0 / NOISE**2
        weighted = phase.by_block(weights)
        a_blocks, b_blocks = weighted[:, :-1, :-1], weighted[:, :-1, -1]
        a, b = a_blocks.sum(axis=0), b_blocks.sum(axis=0)
        values = np.linalg.solve(a, b)
        scores = b_blocks - a_blocks @ values
        np.testing.assert_allclose(phase.scores(weights, values), scores, atol=1e-8)
        without = np.linalg.solve(a - a_blocks, (b - b_blocks)[:, :, None])[:, :, 0]
        moved = values - without
        rows = spread(a_blocks, scores, solve(phase.weighted(weights)).root)
        np.testing.assert_allclose(rows.T @ rows, moved.T @ moved, rtol=1e-9)

    def test_variance_determined_by_few_blocks_is_correct(self):
        """The elbow moves for 0.2 s only, in two blocks with almost no residual."""
        motion = a_motion()
        at = np.clip((motion.time - 5.0) / 0.2, 0.0, 1.0)
        for array, own in zip(
            motion[1:4],
            (
                0.6 * (10 * at**3 - 15 * at**4 + 6 * at**5),
                3.0 * (30 * at**2 - 60 * at**3 + 30 * at**4),
                15.0 * (60 * at - 180 * at**2 + 120 * at**3),
            ),
            strict=True,
        ):
            array[:, 1] = own
        inside, alone, classical = [], [], []
        for seed in range(150):
            noise = coloured(np.random.default_rng(seed), len(motion.time), 5e-3, 0.05)
            result = estimate_repetitions(MODEL, [recording(noise, motion)])
            pooled = result.pooled
            assert not pooled.undetermined
            inside.append(np.abs(pooled.values - truth()) < pooled.interval_factor * pooled.std)
            alone.append(pooled.std)
            classical.append(result.classical_std)
        elbow = [MODEL.parameter_names.index(name) for name in ("f0_2", "f1_2", "I2m")]
        covered = np.mean(inside, axis=0)
        assert 0.90 <= covered.mean() <= 0.99
        assert covered[elbow].min() > 0.85
        assert np.all(np.median(np.array(alone) / classical, axis=0)[elbow] > 1.0)

    def test_a_direction_of_one_block_uses_other_blocks(self):
        rng = np.random.default_rng(0)
        blocks, k = 30, 3
        shares = np.zeros((blocks, k, k))
        shares[:, 0, 0] = shares[:, 1, 1] = 1.0 / blocks
        shares[4, 2, 2] = 1.0
        effect = 7.0
        scores = np.sqrt(effect / blocks) * rng.standard_normal((blocks, k))
        scores[:, 2] = 0.0  # exactly fitted
        rows = leverage_corrected(shares, scores)
        covariance = rows.T @ rows
        usual = leverage_corrected(shares[:, :2, :2], scores[:, :2])
        assert len(usual) == blocks
        np.testing.assert_allclose(covariance[:2, :2], usual.T @ usual)
        assert covariance[2, 2] == pytest.approx(np.diag(usual.T @ usual).mean(), rel=0.1)
        # At least the variance of white noise.
        quiet = leverage_corrected(shares, 1e-3 * scores)
        assert (quiet.T @ quiet)[2, 2] == pytest.approx(1.0)

    @pytest.mark.parametrize("shared", [0.0, 0.09])
    def test_correlation_of_neighbouring_blocks_counts(self, shared):
        """Mean of blocks that are correlated with the next one."""
        rng = np.random.default_rng(3)
        blocks, k = 300, 40
        weight = (1.0 - np.sqrt(1.0 - 4.0 * shared**2)) / (2.0 * shared) if shared else 0.0
        white = rng.standard_normal((blocks + 1, k)) / np.sqrt(blocks * (1.0 + weight**2))
        scores = white[1:] + weight * white[:-1]
        information = np.tile(np.eye(k) / blocks, (blocks, 1, 1))
        solution = solve(NormalEquations(np.eye(k), scores.sum(axis=0)))
        found = cluster_covariance(information, scores, solution)
        assert found.blocks == blocks // 2
        assert np.trace(found.covariance) / k == pytest.approx(1.0 + 2.0 * shared, rel=0.05)

    def test_the_interval_factor_is_of_the_number_of_blocks(self):
        motion = a_motion()
        noise = coloured(np.random.default_rng(0), len(motion.time), 5e-3, 0.0)
        phase = Factor.by_time(MODEL, recording(noise, motion))
        weights = joint_weights(phase)
        result = with_block_covariance(estimate(MODEL, phase, weights), phase, weights)
        assert "40 blocks of 0.25 s" in result.method
        assert result.interval_factor == pytest.approx(2.02, abs=0.01)  # Student's t, 39
