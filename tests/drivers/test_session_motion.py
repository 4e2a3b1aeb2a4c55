"""A motion from request to closed axes: how open mode begins, every set-point, every record."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import Mode, MotionEnded, MotionStarted, Session, State
from drivers.errors import (
    AxisNotInMode,
)
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    N,
    Rig,
    closed,
    opened,
    resumptions,
    running,
    smooth_move,
    still,
)
from tests.messages import CONTROLLER_CLOSED


class TestMotion:
    def test_states_events_and_outcome_of_two_motions(self):
        rig = Rig()
        for distance in (MOVE, -MOVE):
            assert not rig.session.requested
            here = rig.train.joint_position(rig.axes["d"][:, 0].astype(np.float64))
            rig.session.request(smooth_move(distance, 500, start=here))
            assert rig.session.requested
            rig.open()
            rig.exits_asked = 0
            rig.run()
            end = rig.train.joint_position(rig.axes["d"][:, 0])
            np.testing.assert_allclose(end, here + distance, atol=1e-6)
        motion_states = [State.OPEN, State.EXITING, State.CLOSED]
        assert rig.path == [State.INIT, State.CLOSED, *motion_states, *motion_states]
        assert [event.interval for event in rig.seen(MotionStarted)] == [0, 1]
        ended = [(event.outcome, event.interval) for event in rig.seen(MotionEnded)]
        assert ended == [("completed", 0), ("completed", 1)]
        assert set(rig.records["interval"]) == {-1, 0, 1}

    def test_set_points_on_the_wire_are_those_of_the_source(self):
        rig = running(source := smooth_move(MOVE, 300))
        before = rig.train.motor_revolutions(source.positions[0])
        for index, row in enumerate(source.positions[1:200]):
            assert source.index == index
            answer = rig.cycle()
            motor = rig.train.motor_revolutions(row)
            np.testing.assert_array_equal(answer.axes["d"][:, 0], motor.astype(np.float32))
            # The step is formed in float64: far finer than the float32 positions could give it.
            np.testing.assert_allclose(answer.axes["d"][:, 1], motor - before, atol=2e-7)
            assert not answer.axes["d"][:, 2:].any()
            before = motor

    @pytest.mark.parametrize("mode", [4, 5])
    def test_motion_in_cycles_of_1_ms(self, mode):
        rig = Rig(mode=mode, period=0.001)
        source = smooth_move(MOVE, 600)
        source.velocities = np.diff(source.positions, axis=0, prepend=source.positions[:1]) / 0.001
        rig.session.request(source)
        rig.open()
        rig.cycle(200)
        speed = source.velocities[200]
        np.testing.assert_allclose(rig.records[-1]["commanded_velocity"], speed, 1e-6, 1e-9)
        step = rig.axes["d"][:, 1].astype(np.float64)
        np.testing.assert_allclose(rig.train.joint_velocity(step, 0.001), speed, 1e-5, 1e-7)
        rig.run_to("completed")
        assert rig.session.period == 0.001

    def test_end_is_held_then_exit_is_requested_once(self):
        rig = running(smooth_move(MOVE, 300), 300, settle_cycles=30)
        end = rig.axes["d"][:, 0].copy()
        for status in (*[0] * 29, 1, 0):
            answer = rig.cycle()
            assert answer.status == bytes([status, 0, 0, 0])
            np.testing.assert_array_equal(answer.axes["mode"], Mode.POSITION)
            np.testing.assert_array_equal(answer.axes["d"][:, 0], end)
            assert not answer.axes["d"][:, 1].any()
        assert rig.state is State.EXITING
        rig.cycle(status=0)
        assert rig.ended.outcome == "completed"  # although the drive went off

    def test_motion_that_is_finished_at_its_begin_has_begun(self):
        rig = running(still(1), settle_cycles=0)
        assert rig.exits_asked == 1
        assert rig.seen(MotionStarted) == [MotionStarted(0, rig.session.cycle)]
        rig.cycle(mode=Mode.CLOSED)
        assert rig.ended.outcome == "completed"
        assert rig.session.counters.rejected == 0

    def test_end_is_held_for_200_cycles_where_nothing_is_said(self):
        rig = Rig()
        rig.session = Session(rig.train, rig.guard, rig.ring)
        rig.session.request(still(2))
        rig.open()
        rig.cycle(200)
        assert not rig.exits_asked
        rig.cycle()
        assert rig.exits_asked


class TestStaggeredOpening:
    def test_records_of_open_axes(self):
        rig = closed()
        rig.axes["mode"][[1, 4]] = Mode.POSITION
        rig.cycle()
        record = rig.records[-1]
        has = np.isfinite(record["commanded_position"])
        np.testing.assert_array_equal(has, [False, True, False, False, True, False])
        np.testing.assert_allclose(record["commanded_position"][has], START[has], atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"][has], 0.0)
        assert record["interval"] == -1
        rig.axes["d"][4, 2] += 2.1  # off its target
        assert rig.cycle().axes["mode"].tolist() == [0, 4, 0, 0, 508, 0]

    @pytest.mark.parametrize(
        ("mode", "modes", "outcome", "reason"),
        [
            (Mode.POSITION, Mode.CLOSED, "lost", CONTROLLER_CLOSED),
            (Mode.POSITION_RELATIVE, None, "refused", "joint 3 is in mode 5"),
        ],
    )
    def test_axis_that_closes_or_opens_otherwise_ends_the_motion(
        self, mode, modes, outcome, reason
    ):
        rig = closed()
        rig.session.request(still(3))
        rig.axes["mode"][2] = mode
        rig.cycle()
        rig.cycle(mode=modes)
        assert (rig.ended.outcome, rig.ended.interval) == (outcome, -1)
        assert reason in rig.ended.reason
        rig.open()
        rig.cycle(20)
        assert (rig.state, rig.exits_asked) == (State.OPEN, 0)


def test_a_motion_refused_at_its_first_set_point_has_an_interval():
    rig = closed()
    rig.session.request(still(3))
    rig.axes["d"][1, 1] = 0.1
    rig.cycle(mode=Mode.POSITION)
    assert (rig.ended.outcome, rig.ended.interval) == ("refused", 0)


def test_a_stop_is_over_when_the_drive_goes_off():
    rig = opened(3)
    rig.session.stop()
    rig.cycle(status=0)
    rig.session.request(still(3))
    assert rig.session.requested


class TestOnlyAxis:
    """One axis is open and moved; the others get the safe reply of closed ones."""

    MODES = np.array([Mode.POSITION, *[Mode.CLOSED] * (N - 1)])

    def moving(self, *joints: int, cycles: int = 200) -> tuple[Rig, np.ndarray]:
        """So many cycles of a motion of these joints; the arm's first row of d as it began."""
        rig = Rig(only_axis=1)
        rig.session.request(smooth_move(MOVE * np.isin(np.arange(N), joints), 300))
        rig.close()
        rig.modes = self.MODES
        before = rig.axes["d"].copy()
        for _ in range(cycles):
            answer = rig.cycle()
            if rig.state is State.FAULTED:
                break
            np.testing.assert_array_equal(answer.axes["mode"], self.MODES)
            np.testing.assert_array_equal(answer.axes["d"][1:, :2], before[1:, :2])
            rig.axes["d"][0, :4] = [*answer.axes["d"][0, :2]] * 2
        return rig, before

    def test_set_points_in_its_slot_only(self):
        rig, before = self.moving(0)
        assert rig.state is State.OPEN
        assert abs(rig.axes["d"][0, 0] - before[0, 0]) > 0.5

    @pytest.mark.parametrize("joint", range(1, N))
    def test_motion_of_another_joint_is_refused(self, joint):
        rig, _ = self.moving(0, joint, cycles=300)
        assert type(rig.refusal) is AxisNotInMode
        assert f"joint {joint + 1} is in mode 0; the motion needs 4" in str(rig.refusal)

    def test_closed_axes_have_no_velocity_after_a_long_gap(self):
        rig, _ = self.moving(0)
        resumed = resumptions(rig)
        rig.miss(5)
        rig.axes["d"][0, [0, 2]] += 5 * rig.axes["d"][0, 1]
        rig.cycle()
        ((_, velocity, _),) = resumed
        assert abs(velocity[0]) > 0.1
        assert not velocity[1:].any()

    def test_another_open_axis_ends_the_motion(self):
        rig, _ = self.moving(0, cycles=1)
        rig.modes[2] = Mode.POSITION
        rig.cycle()
        assert type(rig.refusal) is AxisNotInMode
        assert "joint 3 is in mode 4; the motion needs 0" in str(rig.refusal)


class TestRecords:
    def test_record_of_each_cyclic_packet_in_si(self):
        rig = Rig()
        rig.start(cold=True)
        rig.cycle(4, status=0)
        rig.status = 5
        rig.close()
        d = rig.axes["d"]
        d[:, 1] = [0.01, -0.02, 0.03, 0.0, 0.01, -0.01]
        d[:, 3] = [0.02, -0.01, 0.01, 0.02, 0.0, 0.01]
        d[:, 4] = [1, 2, 3, 4, 5, 6]
        rig.axes["extra"] = np.arange(18).reshape(6, 3)
        rig.cycle()
        assert len(rig.records) == 6
        record = rig.records[-1]
        assert (record["cycle"], record["number"], record["gap"]) == (8, 18, 0)
        assert (record["state"], record["status"]) == (State.CLOSED, 5)
        assert record["arrival"] == pytest.approx(rig.now)
        np.testing.assert_array_equal(record["mode"], Mode.CLOSED)
        np.testing.assert_allclose(record["target_position"], START, atol=1e-6)
        np.testing.assert_allclose(record["position"], START, atol=1e-6)
        wire = d.astype(np.float64)
        for name, column in (("target_velocity", 1), ("velocity", 3)):
            expected = rig.train.joint_velocity(wire[:, column], PERIOD)
            np.testing.assert_allclose(record[name], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(record["target_current"], [1, 2, 3, 4, 5, 6])
        np.testing.assert_array_equal(record["model_current"], [0, 3, 6, 9, 12, 15])
        np.testing.assert_array_equal(record["diagonal_inertia"], [1, 4, 7, 10, 13, 16])
        np.testing.assert_array_equal(record["extra3"], [2, 5, 8, 11, 14, 17])
        assert np.isnan(record["commanded_position"]).all()
        assert np.isnan(record["commanded_velocity"]).all()
