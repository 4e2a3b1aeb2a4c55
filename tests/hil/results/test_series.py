"""Torques of a report's figures: parts add up, spectra have the power of their signals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace as Series

import numpy as np
import pytest
import scipy.signal

from hil.results.series import example_series, torque_parts
from identification.signals.spectrum import HARRIS, power_density
from tests.identification.two_link import MODEL, NOISE, a_motion, recording, truth


@pytest.fixture
def samples():
    return at_steps_of(0.005)


def at_steps_of(step):
    """A recording with white noise."""
    motion = a_motion(step=step)
    noise = np.random.default_rng(3).standard_normal((len(motion.time), 2))
    return recording(NOISE * noise, motion)


def low_passed(samples):
    """The last part of a recording whose torque was filtered, as of a split."""
    filtered = replace(samples, torque_bandwidth=np.array([6.0, 3.0]))
    return filtered.between(len(samples.motion.time) // 2, len(samples.motion.time))


class TestParts:
    @pytest.mark.parametrize("change", [lambda samples: samples, low_passed])
    def test_add_up_to_the_prediction(self, samples, change):
        samples = change(samples)
        parts = torque_parts(MODEL, truth(), samples)
        assert [*parts] == ["inertia", "coriolis", "gravity", "friction"]
        whole = samples.predicted_torque(MODEL, truth())
        np.testing.assert_allclose(sum(parts.values()), whole, atol=1e-9)
        assert all(np.ptp(part, axis=0).max() > 0.1 for part in parts.values())

    def test_grow_as_their_causes_do(self, samples):
        parts = torque_parts(MODEL, truth(), samples)
        motion = samples.motion
        faster = replace(
            motion, velocity=2.0 * motion.velocity, acceleration=3.0 * motion.acceleration
        )
        others = torque_parts(MODEL, truth(), replace(samples, motion=faster))
        for name, factor in {"inertia": 3.0, "coriolis": 4.0, "gravity": 1.0}.items():
            np.testing.assert_allclose(others[name], factor * parts[name], atol=1e-9)


class TestSeries:
    def test_have_the_nominal_model_and_rows_often_enough(self, samples):
        shown = slice(0, len(samples.motion.time), 9)
        series = Series(**example_series(MODEL, truth(), 0.5 * truth(), samples, shown))
        assert 110.0 < 1.0 / np.diff(series.example_time).mean() < 260.0
        error = series.example_measured - series.example_predicted
        assert np.all(np.std(error, axis=0) < NOISE), "low-passed"
        np.testing.assert_allclose(series.example_nominal, 0.5 * series.example_predicted)
        parts = series.example_inertia + series.example_coriolis + series.example_gravity
        np.testing.assert_allclose(parts + series.example_friction, series.example_predicted)
        assert not hasattr(series, "example_elements")
        # White noise has the same density at all frequencies.
        white = NOISE * np.sqrt(2.0 * 0.005)
        middle = np.median(series.spectrum_residual, axis=0)
        np.testing.assert_allclose(middle, white, rtol=0.2)
        assert "example_nominal" not in example_series(MODEL, truth(), None, samples, shown)

    def test_have_no_spectrum_of_a_few_rows(self, samples):
        few = samples.between(0, 10)
        series = example_series(MODEL, truth(), None, few, slice(0, 10))
        assert "spectrum_frequency" not in series

    def test_are_means_of_a_fast_log(self, samples):
        """What the figure shows of noise does not depend on the rows that it takes."""
        slow = example_series(MODEL, truth(), None, samples, slice(0, len(samples.torque)))
        fast = at_steps_of(0.00125)
        shown = slice(0, len(fast.torque))
        series = Series(**example_series(MODEL, truth(), None, fast, shown))
        assert np.diff(series.example_time).mean() < 1.0 / 110.0
        error = series.example_measured - series.example_predicted
        expected = slow["example_measured"] - slow["example_predicted"]
        np.testing.assert_allclose(np.std(error, axis=0), np.std(expected, axis=0) / 2.0, rtol=0.25)


@pytest.mark.parametrize("length", [1000, 999])
@pytest.mark.parametrize(("name", "arguments"), [("hann", ()), ("blackmanharris", (HARRIS,))])
def test_power_density_is_that_of_scipy(length, name, arguments):
    signals = np.random.default_rng(0).standard_normal((5000, 3)).cumsum(axis=0)
    frequency, density = power_density(signals, 250.0, length, *arguments)
    expected = scipy.signal.welch(
        signals, 250.0, window=name, nperseg=length, noverlap=length - length // 2, axis=0
    )
    np.testing.assert_allclose(frequency, expected[0][1:])
    np.testing.assert_allclose(density, expected[1][1:], rtol=1e-9)
