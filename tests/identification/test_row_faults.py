"""Rows that are not of one motion: frozen, written twice, or of another motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.signals.messages import faults_words
from identification.signals.recording import Recording
from identification.signals.row_faults import RowFault, RowFaultKind, by_kind, without_faulty_rows
from identification.signals.sample_times import true_times

Floats = NDArray[np.float64]
RATE = 250
COUNT = 2000
NAMES = ("a", "b", "c")


def moving(seed: int = 0, count: int = COUNT, noise: float = 2e-5, rest: float = 0.0) -> Recording:
    """A motion of sines from rest to rest, quantised like an encoder of 2e-6 rad."""
    random = np.random.default_rng(seed)
    time = np.arange(count) / RATE
    span = max(time[-1] - 2.0 * rest, 1.0)
    phase = np.clip((time - rest) / span, 0.0, 1.0)
    ramp = np.sin(np.pi * phase) ** 2
    frequency = random.uniform(0.2, 0.9, (3, len(NAMES)))
    position = np.zeros((count, len(NAMES)))
    for row in frequency:
        angles = 2.0 * np.pi * time[:, None] * row + random.uniform(0.0, 6.0, len(NAMES))
        position += ramp[:, None] * np.sin(angles) * random.uniform(0.2, 0.5, len(NAMES))
    position += noise * random.standard_normal(position.shape)
    position = np.round(position / 2e-6) * 2e-6
    torque = np.round(30.0 * np.cos(position) + 0.1 * random.standard_normal(position.shape), 3)
    return Recording(time, position, NAMES, torque=torque)


def with_rows(recording: Recording, order: NDArray[np.intp]) -> Recording:
    """Return rows in another order, at the times of a clock that goes on."""
    time = np.arange(len(order)) / RATE
    return replace(recording.rows(order), time=time)  # type: ignore[arg-type]


class TestSoundRecordings:
    @settings(max_examples=30, deadline=None)
    @given(
        seed=st.integers(0, 10_000),
        noise=st.sampled_from([0.0, 1e-6, 1e-4]),
        rest=st.floats(0.0, 2.0),
        held=st.integers(1, 12),
    )
    def test_nothing_is_found(self, seed: int, noise: float, rest: float, held: int) -> None:
        """Nor where a slower channel holds each sample for some rows, or the arm rests."""
        recording = moving(seed, noise=noise, rest=rest)
        rows = np.arange(COUNT) // held * held
        held_rows = with_rows(recording, rows)
        sound, faults = without_faulty_rows(held_rows)
        assert faults == ()
        assert sound is held_rows

    def test_rows_that_are_missing_are_no_jump(self) -> None:
        recording = moving()
        lost = np.random.default_rng(1).random(COUNT) > 0.05
        assert without_faulty_rows(recording.rows(lost))[1] == ()

    def test_the_jump_of_one_encoder_is_left_to_its_check(self) -> None:
        recording = moving()
        position = recording.position.copy()
        position[700:, 1] += 0.4
        assert without_faulty_rows(replace(recording, position=position))[1] == ()


class TestFrozenLogger:
    @pytest.mark.parametrize("first", [300, 900, 1500])
    def test_a_second_is_left_out(self, first: int) -> None:
        rows = np.arange(COUNT)
        rows[first : first + RATE] = first
        sound, (fault,) = without_faulty_rows(with_rows(moving(), rows))
        assert fault.kind is RowFaultKind.FROZEN
        assert fault.rows == RATE - 1
        assert fault.time == pytest.approx((first + 1) / RATE)
        assert sound.n_samples == COUNT - fault.rows
        assert [part.start for part in sound.segments()] == [0, first + 1]

    def test_an_arm_that_rests_is_not_frozen(self) -> None:
        recording = moving(noise=0.0, rest=1.0)
        torque = np.round(recording.torque, 1) if recording.torque is not None else None
        assert without_faulty_rows(replace(recording, torque=torque))[1] == ()


class TestDisplacedRows:
    @pytest.mark.parametrize("rows", [1, 3, 5, 60, 900])
    @pytest.mark.parametrize("size", [0.02, -0.3])
    def test_rows_of_one_joint_are_left_out(self, rows: int, size: float) -> None:
        recording = moving()
        position = recording.position.copy()
        position[700 : 700 + rows, 1] += size
        sound, (fault,) = without_faulty_rows(replace(recording, position=position))
        assert fault.kind is RowFaultKind.DISPLACED
        assert fault.joints == ("b",)
        assert fault.rows == rows
        assert fault.time == pytest.approx(700 / RATE)
        assert fault.size == pytest.approx(abs(size), abs=5e-3)
        kept = np.delete(np.arange(COUNT), np.arange(700, 700 + rows))
        np.testing.assert_array_equal(sound.position, recording.position[kept])

    @pytest.mark.parametrize("rows", [1, 5, 20])
    def test_so_are_rows_of_zeros_of_all_joints(self, rows: int) -> None:
        recording = moving()
        position = recording.position.copy()
        position[700 : 700 + rows] = 0.0
        sound, faults = without_faulty_rows(replace(recording, position=position))
        assert {fault.kind for fault in faults} == {RowFaultKind.DISPLACED}
        assert {fault.rows for fault in faults} == {rows}
        kept = np.delete(np.arange(COUNT), np.arange(700, 700 + rows))
        np.testing.assert_array_equal(sound.time, recording.time[kept])

    def test_several_of_a_joint_are_one_fault(self) -> None:
        recording = moving()
        position = recording.position.copy()
        for first in (500, 900, 1300):
            position[first : first + 4, 2] += 0.2
        (fault,) = without_faulty_rows(replace(recording, position=position))[1]
        assert fault.rows == 12
        assert fault.joints == ("c",)

    def test_most_of_a_recording_is_not_left_out(self) -> None:
        recording = moving()
        position = recording.position.copy()
        position[400:1600, 1] += 0.4
        assert without_faulty_rows(replace(recording, position=position))[1] == ()

    def test_stamps_that_repeat_are_no_obstacle(self) -> None:
        recording = moving()
        position = recording.position.copy()
        position[700:760, 1] += 0.3
        stamps = np.floor(recording.time * 50.0) / 50.0
        with np.errstate(all="raise"):
            (fault,) = without_faulty_rows(replace(recording, time=stamps, position=position))[1]
        assert fault.kind is RowFaultKind.DISPLACED
        assert fault.rows == 60


class TestTwoMotions:
    def test_the_jump_between_them_separates_them(self) -> None:
        rows = np.concatenate([np.arange(1100, 2000), np.arange(300, 1100)])
        sound, (fault,) = without_faulty_rows(with_rows(moving(), rows))
        assert fault.kind is RowFaultKind.JUMP
        assert fault.time == pytest.approx(900 / RATE)
        assert fault.rows == 0
        assert sound.n_samples == len(rows)
        assert [part.start for part in sound.segments()] == [0, 900]

    def test_rows_written_twice_are_used_once(self) -> None:
        rows = np.concatenate([np.arange(1100), np.arange(800, 2000)])
        sound, (fault,) = without_faulty_rows(with_rows(moving(), rows))
        assert fault.kind is RowFaultKind.WRITTEN_TWICE
        assert fault.rows == 300
        np.testing.assert_array_equal(sound.position, moving().position)

    def test_a_motion_that_is_appended_to_itself_is_used_once(self) -> None:
        rows = np.concatenate([np.arange(200, 1800), np.arange(200, 1800)])
        doubled = with_rows(moving(), rows)
        pause = np.where(np.arange(len(rows)) < 1600, 0.0, 1.0)
        sound, (fault,) = without_faulty_rows(replace(doubled, time=doubled.time + pause))
        assert fault.kind is RowFaultKind.WRITTEN_TWICE
        assert fault.rows == 1600
        assert sound.n_samples == 1600


class TestBursts:
    @pytest.mark.parametrize("seed", range(6))
    def test_stamps_of_arrival_give_the_times_of_an_even_clock(self, seed: int) -> None:
        """Rows wait for up to 35 ms and arrive at once; a few are lost, of which none is noted."""
        random = np.random.default_rng(seed)
        recording = moving(seed)
        arrival = recording.time + random.exponential(3e-4, COUNT)
        for first in random.integers(0, COUNT - 10, 80).tolist():
            wait = random.integers(3, 9)
            arrival[first : first + wait] = recording.time[first + wait] + 2e-3
        arrival = np.maximum.accumulate(arrival)
        timed, times = true_times(replace(recording, time=arrival))
        assert times.even
        assert times.certain
        assert times.rate == pytest.approx(RATE, rel=3e-4)
        error = timed.time - recording.time
        assert np.ptp(error - np.median(error)) < 1e-3

    def test_a_pause_in_which_the_arm_moves_on_is_a_gap(self) -> None:
        kept = np.ones(COUNT, np.bool_)
        for first in (400, 800, 1200):
            kept[first : first + 40] = False
        recording = moving().rows(kept)
        timed, times = true_times(recording)
        assert not times.even
        np.testing.assert_array_equal(timed.time, recording.time)


def test_faults_of_one_kind_are_one_remark() -> None:
    frozen = [RowFault(RowFaultKind.FROZEN, time, 0.04, 8) for time in (5.0, 1.0, 3.0)]
    jump = RowFault(RowFaultKind.JUMP, 2.0, 0.0, 0, ("elbow",))
    first, second = by_kind([frozen[0], jump, *frozen[1:]])
    assert first.rows == 24
    assert faults_words(first).startswith("the log repeats one row in 3 places (first at 1 s)")
    assert second.faults == (jump,)
