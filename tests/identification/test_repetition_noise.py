from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.signals.noise import repetition_noise, standstill_variance
from identification.signals.recording import Recording

Array = NDArray[np.float64]
STEP = 1e-3
POSITION_NOISE = np.array([2e-5, 5e-5])
TORQUE_NOISE = np.array([3.0, 0.5])


def repetition(
    seed: int, *, start: float = 0.0, drift: float = 0.0, gap: int | None = None
) -> Recording:
    """Half a second of rest, then the motion; what is commanded says when."""
    rng = np.random.default_rng(seed)
    time = start + np.arange(5000) * STEP
    since = np.maximum(np.arange(5000) * STEP - 0.5, 0.0)[:, None]
    command = np.sin(np.array([3.0, 5.0]) * since)
    torque = 40.0 * np.cos(np.array([3.0, 5.0]) * since) * (1.0 + drift)
    flags = None
    if gap is not None:
        flags = np.zeros(5000, dtype=np.bool_)
        flags[gap] = True
    return Recording(
        time=time,
        position=command + POSITION_NOISE * rng.standard_normal(command.shape),
        joint_names=("a", "b"),
        torque=torque + TORQUE_NOISE * rng.standard_normal(command.shape),
        commanded_position=command,
        gap_before=flags,
    )


def within(variance: Array, expected: Array, freedom: float) -> bool:
    """Whether a chi-squared estimate lies within four of its standard deviations."""
    return bool(np.all(np.abs(variance / expected - 1.0) < 4.0 * np.sqrt(2.0 / freedom)))


@pytest.mark.parametrize("count", [2, 5])
def test_the_planted_noise_is_found_under_motion(count: int) -> None:
    noise = repetition_noise([repetition(seed, start=7.0 * seed) for seed in range(count)])
    freedom = 4500.0 * (count - 1)
    assert noise.torque is not None
    # differences of neighbours hold fewer degrees of freedom
    assert within(noise.position, POSITION_NOISE**2, freedom / 3.0)
    assert within(noise.torque, TORQUE_NOISE**2, freedom / 3.0)


def test_noise_that_standstill_does_not_show_is_found() -> None:
    """A reading of coarse resolution says nothing at rest, and everything in motion."""
    resolution = 1e-3

    def read(seed: int) -> Recording:
        one = repetition(seed)
        shifted = one.position + 1e-5 * np.random.default_rng(seed).standard_normal()
        return Recording(
            time=one.time,
            position=np.round(shifted / resolution) * resolution,
            joint_names=one.joint_names,
            commanded_position=one.commanded_position,
        )

    moving = repetition_noise([read(1), read(2)])
    resting = standstill_variance(STEP * np.arange(400), read(1).position[:400])
    assert np.all(resting == 0.0)
    assert np.all(moving.position > 1e-3 * resolution**2)


def test_friction_that_drifts_is_no_white_noise() -> None:
    noise = repetition_noise([repetition(1), repetition(2, drift=0.1)])
    assert noise.torque is not None
    assert within(noise.torque, TORQUE_NOISE**2, 1500.0)


def test_repetitions_are_aligned_where_their_motion_begins() -> None:
    late = repetition(2, start=3.0).between(200, 5000)
    noise = repetition_noise([repetition(1), late])
    assert within(noise.position, POSITION_NOISE**2, 1500.0)


def test_a_gap_in_one_of_them_is_not_bridged() -> None:
    noise = repetition_noise([repetition(1), repetition(2, gap=2000)])
    assert within(noise.position, POSITION_NOISE**2, 1500.0)


def test_what_are_no_repetitions_is_refused() -> None:
    one = repetition(1)
    with pytest.raises(IdentificationError, match="takes two"):
        repetition_noise([one])
    other = Recording(one.time, one.position, ("a", "c"))
    with pytest.raises(IdentificationError, match="no repetitions"):
        repetition_noise([one, other])
    slower = Recording(2.0 * one.time, one.position, ("a", "b"))
    with pytest.raises(IdentificationError, match="no repetitions"):
        repetition_noise([one, slower])
    with pytest.raises(IdentificationError, match="in common"):
        repetition_noise([one.between(0, 2000), one.between(4950, 5000)])
