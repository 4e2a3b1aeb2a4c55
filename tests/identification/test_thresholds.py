"""Thresholds of contacts keep the rate that they promise, and say how far the motion reaches."""

import numpy as np
import pytest

from identification.arrays import Array
from identification.model.flange import flange_motion
from identification.purposes.quiet_torque import (
    BLOCK_SECONDS,
    SlowResidual,
    once_in,
    once_in_interval,
    slow_residuals,
)
from identification.purposes.thresholds import (
    SHOWN_EXCEEDANCES,
    ContactThreshold,
    contact_thresholds,
)
from tests.identification.quiet_motion import quiet
from tests.identification.two_link import MODEL, truth

MIDDLE = np.array([0.3, -0.8])
HOUR = 3600.0


def residuals(duration: float, seed: int) -> list[SlowResidual]:
    """Of motion without contact, predicted by the true parameters."""
    return slow_residuals(MODEL, truth(), [quiet(duration, seed)])


def exponential(count: int, seed: int) -> Array:
    """Peaks of blocks of two joints whose distribution is exponential, of mean 1 and 2."""
    return np.random.default_rng(seed).exponential((1.0, 2.0), (count, 2))


class TestInterval:
    @pytest.mark.parametrize("seconds", [60.0, 600.0])
    def test_it_holds_the_level_that_is_exceeded_once_an_hour(self, seconds: float) -> None:
        level = np.array([1.0, 2.0]) * np.log(HOUR / BLOCK_SECONDS)
        inside = []
        for seed in range(200):
            low, high = once_in_interval(HOUR, exponential(round(seconds / BLOCK_SECONDS), seed))
            inside.append((low <= level) & (level <= high))
        assert 0.9 <= np.mean(inside) <= 0.99

    def test_the_threshold_lies_in_it_and_more_motion_narrows_it(self) -> None:
        widths = []
        for count in (200, 2000):
            peaks = exponential(count, 1)
            torque = once_in(600.0, peaks)
            low, high = once_in_interval(600.0, peaks)
            assert torque is not None and (low < torque).all() and (torque < high).all()
            widths.append(high - low)
        assert (widths[1] < widths[0]).all()


def thresholds(duration: float) -> tuple[ContactThreshold, ...]:
    return contact_thresholds(MODEL, residuals(duration, 1), MIDDLE)


class TestThresholds:
    def test_the_first_is_what_the_motion_shows_three_times(self) -> None:
        first = thresholds(60.0)[0]
        assert first.shown
        assert first.period == pytest.approx(60.0 / SHOWN_EXCEEDANCES, rel=0.05)

    def test_a_short_motion_says_nothing_of_an_hour(self) -> None:
        assert thresholds(8.0)[-1].period < HOUR
        assert contact_thresholds(MODEL, residuals(3.0, 1), MIDDLE) == ()
        assert contact_thresholds(MODEL, [], MIDDLE) == ()

    def test_a_long_one_does(self) -> None:
        found = thresholds(900.0)
        assert [level.period for level in found[1:]] == [600.0, HOUR]
        torque = np.array([level.torque for level in found])
        assert (np.diff(torque, axis=0) > 0.0).all()

    def test_force_and_mass_exceed_the_torque_of_a_joint(self) -> None:
        level = thresholds(60.0)[0]
        jacobian = flange_motion(MODEL.chain, MIDDLE[None]).jacobian[0]
        share = np.abs(level.mass * MODEL.gravity @ jacobian) / level.torque
        assert share.max() == pytest.approx(1.0)
        strongest = np.linalg.norm(jacobian, axis=0) * level.force / level.torque
        assert strongest.max() >= 1.0
