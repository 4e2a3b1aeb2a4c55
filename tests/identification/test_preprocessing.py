from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from identification.model.robot import RobotModel
from identification.signals.noise import difference_variance, standstill_variance
from identification.signals.recording import Recording, RecordingError
from identification.signals.samples import (
    Preprocessing,
    prepare,
)
from tests.identification.two_link import MODEL, truth

Array = NDArray[np.float64]

TRUTH = truth()

RESOLUTION = 2e-6  # rad, of the encoders


def motion(time: Array) -> tuple[Array, Array, Array]:
    amplitude, rate, phase = np.array([0.9, 1.2]), np.array([2.1, 3.7]), np.array([0.3, 1.1])
    angle = rate * time[:, None] + phase
    return (
        amplitude * np.sin(angle),
        amplitude * rate * np.cos(angle),
        -amplitude * rate**2 * np.sin(angle),
    )


def a_recording(
    model: RobotModel, truth: Array, *, noise: float = 0.0, delay: float = 0.0
) -> Recording:
    time = np.arange(6000) * 1e-3
    rng = np.random.default_rng(8)
    torque = model.torque(truth, *motion(time - delay))
    return Recording(
        time=time,
        position=np.round(motion(time)[0] / RESOLUTION) * RESOLUTION,
        joint_names=model.joint_names,
        torque=torque + noise * rng.standard_normal(torque.shape),
    )


QUANTISATION = np.full(2, RESOLUTION**2 / 12.0)


def test_smoothed_motion_is_the_true_motion_where_rows_count() -> None:
    recording = a_recording(MODEL, TRUTH)
    samples = prepare(recording, MODEL, noise_variance=QUANTISATION)
    for smoothed, exact in zip(samples.motion[1:4], motion(recording.time), strict=True):
        error = (smoothed - exact)[samples.usable.all(axis=1)]
        assert np.sqrt(np.mean(error**2)) < 2e-3 * np.std(exact)


def test_the_torque_is_left_as_measured() -> None:
    recording = a_recording(MODEL, TRUTH, noise=0.5)
    assert prepare(recording, MODEL).torque is recording.torque


def test_no_derivative_is_taken_across_a_gap() -> None:
    whole = a_recording(MODEL, TRUTH)
    keep = np.r_[0:2000, 2300:6000]
    assert whole.torque is not None
    gap = np.zeros(len(keep), dtype=bool)
    gap[2000] = True
    # Time that counts on through a gap, as a PC's clock would: only the flag tells.
    torn = Recording(
        time=whole.time[: len(keep)],
        position=whole.position[keep],
        joint_names=whole.joint_names,
        torque=whole.torque[keep],
        gap_before=gap,
    )
    samples = prepare(torn, MODEL, noise_variance=QUANTISATION)
    exact = [part[keep] for part in motion(whole.time)]
    rows = samples.usable.all(axis=1)
    assert not samples.usable[1995:2005].any()
    assert np.abs(samples.motion.velocity - exact[1])[rows].max() < 0.02
    unflagged = prepare(replace(torn, gap_before=None), MODEL, noise_variance=QUANTISATION)
    assert np.abs(unflagged.motion.velocity - exact[1])[1995:2005].max() > 1.0


@pytest.mark.parametrize("delay", [0.004, -0.0025])
def test_a_known_delay_of_the_torque_is_taken_out(delay: float) -> None:
    recording = a_recording(MODEL, TRUTH, delay=delay)

    def worst(assumed: float) -> float:
        samples = prepare(
            recording,
            MODEL,
            noise_variance=QUANTISATION,
            options=Preprocessing(torque_delay=assumed),
        )
        error = samples.torque - samples.predicted_torque(MODEL, TRUTH)
        moving = np.abs(samples.motion.velocity) > 0.1  # clear of the step at a reversal
        return float(np.abs(error[samples.usable & moving]).max())

    assert worst(delay) < 0.1
    assert worst(0.0) > 5 * worst(delay)


@settings(max_examples=30)
@given(sigma=st.floats(1e-6, 1e-2), seed=st.integers(0, 2**16))
def test_the_noise_of_a_smooth_signal_is_found_from_its_differences(
    sigma: float, seed: int
) -> None:
    time = np.arange(3000) * 1e-3
    noise = sigma * np.random.default_rng(seed).standard_normal((3000, 2))
    found = difference_variance(time, motion(time)[0] + noise)
    np.testing.assert_allclose(np.sqrt(found), sigma, rtol=0.1)


def test_differences_do_not_take_jitter_of_the_clock_for_noise() -> None:
    rng = np.random.default_rng(4)
    time = np.arange(5000) * 1e-3 + rng.uniform(-3e-4, 3e-4, 5000)
    found = difference_variance(time, motion(time)[0] + 1e-5 * rng.standard_normal((5000, 2)))
    np.testing.assert_allclose(np.sqrt(found), 1e-5, rtol=0.1)


def test_variance_at_standstill_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(6)
    time = np.arange(5000) * 1e-3
    noise = np.array([1e-5, 1e-3]) * rng.standard_normal((5000, 2))
    found = standstill_variance(time, 0.4 + noise)
    np.testing.assert_allclose(np.sqrt(found), [1e-5, 1e-3], rtol=0.05)


def test_an_arm_that_creeps_and_slips_at_rest_is_not_noisy() -> None:
    rng = np.random.default_rng(6)
    time = np.arange(5000) * 1e-3
    slip = 3e-4 * (time > 3.0) * (1.0 - np.exp(-(time - 3.0) / 0.2))
    values = (0.4 + 1e-4 * time + slip)[:, None] + 1e-6 * rng.standard_normal((5000, 1))
    np.testing.assert_allclose(np.sqrt(standstill_variance(time, values)), 1e-6, rtol=0.1)


def test_a_reading_that_never_changes_has_no_variance_of_its_own() -> None:
    assert standstill_variance(np.arange(500) * 1e-3, np.full((500, 1), 0.4))[0] < 1e-40
    with pytest.raises(RecordingError, match="20 samples"):
        standstill_variance(np.arange(19) * 1e-3, np.zeros((19, 2)))


def test_a_low_pass_in_the_torque_channel_cancels_when_the_regressor_goes_through_it_too() -> None:
    recording = a_recording(MODEL, TRUTH)
    assert recording.torque is not None
    # Recorded through a low-pass that is not the smoother itself: Butterworth, both ways.
    logged = sosfiltfilt(butter(3, 4.0, fs=1000.0, output="sos"), recording.torque, axis=0)

    def misfit(options: Preprocessing) -> float:
        samples = prepare(
            replace(recording, torque=logged), MODEL, noise_variance=QUANTISATION, options=options
        )
        error = samples.torque - samples.predicted_torque(MODEL, TRUTH)
        return float(np.sqrt(np.mean(error[1000:-1000] ** 2)))

    assert misfit(Preprocessing(torque_bandwidth=4.0)) < 0.05 * misfit(Preprocessing())


def test_the_papers_way_smooths_torque_and_regressor_alike() -> None:
    recording = a_recording(MODEL, TRUTH, noise=0.5)
    options = Preprocessing(smooth_torque=True)
    samples = prepare(
        recording,
        MODEL,
        noise_variance=QUANTISATION,
        torque_variance=np.full(2, 0.25),
        options=options,
    )
    assert recording.torque is not None
    removed = recording.torque - samples.torque
    np.testing.assert_allclose(np.mean(removed**2, axis=0), 0.25, rtol=0.1)
    # What is left of the noise in the fit's residual is what the smoother lets through; the
    # linear relation itself has not suffered.
    error = (samples.torque - samples.predicted_torque(MODEL, TRUTH))[samples.usable]
    assert np.sqrt(np.mean(error**2)) < 0.2


def test_a_recording_without_torque_is_refused() -> None:
    with pytest.raises(RecordingError, match="no joint torque"):
        prepare(replace(a_recording(MODEL, TRUTH), torque=None), MODEL)


def test_a_recording_that_fails_its_checks_is_refused() -> None:
    wrong = replace(a_recording(MODEL, TRUTH), joint_names=("elbow", "shoulder"))
    with pytest.raises(RecordingError, match="order"):
        prepare(wrong, MODEL)


def test_a_bandwidth_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        Preprocessing(torque_bandwidth=0.0)
