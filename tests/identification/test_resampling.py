from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.signals.clock import time_base
from identification.signals.recording import Recording, RecordingError
from identification.signals.resampling import resample, without_repeats

Array = NDArray[np.float64]


def a_recording(time: Array, gap: NDArray[np.bool_] | None = None) -> Recording:
    phase = np.array([0.2, 1.0])
    command = np.sin(3.0 * time[:, None] + phase)
    return Recording(
        time=time,
        position=command,
        joint_names=("a", "b"),
        torque=10.0 * np.cos(3.0 * time[:, None] + phase),
        motor_current=np.sign(np.sin(5.0 * time[:, None] + phase)),
        commanded_position=command.copy(),
        gap_before=gap,
    )


@pytest.mark.parametrize("rate", [100.0, 125.0, 1000.0, 5000.0])
def test_an_even_clock_is_uniform_and_needs_nothing(rate: float) -> None:
    base = time_base(1.7e9 + np.arange(2000) / rate)  # seconds since 1970, as ROS stamps
    assert base.uniform
    assert base.rate == pytest.approx(rate, rel=1e-4)
    assert (base.repeated, base.backward, base.dropped, base.gaps) == (0, 0, 0, 0)
    assert len(base.describe()) == 1


def test_jitter_is_measured_against_the_usual_step() -> None:
    rng = np.random.default_rng(1)
    steps = 0.002 * (1.0 + 0.2 * rng.uniform(-1.0, 1.0, 20000))
    base = time_base(np.cumsum(steps))
    assert base.jitter == pytest.approx(0.2 / np.sqrt(3.0), rel=0.02)
    assert base.largest_deviation == pytest.approx(0.2, rel=0.02)
    assert not base.uniform
    assert "uneven" in base.describe()[1]


@pytest.mark.parametrize("seed", range(5))
def test_stamps_that_come_late_are_not_taken_for_missing_samples(seed: int) -> None:
    random = np.random.default_rng(seed)
    late = 0.01 * (np.arange(4000) + random.uniform(-0.3, 0.3, 4000))
    lost = np.sort(random.choice(np.arange(100, 3900, 40), 25, replace=False))

    whole, torn = time_base(late), time_base(np.delete(late, lost))

    assert whole.dropped == 0
    assert torn.dropped == 25
    assert whole.rate == pytest.approx(100.0, rel=1e-3)
    assert torn.rate == pytest.approx(100.0, rel=1e-3)


def test_repeats_falls_drops_and_gaps_are_counted_apart() -> None:
    index = np.arange(1000.0)
    index[100] = index[99]  # repeats
    index[200] = index[199] - 0.5  # falls back
    index = np.delete(index, [300, 301, 400])  # two and one samples missing
    index[600:] += 50.0  # a gap
    base = time_base(index * 1e-3)
    assert (base.repeated, base.backward, base.gaps) == (1, 1, 1)
    # The long steps after the repeat and the fall make up for the short ones: nothing is missing.
    assert base.dropped == 3
    assert not base.uniform
    words = " ".join(base.describe())
    for part in ("repeat", "older", "missing", "gaps", "resampled"):
        assert part in words


def test_a_reported_gap_counts_although_the_clock_runs_on() -> None:
    gap = np.zeros(100, dtype=np.bool_)
    gap[50] = True
    assert time_base(np.arange(100) * 1e-3, gap).gaps == 1


def test_a_clock_that_stands_still_is_refused() -> None:
    with pytest.raises(RecordingError, match="stands still"):
        time_base(np.full(5, 3.0))


def test_samples_of_one_stamp_become_their_mean() -> None:
    time = np.array([0.0, 1.0, 1.0, 2.0, 3.0, 3.0, 3.0])
    recording = a_recording(time)
    assert recording.torque is not None
    torque = np.arange(14.0).reshape(7, 2)
    merged = without_repeats(
        Recording(time=time, position=torque, joint_names=("a", "b"), torque=torque)
    )
    np.testing.assert_array_equal(merged.time, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(merged.position, [[0, 1], [3, 4], [6, 7], [10, 11]])
    even = a_recording(np.arange(5.0))
    assert without_repeats(even) is even


def test_a_clock_that_falls_back_is_not_put_in_order() -> None:
    with pytest.raises(RecordingError, match="falls back at sample 2"):
        without_repeats(a_recording(np.array([0.0, 1.0, 0.5, 2.0])))


@settings(max_examples=25)
@given(st.integers(0, 1000), st.sampled_from([0.01, 0.002, 0.0002]))
def test_resampled_positions_are_those_of_the_motion(seed: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    time = 5.0 + np.cumsum(step * rng.uniform(0.6, 1.4, 1500))
    there = resample(a_recording(time), step)
    assert there.torque is not None
    assert time_base(there.time).uniform
    exact = a_recording(there.time)
    assert exact.torque is not None
    inner = slice(5, -5)
    assert np.abs(there.position - exact.position)[inner].max() < 1e-4 * (step / 0.002) ** 3 + 1e-9
    assert np.abs(there.torque - exact.torque)[inner].max() < 1e-2 * (step / 0.002) ** 2 + 1e-6


def test_uniform_samples_stay_what_they_are() -> None:
    recording = a_recording(np.arange(500) * 0.004)
    same = resample(recording)
    np.testing.assert_allclose(same.time, recording.time, atol=1e-12)
    np.testing.assert_allclose(same.position, recording.position, atol=1e-9)


def test_a_step_of_the_current_does_not_overshoot() -> None:
    rng = np.random.default_rng(3)
    there = resample(a_recording(np.cumsum(0.002 * rng.uniform(0.7, 1.3, 2000))))
    assert there.motor_current is not None
    assert np.abs(there.motor_current).max() <= 1.0 + 1e-12


def test_nothing_is_made_up_across_a_gap() -> None:
    time = np.arange(1000) * 1e-3
    time[400:] += 0.0377
    gap = np.zeros(1000, dtype=np.bool_)
    gap[700] = True
    there = resample(a_recording(time, gap))
    assert [part.start for part in there.segments()] == [0, 400, 700]
    assert not np.any((there.time > 0.3991) & (there.time < 0.4376))
    exact = np.sin(3.0 * there.time[:, None] + np.array([0.2, 1.0]))
    np.testing.assert_allclose(there.position, exact, atol=1e-9)


def test_a_missing_command_stays_missing() -> None:
    recording = a_recording(np.arange(100) * 1e-2)
    assert recording.commanded_position is not None
    recording.commanded_position[:10] = np.nan
    there = resample(recording, 0.004)
    assert there.commanded_position is not None
    known = np.isfinite(there.commanded_position).all(axis=1)
    np.testing.assert_array_equal(known, there.time >= 0.1 - 1e-9)


@pytest.mark.parametrize("step", [0.0, -0.001, 0.0021])
def test_a_step_that_would_alias_is_refused(step: float) -> None:
    with pytest.raises(ValueError, match="low-pass first"):
        resample(a_recording(np.arange(100) * 1e-3), step)
