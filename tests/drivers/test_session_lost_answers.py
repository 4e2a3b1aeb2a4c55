"""Answers that the controller does not take show only in the target that it reports."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import MotionNotCarriedOn, State
from drivers.events import AnswersLost
from drivers.open_mode import REPETITIONS
from tests.drivers.rig import START, Cruise, N, Rig, assert_refused, limits, moving, still

STEP = 1.9 * 0.002 * 120.0 / (2.0 * np.pi)
"""Motor revolutions per cycle of joint 1 at full speed."""
PULL = 2.0 * 8.0 * 0.002**2 * 120.0 / (2.0 * np.pi) + 2e-5
"""Most that a step may change by from one cycle to the next in a stop, rounding included."""


class Fast(Cruise):
    SPEED = 1.9
    RAMP = 1.0


def at_speed(cycles: int = 600, speed: float = 1.9, **options) -> Rig:
    wide = limits(lower=np.full(N, -6.0), upper=np.full(N, 6.0))
    rig = Rig(guard_limits=wide, **options)
    rig.session.request(type("AtSpeed", (Fast,), {"SPEED": speed})())
    rig.open()
    rig.cycle(cycles)
    assert rig.state is State.OPEN
    return rig


def report_late(rig: Rig) -> None:
    """From now on the controller takes each answer, and reports its target, a cycle late."""
    take, late = rig._obey, [rig.axes["d"].copy()]

    def obey(answer):
        take(answer)
        late.append(rig.axes["d"].copy())
        rig.axes["d"][:] = late[-2]

    rig._obey = obey


def lose(rig: Rig, count: int):
    """Cycles whose answers never reach the controller, which holds its target."""
    take, rig._obey = rig._obey, lambda answer: rig.axes["d"].__setitem__((slice(None), [1, 3]), 0)
    answer = rig.cycle(count)
    rig._obey = take
    return answer


class TestNextStep:
    """After lost answers the motion goes on by one step from the target that is held."""

    @pytest.mark.parametrize("share", [0.25, 0.5, 0.8, 1.0])
    @pytest.mark.parametrize(("lost", "goes_on"), [(1, True), (2, True), (5, False)])
    def test_it_is_one_step_at_every_speed(self, share, lost, goes_on):
        """Up to the time it is taken, and in each cycle after it, on the way to rest as well."""
        rig = at_speed(speed=1.9 * share)
        target, last = rig.axes["d"][0, 0], 0.0
        lose(rig, lost)
        for _ in range(30):
            answer = rig.cycle()
            step, target = answer.axes["d"][0, 0] - target, answer.axes["d"][0, 0]
            assert -1e-5 <= step <= 1.001 * share * STEP
            assert last == 0.0 or abs(step - last) <= PULL
            last = step
        assert rig.session.counters.unanswered == lost
        rig.session.stop()
        rig.run()
        assert rig.ended.outcome == "stopped"
        assert (rig.ended.reason == "a stop was asked for") is goes_on

    def test_the_motion_waits_and_leaves_nothing_out(self):
        """Without what was sent again, the set-points are those of a motion that lost nothing."""
        rig, other = at_speed(100), at_speed(100)
        lose(rig, 2)
        rig.cycle(60)
        other.cycle(60)
        sent, velocity = (rig.records[f"commanded_{what}"] for what in ("position", "velocity"))
        again = np.append(False, (np.diff(sent, axis=0) == 0.0).all(axis=1))
        again &= velocity.any(axis=1)
        assert again.sum() == 2
        np.testing.assert_array_equal(
            sent[~again][-150:], other.records["commanded_position"][-150:]
        )

    def test_it_is_sent_again_with_its_velocity(self):
        rig = at_speed()
        np.testing.assert_array_equal(lose(rig, 1).axes, rig.cycle().axes)

    def test_a_link_that_becomes_late_at_speed_comes_to_rest(self):
        """Its answers are taken a cycle late; the way to rest knows that and goes smoothly."""
        rig = at_speed()
        report_late(rig)
        rig.run()
        assert rig.ended.outcome == "stopped"
        assert rig.ended.reason == "3 answers were lost in 100 cycles"
        sent = rig.records["commanded_position"]
        waits = (np.diff(sent[600:, 0]) == 0.0) & (rig.records["commanded_velocity"][601:, 0] != 0)
        assert waits.sum() == 3

    def test_a_controller_that_takes_none_any_more_is_refused(self):
        rig = at_speed()
        answer = lose(rig, REPETITIONS + 2)
        assert assert_refused(rig, answer, MotionNotCarriedOn).joint == 0


@pytest.mark.parametrize("lost", [1, 2])
def test_a_few_are_counted_and_told_and_the_motion_goes_on(lost):
    rig = at_speed()
    before = rig.records[-1]["cycle"]
    lose(rig, lost)
    rig.cycle(10)
    assert rig.state is State.OPEN
    events = rig.seen(AnswersLost)
    assert sum(event.count for event in events) == lost
    assert rig.session.counters.unanswered == lost
    # The packet in which it shows is the one after the answer that was lost.
    assert events[0].cycle == before + 2
    rig.session.stop()
    rig.run()
    assert rig.ended.outcome == "stopped"


@pytest.mark.parametrize(("max_gap", "pattern"), [(2, 3), (2, 40), (0, 40), (5, 9)])
def test_too_many_in_a_hundred_cycles_stop_the_motion_on_its_path(max_gap, pattern):
    rig = at_speed(max_gap=max_gap)
    lost = 0
    while lost <= max_gap:
        assert not rig.session._machine.stop_reason
        lose(rig, 1)
        lost += 1
        rig.cycle(1 if lost > max_gap else pattern - 1)
    rig.run()
    assert rig.ended.outcome == "stopped"
    assert rig.ended.reason == f"{max_gap + 1} answers were lost in 100 cycles"


def test_a_poor_way_back_ends_a_motion_within_a_few_cycles():
    rig = at_speed()
    for _ in range(900):
        lose(rig, 2)
        rig.cycle(1)
        if rig.exits_asked:
            break
    rig.modes = 0
    rig.cycle()
    assert rig.ended.outcome == "stopped"
    assert rig.ended.reason == "3 answers were lost in 100 cycles"


def test_slowly_moving_too_many_in_a_row_stop_it_too():
    rig, _ = moving()
    lose(rig, 3)
    rig.run()
    assert rig.ended.reason == "3 answers were lost in 100 cycles"


def test_those_of_long_ago_do_not_count():
    rig = at_speed()
    for _ in range(6):
        lose(rig, 1)
        rig.cycle(49)
    assert rig.session.counters.unanswered == 6
    assert rig.session._machine.stop_reason is None
    assert rig.state is State.OPEN


class TestCarriedOn:
    """A controller that goes on by itself while packets are missing."""

    def carried_on(self, missed: int, extra: float = 0.0, **options) -> Rig:
        """At 50 motor revolutions per second, 0.1 per cycle, and a threshold of one."""
        speed, one = 2.618, np.full(N, 1.0)
        wide = limits(
            lower=-9.0 * one,
            upper=9.0 * one,
            velocity=2.8 * one,
            acceleration=30.0 * one,
            jerk=900.0 * one,
            following_error=one,
        )
        source = type("Faster", (Fast,), {"SPEED": speed})()
        rig = Rig(guard_limits=wide, **options)
        rig.session.request(source)
        rig.open()
        rig.cycle(600)
        step = rig.axes["d"][0, 1]
        assert abs(step) == pytest.approx(0.1, rel=1e-3)
        rig.miss(missed)
        rig.axes["d"][0, [0, 2]] += missed * step + np.sign(step) * extra
        return rig

    @pytest.mark.parametrize("missed", [1, 2])
    def test_at_full_speed_a_gap_not_too_long_is_survived(self, missed):
        rig = self.carried_on(missed)
        rig.cycle(10)
        assert rig.state is State.OPEN
        assert rig.session.counters.unanswered == 0
        rig.session.stop()
        rig.run()
        assert rig.ended.outcome == "stopped"

    @pytest.mark.parametrize("missed", [3, 4, 5])
    def test_more_than_a_quarter_of_the_threshold_is_not(self, missed):
        rig = self.carried_on(missed, max_gap=5)
        error = assert_refused(rig, rig.cycle(), MotionNotCarriedOn)
        assert (error.value, error.bound) == (pytest.approx(0.1 * missed, rel=1e-3), 0.25)

    @pytest.mark.parametrize(("extra", "survived"), [(0.099, True), (0.101, False)])
    def test_give_or_take_a_tenth_of_the_threshold(self, extra, survived):
        rig = self.carried_on(1, extra)
        rig.cycle()
        assert (rig.state is State.OPEN) is survived

    def test_without_a_gap_nothing_is_carried_on(self):
        rig = self.carried_on(0)
        rig.axes["d"][0, [0, 2]] += 1.2 * rig.axes["d"][0, 1]
        assert_refused(rig, rig.cycle(), MotionNotCarriedOn)


def test_one_now_and_then_is_counted_each_time():
    rig = at_speed(max_gap=5)
    for _ in range(5):
        lose(rig, 1)
        rig.cycle(3)
    assert rig.session.counters.unanswered == 5
    assert [event.count for event in rig.seen(AnswersLost)] == [1] * 5


def test_a_controller_that_reports_its_target_a_cycle_late_is_told_of_once():
    rig = at_speed(0)
    report_late(rig)
    rig.cycle(600)
    assert rig.state is State.OPEN
    assert rig.session.counters.unanswered == 1


def test_a_controller_that_takes_all_has_none_lost():
    rig = at_speed()
    rig.session.stop()
    rig.run()
    assert not rig.seen(AnswersLost)
    assert rig.session.counters.unanswered == 0


def test_values_of_an_earlier_cycle_are_no_lost_answers():
    rig = at_speed()
    rig.ages = np.ones((N, 8), np.uint16)
    lose(rig, 1)
    rig.cycle(1)
    assert rig.session.counters.unanswered == 0


def test_a_target_that_jumps_ahead_is_not_taken_for_ours():
    rig = at_speed()
    rig.axes["d"][0, [0, 2]] += 0.25
    assert_refused(rig, rig.cycle(), MotionNotCarriedOn)


class TestAfterAGapWithoutAMotion:
    """Meanwhile the controller may have left open mode, moved the arm, and come back."""

    def held(self, leaving: bool) -> Rig:
        rig = Rig()
        rig.open()
        rig.cycle(20)
        if leaving:
            rig.session.stop()
            rig.cycle()
        rig.miss(400)
        return rig

    @pytest.mark.parametrize("leaving", [False, True])
    def test_an_arm_that_is_elsewhere_is_not_pulled_back(self, leaving):
        rig = self.held(leaving)
        rig.axes["d"][0, [0, 2]] += 1.9
        answer = rig.cycle()
        assert (answer.axes["mode"] == 505).all()
        assert type(rig.refusal) is MotionNotCarriedOn
        assert rig.refusal.value == pytest.approx(1.9)

    @pytest.mark.parametrize("leaving", [False, True])
    def test_one_whose_target_moves_is_let_go(self, leaving):
        rig = self.held(leaving)
        rig.axes["d"][0, 1] = 0.001
        assert (rig.cycle().axes["mode"] == 505).all()

    @pytest.mark.parametrize("leaving", [False, True])
    def test_one_where_it_was_is_held_on(self, leaving):
        rig = self.held(leaving)
        rig.cycle(5)
        assert rig.state is (State.EXITING if leaving else State.OPEN)

    def test_an_axis_that_has_closed_is_not_asked_for(self):
        rig = Rig()
        rig.session.request(still(2, START))
        rig.open()
        rig.cycle(6)
        assert rig.state is State.EXITING
        rig.miss(10)
        rig.axes["mode"][0] = 0
        rig.axes["d"][0] = 3.0
        rig.cycle()
        assert rig.state is State.EXITING
