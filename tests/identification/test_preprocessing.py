from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from identification.model.coupling import Coupling
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.masks import (
    EDGE,
    END_PERIODS,
    LONGEST_END,
    REVERSAL,
    SATURATED,
    STANDSTILL,
    flat_topped,
    mask_rows,
)
from identification.signals.noise import difference_variance, standstill_variance
from identification.signals.recording import Recording, RecordingError
from identification.signals.samples import Preprocessing, prepare
from tests.identification.two_link import MODEL, URDF, one_sine, sine_motion, truth

TRUTH = truth()

RESOLUTION = 2e-6  # rad, of the encoders


def motion(time):
    return one_sine(time)[1:4]


def a_recording(*, noise=0.0, delay=0.0):
    time = np.arange(6000) * 1e-3
    rng = np.random.default_rng(8)
    torque = MODEL.torque(TRUTH, *motion(time - delay))
    return Recording(
        time=time,
        position=np.round(motion(time)[0] / RESOLUTION) * RESOLUTION,
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
        values = motion(time)[0] + max(sigma, 0.03 * jitter) * rng.standard_normal((5000, 2))
        found = difference_variance(time, values)
        np.testing.assert_allclose(np.sqrt(found), max(sigma, 0.03 * jitter), rtol=0.1)

    @pytest.mark.parametrize("creeps", [False, True])
    def test_variance_at_standstill_is_that_of_the_noise(self, creeps):
        time, size = np.arange(5000) * 1e-3, np.array([1e-6, 1e-3])
        noise = size * np.random.default_rng(6).standard_normal((5000, 2))
        slip = 3e-4 * (time > 3.0) * (1.0 - np.exp(-(time - 3.0) / 0.2))
        values = 0.4 + creeps * (1e-4 * time + slip)[:, None] + noise
        np.testing.assert_allclose(np.sqrt(standstill_variance(time, values)), size, rtol=0.1)

    def test_a_constant_reading_has_no_variance(self):
        assert standstill_variance(np.arange(500) * 1e-3, np.full((500, 1), 0.4))[0] < 1e-40
        with pytest.raises(RecordingError, match="20 samples"):
            standstill_variance(np.arange(19) * 1e-3, np.zeros((19, 2)))


class TestSamples:
    def test_smoothed_motion_is_accurate_in_usable_rows(self):
        recording = a_recording()
        samples = prepare(recording, MODEL, noise_variance=QUANTISATION)
        for smoothed, exact in zip(samples.motion[1:4], motion(recording.time), strict=True):
            error = (smoothed - exact)[samples.usable.all(axis=1)]
            assert np.sqrt(np.mean(error**2)) < 2e-3 * np.std(exact)

    def test_the_torque_is_left_as_measured(self):
        recording = a_recording(noise=0.5)
        assert prepare(recording, MODEL).torque is recording.torque

    def test_derivatives_do_not_cross_a_gap(self):
        whole = a_recording()
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
        exact = [part[keep] for part in motion(whole.time)]
        rows = samples.usable.all(axis=1)
        assert not samples.usable[1995:2005].any()
        assert np.abs(samples.motion.velocity - exact[1])[rows].max() < 0.02
        unflagged = prepare(replace(gapped, gap_before=None), MODEL, noise_variance=QUANTISATION)
        assert np.abs(unflagged.motion.velocity - exact[1])[1995:2005].max() > 1.0

    @pytest.mark.parametrize("delay", [0.004, -0.0025])
    def test_a_known_torque_delay_is_compensated(self, delay):
        recording = a_recording(delay=delay)

        def worst(assumed):
            options = Preprocessing(torque_delay=assumed)
            samples = prepare(recording, MODEL, noise_variance=QUANTISATION, options=options)
            error = samples.torque - samples.predicted_torque(MODEL, TRUTH)
            moving = np.abs(samples.motion.velocity) > 0.1  # away from reversals
            return float(np.abs(error[samples.usable & moving]).max())

        assert worst(delay) < 0.1
        assert worst(0.0) > 5 * worst(delay)

    def test_a_torque_low_pass_cancels_with_the_regressor(self):
        recording = a_recording()
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

    def test_smooth_torque_filters_the_regressor_equally(self):
        recording = a_recording(noise=0.5)
        known = {"noise_variance": QUANTISATION, "torque_variance": np.full(2, 0.25)}
        samples = prepare(recording, MODEL, **known, options=Preprocessing(smooth_torque=True))
        removed = recording.torque - samples.torque
        np.testing.assert_allclose(np.mean(removed**2, axis=0), 0.25, rtol=0.1)
        # The residual contains the noise that the smoother passes.
        error = (samples.torque - samples.predicted_torque(MODEL, TRUTH))[samples.usable]
        assert np.sqrt(np.mean(error**2)) < 0.2

    def test_invalid_recordings_and_bandwidths_raise(self):
        valid = a_recording()
        with pytest.raises(RecordingError, match="no joint torque"):
            prepare(replace(valid, torque=None), MODEL)
        with pytest.raises(RecordingError, match="order"):
            prepare(replace(valid, joint_names=("elbow", "shoulder")), MODEL)
        with pytest.raises(ValueError, match="positive"):
            Preprocessing(torque_bandwidth=0.0)


TIME = np.arange(4000) * 1e-3
EVERYWHERE = np.ones((1, 1), dtype=np.bool_)


SLIDING = RobotModel.from_urdf(URDF, friction=FrictionLaw(standstill=0.05))


def motion_and_recording(clip=np.inf):
    rate, rng = np.array([2.0, 3.1]), np.random.default_rng(2)
    angle, motion = rate * TIME[:, None] + 0.4, sine_motion(TIME, np.ones(2), rate, np.full(2, 0.4))
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
        found = flat_topped(clipped.torque, EVERYWHERE)
        assert not np.any(found & ~true)
        # Noise interrupts the limit; short runs are not detected.
        assert np.count_nonzero(found) > 0.9 * np.count_nonzero(true)
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
        for reason in (EDGE, STANDSTILL, REVERSAL, SATURATED):
            assert np.all(mask.counts[reason] > 0)

    def test_rests_exclude_two_rows_at_a_reversal(self):
        motion, recording = motion_and_recording()
        mask = mask_rows(recording, SLIDING, motion, np.full(2, 40.0), left_out="rests")
        for joint, speed in enumerate(motion.velocity.T):
            last = np.flatnonzero(speed[1:] * speed[:-1] < 0.0)
            assert last.size
            np.testing.assert_array_equal(
                np.flatnonzero(mask.reasons[REVERSAL][:, joint]), np.sort([*last, *(last + 1)])
            )

    @pytest.mark.parametrize("friction", [True, False])
    def test_reversals_of_coupled_motors_are_excluded(self, friction):
        turns = np.array([[1.0, 0.0], [-0.8, 1.0]])
        model = RobotModel.from_urdf(
            URDF, friction=FrictionLaw(standstill=0.05), coupling=Coupling(turns, friction=friction)
        )
        motion, recording = motion_and_recording()
        reversals = mask_rows(recording, model, motion, np.array([40.0, 20.0])).reasons[REVERSAL]
        motor = motion.velocity @ turns[1]
        assert model.friction.motors == ((1,) if friction else ())

        def beside(speed, reach):
            at = TIME[:-1][speed[1:] * speed[:-1] < 0.0]
            assert len(at)
            return np.asarray(np.abs(TIME[:, None] - at).min(axis=1) <= reach)

        # By the bandwidth of the slower joint; the joints' own reversals as usual.
        for joint, reach in enumerate((1.0 / 40.0, 1.0 / 20.0)):
            own = beside(motion.velocity[:, joint], reach)
            expected = own | beside(motor, 1.0 / 20.0) if friction else own
            apart = np.flatnonzero(expected != reversals[:, joint])
            # Except the sample at the edge.
            assert len(apart) <= 2 * np.count_nonzero(np.diff(expected))
            assert np.count_nonzero(expected) > 10 * len(apart)
            assert (np.count_nonzero(expected & ~own) > 50) == friction

    @pytest.mark.parametrize("delay", [-0.08, 0.0, 0.08])
    def test_delayed_rows_near_an_edge_are_excluded(self, delay):
        """The motion `delay` earlier must be known and away from an end."""
        _, recording = motion_and_recording()
        samples = prepare(recording, SLIDING, options=Preprocessing(torque_delay=delay))
        end = min(LONGEST_END, END_PERIODS / float(samples.position_bandwidth.min()))
        read = recording.time - delay
        inside = (read >= recording.time[0] + end) & (read <= recording.time[-1] - end)
        np.testing.assert_array_equal(samples.mask.reasons[EDGE][:, 0], ~inside)
        assert not samples.usable[~inside].any()

    def test_edges_of_a_low_passed_torque_are_excluded(self):
        _, recording = motion_and_recording()
        samples = prepare(recording, SLIDING, options=Preprocessing(torque_bandwidth=10.0))
        beside = recording.time < recording.time[0] + END_PERIODS / 10.0
        assert not samples.usable[beside].any()
        assert samples.usable[recording.time > recording.time[0] + LONGEST_END][:100].any()

    def test_edges_of_gaps_and_short_segments_are_excluded(self):
        motion, recording = motion_and_recording()
        gap = np.zeros(len(TIME), dtype=np.bool_)
        gap[[2000, 2040]] = True
        gapped = Recording(
            time=TIME, position=recording.position, joint_names=SLIDING.joint_names, gap_before=gap
        )
        rows = mask_rows(gapped, SLIDING, motion, np.full(2, 40.0)).reasons[EDGE][:, 0]
        assert rows[1950:2090].all()
        assert not rows[100:1940].any()
        assert not rows[2100:3900].any()

    def test_rows_at_the_current_limit_are_excluded(self):
        motion, recording = motion_and_recording()
        driven = replace(recording, motor_current=recording.torque, torque=None)
        limit = np.array([18.0, 100.0])
        mask = mask_rows(driven, SLIDING, motion, np.full(2, 40.0), current_limit=limit)
        saturated = mask.reasons[SATURATED]
        np.testing.assert_array_equal(saturated[:, 0], np.abs(driven.motor_current[:, 0]) >= 17.91)
        assert not saturated[:, 1].any()
