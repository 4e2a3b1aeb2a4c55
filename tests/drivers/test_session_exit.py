"""The way out of open mode, and what is watched while axes are open but nothing moves."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    CurrentLimit,
    FirstSetPoint,
    FollowingError,
    Mode,
    MotionNotCarriedOn,
    NotAtStandstill,
    NotFinite,
    RequestError,
    State,
)
from drivers.errors import ExitNotGranted, FirstSetPointUnknown
from drivers.reply_policy import EXIT_RETRY_CYCLES, EXIT_TIMEOUT
from drivers.states import CORRECTION_MODES
from tests.drivers.rig import (
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    all_drive_off,
    assert_refused,
    smooth_move,
    still,
)

TIMEOUT = round(EXIT_TIMEOUT / PERIOD)


def exiting(**options) -> Rig:
    rig = Rig(**options)
    rig.session.request(still(2))
    rig.open()
    rig.cycle(6)
    assert rig.state is State.EXITING
    return rig


class TestExitNotGranted:
    def test_a_controller_that_never_leaves_open_mode_is_asked_for_drive_off(self):
        rig = exiting()
        rig.cycle(TIMEOUT - 1)
        assert rig.state is State.EXITING
        # 10 s of 2 ms, and the first of them has asked already.
        assert rig.exits_asked == 1 + (TIMEOUT - 1) // EXIT_RETRY_CYCLES
        error = assert_refused(rig, rig.cycle(), ExitNotGranted)
        assert error.cycles == TIMEOUT
        assert all_drive_off(rig.cycle())

    def test_one_that_leaves_in_the_last_cycle_is_in_time(self):
        rig = exiting()
        rig.cycle(TIMEOUT - 1)
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.ended.outcome == "completed"

    def test_missed_cycles_count_as_time(self):
        rig = exiting()
        for _ in range(TIMEOUT // 400 + 1):
            assert rig.state is State.EXITING
            rig.miss(399)
            answer = rig.cycle()
        assert_refused(rig, answer, ExitNotGranted)

    def test_exit_is_asked_for_again_however_the_gaps_fall(self):
        rig = exiting()
        rig.miss(EXIT_RETRY_CYCLES + 7)
        rig.cycle()
        assert rig.exits_asked == 2
        rig.cycle(EXIT_RETRY_CYCLES - 1)
        assert rig.exits_asked == 2
        rig.cycle()
        assert rig.exits_asked == 3

    def test_it_holds_without_a_motion_too(self):
        rig = Rig()
        rig.open()
        rig.session.stop()
        rig.cycle(TIMEOUT)
        assert rig.state is State.EXITING
        assert all_drive_off(rig.cycle())
        assert type(rig.refusal) is ExitNotGranted
        assert rig.ended is None

    def test_it_holds_when_it_was_the_controller_that_began_to_leave(self):
        rig = Rig()
        rig.open()
        rig.cycle(2000)
        rig.axes["mode"][2] = Mode.CLOSED
        rig.cycle(EXIT_RETRY_CYCLES)
        assert (rig.state, rig.exits_asked) == (State.EXITING, 0)
        rig.cycle()
        assert rig.exits_asked == 1
        rig.cycle(TIMEOUT - EXIT_RETRY_CYCLES - 1)
        assert rig.state is State.EXITING
        assert all_drive_off(rig.cycle())
        assert type(rig.refusal) is ExitNotGranted


class TestWatchedWhileLeaving:
    @pytest.mark.parametrize("column", [0, 2])
    @pytest.mark.parametrize("value", [2.01, -2.01])
    def test_following_error_of_an_axis_still_open(self, column, value):
        rig = exiting()
        rig.axes["d"][3, column] += value
        assert rig.cycle().axes["mode"].tolist() == [4, 4, 4, 508, 4, 4]
        assert type(rig.refusal) is FollowingError
        assert rig.ended.outcome == "refused"

    def test_an_arm_and_a_target_that_wander_off_together(self):
        rig = exiting()
        rig.axes["d"][3, [0, 2]] += 2.01
        assert rig.cycle().axes["mode"].tolist() == [4, 4, 4, 508, 4, 4]

    @pytest.mark.parametrize("sign", [-1, 1])
    def test_a_target_that_is_not_the_one_given(self, sign):
        rig = exiting()
        rig.axes["d"][3, [0, 2]] += sign * 0.19
        rig.cycle()
        assert rig.state is State.EXITING
        rig.axes["d"][3, [0, 2]] += sign * 0.21
        assert assert_refused(rig, rig.cycle(), MotionNotCarriedOn).joint == 3

    def test_current_of_an_axis_still_open(self):
        rig = exiting()
        rig.axes["d"][3, 4] = 20.1
        assert_refused(rig, rig.cycle(), CurrentLimit)

    @pytest.mark.parametrize("column", [0, 2, 4])
    def test_what_is_no_number(self, column):
        rig = exiting()
        rig.axes["d"][3, column] = np.nan
        assert_refused(rig, rig.cycle(), NotFinite)

    @pytest.mark.parametrize("column", [0, 2, 4])
    @pytest.mark.parametrize("value", [99.0, np.nan])
    def test_an_axis_that_has_closed_is_the_controllers_own_business(self, column, value):
        rig = exiting()
        rig.axes["mode"][3] = Mode.CLOSED
        rig.axes["d"][3, column] = value
        rig.cycle()
        assert rig.state is State.EXITING
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.ended.outcome == "completed"


class TestRequestWhileHeldOpen:
    def held(self, **options) -> Rig:
        rig = Rig(**options)
        rig.open()
        rig.cycle(20)
        return rig

    def begin(self, rig):
        source = Cruise()
        rig.session.request(source)
        return source, rig.cycle()

    def test_the_motion_begins_where_the_arm_is_held(self):
        rig = self.held()
        source, answer = self.begin(rig)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], rig.axes["d"][:, 0])
        assert (source.advances, rig.state) == (0, State.OPEN)

    @pytest.mark.parametrize("columns", [[0], [2], [0, 2]], ids=["target", "arm", "both"])
    def test_not_if_arm_or_target_are_a_tenth_of_the_threshold_away(self, columns):
        rig = self.held()
        rig.axes["d"][4, columns] += 0.19
        self.begin(rig)
        assert rig.state is State.OPEN
        rig = self.held()
        rig.axes["d"][4, columns] += 0.21
        source, answer = self.begin(rig)
        error = assert_refused(rig, answer, FirstSetPoint)
        assert (error.joint, error.bound) == (4, pytest.approx(0.2))
        assert source.advances == 0

    @pytest.mark.parametrize("columns", [[0], [0, 2]], ids=["target", "both"])
    @pytest.mark.parametrize("sign", [-1, 1])
    def test_a_target_that_wanders_off_is_noticed_without_a_motion_too(self, columns, sign):
        rig = self.held()
        rig.axes["d"][4, columns] += sign * 0.19
        rig.cycle()
        assert rig.state is State.OPEN
        rig.axes["d"][4, columns] += sign * 0.21
        assert all_drive_off(rig.cycle())
        error = rig.refusal
        assert type(error) is MotionNotCarriedOn
        assert (error.joint, error.bound) == (4, pytest.approx(0.2))

    def test_an_arm_that_sags_is_the_controllers_to_hold(self):
        rig = self.held()
        rig.axes["d"][4, 2] += 0.21
        rig.cycle()
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("column", [1, 3])
    def test_not_if_it_does_not_stand(self, column):
        rig = self.held()
        rig.axes["d"][4, column] = 6e-4
        rig.cycle()
        assert rig.state is State.OPEN
        rig.axes["d"][4, column] = 6e-4
        _, answer = self.begin(rig)
        assert assert_refused(rig, answer, NotAtStandstill).joint == 4

    @pytest.mark.parametrize("mode", [1, 5])
    def test_in_every_mode_of_positions(self, mode):
        rig = self.held(mode=mode)
        rig.axes["d"][4, 2] += 0.21
        assert_refused(rig, self.begin(rig)[1], FirstSetPoint)

    def test_none_is_taken_while_open_mode_is_left(self):
        rig = exiting()
        with pytest.raises(RequestError, match="exiting"):
            rig.session.request(still(3))


def test_a_second_motion_in_the_same_interval_after_a_fault_is_not_possible():
    rig = Rig()
    rig.session.request(smooth_move(np.full(N, 0.1), 300))
    rig.open()
    rig.axes["d"][0, 2] += 3.0
    rig.cycle()
    with pytest.raises(RequestError, match="closed first"):
        rig.session.request(still(2, START))


class TestReopenedWhileLeaving:
    def test_an_axis_that_closed_and_opens_again_is_held_where_it_is(self):
        rig = exiting()
        end = rig.axes["d"][:, 0].copy()
        rig.axes["mode"][2] = Mode.CLOSED
        rig.cycle()
        rig.axes["d"][2, [0, 2]] += 0.5
        rig.axes["mode"][2] = Mode.POSITION
        answer = rig.cycle()
        assert rig.state is State.EXITING
        told = answer.axes["d"]
        assert told[2, 0] == np.float32(end[2] + 0.5)
        np.testing.assert_array_equal(np.delete(told[:, 0], 2), np.delete(end, 2))
        assert not told[:, 1].any()
        rig.axes["d"][2, 2] += 2.01
        assert rig.cycle().axes["mode"].tolist() == [4, 4, 508, 4, 4, 4]

    @pytest.mark.parametrize("mode", [8, 9])
    def test_corrections_stay_zero(self, mode):
        rig = Rig(mode=mode)
        rig.open()
        rig.session.stop()
        rig.cycle()
        rig.axes["mode"][2] = Mode.CLOSED
        rig.cycle()
        rig.axes["mode"][2] = mode
        assert not rig.cycle().axes["d"].any()


class TestAStrayAxisWhileCorrectionsEnd:
    """It is in a mode of positions, so its own target is given back: if it can be held there."""

    def stray(self, wanted, target=None, age=0, opening=False):
        rig = Rig(mode=wanted)
        rig.open()
        rig.cycle(5)
        if opening:
            rig.close()
        rig.modes = [wanted if opening else 0, 0, 4, 0, 0, 0]
        if target is not None:
            rig.axes["d"][2, 0] = target
        rig.ages = np.full((N, 8), age, np.uint16)
        return rig, rig.cycle()

    @pytest.mark.parametrize("opening", [False, True])
    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_a_target_that_is_no_number_is_not_given_back(self, mode, opening):
        rig, answer = self.stray(mode, np.nan, opening=opening)
        assert all_drive_off(answer)
        assert np.isfinite(answer.axes["d"]).all()
        assert type(rig.refusal) is NotFinite

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_one_far_from_the_arm_is_not_given_back(self, mode):
        rig, answer = self.stray(mode, 50.0)
        assert answer.axes["mode"].tolist() == [0, 0, 508, 0, 0, 0]
        assert type(rig.refusal) is FollowingError

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_one_of_an_earlier_cycle_is_not_given_back(self, mode):
        rig, answer = self.stray(mode, age=1)
        assert all_drive_off(answer)
        assert type(rig.refusal) is FirstSetPointUnknown

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_another_is(self, mode):
        rig, answer = self.stray(mode)
        assert rig.state is State.EXITING
        assert answer.axes["mode"].tolist() == [0, 0, 4, 0, 0, 0]
        assert answer.axes["d"][2, 0] == rig.axes["d"][2, 0]
        assert (
            np.isfinite(rig.records[-1]["commanded_position"]).tolist()
            == [False] * 2 + [True] + [False] * 3
        )


class TestOpeningThatNeverCompletes:
    def opening(self, source=None, opened=N - 1) -> Rig:
        rig = Rig()
        if source is not None:
            rig.session.request(source)
        rig.close()
        rig.axes["mode"][:opened] = Mode.POSITION
        rig.cycle()
        assert rig.state is State.OPENING
        return rig

    def test_a_stop_leaves_open_mode_and_holds_each_axis_at_its_target(self):
        rig = self.opening(Cruise())
        rig.session.stop("enough")
        assert rig.session.requested is False
        rig.axes["d"][1, [0, 2]] += 0.01
        target = rig.axes["d"][:, 0].copy()
        answer = rig.cycle()
        assert (rig.state, rig.exits_asked) == (State.EXITING, 1)
        for _ in range(3):
            np.testing.assert_array_equal(answer.axes["d"][:, 0], target)
            assert not answer.axes["d"][: N - 1, 1].any()
            answer = rig.cycle()
        assert rig.exits_asked == 1
        assert rig.ended.outcome == "stopped"
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.state is State.CLOSED

    def test_the_last_axis_opening_after_all_is_held_too(self):
        rig = self.opening(Cruise())
        rig.session.stop()
        rig.cycle()
        target = rig.axes["d"][:, 0].copy()
        rig.modes = Mode.POSITION
        for _ in range(5):
            answer = rig.cycle()
            np.testing.assert_array_equal(answer.axes["d"][:, 0], target)
        assert rig.state is State.EXITING
        assert set(rig.records["interval"]) == {-1}

    @pytest.mark.parametrize("opened", [1, N - 1])
    def test_a_motion_that_waits_too_long_is_given_up(self, opened):
        rig = self.opening(source := Cruise(), opened)
        rig.cycle(TIMEOUT - 1)
        assert rig.state is State.OPENING
        assert rig.exits_asked == 0
        rig.cycle()
        assert (rig.state, rig.exits_asked) == (State.EXITING, 1)
        assert rig.ended.outcome == "stopped"
        assert "did not open" in rig.ended.reason
        assert ("axis 1 alone is to open, use --only-axis" in rig.ended.reason) is (opened == 1)
        assert source.begun_at is None
        rig.cycle(TIMEOUT - 1)
        assert rig.state is State.EXITING
        assert all_drive_off(rig.cycle())

    def test_without_a_motion_nobody_waits(self):
        rig = self.opening()
        rig.cycle(TIMEOUT + 10)
        assert (rig.state, rig.exits_asked) == (State.OPENING, 0)
