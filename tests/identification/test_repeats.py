"""Repetitions are recognised from positions, whatever their clocks say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.signals.recording import Recording, offsets_of_repetitions

STEP = 2e-3


def recorded(
    seed: int, *, start: float = 0.0, clock: float = 0.0, pace: float = 1.0, noise: int = 0
) -> Recording:
    """Eight seconds of a motion from `start` on, by a clock that is fast by `clock` [s]."""
    rng = np.random.default_rng(seed)
    amplitude, rate = rng.uniform(0.2, 1.0, (3, 2)), rng.uniform(0.5, 3.0, (3, 2))
    time = start + STEP * np.arange(4000)
    angle = pace * rate * time[:, None, None] + rng.uniform(0.0, 6.0, (3, 2))
    position = (amplitude * np.sin(angle)).sum(axis=1)
    position += 1e-4 * np.random.default_rng(noise).standard_normal(position.shape)
    return Recording(time=time + clock, position=position, joint_names=("a", "b"))


class TestRepetitions:
    """One motion, several times."""

    @settings(max_examples=20, deadline=None)
    @given(
        seed=st.integers(0, 50),
        clock=st.floats(-1e3, 1e3),
        start=st.floats(-0.4, 0.4).map(lambda one: round(one / STEP) * STEP),
    )
    def test_offsets_of_clocks_are_found(self, seed: int, clock: float, start: float) -> None:
        runs = [recorded(seed), recorded(seed, start=start, clock=clock, noise=1)]
        offsets = offsets_of_repetitions(runs)
        assert offsets is not None
        np.testing.assert_allclose(offsets, [0.0, clock], atol=2e-3)

    @pytest.mark.parametrize("seed", range(5))
    def test_other_motions_are_none(self, seed: int) -> None:
        assert offsets_of_repetitions([recorded(seed), recorded(seed + 100)]) is None

    def test_another_speed_is_another_motion(self) -> None:
        assert offsets_of_repetitions([recorded(1), recorded(1, pace=1.05)]) is None

    def test_half_of_a_motion_is_no_repetition(self) -> None:
        assert offsets_of_repetitions([recorded(1), recorded(1, start=4.0)]) is None

    def test_one_of_three_that_differs_makes_none(self) -> None:
        runs = [recorded(1), recorded(1, noise=1), recorded(2)]
        assert offsets_of_repetitions(runs) is None

    def test_a_single_recording_repeats_nothing(self) -> None:
        assert offsets_of_repetitions([recorded(1)]) is None
