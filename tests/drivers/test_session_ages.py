"""Links that carry some values more slowly than others say how old each is."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import Mode, MotionHeld, State
from drivers.errors import FirstSetPointUnknown, MotionUnknown
from tests.drivers.rig import (
    Cruise,
    N,
    Rig,
    all_drive_off,
    assert_refused,
    closed,
    init_packet,
    moving,
    opened,
    running,
    smooth_move,
    still,
)

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])
D1, D2, D3, D4, D5 = range(5)


def fresh(n_axes: int = N) -> np.ndarray:
    return np.zeros((n_axes, 8), np.uint16)


class TestRecords:
    def test_without_ages_all_is_fresh(self):
        rig = closed()
        assert not rig.records[-1]["age"].any()

    def test_the_oldest_joint_counts(self):
        rig = Rig()
        rig.ages = fresh()
        rig.ages[:, 1] = [3, 17, 4, 0, 65535, 2]
        rig.ages[5, 7] = 9
        rig.close()
        assert rig.records[-1]["age"].tolist() == [0, 65535, 0, 0, 0, 0, 0, 9]
        rig.ages = None
        rig.cycle()
        assert not rig.records[-1]["age"].any()

    def test_axes_that_are_not_ours_do_not_count(self):
        axes_map = np.full((4, 10), 0xFF)
        axes_map[0, :N] = [6, 5, 4, 2, 1, 0]
        axes_map[1, 0] = 3
        init = init_packet(n_axes=7, open_axes_map=axes_map)
        rig = Rig(init=init, slots=axes_map[0, :N], other_axes={(2, 1)})
        rig.ages = fresh(7)
        rig.ages[3] = 50
        rig.ages[6, 0] = 2
        rig.close()
        assert rig.records[-1]["age"].tolist() == [2, 0, 0, 0, 0, 0, 0, 0]


class TestFirstSetPoint:
    @pytest.mark.parametrize("mode", [4, 8])
    @pytest.mark.parametrize("column", [D1, D3, D4])
    def test_target_position_and_velocity_have_to_be_of_this_cycle(self, mode, column):
        rig = Rig(mode=mode)
        rig.ages = fresh()
        rig.close()
        rig.ages[3, column] = 1
        assert (rig.cycle(mode=mode).axes["mode"] == 505).all()
        error = rig.refusal
        assert type(error) is FirstSetPointUnknown
        assert (error.joint, error.value, error.bound, error.unit) == (3, 1.0, 0.0, "cycles")
        assert rig.state is State.FAULTED

    @pytest.mark.parametrize("column", [D2, D5, 5, 6, 7])
    def test_the_others_need_not(self, column):
        rig = Rig()
        rig.ages = fresh()
        rig.ages[:, column] = 40
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        rig.run_to("completed")

    @pytest.mark.parametrize("column", [D1, D3, D4])
    def test_none_may_be_older_for_a_motion_that_begins_in_open_mode(self, column):
        rig = opened()
        rig.ages = fresh()
        rig.ages[1, column] = 1
        rig.cycle(5)
        assert rig.state is State.OPEN
        rig.session.request(still(5))
        assert_refused(rig, rig.cycle(), FirstSetPointUnknown)


class TestLongGaps:
    def after(self, missed: int, column: int, age: int):
        rig, source = moving()
        rig.ages = fresh()
        rig.ages[2, column] = age
        rig.cycle(5)
        assert rig.state is State.OPEN
        rig.miss(missed)
        return rig, source, rig.cycle()

    @pytest.mark.parametrize("column", [D1, D2, D4])
    def test_a_velocity_from_before_the_gap_says_nothing_about_it(self, column):
        rig, source, answer = self.after(3, column, 1)
        error = assert_refused(rig, answer, MotionUnknown)
        assert isinstance(error, MotionHeld)
        assert (error.joint, error.value, error.unit) == (2, 1.0, "cycles")
        assert source.advances == 305

    @pytest.mark.parametrize("column", [D1, D2, D4])
    def test_one_of_this_cycle_does(self, column):
        rig, source, _ = self.after(3, column, 0)
        assert (rig.state, source.stops) == (State.OPEN, 1)

    def test_short_gaps_are_bridged_whatever_the_ages(self):
        rig, source, _ = self.after(2, D2, 60)
        assert (rig.state, source.stops) == (State.OPEN, 0)

    @pytest.mark.parametrize("leaving", [False, True])
    def test_a_velocity_from_before_the_gap_says_nothing_of_an_arm_that_is_held(self, leaving):
        rig = opened()
        if leaving:
            rig.session.stop()
            rig.cycle()
            assert rig.state is State.EXITING
        rig.ages = fresh() + np.uint16(3)
        rig.cycle()
        rig.miss(10)
        assert all_drive_off(rig.cycle())
        assert type(rig.refusal) is MotionUnknown


class TestTargetsGivenBack:
    def opening(self) -> Rig:
        rig = Rig()
        rig.ages = fresh()
        rig.close()
        rig.axes["mode"][2] = Mode.POSITION
        rig.cycle()
        assert rig.state is State.OPENING
        return rig

    def test_one_of_an_earlier_cycle_is_not_given_to_an_axis_that_opens(self):
        rig = self.opening()
        rig.ages[4, D1] = 1
        rig.cycle()
        assert rig.state is State.OPENING, "axis 5 is closed"
        rig.ages[2, D1] = 1
        assert all_drive_off(rig.cycle())
        error = rig.refusal
        assert type(error) is FirstSetPointUnknown
        assert (error.joint, error.value) == (2, 1.0)

    def test_one_of_an_earlier_cycle_is_not_given_to_one_that_opens_again_on_the_way_out(self):
        rig = Rig()
        rig.ages = fresh()
        rig.open()
        rig.session.stop()
        rig.cycle()
        rig.axes["mode"][2] = Mode.CLOSED
        rig.cycle()
        rig.ages[:, D1] = 1
        rig.cycle()
        assert rig.state is State.EXITING, "axes still open are given the last set-point"
        rig.axes["mode"][2] = Mode.POSITION
        assert all_drive_off(rig.cycle())
        assert type(rig.refusal) is FirstSetPointUnknown


def test_a_motion_under_changing_ages_is_the_same_motion():
    def replies(ages):
        rig = running(Cruise())
        for cycle in range(100):
            rig.ages = ages(cycle)
            rig.cycle()
        return [reply for _, reply in rig.transcript]

    rng = np.random.default_rng(5)
    assert replies(lambda _: None) == replies(lambda _: rng.integers(0, 99, (N, 8), np.uint16))
