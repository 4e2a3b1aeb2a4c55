"""What is recorded and watched while open mode is left, and at the edges of corrections."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    FollowingError,
    Mode,
    NotFinite,
    Refused,
    RequestError,
    State,
)
from drivers.errors import (
    ExitNotGranted,
    FirstSetPointUnknown,
    MotionUnknown,
    NotAtStandstill,
    TargetNotFinite,
)
from drivers.packets import DRIVE_ON, CyclicPacket
from drivers.reply_policy import EXIT_RETRY_CYCLES, EXIT_TIMEOUT
from drivers.states import CORRECTION_MODES
from tests.drivers.rig import (
    PERIOD,
    START,
    Correction,
    Cruise,
    N,
    Rig,
    all_drive_off,
    assert_refused,
    bump,
    closed,
    exiting,
    init_packet,
    moving,
    opened,
    running,
    smooth_move,
    still,
)


class TestRecordsWhileLeaving:
    """Where an axis was given a set-point, that is what was commanded; elsewhere nothing was."""

    def test_open_axes_rest_at_the_last_set_point(self):
        rig = self.leaving(axis=None)
        for record in rig.records[-2:]:
            np.testing.assert_allclose(record["commanded_position"], START, atol=1e-6)
            np.testing.assert_array_equal(record["commanded_velocity"], np.zeros(N))

    def test_one_that_closed_has_none_and_one_that_opens_again_its_own_target(self):
        rig = self.leaving(axis=2)
        nothing = np.arange(N) == 2
        for name in ("commanded_position", "commanded_velocity"):
            np.testing.assert_array_equal(np.isnan(rig.records[-1][name]), nothing)
        rig.axes["d"][2, [0, 2]] += 0.5
        rig.modes[2] = rig.mode
        rig.cycle()
        record = rig.records[-1]
        expected = rig.train.joint_position(rig.axes["d"][:, 0].astype(np.float64))
        np.testing.assert_allclose(record["commanded_position"], expected, atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"], np.zeros(N))
        assert record["commanded_position"][2] != pytest.approx(START[2], abs=1e-3)

    def test_one_in_another_mode_of_positions_is_held_only_near_its_target(self):
        rig = self.leaving(axis=None)
        rig.modes[2] = Mode.POSITION_RELATIVE
        rig.cycle()
        assert rig.state is State.EXITING
        rig.axes["d"][2, 2] += 2.01
        answer = rig.cycle()
        assert answer.axes["mode"][2] == Mode.FOLLOWING_ERROR
        assert type(rig.refusal) is FollowingError

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_of_corrections_only_one_in_a_mode_of_positions_has_a_target(self, mode):
        rig = opened(mode=mode)
        rig.session.stop()
        rig.cycle()
        rig.modes[2] = Mode.POSITION
        rig.axes["d"][2, 1] = 4e-4
        rig.cycle()
        record = rig.records[-1]
        held = np.arange(N) == 2
        expected = np.where(held, START, np.nan)
        np.testing.assert_allclose(record["commanded_position"], expected, atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"], np.where(held, 0.0, np.nan))

    @pytest.mark.parametrize("mode", [Mode.POSITION, *sorted(CORRECTION_MODES)])
    def test_where_an_axis_that_has_closed_goes_is_the_controller_s_own_business(self, mode):
        rig = opened(mode=mode)
        rig.session.stop()
        rig.cycle()
        rig.modes[2] = Mode.CLOSED
        rig.axes["d"][2, 2] += 5.0
        rig.axes["d"][2, 4] = 50.0
        rig.cycle()
        assert rig.state is State.EXITING
        rig.axes["d"][3, 2] += 5.0
        rig.cycle()
        assert (type(rig.refusal), rig.refusal.joint) == (FollowingError, 3)

    @staticmethod
    def leaving(axis: int | None) -> Rig:
        """Open mode is left without a motion; this axis has closed first."""
        rig = opened(3)
        rig.session.stop()
        rig.cycle()
        if axis is not None:
            rig.modes[axis] = Mode.CLOSED
        rig.cycle()
        assert rig.state is State.EXITING
        return rig


class TestAges:
    """Cycles since a value was sent, on links that carry some more slowly."""

    TARGET, TARGET_VELOCITY, ACTUAL, VELOCITY = range(4)

    @pytest.mark.parametrize(("age", "lost"), [(0, 1), (1, 0)])
    def test_a_target_of_an_earlier_cycle_is_no_answer_lost(self, age, lost):
        rig, _ = moving(100)
        before = rig.axes.copy()
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.cycle()
        rig.axes[:] = before
        rig.ages[0, self.TARGET] = age
        rig.cycle()
        assert rig.session.counters.unanswered == lost

    @pytest.mark.parametrize(("axis", "refused"), [(2, False), (3, True)])
    @pytest.mark.parametrize("column", [TARGET, TARGET_VELOCITY, VELOCITY])
    def test_after_a_long_gap_those_of_a_closed_axis_do_not_matter(self, column, axis, refused):
        rig = TestRecordsWhileLeaving.leaving(axis=2)
        rig.miss(10)
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.ages[axis, column] = 1
        rig.cycle()
        assert bool(rig.seen(Refused)) == refused
        if refused:
            assert type(rig.refusal) is MotionUnknown

    def test_a_target_not_sent_in_each_cycle_may_have_moved_for_all_of_them(self):
        """Mode 7 holds target and offset together to the velocity of the joint, here 2 rad/s."""
        way = rig_way(2.0 * PERIOD)
        for ages, refused in (((1, 2, 0), False), ((0, 0, 0), True)):
            rig = running(Correction(rows=50), mode=Mode.DELTA_POSITION)
            rig.ages = np.zeros((N, 8), np.uint16)
            for age in ages[:-1]:
                rig.ages[:, self.TARGET] = age
                rig.cycle()
            rig.ages[:, self.TARGET] = ages[-1]
            rig.axes["d"][:, [0, 2]] += 2.9 * way[:, None]
            rig.cycle()
            assert bool(rig.seen(Refused)) == refused


def rig_way(radians: float) -> np.ndarray:
    """Motor revolutions of joint 1 alone."""
    train = Rig().train
    first = radians * (np.arange(N) == 0)
    return train.motor_revolutions(first) - train.motor_revolutions(np.zeros(N))


class TestCorrections:
    def test_a_velocity_fed_forward_is_no_way(self):
        """0.05 rad from the end of its range a joint may well go at 0.1 rad/s."""
        near = START.copy()
        near[0] = 1.95
        rig = Rig(mode=Mode.VELOCITY)
        rig.put_arm_at(near)
        rig.session.request(Correction(bump([0.1, 0, 0, 0, 0, 0], 300)))
        rig.open()
        rig.run_to("completed")

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_one_requested_in_open_mode_begins_only_where_the_arm_stands(self, mode):
        for column, refused in ((3, True), (4, False)):
            rig = opened(mode=mode)
            rig.axes["d"][1, column] = 6e-4
            rig.session.request(Correction(rows=5))
            rig.cycle()
            assert bool(rig.seen(Refused)) == refused
            if refused:
                assert type(rig.refusal) is NotAtStandstill


TIMEOUT = round(EXIT_TIMEOUT / PERIOD)


class TestExitNotGranted:
    def test_one_that_leaves_in_the_last_cycle_is_in_time(self):
        rig = exiting()
        rig.cycle(TIMEOUT - 1)
        rig.cycle(mode=Mode.CLOSED)
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


class TestWatchedWhileLeaving:
    @pytest.mark.parametrize("column", [0, 2, 4])
    @pytest.mark.parametrize("value", [99.0, np.nan])
    def test_an_axis_that_has_closed_is_the_controllers_own_business(self, column, value):
        rig = exiting()
        rig.axes["mode"][3] = Mode.CLOSED
        rig.axes["d"][3, column] = value
        rig.cycle()
        assert rig.state is State.EXITING
        rig.cycle(mode=Mode.CLOSED)
        assert rig.ended.outcome == "completed"


class TestRequestWhileHeldOpen:
    def held(self, **options) -> Rig:
        return opened(20, **options)

    def begin(self, rig):
        source = Cruise()
        rig.session.request(source)
        return source, rig.cycle()

    def test_the_motion_begins_where_the_arm_is_held(self):
        rig = self.held()
        source, answer = self.begin(rig)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], rig.axes["d"][:, 0])
        assert (source.advances, rig.state) == (0, State.OPEN)

    def test_none_is_taken_while_open_mode_is_left(self):
        rig = exiting()
        with pytest.raises(RequestError, match="exiting"):
            rig.session.request(still(3))


def test_a_second_motion_in_the_same_interval_after_a_fault_is_not_possible():
    rig = running(smooth_move(np.full(N, 0.1), 300))
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
        rig = opened(mode=mode)
        rig.session.stop()
        rig.cycle()
        rig.axes["mode"][2] = Mode.CLOSED
        rig.cycle()
        rig.axes["mode"][2] = mode
        assert not rig.cycle().axes["d"].any()


class TestAStrayAxisWhileCorrectionsEnd:
    """It is in a mode of positions, so its own target is given back: if it can be held there."""

    def stray(self, wanted, target=None, age=0, opening=False):
        rig = opened(5, mode=wanted)
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
        rig.cycle(mode=Mode.CLOSED)
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


NOT_FINITE = [np.nan, np.inf, -np.inf]


class OtherAxis(Rig):
    """A seventh axis is open in the controller, of this arm or of another."""

    def __init__(self, arm: int):
        axis = 6 if arm == 1 else 0
        table = np.full((4, 10), 0xFF)
        table[0, :N] = range(N)
        table[arm - 1, axis] = N
        super().__init__(
            init=init_packet(n_axes=N + 1, open_axes_map=table),
            slots=np.arange(N),
            other_axes={(arm, axis + 1)},
        )
        self.arm = arm
        self.drive = DRIVE_ON

    def packet(self) -> bytes:
        packet = bytearray(super().packet())
        packet[4 + self.arm - 1] = self.drive
        return bytes(packet)


@pytest.mark.parametrize("arm", [1, 2])
@pytest.mark.parametrize("value", NOT_FINITE)
class TestOtherAxes:
    def refused(self, rig, answer, arm):
        assert all_drive_off(answer)
        assert np.isfinite(answer.axes["d"]).all()
        assert rig.state is State.FAULTED
        error = rig.refusal
        assert type(error) is TargetNotFinite
        assert isinstance(error, NotFinite)
        assert (error.arm, error.joint) == (arm, 6 if arm == 1 else 0)
        assert f"axis {error.joint + 1} of arm {arm}" in str(error)

    def test_beside_a_motion(self, arm, value):
        rig = OtherAxis(arm)
        rig.session.request(Cruise())
        rig.open()
        rig.cycle(50)
        rig.axes["d"][6, 0] = value
        self.refused(rig, rig.cycle(), arm)
        assert rig.ended.outcome == "refused"

    def test_while_ours_are_closed_it_is_told_once_and_asked_for_in_each_cycle(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.session.request(still(3))
        rig.axes["mode"][6] = Mode.POSITION
        rig.cycle()
        rig.axes["d"][6, 0] = value
        self.refused(rig, rig.cycle(), arm)
        assert rig.ended.outcome == "refused"
        for _ in range(5):
            assert all_drive_off(rig.cycle())
        assert len(rig.seen(Refused)) == 1
        rig.axes["d"][6, 0] = 1.0
        assert rig.cycle().axes["mode"][6] == Mode.POSITION
        rig.axes["d"][6, 0] = value
        rig.cycle()
        assert len(rig.seen(Refused)) == 2

    def test_no_motion_begins_beside_it(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        rig.cycle(3)
        rig.session.request(source := Cruise())
        assert all_drive_off(rig.cycle(mode=Mode.POSITION))
        assert source.begun_at is None
        assert rig.ended.outcome == "refused"

    def test_without_its_drive_it_is_echoed(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.drive = 0
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        packet = rig.packet()
        answer = CyclicPacket.decode(rig.send(packet), N + 1)
        assert answer.axes[6].tobytes() == CyclicPacket.decode(packet, N + 1).axes[6].tobytes()
        assert not rig.seen(Refused)


class TestPause:
    def paused(self) -> Rig:
        rig = opened(5)
        rig.axes["mode"][5] = Mode.PAUSE_BY_CONTROLLER
        rig.cycle()
        assert rig.state is State.FREEZING
        return rig

    def test_axes_still_open_are_held_at_their_target(self):
        rig = self.paused()
        rig.axes["d"][0, 0] += 1.9
        answer = rig.cycle()
        assert answer.axes["mode"].tolist() == [4, 4, 4, 4, 4, 0]
        assert answer.axes["d"][0, 0] == rig.axes["d"][0, 0]
        assert not rig.seen(Refused)

    @pytest.mark.parametrize("value", NOT_FINITE)
    def test_not_at_what_is_no_number(self, value):
        rig = self.paused()
        rig.axes["d"][0, 0] = value
        answer = rig.cycle()
        assert all_drive_off(answer)
        assert np.isfinite(answer.axes["d"]).all()
        assert isinstance(rig.refusal, NotFinite)
        assert rig.state is State.FAULTED

    @pytest.mark.parametrize("column", [0, 2])
    def test_axes_still_open_are_not_held_at_a_target_that_is_far_from_the_arm(self, column):
        rig = self.paused()
        rig.axes["d"][0, column] += 2.1
        for _ in range(5):
            assert rig.cycle().axes["mode"].tolist() == [508, 4, 4, 4, 4, 0]
        assert [type(event.error) for event in rig.seen(Refused)] == [FollowingError]


def test_a_mode_unknown_here_beside_open_axes_asks_for_drive_off():
    rig = closed()
    rig.session.request(source := still(3, START))
    assert all_drive_off(rig.cycle(mode=[4, 4, 4, 4, 4, 3]))
    assert rig.state is State.FAULTED
    assert rig.ended.outcome == "lost"
    assert source.index == 0
