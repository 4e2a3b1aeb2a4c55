from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.interpolate import BSpline
from scipy.signal import butter, filtfilt, sosfiltfilt

from identification.factor.factor import Factor, estimate
from identification.model.robot import RobotModel
from identification.signals.clock import time_base
from identification.signals.masks import TORN
from identification.signals.recording import Recording, RecordingError
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import (
    butterworth_motion,
    choose_cutoff,
    fit_smoothing_spline,
    low_pass,
)
from identification.validation.prediction import prediction_error
from tests.identification.ur10_bag import ur10

Array = NDArray[np.float64]


def noisy_sines(sigma: float, *, samples: int = 8000, step: float = 1e-3) -> tuple[Array, Array]:
    """Time and two channels of a few hertz."""
    time = np.arange(samples) * step
    rng = np.random.default_rng(3)
    return time, sines(time) + sigma * rng.standard_normal((samples, 2))


def sines(time: Array, derivative: int = 0) -> Array:
    w = 2.0 * np.pi * np.array([[0.7, 1.9], [2.3, 3.1]])
    a = np.array([[0.9, 0.4], [0.2, 0.3]])
    phase = w * time[:, None, None] + a + derivative * np.pi / 2.0
    return np.asarray((a * w**derivative * np.sin(phase)).sum(axis=1))


@given(
    coefficients=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    tolerance=st.floats(1e-12, 1e-2),
    seed=st.integers(0, 2**16),
)
def test_parabolas_pass_unchanged_whatever_the_tolerance(
    coefficients: list[float], tolerance: float, seed: int
) -> None:
    # The roughness of a parabola is zero, so no penalty can move it.
    time = np.sort(np.random.default_rng(seed).uniform(0.0, 2.0, 300))
    polynomial = np.polynomial.Polynomial(coefficients)
    spline = fit_smoothing_spline(time, polynomial(time)[:, None], np.array([tolerance]))
    np.testing.assert_allclose(spline(time)[:, 0], polynomial(time), atol=1e-7)
    np.testing.assert_allclose(spline(time, 1)[:, 0], polynomial.deriv()(time), atol=1e-5)
    np.testing.assert_allclose(spline(time, 2)[:, 0], polynomial.deriv(2)(time), atol=1e-3)


def test_quintics_are_reproduced_when_hardly_anything_may_be_smoothed() -> None:
    time = np.linspace(0.0, 1.0, 400)
    polynomial = np.polynomial.Polynomial([0.2, -1.0, 3.0, 2.0, -4.0, 1.5])
    spline = fit_smoothing_spline(time, polynomial(time)[:, None], np.array([1e-24]))
    # What is left is rounding, divided by the knot spacing once per derivative.
    for derivative, tolerance in ((0, 1e-12), (1, 1e-8), (2, 1e-4)):
        expected = polynomial.deriv(derivative)(time) if derivative else polynomial(time)
        np.testing.assert_allclose(spline(time, derivative)[:, 0], expected, atol=tolerance)


@pytest.mark.parametrize("sigma", [1e-6, 1e-4, 1e-2])
def test_the_mean_squared_residual_is_the_tolerance(sigma: float) -> None:
    time, values = noisy_sines(sigma)
    spline = fit_smoothing_spline(time, values, np.full(2, sigma**2))
    measured = np.mean((values - spline(time)) ** 2, axis=0)
    np.testing.assert_allclose(measured, sigma**2, rtol=1e-3)


def test_derivatives_of_noisy_sines_are_far_better_than_differences() -> None:
    sigma = 1e-5
    time, values = noisy_sines(sigma)
    spline = fit_smoothing_spline(time, values, np.full(2, sigma**2))
    inner = slice(200, -200)
    error = [np.std((spline(time, d) - sines(time, d))[inner]) for d in range(3)]
    assert error[0] < 0.4 * sigma
    assert error[1] < 2e-3 * np.std(sines(time, 1))
    assert error[2] < 5e-3 * np.std(sines(time, 2))
    differences = np.gradient(np.gradient(values, time, axis=0), time, axis=0)
    assert np.std((differences - sines(time, 2))[inner]) > 50 * error[2]


def test_derivatives_are_those_of_the_spline_itself() -> None:
    time, values = noisy_sines(1e-3)
    spline = fit_smoothing_spline(time, values, np.full(2, 1e-6))
    at, h = np.linspace(0.5, 7.0, 50), 1e-5
    for derivative in (0, 1, 2):
        slope = (spline(at + h, derivative) - spline(at - h, derivative)) / (2.0 * h)
        np.testing.assert_allclose(spline(at, derivative + 1), slope, rtol=1e-5, atol=1e-4)


def test_it_minimises_squares_plus_penalty_times_the_integral_of_the_squared_third_derivative() -> (
    None
):
    # Small enough for a dense solution built from SciPy's splines and adaptive quadrature.
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0.0, 1.0, 40))
    values = np.sin(5.0 * time) + 0.05 * rng.standard_normal(40)
    spline = fit_smoothing_spline(time, values[:, None], np.array([0.05**2]))
    k = len(spline.coefficients)
    knots = spline.start + spline.spacing * np.arange(-5, k + 1)
    basis = BSpline(knots, np.eye(k), 5)
    third = basis.derivative(3)
    roughness = np.zeros((k, k))
    for i in range(k):
        for j in range(max(0, i - 5), i + 1):
            pieces = [
                quad(lambda t, i=i, j=j: third(t)[i] * third(t)[j], *knots[p : p + 2])[0]
                for p in range(max(i, 5), min(j + 6, k))
            ]
            roughness[i, j] = roughness[j, i] = sum(pieces)
    density = len(time) / (time[-1] - time[0])
    penalty = density / (2.0 * np.pi * spline.bandwidth[0]) ** 6
    rows = basis(time)
    dense = np.linalg.solve(rows.T @ rows + penalty * roughness, rows.T @ values)
    np.testing.assert_allclose(spline(time)[:, 0], rows @ dense, atol=1e-9)


def test_the_fixed_low_pass_is_a_third_order_butterworth_run_both_ways() -> None:
    # |H|^2 of a third-order Butterworth is 1 / (1 + (w/w_c)^6), the smoother's own gain.
    time, values = noisy_sines(0.1)
    sections = butter(3, 6.0, fs=1000.0, output="sos")
    expected = sosfiltfilt(sections, values, axis=0)
    inner = slice(1000, -1000)
    np.testing.assert_allclose(low_pass(time, values, 6.0)[inner], expected[inner], atol=2e-4)


@given(st.floats(1.0, 60.0), st.integers(0, 2**16))
def test_the_low_pass_is_linear_and_keeps_constants(bandwidth: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.arange(400) * 2e-3
    x, y = rng.standard_normal((2, 400, 3))
    combined = low_pass(time, 2.0 * x - 0.5 * y, bandwidth)
    apart = 2.0 * low_pass(time, x, bandwidth) - 0.5 * low_pass(time, y, bandwidth)
    np.testing.assert_allclose(combined, apart, atol=1e-9)
    np.testing.assert_allclose(low_pass(time, np.ones((400, 1)), bandwidth), 1.0, atol=1e-9)


def test_a_jittering_time_base_costs_no_accuracy() -> None:
    rng = np.random.default_rng(11)
    sigma = 1e-4
    time = np.arange(8000) * 1e-3 + rng.uniform(-4e-4, 4e-4, 8000)
    values = sines(time) + sigma * rng.standard_normal((8000, 2))
    spline = fit_smoothing_spline(time, values, np.full(2, sigma**2))
    np.testing.assert_allclose(np.mean((values - spline(time)) ** 2, axis=0), sigma**2, rtol=1e-3)
    error = (spline(time, 2) - sines(time, 2))[200:-200]
    assert np.std(error) < 0.01 * np.std(sines(time, 2))


def test_knots_are_refined_where_the_tolerance_asks_for_it() -> None:
    # 120 Hz at 1 kHz: one knot per four samples cannot follow, one per sample can.
    time = np.arange(2000) * 1e-3
    values = np.sin(2.0 * np.pi * 120.0 * time)[:, None]
    spline = fit_smoothing_spline(time, values, np.array([1e-8]))
    assert spline.spacing < 3e-3
    assert np.mean((values - spline(time)) ** 2) <= 1.001e-8


def test_a_standing_joint_is_smoothed_to_rest() -> None:
    time = np.arange(4000) * 1e-3
    noise = 1e-5 * np.random.default_rng(2).standard_normal((4000, 1))
    spline = fit_smoothing_spline(time, 0.7 + noise, np.array([1e-10]))
    assert np.abs(spline(time, 1)[500:-500]).max() < 1e-4


def test_what_cannot_be_smoothed_is_refused() -> None:
    with pytest.raises(ValueError, match="needs 6 samples"):
        fit_smoothing_spline(np.arange(5.0), np.zeros((5, 1)), np.array([1.0]))
    with pytest.raises(ValueError, match="tolerance must be positive"):
        fit_smoothing_spline(np.arange(50.0), np.zeros((50, 1)), np.array([0.0]))


BUTTERWORTH = Preprocessing(smoother="butterworth")


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
