"""A growing oscillation in a following error is named with joint, frequency and growth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.campaign.oscillation import growing_oscillation

PERIOD = 0.002
RESOLUTION = np.full(2, 1e-6)


def following_error(*, growing: float, noise: float = 1e-6) -> NDArray[np.float64]:
    """Four seconds of two joints; the second oscillates at 110 Hz, growing by `growing` per s."""
    time = np.arange(0.0, 4.0, PERIOD)
    slow = 1e-3 * np.sin(2.0 * np.pi * 0.8 * time)
    error = np.stack([slow, slow], axis=1)
    error += noise * np.random.default_rng(1).standard_normal(error.shape)
    error[:, 1] += 1e-5 * np.exp(growing * time) * np.sin(2.0 * np.pi * 110.0 * time)
    return error


def test_it_is_named() -> None:
    oscillation = growing_oscillation(following_error(growing=1.5), PERIOD, RESOLUTION)
    assert oscillation is not None
    assert oscillation.joint == 1
    assert oscillation.frequency == pytest.approx(110.0, abs=5.0)
    assert oscillation.growth > 100.0


@pytest.mark.parametrize(
    "error", [{"growing": 0.0}, {"growing": -1.0}, {"growing": 0.0, "noise": 1e-3}]
)
def test_what_does_not_grow_is_none(error: dict[str, float]) -> None:
    assert growing_oscillation(following_error(**error), PERIOD, RESOLUTION) is None


def test_a_short_motion_is_not_judged() -> None:
    assert growing_oscillation(following_error(growing=1.5)[:100], PERIOD, RESOLUTION) is None


@pytest.mark.parametrize(("frequency", "rate"), [(26.0, 15.0), (65.0, 30.0)])
def test_one_that_ends_a_motion_in_tenths_of_a_second_is_named(
    frequency: float, rate: float
) -> None:
    time = np.arange(0.0, 0.3, PERIOD)
    error = 1e-6 * np.random.default_rng(1).standard_normal((len(time), 1)) + 1e-2 * time[:, None]
    error[:, 0] += 1e-5 * np.exp(rate * time) * np.sin(2.0 * np.pi * frequency * time)
    oscillation = growing_oscillation(error, PERIOD, RESOLUTION)
    assert oscillation is not None
    assert oscillation.frequency == pytest.approx(frequency, rel=0.1)
    assert oscillation.seconds <= 0.3


@pytest.mark.parametrize("frequency", [3.0, 15.0])
def test_what_grows_slowly_where_a_motion_begins_is_none(frequency: float) -> None:
    time = np.arange(0.0, 2.0, PERIOD)
    slow = 1e-6 * np.exp(5.0 * time) * np.sin(2.0 * np.pi * frequency * time)
    assert growing_oscillation(slow[:, np.newaxis], PERIOD, RESOLUTION) is None
