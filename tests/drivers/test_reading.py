"""What makes a packet new, what its status and modes mean, and what an answer may hold."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import Mode
from drivers.packets import DRIVE_ON, LAST_NUMBER
from drivers.replies import D1, Reader, safe_answer
from drivers.session import Sequence
from tests.drivers.rig import START, Rig, all_drive_off

HALF = LAST_NUMBER // 2


def following(number: int, window: float) -> Sequence:
    sequence = Sequence()
    sequence.restart(number, window)
    return sequence


class TestNumbers:
    def test_nothing_was_heard_at_first(self):
        sequence = Sequence()
        assert (sequence.last, sequence.cycle, sequence.broken) == (0, 0, False)

    def test_right_after_the_init_packet_only_later_numbers_are_new(self):
        sequence = following(10, 500.0)
        assert not sequence.broken
        assert sequence.is_duplicate(10)
        for number in (9, 10, 511, LAST_NUMBER):
            assert sequence.is_stale(number)
        for number in (11, 510):
            assert not sequence.is_stale(number)

    @pytest.mark.parametrize("window", [0.0, 0.9, 1.0, 1.9])
    def test_the_next_number_is_new_however_short_silence_may_be(self, window):
        assert not following(10, window).is_stale(11)
        assert following(10, window).is_stale(12)

    @pytest.mark.parametrize("window", [HALF, HALF + 1, 1e9])
    def test_half_of_all_numbers_are_ahead_at_most(self, window):
        sequence = following(10, window)
        assert not sequence.is_stale(10 + HALF)
        assert sequence.is_stale(11 + HALF)

    def test_before_the_init_packet_half_of_them_count_as_missed(self):
        assert Sequence().accept(HALF) == HALF - 1
        assert Sequence().accept(HALF + 1) == 0

    def test_after_a_silence_the_same_number_is_new(self):
        sequence = following(10, 500.0)
        sequence.broken = True
        assert not sequence.is_duplicate(10)
        assert not sequence.is_stale(10)
        assert sequence.accept(10) == 0
        assert (sequence.cycle, sequence.broken) == (1, False)
        assert sequence.is_duplicate(10)


def test_the_same_packet_after_a_silence_is_answered_anew():
    rig = Rig()
    rig.close()
    packet = rig.packet()
    before = rig.send(packet)
    rig.now += 2.0
    answered = rig.session.counters.answered
    assert rig.send(packet) == before
    assert rig.session.counters.answered == answered + 1
    assert rig.session.counters.duplicates == 0


def test_a_number_before_that_of_the_init_packet_is_no_answer_s():
    rig = Rig()
    rig.start()
    rig.number = 8
    assert rig.cycle() is None
    assert rig.session.counters.stale == 1


class TestDrives:
    """Which arm a slot belongs to is not always known."""

    CLOSED = np.zeros(2, np.int32)

    @pytest.mark.parametrize("arms", [None, (1, 1)])
    def test_of_slots_nobody_knows_any_drive_that_is_on_counts(self, arms):
        reader = Reader(np.arange(2), arms, 1, Mode.POSITION)
        opened = np.full(2, Mode.POSITION, np.int32)
        reading = reader.read(bytes([0, 0, 5, 0]), opened)
        assert reading.powered == (arms is None)
        assert not reader.read(bytes(4), opened).powered

    @pytest.mark.parametrize("arms", [None, (1, 1), (1, 4)])
    @pytest.mark.parametrize("status", [bytes(4), bytes([5, 0, 0, 0]), bytes([9, 5, 7, 3])])
    def test_four_status_bytes_go_back_and_none_says_that_a_drive_is_on(self, arms, status):
        answer = safe_answer(status, self.CLOSED, arms)
        assert len(answer.status) == 4
        assert 5 not in answer.status


def test_where_drive_off_is_asked_for_what_is_no_number_is_zero():
    rig = Rig()
    rig.open()
    rig.axes["d"][2, :] = np.nan
    rig.axes["d"][4, 2] = np.inf
    answer = rig.cycle()
    assert all_drive_off(answer)
    expected = rig.train.motor_revolutions(START)
    expected[2] = 0.0
    np.testing.assert_allclose(answer.axes["d"][:, 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(answer.axes["d"][:, 1:], 0.0)


def test_slots_of_unknown_arms_are_the_first_arms_and_driven_if_any_drive_is_on():
    modes = np.full(2, Mode.CLOSED, np.int32)
    off, other_on = bytes([3, 4, 7, 9]), bytes([3, DRIVE_ON, 7, 9])
    answer = safe_answer(off, modes, None)
    assert answer.status == bytes([3, 0, 0, 0])
    assert answer.mask[:, D1:].all()  # echoed whole, as with the drive off
    answer = safe_answer(other_on, modes, None)
    assert answer.status == bytes(4)
    assert not answer.mask[:, D1:].all()
