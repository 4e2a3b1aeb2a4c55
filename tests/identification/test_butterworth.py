from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import butter, filtfilt

from identification.factor.factor import Factor, estimate
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.clock import time_base
from identification.signals.masks import TORN
from identification.signals.recording import Recording, RecordingError
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import butterworth_motion, choose_cutoff
from identification.validation.prediction import prediction_error
from tests.identification.ur10_bag import ur10

Array = NDArray[np.float64]
URDF = (Path(__file__).parent / "two_link.urdf").read_text()
BUTTERWORTH = Preprocessing(smoother="butterworth")


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))


@pytest.fixture(scope="module")
def truth(model: RobotModel) -> Array:
    standard = model.nominal.copy()
    standard[[10, 21]] = 0.4, 0.1
    return np.concatenate([model.base.grouping @ standard, [4.0, 2.0, 1.5, 0.8]])


def motion(time: Array) -> tuple[Array, Array, Array]:
    amplitude, rate, phase = np.array([0.9, 1.2]), np.array([4.1, 5.7]), np.array([0.3, 1.1])
    angle = rate * time[:, None] + phase
    wave = amplitude * np.sin(angle) + 0.3 * np.sin(1.7 * angle)
    speed = amplitude * rate * np.cos(angle) + 0.51 * rate * np.cos(1.7 * angle)
    return (
        wave,
        speed,
        -amplitude * rate**2 * np.sin(angle) - 0.867 * rate**2 * np.sin(1.7 * angle),
    )


def a_recording(
    model: RobotModel, truth: Array, time: Array, *, noise: float = 2e-5, delay: float = 0.0
) -> Recording:
    rng = np.random.default_rng(8)
    torque = model.torque(truth, *motion(time - delay))
    return Recording(
        time=time,
        position=motion(time)[0] + noise * rng.standard_normal(torque.shape),
        joint_names=model.joint_names,
        torque=torque + 0.3 * rng.standard_normal(torque.shape),
    )


EVEN = np.arange(8000) * 1e-3


@settings(max_examples=20)
@given(frequency=st.floats(1.0, 30.0), cutoff=st.floats(3.0, 40.0), order=st.integers(2, 5))
def test_the_gain_is_butterworths_squared_and_the_phase_zero(
    frequency: float, cutoff: float, order: int
) -> None:
    time = np.arange(6000) * 1e-3
    wave = np.sin(2.0 * np.pi * frequency * time + 0.7)[:, None]
    recording = Recording(time, wave, ("a",))
    smoothed = butterworth_motion(recording, np.array([cutoff]), order=order)
    middle = slice(2000, 4000)
    # The bilinear transform bends frequencies.
    warped = np.tan(np.pi * frequency * 1e-3) / np.tan(np.pi * cutoff * 1e-3)
    gain = 1.0 / (1.0 + warped ** (2 * order))
    rate = 2.0 * np.pi * frequency
    phase = rate * time[middle] + 0.7
    assert smoothed.position[middle, 0] == pytest.approx(gain * np.sin(phase), abs=1e-5)
    assert smoothed.velocity[middle, 0] == pytest.approx(
        gain * rate * np.cos(phase), abs=1e-5 * rate
    )
    assert smoothed.acceleration[middle, 0] == pytest.approx(
        -gain * rate**2 * np.sin(phase), abs=2e-4 * rate**2
    )


def test_positions_are_those_of_scipys_filtfilt(model: RobotModel, truth: Array) -> None:
    recording = a_recording(model, truth, EVEN)
    b, a = butter(4, 20.0, fs=1000.0)
    expected = filtfilt(b, a, recording.position, axis=0)
    got = butterworth_motion(recording, np.full(2, 20.0)).position
    # Away from the ends, which each pads in its own way.
    np.testing.assert_allclose(got[300:-300], expected[300:-300], atol=1e-8)


def test_derivatives_are_better_than_central_differences(model: RobotModel, truth: Array) -> None:
    time = np.arange(1000) * 8e-3
    recording = a_recording(model, truth, time, noise=1e-7)
    smoothed = butterworth_motion(recording, np.full(2, 30.0))
    exact = motion(time)
    inner = slice(60, -60)
    central = np.gradient(smoothed.position, time, axis=0)
    ours = np.abs(smoothed.velocity - exact[1])[inner].max()
    assert ours < 0.1 * np.abs(central - exact[1])[inner].max()


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_the_cutoff_is_as_good_as_the_best_for_the_acceleration(
    model: RobotModel, truth: Array, noise: float
) -> None:
    recording = a_recording(model, truth, EVEN, noise=noise)
    exact = motion(EVEN)[2]
    inner = slice(1500, -1500)

    def error(cutoff: Array) -> Array:
        smoothed = butterworth_motion(recording, cutoff).acceleration
        return np.sqrt(np.mean((smoothed - exact)[inner] ** 2, axis=0))

    best = np.min([error(np.full(2, f)) for f in np.geomspace(1.0, 40.0, 40)], axis=0)
    for chosen in (choose_cutoff(recording, np.full(2, noise**2)), choose_cutoff(recording)):
        assert np.all(error(chosen) < 1.5 * best)


def test_little_noise_means_the_widest_cutoff(model: RobotModel, truth: Array) -> None:
    recording = a_recording(model, truth, EVEN, noise=1e-7)
    sharp = np.full(2, 1e-14)
    np.testing.assert_array_equal(choose_cutoff(recording, sharp, widest=40.0), 40.0)
    slow = a_recording(model, truth, np.arange(800) * 0.02, noise=1e-7)  # 50 Hz
    np.testing.assert_allclose(choose_cutoff(slow, sharp, widest=40.0), 20.0)


@pytest.mark.parametrize("uneven", [False, True])
def test_a_fit_to_it_is_as_good_as_one_to_the_spline(
    model: RobotModel, truth: Array, uneven: bool
) -> None:
    rng = np.random.default_rng(4)
    time = np.cumsum(1e-3 * rng.uniform(0.6, 1.4, 8000)) if uneven else EVEN
    recording = a_recording(model, truth, time, delay=2e-3)
    variance = np.full(2, (2e-5) ** 2)
    filtered = replace(BUTTERWORTH, torque_delay=2e-3)
    samples = prepare(recording, model, noise_variance=variance, options=filtered)
    there = estimate(model, Factor.of(model, samples))

    spline = prepare(
        recording, model, noise_variance=variance, options=Preprocessing(torque_delay=2e-3)
    )
    other = estimate(model, Factor.of(model, spline))
    assert np.all(np.abs(there.values - truth) < 5.0 * there.std + 2e-3 * np.abs(truth))
    assert there.noise_std == pytest.approx(other.noise_std, rel=0.05)


def test_rows_beside_ends_and_gaps_do_not_count_and_say_why(
    model: RobotModel, truth: Array
) -> None:
    recording = a_recording(model, truth, EVEN)
    gap = np.zeros(len(EVEN), dtype=np.bool_)
    gap[4000] = True
    samples = prepare(
        replace(recording, gap_before=gap),
        model,
        noise_variance=np.full(2, 1e-16),
        options=replace(BUTTERWORTH, rigid_bandwidth=20.0),
    )
    np.testing.assert_array_equal(samples.position_bandwidth, 20.0)
    reach = 100  # two periods of 20 Hz
    for edge in (0, 4000, len(EVEN)):
        assert not samples.usable[max(0, edge - reach) : edge + reach].any()
    exact = motion(EVEN)
    for smoothed, true in zip(samples.motion[1:4], exact, strict=True):
        error = (smoothed - true)[samples.usable.all(axis=1)]
        assert np.sqrt(np.mean(error**2)) < 5e-3 * np.std(true)
    assert samples.mask is not None
    assert samples.mask.counts[TORN].all()


def test_a_stretch_too_short_to_filter_is_at_rest_and_does_not_count(
    model: RobotModel, truth: Array
) -> None:
    recording = a_recording(model, truth, EVEN)
    gap = np.zeros(len(EVEN), dtype=np.bool_)
    gap[[4000, 4010]] = True
    samples = prepare(replace(recording, gap_before=gap), model, options=BUTTERWORTH)
    assert not samples.usable[4000:4010].any()
    assert not samples.motion.velocity[4000:4010].any()


def test_what_cannot_be_filtered_is_refused(model: RobotModel, truth: Array) -> None:
    recording = a_recording(model, truth, EVEN)
    with pytest.raises(RecordingError, match="no joint torque"):
        prepare(replace(recording, torque=None), model, options=BUTTERWORTH)
    with pytest.raises(RecordingError, match="24 samples"):
        choose_cutoff(recording.between(0, 20))


def test_on_a_real_ur10_it_is_as_good_as_the_spline(shared_data: Path) -> None:
    model, recording = ur10(shared_data)
    assert time_base(recording.time).uniform
    filtered = prepare(recording, model, options=BUTTERWORTH)
    splined = prepare(recording, model)
    errors = []
    for samples in (filtered, splined):
        fit = estimate(model, Factor.of(model, samples))
        errors.append(prediction_error(model, fit.values, [samples])[0].overall)
    assert errors[0] == pytest.approx(errors[1], abs=0.001)
    assert errors[0] < 0.0515  # what a plain fit with the quadratic term reaches on this bag
    assert np.all(filtered.usable.mean(axis=0) > 0.9)
