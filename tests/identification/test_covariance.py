from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from identification.covariance import (
    PhaseFactor,
    block_length,
    leverage_corrected,
    with_block_covariance,
)
from identification.estimation import estimate, joint_weights
from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.motion import Motion
from identification.preprocessing import Samples
from identification.repetitions import estimate_repetitions

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
NOISE = np.array([3.0, 0.2])


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))


@pytest.fixture(scope="module")
def truth(model: RobotModel) -> Array:
    standard = model.nominal.copy()
    standard[[10, 21]] = 0.4, 0.1  # rotors
    return np.concatenate([model.base.grouping @ standard, [4.0, 2.0, 1.5, 0.8]])


def a_motion(duration: float = 10.0, step: float = 5e-3) -> Motion:
    time = np.arange(0.0, duration, step)
    rng = np.random.default_rng(12)
    a, w, phase = rng.uniform([[[0.2]], [[2.0]], [[0.0]]], [[[0.5]], [[9.0]], [[6.0]]], (3, 4, 2))
    angle = w * time[:, None, None] + phase
    return Motion(
        time,
        (a * np.sin(angle)).sum(axis=1),
        (a * w * np.cos(angle)).sum(axis=1),
        (-a * w**2 * np.sin(angle)).sum(axis=1),
    )


def samples_with(model: RobotModel, truth: Array, error: Array, motion: Motion) -> Samples:
    return Samples(
        motion=motion,
        torque=model.torque(truth, *motion[1:]) + error,
        usable=model.moving(motion.velocity),
        segments=(slice(0, len(motion.time)),),
        origin=float(motion.time[0]),
        position_bandwidth=np.full(2, np.inf),
    )


def coloured(rng: np.random.Generator, length: int, step: float, correlation: float) -> Array:
    """First-order noise of standard deviation NOISE, correlated over a time [s]; 0 for white."""
    r = np.exp(-step / correlation) if correlation else 0.0
    start = rng.standard_normal((1, 2)) * r
    white = np.sqrt(1.0 - r**2) * rng.standard_normal((length, 2))
    return NOISE * lfilter([1.0], [1.0, -r], white, axis=0, zi=start)[0]


@pytest.mark.parametrize("correlation", [0.0, 0.02, 0.05, 0.1])
def test_95_percent_intervals_cover_90_to_99_percent_whatever_the_colour_of_the_noise(
    model: RobotModel, truth: Array, correlation: float
) -> None:
    motion = a_motion()
    honest, classical = [], []
    for seed in range(120):
        noise = coloured(np.random.default_rng(seed), len(motion.time), 5e-3, correlation)
        result = estimate_repetitions(model, [samples_with(model, truth, noise, motion)])
        error = np.abs(result.pooled.values - truth)
        honest.append(error < result.pooled.interval_factor * result.pooled.std)
        classical.append(error < 1.96 * result.classical_std)
    assert 0.90 <= np.mean(honest) <= 0.99
    if correlation >= 0.02:
        assert np.mean(classical) < 0.75


def test_an_error_that_repeats_in_every_repetition_is_not_averaged_away(
    model: RobotModel, truth: Array
) -> None:
    motion = a_motion()
    rng = np.random.default_rng(3)
    repeated = coloured(rng, len(motion.time), 5e-3, 0.05)
    runs = [
        samples_with(
            model, truth, repeated + 0.1 * NOISE * rng.standard_normal(repeated.shape), motion
        )
        for _ in range(16)
    ]
    one, many = estimate_repetitions(model, runs[:1]), estimate_repetitions(model, runs)
    # Sixteen repetitions of the same error say as much as one ...
    np.testing.assert_allclose(many.pooled.std, one.pooled.std, rtol=0.35)
    # ... which neither the scatter over repetitions nor their independence would tell.
    assert np.median(many.scatter_std / many.pooled.std) < 0.1
    assert np.median(many.independent_std / many.pooled.std) < 0.35
    error = np.abs(many.pooled.values - truth)
    assert np.mean(error < many.pooled.interval_factor * many.pooled.std) > 0.85


def test_independent_noise_averages_over_repetitions(model: RobotModel, truth: Array) -> None:
    motion = a_motion()
    rng = np.random.default_rng(4)
    runs = [
        samples_with(model, truth, coloured(rng, len(motion.time), 5e-3, 0.02), motion)
        for _ in range(16)
    ]
    result = estimate_repetitions(model, runs)
    # All three honest routes agree when repetitions really are independent.
    assert np.median(result.scatter_std / result.pooled.std) == pytest.approx(1.0, abs=0.35)
    assert np.median(result.independent_std / result.pooled.std) == pytest.approx(1.0, abs=0.35)
    assert np.median(result.classical_std / result.pooled.std) < 0.75


def test_leverage_correction_is_leaving_out_one_block(model: RobotModel, truth: Array) -> None:
    # CR3: the corrected score is what the estimate moves by, times A, when a block goes.
    motion = a_motion(4.0)
    noise = coloured(np.random.default_rng(9), len(motion.time), 5e-3, 0.02)
    phase = PhaseFactor.from_samples(model, samples_with(model, truth, noise, motion))
    weights = 1.0 / NOISE**2
    weighted = np.tensordot(weights, phase.gram, axes=(0, 1))
    np.testing.assert_allclose(phase.weighted(weights), weighted, rtol=1e-12)
    a_blocks, b_blocks = weighted[:, :-1, :-1], weighted[:, :-1, -1]
    a, b = a_blocks.sum(axis=0), b_blocks.sum(axis=0)
    values, inverse = np.linalg.solve(a, b), np.linalg.inv(a)
    corrected = leverage_corrected(a_blocks, b_blocks - a_blocks @ values, inverse)
    for block in (0, 7, 20):
        without = np.linalg.solve(a - a_blocks[block], b - b_blocks[block])
        np.testing.assert_allclose(inverse @ corrected[block], values - without, atol=1e-9)


def test_blocks_grow_with_the_correlation_of_the_scores() -> None:
    rng = np.random.default_rng(5)
    white = rng.standard_normal((400, 30))
    slow = lfilter([1.0], [1.0, -0.8], white, axis=0)
    assert block_length(white) == 2
    assert 4 <= block_length(slow) <= 20
    assert block_length(white[:25]) == 1  # never so long that hardly any block is left


def test_the_factor_of_all_blocks_is_the_factor_of_the_samples(
    model: RobotModel, truth: Array
) -> None:
    motion = a_motion(4.0)
    samples = samples_with(model, truth, np.zeros((len(motion.time), 2)), motion)
    whole, blocks = samples.factor(model), PhaseFactor.from_samples(model, samples).total
    np.testing.assert_allclose(blocks.gram, whole.gram, rtol=1e-10, atol=1e-8)
    np.testing.assert_array_equal(blocks.samples, whole.samples)


def test_repetitions_are_added_at_equal_times_of_the_motion(
    model: RobotModel, truth: Array
) -> None:
    motion = a_motion(4.0)
    error = np.zeros((len(motion.time), 2))
    early = samples_with(model, truth, error, motion)
    # The same motion in a recording whose clock stands elsewhere.
    late = Samples(
        motion=motion._replace(time=motion.time + 7.3),
        torque=early.torque,
        usable=early.usable,
        segments=early.segments,
        origin=early.origin + 7.3,
        position_bandwidth=early.position_bandwidth,
    )
    one, two = (PhaseFactor.from_samples(model, samples) for samples in (early, late))
    np.testing.assert_allclose((one + two).gram, 2.0 * one.gram, rtol=1e-9, atol=1e-8)


def test_the_method_says_what_was_done(model: RobotModel, truth: Array) -> None:
    motion = a_motion()
    noise = coloured(np.random.default_rng(0), len(motion.time), 5e-3, 0.0)
    phase = PhaseFactor.from_samples(model, samples_with(model, truth, noise, motion))
    weights = joint_weights(phase.total)
    result = with_block_covariance(estimate(model, phase.total, weights), phase, weights)
    assert "40 blocks of 0.25 s" in result.method
    assert result.interval_factor == pytest.approx(2.02, abs=0.01)  # Student's t, 39
