"""A motion from request to closed axes, and every set-point on the way."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    Mode,
    MotionEnded,
    MotionStarted,
    RequestError,
    State,
)
from drivers.reply_policy import EXIT_RETRY_CYCLES
from tests.drivers.rig import (
    START,
    Cruise,
    N,
    Rig,
    closed,
    running,
    smooth_move,
    still,
)

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


class TestFromRequestToRest:
    def test_states_events_and_outcome_of_a_whole_motion(self):
        rig = Rig()
        assert not rig.session.requested
        rig.session.request(smooth_move(MOVE, 500))
        assert rig.session.requested
        rig.open()
        rig.run()
        assert not rig.session.requested
        assert rig.path == [
            State.INIT,
            State.CLOSED,
            State.OPEN,
            State.EXITING,
            State.CLOSED,
        ]
        started, ended = rig.seen(MotionStarted), rig.seen(MotionEnded)
        assert [event.interval for event in started] == [0]
        assert [(event.outcome, event.interval) for event in ended] == [("completed", 0)]
        np.testing.assert_allclose(
            rig.train.joint_position(rig.axes["d"][:, 0]), START + MOVE, atol=1e-6
        )

    def test_the_first_set_point_is_the_target_received_bit_for_bit_at_zero_velocity(self):
        rig = Rig()
        rig.session.request(smooth_move(MOVE, 500))
        rig.close()
        rng = np.random.default_rng(4)
        rig.put_arm_at(START + rng.uniform(-1e-6, 1e-6, N))
        received = rig.axes["d"][:, 0].copy()
        answer = rig.cycle(mode=Mode.POSITION)
        assert rig.state is State.OPEN
        np.testing.assert_array_equal(answer.axes["mode"], Mode.POSITION)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], received)
        assert not answer.axes["d"][:, 1:].any()
        assert not answer.axes["extra"].any()
        assert answer.status == bytes(4)

    def test_the_source_begins_at_that_target_and_advances_once_per_later_packet(self):
        source = Cruise()
        rig = running(source)
        np.testing.assert_allclose(
            source.begun_at, rig.train.joint_position(rig.axes["d"][:, 0]), atol=1e-12
        )
        assert source.advances == 0
        rig.cycle(7)
        assert source.advances == 7

    def test_a_source_may_reuse_its_arrays(self):
        class Reusing(Cruise):
            def advance(self):
                position, velocity = super().advance()
                self.q[:], self.qd[:] = position, velocity
                return self.q, self.qd

        def answers(source):
            rig = Rig()
            source.q, source.qd = np.zeros(N), np.zeros(N)
            rig.session.request(source)
            rig.open()
            rig.cycle(100)
            return [reply for _, reply in rig.transcript], rig.records["commanded_velocity"]

        (replies, velocities), (expected, theirs) = answers(Reusing()), answers(Cruise())
        assert replies == expected
        np.testing.assert_array_equal(velocities, theirs)

    def test_set_points_on_the_wire_are_those_of_the_source(self):
        source = smooth_move(MOVE, 300)
        rig = running(source)
        before = rig.train.motor_revolutions(source.positions[0])
        for row in source.positions[1:200]:
            answer = rig.cycle()
            motor = rig.train.motor_revolutions(row)
            np.testing.assert_array_equal(answer.axes["d"][:, 0], motor.astype(np.float32))
            # The step is formed in float64: far finer than the float32 positions could give it.
            np.testing.assert_allclose(answer.axes["d"][:, 1], motor - before, atol=2e-7)
            assert not answer.axes["d"][:, 2:].any()
            before = motor

    def test_the_end_is_held_for_the_settling_time_then_exit_is_asked_for_once(self):
        rig = running(smooth_move(MOVE, 300), 300, settle_cycles=30)
        end = rig.axes["d"][:, 0].copy()
        for _ in range(29):
            answer = rig.cycle()
            assert answer.status == bytes(4)
            np.testing.assert_array_equal(answer.axes["d"][:, 0], end)
            assert not answer.axes["d"][:, 1].any()
        answer = rig.cycle()
        assert answer.status == bytes([1, 0, 0, 0])
        np.testing.assert_array_equal(answer.axes["mode"], Mode.POSITION)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], end)
        assert rig.state is State.EXITING
        answer = rig.cycle()
        assert answer.status == bytes(4)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], end)

    def test_the_wait_for_closed_axes_begins_anew_each_time(self):
        rig = Rig()
        for motion in range(1, 3):
            rig.open()
            rig.session.stop()
            rig.cycle(1 + EXIT_RETRY_CYCLES - 1)
            assert rig.exits_asked == motion
            rig.close()

    def test_axes_that_close_one_by_one_are_answered_one_by_one(self):
        rig = running(smooth_move(MOVE, 300), 305)
        end = rig.axes["d"][:, 0].copy()
        for joint in range(N - 1):
            rig.axes["mode"][joint] = Mode.CLOSED
            rig.axes["d"][joint, 0] += 0.001
            answer = rig.cycle()
            assert rig.state is State.EXITING
            np.testing.assert_array_equal(answer.axes["mode"], rig.axes["mode"])
            np.testing.assert_array_equal(answer.axes["d"][joint + 1 :, 0], end[joint + 1 :])
            np.testing.assert_array_equal(
                answer.axes["d"][: joint + 1, 0], rig.axes["d"][: joint + 1, 0]
            )
        assert rig.ended is None
        rig.cycle(mode=Mode.CLOSED)
        assert rig.ended.outcome == "completed"

    def test_the_drive_going_off_while_leaving_does_not_spoil_a_finished_motion(self):
        rig = running(still(2), 6)
        rig.cycle(status=0)
        assert rig.ended.outcome == "completed"

    def test_two_motions_are_two_intervals(self):
        rig = Rig()
        for _ in range(2):
            rig.session.request(still(4))
            rig.open()
            rig.run()
        assert [event.interval for event in rig.seen(MotionEnded)] == [0, 1]
        assert set(rig.records["interval"]) == {-1, 0, 1}


class TestRequest:
    def test_only_one_motion_at_a_time(self):
        rig = Rig()
        rig.session.request(still(3))
        with pytest.raises(RequestError, match="another motion"):
            rig.session.request(still(3))

    def test_none_after_the_end_of_the_session(self):
        rig = closed()
        rig.cycle(mode=Mode.END_OF_SESSION)
        with pytest.raises(RequestError, match="new one"):
            rig.session.request(still(3))


@pytest.mark.parametrize("period", [0.001, 0.002])
@pytest.mark.parametrize("mode", [1, 4, 5])
def test_a_motion_at_either_cycle_in_every_mode_of_positions(period, mode):
    rig = Rig(mode=mode, period=period)
    source = smooth_move(MOVE, round(0.6 / period))
    source.velocities = np.diff(source.positions, axis=0, prepend=source.positions[:1]) / period
    rig.session.request(source)
    rig.open()
    rig.cycle(200)
    np.testing.assert_allclose(
        rig.records[-1]["commanded_velocity"], source.velocities[200], rtol=1e-6, atol=1e-9
    )
    d = rig.axes["d"].astype(np.float64)
    np.testing.assert_allclose(
        rig.train.joint_velocity(d[:, 1], period), source.velocities[200], rtol=1e-5, atol=1e-7
    )
    rig.run_to("completed")
    assert rig.session.period == period
