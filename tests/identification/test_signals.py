"""Recordings and their checks, smoothing, noise, and samples with excluded rows."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import BSpline
from scipy.signal import butter, lfilter, sosfiltfilt

from identification.errors import ShapeError
from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.selection.questions import SELECTION_RATE
from identification.signals.masks import (
    END_PERIODS,
    MAX_END_SECONDS,
    REVERSAL_SECONDS,
    RowReason,
    flat_topped,
    mask_rows,
    spiking,
)
from identification.signals.messages import clock_lines
from identification.signals.noise import (
    difference_variance,
    has_small_noise,
    hidden_by_rounding,
    noiseless_above,
    standstill_variance,
)
from identification.signals.recording import (
    Recording,
    RecordingError,
    in_succession,
    offsets_of_repetitions,
    without_repeats,
)
from identification.signals.sample_times import time_base, true_times
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import (
    fit_smoothing_spline,
    low_pass,
)
from tests.identification.two_link import MODEL, URDF, one_sine, sine_motion, truth

NAMES = ("shoulder", "elbow", "wrist")


def a_recording(samples=200, *, commanded=True):
    time = np.arange(samples) * 1e-3
    phase = 8.0 * time[:, None] + np.arange(3)
    command = 0.5 * np.sin(phase)
    return Recording(
        time=time,
        position=0.5 * np.sin(phase - 0.01),
        joint_names=NAMES,
        torque=np.cos(phase),
        commanded_position=command if commanded else None,
    )


def changed(name, rows, joint, value):
    """Return a valid recording with other readings of a joint."""
    recording = a_recording()
    values = getattr(recording, name).copy()
    values[rows, joint] = values[0, joint] if value is None else value
    return replace(recording, **{name: values})


def leaping(sample, step):
    """Return a recording with another time step at a sample [s]."""
    time = a_recording().time.copy()
    time[sample:] += time[sample - 1] + step - time[sample]
    return replace(a_recording(), time=time)


RESTING = changed("commanded_position", slice(None), 1, 0.3).commanded_position


class TestChecks:
    @given(
        channel=st.sampled_from(["position", "torque"]),
        sample=st.integers(0, 199),
        joint=st.integers(0, 2),
        value=st.sampled_from([np.nan, np.inf, -np.inf]),
    )
    def test_nan_and_infinity_raise(self, channel, sample, joint, value):
        where = f"{channel} of joint {NAMES[joint]} is {value} at sample {sample} "
        with pytest.raises(RecordingError, match=where):
            changed(channel, sample, joint, value).checked()

    @pytest.mark.parametrize(
        ("recording", "message"),
        [
            (leaping(50, np.nan), "time is nan at sample 50"),
            (leaping(50, 0.0), "repeats at sample 50"),
            (leaping(50, -5e-3), "falls back at sample 50"),
            (leaping(50, 601.0), r"time step is .* at sample 50, limit .* cut the recording"),
            (leaping(50, 2e9), r"time step is .* at sample 50, limit .* cut the recording"),
            (a_recording(1), "has 1 samples"),
        ],
    )
    def test_invalid_recordings_raise(self, recording, message):
        with pytest.raises(RecordingError, match=message):
            recording.checked()

    @pytest.mark.parametrize(
        "recording",
        [
            changed("commanded_position", slice(20, 30), 1, np.nan),
            replace(changed("position", slice(None), 1, 0.3), commanded_position=RESTING),
            leaping(50, 599.0),
            changed("position", slice(None), 1, None),
            changed("position", slice(120, None), 2, 0.3),
            replace(a_recording(commanded=False), position=np.full((200, 3), 0.3)),
        ],
        ids=[
            "cycles without a set-point",
            "commanded to rest",
            "a long pause",
            "a servo that stands",
            "a servo that stops",
            "standstill",
        ],
    )
    def test_valid_recordings_pass(self, recording):
        assert recording.checked() is recording

    def test_without_commands_a_constant_joint_stands(self):
        recording = replace(changed("position", slice(None), 0, 0.3), commanded_position=None)
        assert recording.checked() is recording

    def test_quantised_readings_of_a_slow_joint_are_not_stuck(self):
        slow = 0.01 * a_recording().time[:, None] + np.zeros(3)
        coarse = np.round(slow / 1e-3) * 1e-3
        replace(a_recording(), position=coarse, commanded_position=slow).checked()

    @pytest.mark.parametrize(
        "expected",
        [("elbow", "shoulder", "wrist"), ("shoulder", "elbow", "hand"), ("shoulder", "elbow")],
    )
    def test_other_joints_than_the_model_raise(self, expected):
        with pytest.raises(RecordingError, match=f"the model's are {', '.join(expected)}"):
            a_recording().checked(expected)


class TestRecording:
    def test_arrays_of_other_shapes_are_refused_by_name(self):
        recording = a_recording()
        for name, values in (("torque", recording.torque[:-1]), ("gap_before", np.zeros(3, bool))):
            with pytest.raises(ShapeError, match=name):
                replace(recording, **{name: values})
        with pytest.raises(ShapeError, match="time"):
            replace(recording, time=recording.time[:, None])

    def test_gaps_split_it_but_jitter_does_not(self):
        recording = a_recording()
        gap = np.zeros(200, dtype=bool)
        gap[30] = True
        time = recording.time.copy()
        time[100:] += 0.5
        parts = [slice(0, 30), slice(30, 100), slice(100, 200)]
        assert replace(recording, time=time, gap_before=gap).segments() == parts
        jitter = np.random.default_rng(1).uniform(-4e-4, 4e-4, 200)
        assert replace(recording, time=recording.time + jitter).segments() == [slice(0, 200)]

    def test_a_motion_starts_with_its_command(self):
        recording = a_recording()
        command = recording.commanded_position.copy()
        command[:40] = command[40]
        assert replace(recording, commanded_position=command).motion_start == recording.time[41]
        command[:10] = np.nan
        assert replace(recording, commanded_position=command).motion_start == recording.time[41]
        assert a_recording(commanded=False).motion_start == 0.0
        command[:] = np.nan
        assert replace(recording, commanded_position=command).motion_start == 0.0


STEP = 2e-3


def recorded(seed, *, start=0.0, clock=0.0, pace=1.0, noise=0):
    """Return eight seconds of a motion from `start`, with a clock offset [s]."""
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.2, 1.0, (3, 2))
    rate = rng.uniform(0.5, 3.0, (3, 2))
    time = start + STEP * np.arange(4000)
    angle = pace * rate * time[:, None, None] + rng.uniform(0.0, 6.0, (3, 2))
    position = (amplitude * np.sin(angle)).sum(axis=1)
    position += 1e-4 * np.random.default_rng(noise).standard_normal(position.shape)
    return Recording(time=time + clock, position=position, joint_names=("a", "b"))


def resting():
    return replace(recorded(1), position=np.ones((4000, 2)))


class TestAveraged:
    """Means of consecutive samples."""

    def test_all_channels_are_means_at_about_the_rate(self):
        recording = a_recording(203)
        averaged = recording.averaged(125.0)
        assert averaged.n_samples == 203 // 8
        for name in ("time", "position", "torque", "commanded_position"):
            values = getattr(recording, name)[:200]
            expected = values.reshape(25, 8, *values.shape[1:]).mean(axis=1)
            np.testing.assert_allclose(getattr(averaged, name), expected, rtol=1e-12)

    def test_a_lower_rate_is_kept(self):
        recording = a_recording()
        assert recording.averaged(600.0) is recording

    def test_a_linear_model_stays_true(self):
        recording = a_recording()
        gains = np.random.default_rng(3).standard_normal((3, 3))
        linear = replace(recording, torque=recording.position @ gains + 2.0)
        averaged = linear.averaged(100.0)
        np.testing.assert_allclose(averaged.torque, averaged.position @ gains + 2.0, rtol=1e-12)

    @pytest.mark.parametrize("reported", [True, False])
    def test_no_mean_is_of_samples_beside_a_gap(self, reported):
        """A segment shorter than a mean is left out."""
        time = np.arange(200) * 1e-3
        gap = np.zeros(200, dtype=np.bool_)
        gap[[61, 64, 150]] = True
        if not reported:
            time += 0.5 * np.cumsum(gap)
        recording = replace(a_recording(), time=time, gap_before=gap if reported else None)
        averaged = recording.averaged(125.0)
        lengths = [part.stop - part.start for part in averaged.segments()]
        assert lengths == [61 // 8, 86 // 8, 50 // 8]
        starts = np.concatenate([8 * np.arange(7), 64 + 8 * np.arange(10), 150 + 8 * np.arange(6)])
        expected = recording.position[starts[:, None] + np.arange(8)].mean(axis=1)
        np.testing.assert_allclose(averaged.position, expected, rtol=1e-12)


class TestInSuccession:
    def test_recordings_are_segments_of_one(self):
        """With one step between them, and the channels that all have."""
        first = a_recording(150)
        second = replace(a_recording(90), commanded_position=None)
        both = in_succession([first, second])
        assert [part.stop - part.start for part in both.segments()] == [150, 90]
        for name in ("position", "torque"):
            expected = np.concatenate([getattr(first, name), getattr(second, name)])
            np.testing.assert_array_equal(getattr(both, name), expected)
        assert both.commanded_position is None
        assert both.checked(first.joint_names) is both

    def test_one_recording_is_itself(self):
        recording = a_recording()
        assert in_succession([recording]) is recording


class TestTrueTimes:
    @pytest.mark.parametrize("with_velocity", [False, True])
    @pytest.mark.parametrize("is_even", [False, True])
    def test_positions_tell_late_stamps_from_uneven_samples(self, is_even, with_velocity):
        rng = np.random.default_rng(3)
        even = 1e-3 * np.arange(4000)
        stamps = even + rng.uniform(0.0, 3e-4, 4000)
        true = even if is_even else stamps
        exact = one_sine(true)
        gap = np.isin(np.arange(4000), [3990])  # few samples behind it tell nothing
        recording = Recording(
            time=stamps,
            position=exact.position + 1e-6 * rng.standard_normal(exact.position.shape),
            velocity=exact.velocity if with_velocity else None,
            joint_names=("a", "b"),
            gap_before=gap,
        )
        corrected, times = true_times(recording)
        rows = slice(0, 3990)
        np.testing.assert_allclose(np.diff(corrected.time[rows]), np.diff(true[rows]), atol=2e-5)
        assert times.even == is_even
        assert times.certain

    def test_a_resting_arm_confirms_neither(self):
        stamps = 1e-3 * np.arange(400.0) + np.random.default_rng(4).uniform(0.0, 3e-4, 400)
        corrected, _ = true_times(Recording(stamps, np.ones((400, 2)), ("a", "b")))
        np.testing.assert_array_equal(corrected.time, stamps)


class TestRepetitions:
    @settings(max_examples=20, deadline=None)
    @given(
        seed=st.integers(0, 50),
        clock=st.floats(-1e3, 1e3),
        start=st.floats(-0.4, 0.4).map(lambda second: round(second / STEP) * STEP),
    )
    def test_offsets_of_clocks_are_found(self, seed, clock, start):
        runs = [recorded(seed), recorded(seed, start=start, clock=clock, noise=1)]
        offsets = offsets_of_repetitions(runs)
        np.testing.assert_allclose(offsets, [0.0, clock], atol=2e-3)

    @pytest.mark.parametrize(
        "runs",
        [
            [recorded(1)],
            *([recorded(seed), recorded(seed + 100)] for seed in range(5)),
            [recorded(1), recorded(1, pace=1.05)],
            [recorded(1), recorded(1, start=4.0)],
            [recorded(1), recorded(1, noise=1), recorded(2)],
            [recorded(1), recorded(1).rows(slice(0, 800))],  # too short to tell
            [resting(), resting()],
        ],
    )
    def test_other_motions_are_no_repetitions(self, runs):
        assert offsets_of_repetitions(runs) is None


class TestTimeBase:
    @pytest.mark.parametrize("rate", [100.0, 125.0, 1000.0, 5000.0])
    def test_an_even_clock_since_1970_is_uniform_and_jitter_is_not(self, rate):
        base = time_base(1.7e9 + np.arange(2000) / rate)
        assert base.uniform
        assert base.rate == pytest.approx(rate, rel=1e-4)
        assert (base.repeated, base.backward, base.dropped, base.gaps) == (0, 0, 0, 0)
        steps = (1.0 + 0.2 * np.random.default_rng(1).uniform(-1.0, 1.0, 20_000)) / rate
        uneven = time_base(np.cumsum(steps))
        assert not uneven.uniform
        assert uneven.jitter == pytest.approx(0.2 / np.sqrt(3.0), rel=0.02)

    @pytest.mark.parametrize("seed", range(5))
    def test_late_stamps_are_not_missing_samples(self, seed):
        random = np.random.default_rng(seed)
        late = 0.01 * (np.arange(4000) + random.uniform(-0.3, 0.3, 4000))
        lost = np.sort(random.choice(np.arange(100, 3900, 40), 25, replace=False))

        for base, dropped in ((time_base(late), 0), (time_base(np.delete(late, lost)), 25)):
            assert base.dropped == dropped
            assert base.rate == pytest.approx(100.0, rel=1e-3)

    def test_repeats_falls_drops_and_gaps_are_distinguished(self):
        index = np.arange(1000.0)
        index[100] = index[99]  # repeats
        index[200] = index[199] - 0.5  # falls back
        index = np.delete(index, [300, 301, 400])  # two and one samples missing
        index[600:] += 50.0  # a gap
        base = time_base(index * 1e-3)
        assert (base.repeated, base.backward, base.gaps) == (1, 1, 1)
        # Long steps after the repeat and the fall compensate the short ones.
        assert base.dropped == 3
        assert not base.uniform
        description = " ".join(clock_lines(base))
        for part in ("repeat", "earlier", "missing", "gap"):
            assert part in description
        reported = np.arange(100) == 50  # without a time step
        assert time_base(np.arange(100) * 1e-3, reported).gaps == 1
        with pytest.raises(RecordingError, match="same time stamp"):
            time_base(np.full(5, 3.0))

    def test_samples_of_one_stamp_are_averaged(self):
        time = np.array([0.0, 1.0, 1.0, 2.0, 3.0, 3.0, 3.0])
        torque = np.arange(14.0).reshape(7, 2)
        merged = without_repeats(
            Recording(time=time, position=torque, joint_names=("a", "b"), torque=torque)
        )
        np.testing.assert_array_equal(merged.time, [0.0, 1.0, 2.0, 3.0])
        np.testing.assert_array_equal(merged.position, [[0, 1], [3, 4], [6, 7], [10, 11]])
        even = Recording(np.arange(7.0), torque, ("a", "b"))
        assert without_repeats(even) is even
        with pytest.raises(RecordingError, match="falls back at sample 2"):
            without_repeats(Recording(np.array([0.0, 1.0, 0.5, 2.0]), np.zeros((4, 1)), ("a",)))


def noisy_sines(sigma, *, jitter=0.0):
    """Time and two channels of a few hertz."""
    rng = np.random.default_rng(3)
    time = np.arange(8000) * 1e-3 + jitter * rng.uniform(-1.0, 1.0, 8000)
    return time, sines(time) + sigma * rng.standard_normal((8000, 2))


def sines(time, derivative=0):
    w = 2.0 * np.pi * np.array([[0.7, 1.9], [2.3, 3.1]])
    a = np.array([[0.9, 0.4], [0.2, 0.3]])
    phase = w * time[:, None, None] + a + derivative * np.pi / 2.0
    return np.asarray((a * w**derivative * np.sin(phase)).sum(axis=1))


class TestLowPass:
    def test_it_is_a_zero_phase_butterworth(self):
        # |H|^2 of a third-order Butterworth is 1 / (1 + (w/w_c)^6), the smoother's own gain.
        time, values = noisy_sines(0.1)
        sections = butter(3, 6.0, fs=1000.0, output="sos")
        expected = sosfiltfilt(sections, values, axis=0)
        inner = slice(1000, -1000)
        np.testing.assert_allclose(low_pass(time, values, 6.0)[inner], expected[inner], atol=2e-4)


class TestSmoothingSpline:
    @given(
        coefficients=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
        tolerance=st.floats(1e-12, 1e-2),
        seed=st.integers(0, 2**16),
    )
    def test_parabolas_pass_unchanged(self, coefficients, tolerance, seed):
        # The roughness of a parabola is zero.
        time = np.sort(np.random.default_rng(seed).uniform(0.0, 2.0, 300))
        polynomial = np.polynomial.Polynomial(coefficients)
        spline = fit_smoothing_spline(time, polynomial(time)[:, None], np.array([tolerance]))
        np.testing.assert_allclose(spline(time)[:, 0], polynomial(time), atol=1e-7)
        np.testing.assert_allclose(spline(time, 1)[:, 0], polynomial.deriv()(time), atol=1e-5)
        np.testing.assert_allclose(spline(time, 2)[:, 0], polynomial.deriv(2)(time), atol=1e-3)

    @pytest.mark.parametrize(
        ("sigma", "jitter"), [(1e-6, 0.0), (1e-4, 0.0), (1e-2, 0.0), (1e-4, 4e-4)]
    )
    def test_the_mean_squared_residual_is_the_tolerance(self, sigma, jitter):
        time, values = noisy_sines(sigma, jitter=jitter)
        spline = fit_smoothing_spline(time, values, np.full(2, sigma**2))
        measured = np.mean((values - spline(time)) ** 2, axis=0)
        np.testing.assert_allclose(measured, sigma**2, rtol=1e-3)
        if jitter:
            error = (spline(time, 2) - sines(time, 2))[200:-200]
            assert np.std(error) < 0.01 * np.std(sines(time, 2))

    def test_it_minimises_squares_plus_roughness(self):
        """Small enough for a dense solution by splines and quadrature of SciPy."""
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
                roughness[i, j] = roughness[j, i] = sum(
                    quad(lambda t, i=i, j=j: third(t)[i] * third(t)[j], *knots[p : p + 2])[0]
                    for p in range(max(i, 5), min(j + 6, k))
                )
        density = len(time) / (time[-1] - time[0])
        penalty = density / (2.0 * np.pi * spline.bandwidth[0]) ** 6
        rows = basis(time)
        dense = np.linalg.solve(rows.T @ rows + penalty * roughness, rows.T @ values)
        np.testing.assert_allclose(spline(time)[:, 0], rows @ dense, atol=1e-9)

    def test_derivatives_are_far_better_than_differences(self):
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

    def test_knots_are_refined_to_the_tolerance(self):
        """120 Hz at 1 kHz: one knot per four samples cannot follow, one per sample can."""
        time = np.arange(2000) * 1e-3
        values = np.sin(2.0 * np.pi * 120.0 * time)[:, None]
        spline = fit_smoothing_spline(time, values, np.array([1e-8]))
        assert spline.spacing < 3e-3
        assert np.mean((values - spline(time)) ** 2) <= 1.001e-8


TRUTH = truth()

RESOLUTION = 2e-6  # rad, of the encoders


def smooth_recording(*, noise=0.0, delay=0.0):
    time = np.arange(6000) * 1e-3
    rng = np.random.default_rng(8)
    torque = MODEL.torque(TRUTH, one_sine(time - delay))
    return Recording(
        time=time,
        position=np.round(one_sine(time).position / RESOLUTION) * RESOLUTION,
        joint_names=MODEL.joint_names,
        torque=torque + noise * rng.standard_normal(torque.shape),
    )


QUANTISATION = np.full(2, RESOLUTION**2 / 12.0)


class TestNoise:
    @settings(max_examples=30)
    @given(
        sigma=st.floats(1e-6, 1e-2),
        jitter=st.sampled_from([0.0, 3e-4]),
        seed=st.integers(0, 2**16),
    )
    def test_differences_measure_it(self, sigma, jitter, seed):
        """Not the jitter of the clock."""
        rng = np.random.default_rng(seed)
        time = np.arange(5000) * 1e-3 + jitter * rng.uniform(-1.0, 1.0, 5000)
        values = one_sine(time).position + max(sigma, 0.03 * jitter) * rng.standard_normal(
            (5000, 2)
        )
        variance = difference_variance(time, values)
        np.testing.assert_allclose(np.sqrt(variance), max(sigma, 0.03 * jitter), rtol=0.1)

    @pytest.mark.parametrize("creeps", [False, True])
    def test_variance_at_standstill_is_that_of_the_noise(self, creeps):
        time = np.arange(5000) * 1e-3
        size = np.array([1e-6, 1e-3])
        noise = size * np.random.default_rng(6).standard_normal((5000, 2))
        slip = 3e-4 * (time > 3.0) * (1.0 - np.exp(-(time - 3.0) / 0.2))
        values = 0.4 + creeps * (1e-4 * time + slip)[:, None] + noise
        np.testing.assert_allclose(np.sqrt(standstill_variance(time, values)), size, rtol=0.1)

    @pytest.mark.parametrize("measure", [standstill_variance, difference_variance])
    def test_a_few_samples_show_none(self, measure):
        with pytest.raises(RecordingError, match=r"requires .* samples, got 3"):
            measure(np.arange(3.0), np.zeros((3, 1)))
        assert noiseless_above(np.arange(3.0), np.zeros((3, 1)), [slice(0, 3)]) is None

    @pytest.mark.parametrize(
        ("logged", "measured"),
        [
            (lambda angle, noise: angle + 1e-5 * noise, True),
            (lambda angle, noise: angle, False),
            (lambda angle, noise: angle.astype(np.float32).astype(float), False),
            (lambda angle, noise: np.round(angle, 4), False),
            (lambda angle, noise: angle + 1e-5 * lfilter([0.02], [1.0, -0.98], noise, 0), False),
        ],
        ids=["encoder", "computed", "single precision", "four decimals", "low-passed noise"],
    )
    def test_small_noise_of_an_encoder_is_none_of_arithmetic(self, logged, measured):
        """Of chirps, whose fastest part is weak but larger than the noise."""
        time = np.arange(20000) * 1e-3
        chirp = np.sin(2.0 * np.pi * (0.1 + 0.1 * time) * time) * np.exp(-0.5 * time)
        angle = np.column_stack([chirp + 1.5 * np.sin(time), chirp + 1.5 * np.cos(time)])
        noise = np.random.default_rng(7).standard_normal(angle.shape)
        angle = logged(angle, noise)
        above = noiseless_above(time, angle, [slice(0, len(time))])
        assert above is not None
        assert has_small_noise(time, angle, [slice(0, len(time))], above) == measured

    @pytest.mark.parametrize(
        ("step", "hidden"), [(1e-3, 1e-3), (1e-4, 1e-4), (1e-6, None), (None, None)]
    )
    def test_coarse_steps_hide_noise(self, step, hidden):
        """Steps below the noise of the encoder do not, and finer ones than any encoder's."""
        time = np.arange(0.0, 20.0, 0.004)
        angle = np.column_stack([np.sin(1.1 * time), np.cos(1.7 * time)])
        angle += 2e-5 * np.random.default_rng(7).standard_normal(angle.shape)
        if step is not None:
            angle = step * np.round(angle / step)
        found = hidden_by_rounding(time, angle, [slice(0, len(time))])
        assert found == (None if hidden is None else pytest.approx(hidden))


class TestSamples:
    def test_smoothed_motion_is_accurate_in_usable_rows(self):
        recording = smooth_recording()
        samples = prepare(recording, MODEL, noise_variance=QUANTISATION)
        exact = one_sine(recording.time).columns()
        for name in ("position", "velocity", "acceleration"):
            error = (samples.motion.columns()[name] - exact[name])[samples.usable.all(axis=1)]
            assert np.sqrt(np.mean(error**2)) < 2e-3 * np.std(exact[name])

    def test_derivatives_do_not_cross_a_gap(self):
        whole = smooth_recording()
        keep = np.r_[0:2000, 2300:6000]
        gap = np.zeros(len(keep), dtype=bool)
        gap[2000] = True
        # Time that continues through a gap: only the flag reports it.
        gapped = replace(
            whole,
            time=whole.time[: len(keep)],
            position=whole.position[keep],
            torque=whole.torque[keep],
            gap_before=gap,
        )
        samples = prepare(gapped, MODEL, noise_variance=QUANTISATION)
        exact = one_sine(whole.time).rows(keep)
        rows = samples.usable.all(axis=1)
        assert not samples.usable[1995:2005].any()
        assert np.abs(samples.motion.velocity - exact.velocity)[rows].max() < 0.02
        unflagged = prepare(replace(gapped, gap_before=None), MODEL, noise_variance=QUANTISATION)
        assert np.abs(unflagged.motion.velocity - exact.velocity)[1995:2005].max() > 1.0

    @pytest.mark.parametrize("delay", [0.004, -0.0025])
    def test_a_known_torque_delay_is_compensated(self, delay):
        recording = smooth_recording(delay=delay)

        def worst(assumed):
            options = Preprocessing(torque_delay=assumed)
            samples = prepare(recording, MODEL, noise_variance=QUANTISATION, options=options)
            error = samples.torque - samples.predicted_torque(MODEL, TRUTH)
            moving = np.abs(samples.motion.velocity) > 0.1  # away from reversals
            return float(np.abs(error[samples.usable & moving]).max())

        assert worst(delay) < 0.1
        assert worst(0.0) > 5 * worst(delay)

    def test_a_torque_low_pass_cancels_with_the_regressor(self):
        recording = smooth_recording()
        # Filtered by a zero-phase Butterworth filter, not by the smoother.
        logged = sosfiltfilt(butter(3, 4.0, fs=1000.0, output="sos"), recording.torque, axis=0)

        def misfit(options):
            samples = prepare(
                replace(recording, torque=logged),
                MODEL,
                noise_variance=QUANTISATION,
                options=options,
            )
            error = samples.torque - samples.predicted_torque(MODEL, TRUTH)
            return float(np.sqrt(np.mean(error[1000:-1000] ** 2)))

        assert misfit(Preprocessing(torque_bandwidth=4.0)) < 0.05 * misfit(Preprocessing())

    def test_the_torque_is_smoothed_to_its_noise(self):
        """The default bandwidth of `--method paper`."""
        recording = smooth_recording(noise=0.5)
        options = Preprocessing(smooth_torque=True)
        samples = prepare(recording, MODEL, noise_variance=QUANTISATION, options=options)
        exact = MODEL.torque(TRUTH, one_sine(recording.time))
        rows = samples.usable.all(axis=1)
        noise = np.std((samples.torque - exact)[rows], axis=0)
        assert (noise < 0.15).all()

    def test_measured_velocities_are_used(self):
        recording = smooth_recording()
        exact = one_sine(recording.time)
        rows = recording.time < 3.0  # and a segment too short to smooth
        gaps = np.isin(np.arange(6000), [3000, 3002])
        recording = replace(recording, velocity=exact.velocity + 0.1, gap_before=gaps)
        options = Preprocessing(velocity="measured")
        smoothed = prepare(recording, MODEL, noise_variance=QUANTISATION, options=options).motion
        inner = np.flatnonzero(rows)[9:-9]
        np.testing.assert_allclose(smoothed.velocity[inner], exact.velocity[inner] + 0.1, atol=0.01)
        assert not smoothed.velocity[3000:3002].any()

    def test_a_constant_torque_of_a_joint_that_moves_is_not_measured(self):
        recording = smooth_recording()
        torque = recording.torque.copy()
        torque[:, 1] = 0.37
        samples = prepare(replace(recording, torque=torque), MODEL)
        assert not samples.usable[:, 1].any()
        assert samples.usable[:, 0].any()

    def test_no_acceleration_near_an_end_is_an_outlier(self):
        """Its first velocities are far from the slope of the positions."""
        recording = smooth_recording()
        exact = one_sine(recording.time)
        velocity = exact.velocity.copy()
        velocity[:4] += np.array([[5.0], [2.0], [1.0], [0.5]])
        recording = replace(recording, velocity=velocity)
        options = Preprocessing(velocity="measured")
        smoothed = prepare(recording, MODEL, noise_variance=QUANTISATION, options=options).motion
        for name in ("velocity", "acceleration"):
            largest = np.abs(getattr(exact, name)).max(axis=0)
            assert (np.abs(getattr(smoothed, name)) < 2.2 * largest).all()

    def test_invalid_recordings_and_bandwidths_raise(self):
        valid = smooth_recording()
        with pytest.raises(RecordingError, match="no joint torque"):
            prepare(replace(valid, torque=None), MODEL)
        with pytest.raises(RecordingError, match="order"):
            prepare(replace(valid, joint_names=("elbow", "shoulder")), MODEL)
        with pytest.raises(ValueError, match="positive"):
            Preprocessing(torque_bandwidth=0.0)


TIME = np.arange(4000) * 1e-3
EVERYWHERE = np.ones((1, 1), dtype=np.bool_)


SLIDING = RobotModel.from_urdf(URDF, friction=FrictionLaw(standstill=0.05))


def rows_at_reversals(speed):
    """Return the rows (m,) within half of `REVERSAL_SECONDS` of a change of sign, or beside it."""
    last = np.flatnonzero(speed[1:] * speed[:-1] < 0.0)
    reach = max(0.0, 0.5 * (REVERSAL_SECONDS - (TIME[1] - TIME[0])))
    rows = np.zeros(len(TIME), dtype=np.bool_)
    for begin, end in zip(TIME[last] - reach, TIME[last + 1] + reach, strict=True):
        rows[(begin <= TIME) & (end >= TIME)] = True
    return rows


def motion_and_recording(clip=np.inf):
    rate = np.array([2.0, 3.1])
    rng = np.random.default_rng(2)
    angle = rate * TIME[:, None] + 0.4
    motion = sine_motion(TIME, np.ones(2), rate, np.full(2, 0.4))
    torque = 20.0 * np.sin(angle * 1.7) + 0.2 * rng.standard_normal(angle.shape)
    return motion, Recording(
        time=TIME,
        position=motion.position + 1e-6 * rng.standard_normal(angle.shape),
        joint_names=SLIDING.joint_names,
        torque=np.clip(torque, -clip, clip),
    )


class TestClipping:
    def test_clipped_torque_is_found(self):
        _, whole = motion_and_recording()
        _, clipped = motion_and_recording(clip=15.0)
        true = np.abs(whole.torque) > 15.0
        clipped_rows = flat_topped(clipped.torque, EVERYWHERE)
        assert not np.any(clipped_rows & ~true)
        # Noise interrupts the limit; short runs are not detected.
        assert np.count_nonzero(clipped_rows) > 0.9 * np.count_nonzero(true)
        assert not flat_topped(whole.torque, EVERYWHERE).any()

    @given(
        resolution=st.sampled_from([1.0, 0.1, 0.01]),
        rate=st.floats(0.5, 20.0),
        phase=st.floats(0.0, 6.0),
    )
    def test_a_coarse_smooth_peak_is_not_clipped(self, resolution, rate, phase):
        smooth = np.round(20.0 * np.sin(rate * TIME + phase) / resolution) * resolution
        assert not flat_topped(smooth[:, None], EVERYWHERE).any()

    def test_a_constant_channel_at_rest_is_not_clipped(self):
        channel = np.concatenate([np.full(500, 12.0), 12.0 * np.cos(TIME[:2000] * 4.0)])[:, None]
        moving = np.arange(len(channel))[:, None] > 500
        assert not flat_topped(channel, moving).any()
        assert not flat_topped(np.full((100, 1), 3.0), EVERYWHERE).any()


class TestExcludedRows:
    def test_each_has_a_reason(self):
        motion, recording = motion_and_recording(clip=15.0)
        mask = mask_rows(recording, SLIDING, motion, np.full(2, 40.0))
        reasons = np.any(list(mask.reasons.values()), axis=0)
        np.testing.assert_array_equal(mask.usable, ~reasons)
        lost = np.sum(list(mask.counts.values()), axis=0)
        np.testing.assert_array_equal(lost + mask.usable.sum(axis=0), len(TIME))
        for reason in (
            RowReason.EDGE,
            RowReason.STANDSTILL,
            RowReason.REVERSAL,
            RowReason.SATURATED,
        ):
            assert np.all(mask.counts[reason] > 0)

    def still(self, *joints):
        """Masks of a motion in which joints stand for half of the time."""
        motion, recording = motion_and_recording()
        halt = np.zeros(len(TIME), dtype=np.bool_)
        halt[len(TIME) // 4 : 3 * len(TIME) // 4] = True
        for joint in joints:
            motion.velocity[halt, joint] = 0.0
        masks = {
            rows: mask_rows(recording, SLIDING, motion, np.full(2, 40.0), exclude_rows=rows)
            for rows in ("rests", "halts", "slow", "none")
        }
        return halt, masks

    def test_a_joint_that_stands_while_another_moves_holds_its_load(self):
        halt, masks = self.still(1)
        assert not masks["rests"].reasons[RowReason.REST].any()
        assert masks["rests"].usable[halt, 1].all()
        assert masks["halts"].reasons[RowReason.REST][halt, 1].all()
        assert not masks["halts"].reasons[RowReason.REST][:, 0].any()
        assert masks["slow"].reasons[RowReason.STANDSTILL][halt, 1].all()

    def test_a_rest_of_the_whole_arm_is_left_out(self):
        halt, masks = self.still(0, 1)
        assert masks["rests"].reasons[RowReason.REST][halt].all()
        assert masks["none"].usable[halt].all()
        # A reversal of one joint is none.
        assert not masks["rests"].reasons[RowReason.REST][~halt].any()

    def test_rests_exclude_two_rows_at_a_reversal_of_a_moving_joint(self):
        """A motion as noise turns it: what a standing joint holds is its load."""
        motion, recording = motion_and_recording()
        halt = np.zeros(len(TIME), dtype=np.bool_)
        halt[len(TIME) // 4 : 3 * len(TIME) // 4] = True
        motion.velocity[halt, 1] = 1e-6 * (-1.0) ** np.arange(np.count_nonzero(halt))
        mask = mask_rows(recording, SLIDING, motion, np.full(2, 40.0), exclude_rows="rests")
        turning = rows_at_reversals(motion.velocity[:, 0])
        assert turning.any()
        np.testing.assert_array_equal(mask.reasons[RowReason.REVERSAL][:, 0], turning)
        assert not mask.reasons[RowReason.REVERSAL][halt, 1].any()

    def test_halts_exclude_two_rows_at_a_reversal(self):
        motion, recording = motion_and_recording()
        mask = mask_rows(recording, SLIDING, motion, np.full(2, 40.0), exclude_rows="halts")
        for joint, speed in enumerate(motion.velocity.T):
            turning = rows_at_reversals(speed)
            assert turning.any()
            np.testing.assert_array_equal(mask.reasons[RowReason.REVERSAL][:, joint], turning)

    @pytest.mark.parametrize("clock", [0.0, 12.3, 1.7e9])
    @pytest.mark.parametrize("rate", [50.0, SELECTION_RATE, 200.0, 2.0 * SELECTION_RATE, 1000.0])
    def test_a_reversal_excludes_as_much_time_at_any_rate(self, rate, clock):
        since = np.arange(0.0, 2.0, 1.0 / rate)
        time = clock + since
        position = np.stack((np.sin(3.0 * since), np.cos(3.0 * since)), axis=1)
        velocity = 3.0 * np.stack((np.cos(3.0 * since), -np.sin(3.0 * since)), axis=1)
        motion = Motion(time, position, velocity, -9.0 * position)
        recording = Recording(
            time=time, position=position, joint_names=SLIDING.joint_names, torque=position
        )
        mask = mask_rows(recording, SLIDING, motion, np.full(2, 40.0), exclude_rows="rests")
        at = since[mask.reasons[RowReason.REVERSAL][:, 0]]
        assert REVERSAL_SECONDS == 2.0 / SELECTION_RATE
        for turn in (np.pi / 6.0, np.pi / 2.0):
            around = at[np.abs(at - turn) < 0.1]
            assert len(around) == max(2, 2 * round(0.5 * REVERSAL_SECONDS * rate))
            assert around.mean() == pytest.approx(turn, abs=1.01 / rate)

    @pytest.mark.parametrize("friction", [True, False])
    def test_reversals_of_coupled_motors_are_excluded(self, friction):
        turns = np.array([[1.0, 0.0], [-0.8, 1.0]])
        model = RobotModel.from_urdf(
            URDF, friction=FrictionLaw(standstill=0.05), coupling=Coupling(turns, friction=friction)
        )
        motion, recording = motion_and_recording()
        reversals = mask_rows(recording, model, motion, np.array([40.0, 20.0])).reasons[
            RowReason.REVERSAL
        ]
        motor = motion.velocity @ turns[1]
        assert model.friction.motors == ((1,) if friction else ())

        def beside(speed, reach):
            at = TIME[:-1][speed[1:] * speed[:-1] < 0.0]
            assert len(at)
            return np.asarray(np.abs(TIME[:, None] - at).min(axis=1) <= reach)

        # By the bandwidth of the slower joint; the joints' own reversals as usual.
        for joint, reach in enumerate((1.0 / 40.0, 1.0 / 20.0)):
            joint_reversals = beside(motion.velocity[:, joint], reach)
            expected = joint_reversals | beside(motor, 1.0 / 20.0) if friction else joint_reversals
            apart = np.flatnonzero(expected != reversals[:, joint])
            # Except the sample at the edge.
            assert len(apart) <= 2 * np.count_nonzero(np.diff(expected))
            assert np.count_nonzero(expected) > 10 * len(apart)
            assert (np.count_nonzero(expected & ~joint_reversals) > 50) == friction

    @pytest.mark.parametrize("delay", [-0.08, 0.0, 0.08])
    def test_delayed_rows_near_an_edge_are_excluded(self, delay):
        """The motion `delay` earlier must be known and away from an end."""
        _, recording = motion_and_recording()
        samples = prepare(recording, SLIDING, options=Preprocessing(torque_delay=delay))
        end = min(MAX_END_SECONDS, END_PERIODS / float(samples.position_bandwidth.min()))
        read = recording.time - delay
        inside = (read >= recording.time[0] + end) & (read <= recording.time[-1] - end)
        np.testing.assert_array_equal(samples.mask.reasons[RowReason.EDGE][:, 0], ~inside)
        assert not samples.usable[~inside].any()

    def test_edges_of_gaps_and_short_segments_are_excluded(self):
        motion, recording = motion_and_recording()
        gap = np.zeros(len(TIME), dtype=np.bool_)
        gap[[2000, 2040]] = True
        gapped = Recording(
            time=TIME, position=recording.position, joint_names=SLIDING.joint_names, gap_before=gap
        )
        rows = mask_rows(gapped, SLIDING, motion, np.full(2, 40.0)).reasons[RowReason.EDGE][:, 0]
        assert rows[1950:2090].all()
        assert not rows[100:1940].any()
        assert not rows[2100:3900].any()

    def test_rows_at_the_current_limit_are_excluded(self):
        motion, recording = motion_and_recording()
        driven = replace(recording, motor_current=recording.torque, torque=None)
        limit = np.array([18.0, 100.0])
        mask = mask_rows(driven, SLIDING, motion, np.full(2, 40.0), current_limit=limit)
        saturated = mask.reasons[RowReason.SATURATED]
        np.testing.assert_array_equal(saturated[:, 0], np.abs(driven.motor_current[:, 0]) >= 17.91)
        assert not saturated[:, 1].any()


def test_torque_that_stands_out_alone_is_left_out() -> None:
    """One or two samples beyond the range of the channel; no step, and no noise."""
    random = np.random.default_rng(0)
    time = np.arange(0.0, 8.0, 0.004)
    torque = 10.0 * np.sin(2.0 * time) + 3.0 * np.sign(np.cos(2.0 * time))
    torque += 0.3 * random.normal(size=len(time))
    clean = np.column_stack([torque, torque])
    spoilt = clean.copy()
    rows = np.array([200, 201, 777, 1500])
    spoilt[rows, 1] += [40.0, 35.0, -60.0, 45.0]
    segments = [slice(0, 1000), slice(1000, len(time))]
    assert not spiking(clean, segments).any()
    found = spiking(spoilt, segments)
    assert not found[:, 0].any()
    assert np.flatnonzero(found[:, 1]).tolist() == rows.tolist()
    pulse = clean.copy()
    pulse[900:907] += np.array([[9.0, 36.0, 47.0, 40.0, -24.0, -20.0, -9.0]]).T
    assert not spiking(pulse, segments).any()
    lasting = clean.copy()
    lasting[900:950] += 40.0
    assert not spiking(lasting, segments).any()
