"""How open mode begins: the first set-point, and axes that open one after the other."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    AxisLeft,
    CurrentLimit,
    FirstSetPoint,
    Mode,
    MotionStarted,
    NotAtStandstill,
    PositionLimit,
    State,
)
from tests.drivers.rig import (
    START,
    Cruise,
    N,
    Rig,
    closed,
    init_packet,
    limits,
    smooth_move,
    still,
)

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


class TestFirstSetPoint:
    """Ten per cent of the axis's following-error threshold, and at rest; refused, never clamped."""

    def opening_with(self, change, **options) -> Rig:
        rig = Rig(**options)
        rig.session.request(smooth_move(MOVE, 300))
        rig.close()
        change(rig.axes["d"])
        rig.modes = Mode.POSITION
        rig.answer = rig.cycle()
        return rig

    def refused(self, rig: Rig):
        assert (rig.answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert rig.ended.outcome == "refused"
        assert rig.seen(MotionStarted) == []
        assert rig.state is State.FAULTED
        assert np.isnan(rig.records[-1]["commanded_position"]).all()
        return rig.refusal

    @pytest.mark.parametrize("joint", range(N))
    @pytest.mark.parametrize("sign", [-1, 1])
    def test_a_target_away_from_the_arm_is_refused(self, joint, sign):
        def change(d):
            d[joint, 2] = d[joint, 0] + sign * 0.21

        error = self.refused(self.opening_with(change))
        assert type(error) is FirstSetPoint
        assert error.joint == joint
        assert error.value == pytest.approx(0.21, abs=1e-5)
        assert error.bound == pytest.approx(0.2)

    def test_the_narrower_threshold_of_cell_and_controller_counts(self):
        def change(d):
            d[1, 2] += 0.06

        cell = limits(following_error=np.full(N, 0.5))
        assert self.refused(self.opening_with(change, guard_limits=cell)).bound == pytest.approx(
            0.05
        )
        controller = init_packet(arm_1={"following_error": np.full(N, 0.5)})
        assert self.refused(self.opening_with(change, init=controller)).bound == pytest.approx(0.05)

    @pytest.mark.parametrize("field", [1, 3], ids=["target", "actual"])
    def test_an_axis_in_motion_is_refused(self, field):
        def change(d):
            d[2, field] = -0.001

        error = self.refused(self.opening_with(change))
        assert type(error) is NotAtStandstill
        assert error.joint == 2

    def test_an_axis_that_already_needs_too_much_current_is_refused(self):
        def change(d):
            d[3, 4] = 20.1

        assert type(self.refused(self.opening_with(change))) is CurrentLimit

    def test_an_arm_outside_its_range_is_refused(self):
        rig = Rig()
        rig.session.request(smooth_move(MOVE, 300))
        rig.close()
        outside = START.copy()
        outside[3] = 2.01
        rig.put_arm_at(outside)
        rig.modes = Mode.POSITION
        rig.answer = rig.cycle()
        error = self.refused(rig)
        assert type(error) is PositionLimit
        assert (error.joint, error.bound) == (3, 2.0)
        assert error.value == pytest.approx(2.01, abs=1e-5)

    def test_the_rule_holds_without_a_motion_too(self):
        rig = closed()
        rig.axes["d"][0, 2] += 1.0
        assert (rig.cycle(mode=Mode.POSITION).axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()

    def test_a_source_that_wants_to_begin_elsewhere_is_refused(self):
        class Elsewhere(Cruise):
            def begin(self, position):
                raise ValueError("start is 3 rad away")

        rig = Rig()
        rig.session.request(Elsewhere())
        rig.answer = rig.open()
        assert "3 rad away" in str(self.refused(rig))


class TestStaggeredOpening:
    def test_nothing_moves_until_the_last_axis_is_open(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.close()
        target = rig.axes["d"][:, 0].copy()
        for joint in range(N - 1):
            rig.axes["mode"][joint] = Mode.POSITION
            for _ in range(3):
                answer = rig.cycle()
                assert rig.state is State.OPENING
                np.testing.assert_array_equal(answer.axes["mode"], rig.axes["mode"])
                np.testing.assert_array_equal(answer.axes["d"][:, 0], target)
                assert not answer.axes["d"][:, 1:].any()
        assert source.begun_at is None
        rig.cycle(mode=Mode.POSITION)
        assert rig.state is State.OPEN
        assert source.begun_at is not None

    def test_records_say_which_axes_had_a_set_point(self):
        rig = closed()
        rig.axes["mode"][[1, 4]] = Mode.POSITION
        rig.cycle()
        record = rig.records[-1]
        has = np.isfinite(record["commanded_position"])
        np.testing.assert_array_equal(has, [False, True, False, False, True, False])
        np.testing.assert_allclose(record["commanded_position"][has], START[has], atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"][has], 0.0)
        assert record["interval"] == -1

    def test_an_open_axis_that_is_not_where_its_target_is_gets_508(self):
        rig = closed()
        rig.axes["mode"][[1, 4]] = Mode.POSITION
        rig.axes["d"][4, 2] += 2.1
        answer = rig.cycle()
        assert answer.axes["mode"].tolist() == [0, 4, 0, 0, 508, 0]

    def test_axes_that_close_again_lose_the_motion(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        rig.axes["mode"][0] = Mode.POSITION
        rig.cycle()
        rig.cycle(mode=Mode.CLOSED)
        assert (rig.ended.outcome, rig.ended.interval) == ("lost", -1)
        rig.open()
        rig.cycle(20)
        assert (rig.state, rig.exits_asked) == (State.OPEN, 0)

    def test_a_motion_does_not_start_in_a_mode_it_was_not_asked_for(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        rig.axes["mode"][2] = Mode.POSITION_RELATIVE
        answer = rig.cycle()
        assert (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        assert rig.ended.outcome == "refused"
        assert "mode 5" in rig.ended.reason

    def test_without_a_motion_another_open_mode_is_answered_by_holding(self):
        rig = closed()
        answer = rig.cycle(mode=Mode.POSITION_RELATIVE)
        assert rig.state is State.OPENING
        np.testing.assert_array_equal(answer.axes["d"][:, 0], rig.axes["d"][:, 0])
        answer = rig.cycle(mode=Mode.DELTA_POSITION)
        np.testing.assert_array_equal(answer.axes["mode"], Mode.DELTA_POSITION)
        assert not answer.axes["d"].any()


class TestOnlyAxis:
    """One axis is open and moved; the others keep the safe answer of closed ones."""

    def moving(self, by: np.ndarray) -> Rig:
        rig = Rig(only_axis=1)
        rig.session.request(smooth_move(by, 300))
        rig.close()
        rig.modes = np.array([Mode.POSITION, *[Mode.CLOSED] * (N - 1)])
        return rig

    def test_only_its_slot_carries_set_points(self):
        rig = self.moving(MOVE * (np.arange(N) == 0))
        before = rig.axes["d"].copy()
        for _ in range(200):
            answer = rig.cycle()
            assert rig.state is State.OPEN
            np.testing.assert_array_equal(answer.axes["mode"], rig.modes)
            np.testing.assert_array_equal(answer.axes["d"][1:, :2], before[1:, :2])
            rig.axes["d"][0, :4] = [*answer.axes["d"][0, :2]] * 2
        assert abs(rig.axes["d"][0, 0] - before[0, 0]) > 0.5

    @pytest.mark.parametrize("joint", range(1, N))
    def test_a_motion_of_another_joint_is_refused(self, joint):
        rig = self.moving(MOVE * np.isin(np.arange(N), [0, joint]))
        for _ in range(300):
            answer = rig.cycle()
            if rig.state is State.FAULTED:
                break
            rig.axes["d"][0, :4] = [*answer.axes["d"][0, :2]] * 2
        assert type(rig.refusal) is AxisLeft
        assert (rig.refusal.joint, rig.refusal.mode) == (joint, Mode.CLOSED)

    def test_another_axis_that_opens_ends_the_motion(self):
        rig = self.moving(MOVE * (np.arange(N) == 0))
        rig.cycle()
        rig.modes[2] = Mode.POSITION
        rig.cycle()
        assert type(rig.refusal) is AxisLeft
        assert rig.refusal.joint == 2
