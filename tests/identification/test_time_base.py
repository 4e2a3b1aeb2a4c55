"""Clocks of recordings: even, uneven, with repeats, drops and gaps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.signals.clock import time_base
from identification.signals.recording import Recording, RecordingError, without_repeats

Array = NDArray[np.float64]


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
    torque = np.arange(14.0).reshape(7, 2)
    merged = without_repeats(
        Recording(time=time, position=torque, joint_names=("a", "b"), torque=torque)
    )
    np.testing.assert_array_equal(merged.time, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(merged.position, [[0, 1], [3, 4], [6, 7], [10, 11]])
    even = Recording(np.arange(7.0), torque, ("a", "b"))
    assert without_repeats(even) is even


def test_a_clock_that_falls_back_is_not_put_in_order() -> None:
    with pytest.raises(RecordingError, match="falls back at sample 2"):
        without_repeats(Recording(np.array([0.0, 1.0, 0.5, 2.0]), np.zeros((4, 1)), ("a",)))
