"""Recordings: checks, clock statistics, and repetitions recognised from positions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.errors import ShapeError
from identification.signals.clock import time_base
from identification.signals.recording import (
    Recording,
    RecordingError,
    offsets_of_repetitions,
    without_repeats,
)

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
    def test_a_valid_recording_is_unchanged(self):
        recording = a_recording()
        assert recording.checked(NAMES) is recording

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
        ("recording", "words"),
        [
            (leaping(50, np.nan), "time is nan at sample 50"),
            (leaping(50, 0.0), "repeats at sample 50"),
            (leaping(50, -5e-3), "falls back at sample 50"),
            (leaping(50, 601.0), r"time step is .* at sample 50, limit .* cut the recording"),
            (leaping(50, 2e9), r"time step is .* at sample 50, limit .* cut the recording"),
            (changed("position", slice(None), 1, None), "elbow is stuck.* from sample 0 on"),
            (changed("position", slice(120, None), 2, 0.3), "wrist is stuck.* from sample 120 on"),
            (a_recording(1), "has 1 samples"),
        ],
    )
    def test_invalid_recordings_raise(self, recording, words):
        with pytest.raises(RecordingError, match=words):
            recording.checked()

    @pytest.mark.parametrize(
        "recording",
        [
            changed("commanded_position", slice(20, 30), 1, np.nan),
            replace(changed("position", slice(None), 1, 0.3), commanded_position=RESTING),
            leaping(50, 599.0),
            replace(a_recording(commanded=False), position=np.full((200, 3), 0.3)),
        ],
        ids=["cycles without a set-point", "commanded to rest", "a long pause", "standstill"],
    )
    def test_valid_recordings_pass(self, recording):
        assert recording.checked() is recording

    def test_a_constant_reading_must_be_declared(self):
        recording = replace(changed("position", slice(None), 0, 0.3), commanded_position=None)
        with pytest.raises(RecordingError, match=r"shoulder is stuck.*declare it as held"):
            recording.checked()
        replace(recording, held_joints=("shoulder",)).checked()

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

    def test_arrays_of_other_shapes_raise(self):
        recording = a_recording()
        with pytest.raises(ShapeError, match="torque"):
            replace(recording, torque=recording.torque[:-1])
        with pytest.raises(ShapeError, match="gap_before"):
            replace(recording, gap_before=np.zeros(3, dtype=bool))

    def test_a_motion_starts_with_its_command(self):
        recording = a_recording()
        command = recording.commanded_position.copy()
        command[:40] = command[40]
        assert replace(recording, commanded_position=command).motion_start == recording.time[41]
        command[:10] = np.nan
        assert replace(recording, commanded_position=command).motion_start == recording.time[41]
        assert a_recording(commanded=False).motion_start == 0.0


STEP = 2e-3


def recorded(seed, *, start=0.0, clock=0.0, pace=1.0, noise=0):
    """Return eight seconds of a motion from `start`, with a clock offset [s]."""
    rng = np.random.default_rng(seed)
    amplitude, rate = rng.uniform(0.2, 1.0, (3, 2)), rng.uniform(0.5, 3.0, (3, 2))
    time = start + STEP * np.arange(4000)
    angle = pace * rate * time[:, None, None] + rng.uniform(0.0, 6.0, (3, 2))
    position = (amplitude * np.sin(angle)).sum(axis=1)
    position += 1e-4 * np.random.default_rng(noise).standard_normal(position.shape)
    return Recording(time=time + clock, position=position, joint_names=("a", "b"))


class TestRepetitions:
    @settings(max_examples=20, deadline=None)
    @given(
        seed=st.integers(0, 50),
        clock=st.floats(-1e3, 1e3),
        start=st.floats(-0.4, 0.4).map(lambda one: round(one / STEP) * STEP),
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
        ],
    )
    def test_other_motions_are_no_repetitions(self, runs):
        assert offsets_of_repetitions(runs) is None


class TestTimeBase:
    @pytest.mark.parametrize("rate", [100.0, 125.0, 1000.0, 5000.0])
    def test_an_even_clock_is_uniform(self, rate):
        base = time_base(1.7e9 + np.arange(2000) / rate)  # seconds since 1970, as ROS stamps
        assert base.uniform
        assert base.rate == pytest.approx(rate, rel=1e-4)
        assert (base.repeated, base.backward, base.dropped, base.gaps) == (0, 0, 0, 0)
        assert len(base.describe()) == 1

    def test_jitter_is_measured_against_the_usual_step(self):
        rng = np.random.default_rng(1)
        steps = 0.002 * (1.0 + 0.2 * rng.uniform(-1.0, 1.0, 20000))
        base = time_base(np.cumsum(steps))
        assert base.jitter == pytest.approx(0.2 / np.sqrt(3.0), rel=0.02)
        assert base.largest_deviation == pytest.approx(0.2, rel=0.02)
        assert not base.uniform
        assert "uneven" in base.describe()[1]

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
        words = " ".join(base.describe())
        for part in ("repeat", "older", "missing", "gaps"):
            assert part in words
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
