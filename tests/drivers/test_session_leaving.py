"""What is recorded and watched while open mode is left, and at the edges of corrections."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import FollowingError, Mode, Refused, State
from drivers.errors import MotionUnknown, NotAtStandstill
from drivers.states import CORRECTION_MODES
from tests.drivers.rig import PERIOD, START, Correction, N, Rig, bump, moving


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
        rig = Rig(mode=mode)
        rig.open()
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
        rig = Rig(mode=mode)
        rig.open()
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
        rig = Rig()
        rig.open()
        rig.cycle(3)
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
            rig = Rig(mode=Mode.DELTA_POSITION)
            rig.session.request(Correction(rows=50))
            rig.open()
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
        rig.run()
        assert rig.ended.outcome == "completed"

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_one_requested_in_open_mode_begins_only_where_the_arm_stands(self, mode):
        for column, refused in ((3, True), (4, False)):
            rig = Rig(mode=mode)
            rig.open()
            rig.axes["d"][1, column] = 6e-4
            rig.session.request(Correction(rows=5))
            rig.cycle()
            assert bool(rig.seen(Refused)) == refused
            if refused:
                assert type(rig.refusal) is NotAtStandstill
