"""The session at the edges of what it takes for a packet of its own, and what it counts."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    CyclicPacket,
    FollowingError,
    LinkLost,
    Mode,
    Refused,
    RequestError,
    State,
    reply_policy,
)
from drivers.errors import (
    ExitNotGranted,
    NotFinite,
    TargetNotFinite,
)
from drivers.events import AnswersLost
from drivers.packets import INIT_LENGTH, LAST_NUMBER
from drivers.session import MAX_GAP
from tests.drivers.rig import (
    PERIOD,
    Cruise,
    N,
    Rig,
    assert_refused,
    init_packet,
    moving,
)


class TestConstruction:
    @pytest.mark.parametrize("max_gap", [0, MAX_GAP])
    def test_any_patience_within_its_range_will_do(self, max_gap):
        assert Rig(max_gap=max_gap).open() is not None

    def test_what_cannot_be_is_named(self):
        with pytest.raises(
            ValueError, match=r"mode 3 is not served; modes 1, 2, 4, 5, 7, 8, 9 are"
        ):
            Rig(mode=3)
        for arm in (0, 5):
            with pytest.raises(ValueError, match=rf"arm {arm} is not one of 1\.\.4"):
                Rig(arm=arm)

    def test_a_request_is_refused_in_the_words_of_the_state(self):
        rig = Rig()
        rig.close()
        with pytest.raises(RequestError, match="not the kind of source") as caught:
            rig.session.request(object())
        assert caught.value.state == "closed"


class TestBeforeInit:
    @pytest.mark.parametrize("length", [12, 732, INIT_LENGTH - 1])
    def test_a_sync_packet_is_shorter_than_an_init_packet(self, length):
        rig = Rig()
        assert rig.sync(1, length) is not None
        assert rig.session.counters.malformed == 0

    def test_one_as_long_is_none(self):
        rig = Rig()
        assert rig.sync(1, INIT_LENGTH) is None
        assert rig.session.counters.malformed == 1
        assert rig.state is State.SYNC

    @pytest.mark.parametrize("place", [4, 7])
    def test_a_drive_is_on_only_in_the_four_status_bytes(self, place):
        packet = bytearray(b"\x01\x00\x00\x00" + bytes(100))
        packet[8:] = b"\x05" * (len(packet) - 8)
        assert Rig().send(bytes(packet)) is not None
        packet[place] = 5
        assert Rig().send(bytes(packet)) is None

    def test_one_sync_packet_makes_a_cold_start(self):
        rig = Rig()
        rig.sync(1)
        rig.send(rig.init.encode())
        assert rig.sync(11) is not None
        assert rig.state is State.INIT

    def test_the_deadline_begins_with_the_first_packet_even_one_that_is_none(self):
        rig = Rig(init_timeout=30.0)
        assert rig.session.deadline == np.inf
        assert rig.send(b"?") is None
        assert rig.session.deadline == pytest.approx(rig.now + 30.0)


class TestNumbers:
    def test_a_low_number_in_a_running_session_is_stale_and_no_new_beginning(self):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.number = 4
        assert rig.cycle() is None
        assert (rig.state, rig.session.counters.stale) == (State.DRIVE_OFF, 1)

    def test_the_same_number_with_other_bytes_is_no_duplicate(self):
        rig = Rig()
        rig.close()
        rig.number -= 1
        rig.axes["d"][0, 2] += 0.1
        assert rig.cycle() is None
        counters = rig.session.counters
        assert (counters.duplicates, counters.stale) == (0, 1)

    @pytest.mark.parametrize(("number", "after"), [(9, State.SYNC), (10, State.DRIVE_OFF)])
    def test_after_a_silence_the_numbers_before_that_of_init_begin_anew(self, number, after):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.now += 2.0
        rig.number = number - 1
        assert rig.send(rig.packet()) is not None
        assert rig.state is after

    def test_after_a_silence_a_number_1_that_is_just_the_next_begins_nothing_anew(self):
        rig = Rig()
        rig.status = 0
        rig.start()
        for before in (LAST_NUMBER - 1, LAST_NUMBER):
            rig.now += 2.0
            rig.number = before
            assert rig.cycle() is not None
        assert rig.number == 1
        assert rig.state is State.DRIVE_OFF

    def test_a_packet_at_the_very_deadline_comes_too_late(self):
        rig = Rig()
        rig.close()
        assert rig.session.reply(rig.packet(), rig.session.deadline) is not None
        assert any(isinstance(event, LinkLost) for event in rig.session.events())

    def test_each_packet_that_looked_stale_meanwhile_counts_as_missed(self):
        """A corrupted number that was far ahead makes the controller's own look stale."""
        for stale, stops in ((2, False), (3, True)):
            rig, source = moving(20)
            ahead = rig.number
            for _ in range(stale):
                rig.number = ahead - 30
                assert rig.cycle() is None
            rig.number = ahead
            rig.cycle(2)
            assert (source.stops == 1) == stops


class TestCounts:
    def test_every_fate_adds_up(self):
        rig = Rig()
        rig.send(rig.init.encode())
        for _ in range(2):
            rig.send(rig.init.encode())
        rig.number = 10
        rig.modes = Mode.CLOSED
        rig.cycle(3)
        packet, _ = rig.transcript[-1]
        rig.send(packet)
        counters = rig.session.counters
        assert (counters.answered, counters.duplicates) == (4, 3)

    def test_cycles_begin_at_the_init_packet(self):
        rig = Rig()
        rig.close()
        rig.cycle(5)
        assert rig.session.cycle == 6
        rig.send(rig.init.encode())
        assert rig.session.cycle == 0

    def test_every_refusal_counts(self):
        rig = Rig()
        for count in (1, 2):
            rig.modes = Mode.CLOSED
            rig.close()
            rig.modes = rig.mode
            rig.axes["d"][0, 1] = 1.0
            rig.cycle()
            assert rig.session.counters.refused == count
            rig.axes["d"][0, 1] = 0.0

    def test_a_record_is_of_an_interval_until_its_last_axis_has_closed(self):
        rig = Rig()
        rig.open()
        rig.modes[0] = Mode.CLOSED
        rig.cycle()
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert [record["interval"] for record in rig.records] == [-1, 0, 0, -1]

    def test_a_refusal_leaves_no_set_point_in_its_record(self):
        rig, _ = moving(20)
        rig.axes["d"][3, 2] += 3.0
        answer = rig.cycle()
        assert answer.axes["mode"][3] == Mode.FOLLOWING_ERROR
        assert type(rig.refusal) is FollowingError
        assert np.isnan(rig.records[-1]["commanded_position"]).all()
        assert np.isnan(rig.records[-1]["commanded_velocity"]).all()


def test_an_answer_lost_in_one_interval_is_not_counted_in_the_next():
    """Lost in its last cycle; the next is left before its last axis has opened."""
    rig, _ = moving(300)
    before = rig.axes.copy()
    rig.cycle()
    rig.axes[:] = before
    rig.cycle()
    assert rig.session.counters.unanswered == 1
    rig.axes["d"][:, 1] = rig.axes["d"][:, 3] = 0.0
    rig.modes = Mode.CLOSED
    rig.cycle(2)
    rig.modes[:3] = rig.mode
    rig.cycle()
    rig.session.stop()
    rig.cycle(5)
    assert rig.state is State.EXITING
    assert rig.session.counters.unanswered == 1
    assert len(rig.seen(AnswersLost)) == 1


class TestLeaving:
    """What a controller that goes on is asked, and for how long; limits shortened to be quick."""

    RETRY, TIMEOUT = 10, 25

    @pytest.fixture(autouse=True)
    def short(self, monkeypatch):
        monkeypatch.setattr(reply_policy, "EXIT_RETRY_CYCLES", self.RETRY)
        monkeypatch.setattr(reply_policy, "EXIT_TIMEOUT", self.TIMEOUT * PERIOD)

    def test_the_end_of_open_mode_is_asked_for_again_until_that_is_a_fault(self):
        rig = Rig()
        rig.open()
        rig.cycle(50)
        rig.session.stop()
        asked = []
        for cycle in range(self.TIMEOUT + 1):
            rig.cycle()
            asked += [cycle] if rig.exits_asked > len(asked) else []
            assert rig.state is (State.EXITING if cycle < self.TIMEOUT else State.FAULTED)
        assert asked == [0, self.RETRY, 2 * self.RETRY]
        assert type(rig.refusal) is ExitNotGranted
        assert rig.refusal.cycles == self.TIMEOUT

    def test_where_the_controller_began_to_leave_it_is_asked_after_as_long(self):
        rig = Rig()
        rig.open()
        rig.cycle(50)
        rig.modes[0] = Mode.CLOSED
        asked = []
        for cycle in range(2 * self.RETRY):
            rig.cycle()
            asked += [cycle] if rig.exits_asked > len(asked) else []
        assert asked == [self.RETRY]

    def test_a_motion_waits_as_long_for_the_last_axis(self):
        rig = Rig()
        rig.close()
        rig.cycle(50)
        rig.session.request(Cruise())
        rig.modes[:5] = rig.mode
        for cycle in range(self.TIMEOUT + 1):
            assert rig.ended is None
            rig.cycle()
            assert rig.state is (State.OPENING if cycle < self.TIMEOUT else State.EXITING)
        assert rig.ended.outcome == "stopped"
        assert rig.exits_asked == 1


class TestALongGap:
    """Only what goes on in open mode has to have been carried on."""

    def test_after_which_open_mode_is_closed_asks_for_nothing(self):
        rig, _ = moving(100)
        rig.miss(10)
        rig.axes["d"][:, 0] += 5.0
        rig.axes["d"][:, 2] += 5.0
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.state is State.CLOSED
        assert not rig.seen(Refused)

    def test_while_an_opening_is_left_does_not_either(self):
        rig = Rig()
        rig.open()
        rig.cycle(20)
        rig.modes = Mode.CLOSED
        rig.cycle()
        rig.axes["d"][:, 0] += 0.5
        rig.axes["d"][:, 2] += 0.5
        rig.modes[:3] = rig.mode
        rig.cycle()
        rig.session.stop()
        rig.cycle()
        rig.miss(10)
        rig.cycle()
        assert rig.state is State.EXITING
        assert not rig.seen(Refused)


class TestOtherArms:
    def test_an_open_axis_of_another_arm_that_can_be_held_nowhere_is_told_at_once(self):
        """Its drive is on, that of the arm that is moved is off."""
        axes_map = np.full((4, 10), 0xFF)
        axes_map[0, :N] = range(N)
        axes_map[1, 0] = N
        init = init_packet(n_axes=N + 1, open_axes_map=axes_map)
        rig = Rig(init=init, slots=np.arange(N), other_axes={(2, 1)})
        rig.start()
        rig.modes[N] = Mode.POSITION
        rig.axes["d"][N, 0] = np.nan
        for _ in range(3):
            number = rig.number + 1
            packet = CyclicPacket(number, bytes([0, 5, 0, 0]), bytes(4), rig.axes.copy())
            rig.number = number
            answer = CyclicPacket.decode(rig.send(packet.encode()), N + 1)
            assert (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        [refusal] = rig.seen(Refused)
        assert (type(refusal.error), refusal.error.arm) == (TargetNotFinite, 2)


class TestAnArmThatCannotBeMatched:
    """Its packets are answered and archived, but nothing in them is a joint."""

    def test_records_say_so(self):
        crossed = init_packet(open_axes_map=np.full((4, 10), 3))
        rig = Rig(init=crossed)
        rig.start()
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.ages[4, 2] = 7
        rig.cycle()
        record = rig.records[-1]
        assert (record["mode"] == -1).all()
        assert np.isnan(record["position"]).all()
        assert np.isnan(record["target_position"]).all()
        assert record["age"][2] == 7
        assert record["age"].sum() == 7
        rig.ages = None
        rig.cycle()
        assert not rig.records[-1]["age"].any()


class TestFaulted:
    def test_whose_following_error_it_was_is_said_again_in_each_answer(self):
        rig, _ = moving(20)
        rig.axes["d"][3, 2] += 3.0
        for _ in range(3):
            answer = rig.cycle()
            modes = answer.axes["mode"].tolist()
            assert modes == [rig.mode] * 3 + [Mode.FOLLOWING_ERROR] + [rig.mode] * 2

    def test_drive_off_is_asked_for_if_another_axis_could_then_be_held_nowhere(self):
        rig, _ = moving(20)
        rig.axes["d"][3, 2] += 3.0
        assert (rig.cycle().axes["mode"] == Mode.FOLLOWING_ERROR).sum() == 1
        rig.axes["d"][1, 0] = np.nan
        answer = rig.cycle()
        assert (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()

    def test_a_target_that_is_no_number_is_told_once_and_answered_by_drive_off_each_time(self):
        rig = Rig()
        rig.open()
        rig.modes = Mode.PAUSE_BY_CONTROLLER
        rig.cycle()
        rig.modes[2] = rig.mode
        rig.axes["d"][2, 0] = np.nan
        answer = rig.cycle()
        assert (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert isinstance(rig.refusal, NotFinite)


def test_a_refusal_at_the_first_set_point_is_told_with_its_cycle():
    rig = Rig()
    rig.session.request(Cruise())
    rig.close()
    rig.modes = rig.mode
    rig.axes["d"][0, 4] = np.nan
    assert_refused(rig, rig.cycle(), NotFinite)
