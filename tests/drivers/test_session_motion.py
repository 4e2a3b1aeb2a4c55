"""A motion from request to closed axes, and every set-point on the way."""

from __future__ import annotations

import numpy as np
import pytest
from rig import PERIOD, START, Cruise, N, Rig, init_packet, limits, smooth_move, still

from drivers import (
    CurrentLimit,
    CyclicPacket,
    FirstSetPoint,
    GapSeen,
    Mode,
    MotionEnded,
    MotionStarted,
    NotAtStandstill,
    NotFinite,
    PositionLimit,
    RequestError,
    State,
)
from drivers.answers import EXIT_RETRY_CYCLES
from drivers.packets import NO_SLOT

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


class TestFromRequestToRest:
    def test_states_events_and_outcome_of_a_whole_motion(self):
        rig = Rig()
        rig.session.request(smooth_move(MOVE, 500))
        rig.open()
        rig.run()
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
        rig.modes = Mode.POSITION
        answer = rig.cycle()
        assert rig.state is State.OPEN
        np.testing.assert_array_equal(answer.axes["mode"], Mode.POSITION)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], received)
        assert not answer.axes["d"][:, 1:].any()
        assert not answer.axes["extra"].any()
        assert answer.status == bytes(4)

    def test_the_source_begins_at_that_target_and_advances_once_per_later_packet(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
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
        rig = Rig()
        source = smooth_move(MOVE, 300)
        rig.session.request(source)
        rig.open()
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
        rig = Rig(settle_cycles=30)
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        rig.cycle(300)
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

    def test_exit_is_asked_for_again_if_the_controller_stays_open(self):
        rig = Rig()
        rig.session.request(still(2))
        rig.open()
        rig.cycle(6)
        assert rig.exits_asked == 1
        rig.cycle(EXIT_RETRY_CYCLES)
        assert rig.exits_asked == 2

    def test_the_wait_for_closed_axes_begins_anew_each_time(self):
        rig = Rig()
        for motion in range(1, 3):
            rig.open()
            rig.session.stop()
            rig.cycle(1 + EXIT_RETRY_CYCLES - 1)
            assert rig.exits_asked == motion
            rig.close()

    def test_axes_that_close_one_by_one_are_answered_one_by_one(self):
        rig = Rig()
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        rig.cycle(305)
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
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.ended.outcome == "completed"

    def test_the_drive_going_off_while_leaving_does_not_spoil_a_finished_motion(self):
        rig = Rig()
        rig.session.request(still(2))
        rig.open()
        rig.cycle(6)
        rig.status = 0
        rig.cycle()
        assert rig.ended.outcome == "completed"

    def test_two_motions_are_two_intervals(self):
        rig = Rig()
        for _ in range(2):
            rig.session.request(still(4))
            rig.open()
            rig.run()
        assert [event.interval for event in rig.seen(MotionEnded)] == [0, 1]
        assert set(rig.records["interval"]) == {-1, 0, 1}

    def test_without_a_motion_the_first_set_point_is_held(self):
        rig = Rig()
        rig.open()
        target = rig.axes["d"][:, 0].copy()
        answer = rig.cycle(50)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], target)
        assert not answer.axes["d"][:, 1].any()
        assert rig.exits_asked == 0

    def test_a_motion_may_be_requested_while_the_arm_is_held(self):
        rig = Rig()
        rig.open()
        rig.cycle(3)
        source = smooth_move(MOVE, 300)
        rig.session.request(source)
        rig.cycle()
        assert (len(rig.seen(MotionStarted)), source.index) == (1, 0)
        rig.run()
        assert rig.ended.outcome == "completed"

    def test_two_arms_share_a_packet_and_only_ours_leaves(self):
        axes_map = np.full((4, 10), NO_SLOT)
        axes_map[0, 0] = 3
        axes_map[1, :N] = [6, 5, 4, 2, 1, 0]
        init = init_packet(n_axes=7, open_axes_map=axes_map)
        init.record["following_error"][0, 1] = 2.0
        init.record["current_limit"][0, 1] = 20.0
        rig = Rig(init=init, slots=np.array([6, 5, 4, 2, 1, 0]), arm=2)
        rig.start()
        self_status = bytes([5, 5, 0, 0])

        def cycle(mode):
            rig.axes["mode"][rig.slots] = mode
            packet = rig.packet()
            packet = packet[:4] + self_status + packet[8:]
            answer = CyclicPacket.decode(rig.send(packet), 7)
            rig._obey(answer)
            return answer

        rig.session.request(smooth_move(MOVE, 300))
        cycle(Mode.CLOSED)
        cycle(Mode.POSITION)
        for _ in range(300):
            answer = cycle(Mode.POSITION)
        np.testing.assert_allclose(
            rig.train.joint_position(answer.axes["d"][rig.slots, 0]), START + MOVE, atol=1e-6
        )
        for _ in range(5):
            answer = cycle(Mode.POSITION)
        assert answer.status == bytes([0, 1, 0, 0])
        assert answer.axes["mode"][3] == Mode.CLOSED


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

    def test_a_target_within_ten_per_cent_is_taken(self):
        rig = self.opening_with(lambda d: d[:, 2].__iadd__(0.19))
        assert rig.state is State.OPEN

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

    def test_encoder_noise_of_an_axis_at_rest_is_not_motion(self):
        two_increments_of_12_bit = 2.0 / 4096.0
        rig = self.opening_with(lambda d: d[:, 3].__iadd__(two_increments_of_12_bit))
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("field", [0, 1, 2, 3])
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_what_is_not_a_number_is_refused(self, field, value):
        def change(d):
            d[4, field] = value

        rig = self.opening_with(change)
        error = self.refused(rig)
        assert type(error) is NotFinite
        assert error.joint == 4
        assert np.isfinite(rig.answer.axes["d"]).all()

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
        rig = Rig()
        rig.close()
        rig.axes["d"][0, 2] += 1.0
        rig.modes = Mode.POSITION
        assert (rig.cycle().axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()

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
        rig.modes = Mode.POSITION
        rig.cycle()
        assert rig.state is State.OPEN
        assert source.begun_at is not None

    def test_records_say_which_axes_had_a_set_point(self):
        rig = Rig()
        rig.close()
        rig.axes["mode"][[1, 4]] = Mode.POSITION
        rig.cycle()
        record = rig.records[-1]
        has = np.isfinite(record["commanded_position"])
        np.testing.assert_array_equal(has, [False, True, False, False, True, False])
        np.testing.assert_allclose(record["commanded_position"][has], START[has], atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"][has], 0.0)
        assert record["interval"] == -1

    def test_an_open_axis_that_is_not_where_its_target_is_gets_508(self):
        rig = Rig()
        rig.close()
        rig.axes["mode"][[1, 4]] = Mode.POSITION
        rig.axes["d"][4, 2] += 2.1
        answer = rig.cycle()
        assert answer.axes["mode"].tolist() == [0, 4, 0, 0, 508, 0]

    def test_axes_that_close_again_leave_the_motion_waiting(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        rig.axes["mode"][0] = Mode.POSITION
        rig.cycle()
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.ended is None
        rig.open()
        rig.run()
        assert rig.ended.outcome == "completed"

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
        rig = Rig()
        rig.close()
        rig.modes = Mode.POSITION_RELATIVE
        answer = rig.cycle()
        assert rig.state is State.OPENING
        np.testing.assert_array_equal(answer.axes["d"][:, 0], rig.axes["d"][:, 0])
        rig.modes = Mode.DELTA_POSITION
        answer = rig.cycle()
        np.testing.assert_array_equal(answer.axes["mode"], Mode.DELTA_POSITION)
        assert not answer.axes["d"].any()


class TestGaps:
    def test_motion_goes_on_one_period_after_a_gap(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(300)
        rig.miss(2)
        rig.cycle()
        assert source.advances == 301
        assert rig.seen(GapSeen) == [GapSeen(2, rig.records["cycle"][-1])]
        last, before = rig.records[-1], rig.records[-2]
        assert last["gap"] == 2
        assert last["cycle"] - before["cycle"] == 3
        assert rig.state is State.OPEN
        assert source.stops == 0

    def test_more_than_the_allowed_gap_stops_on_the_path(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(300)
        rig.miss(3)
        rig.cycle()
        assert source.stops == 1
        rig.run()
        assert rig.ended.outcome == "stopped"
        assert "3 packets" in rig.ended.reason

    def test_two_gaps_that_are_small_enough_do_not_add_up(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        for _ in range(20):
            rig.miss(2)
            rig.cycle(2)
        assert source.stops == 0
        assert rig.session.counters.missed == 40

    def test_a_duplicate_does_not_advance_the_motion(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(50)
        packet, reply = rig.transcript[-1]
        assert rig.send(packet) == reply
        assert source.advances == 50

    def test_motion_survives_the_wrap_of_the_numbers(self):
        rig = Rig(ring_capacity=64)
        rig.close()
        rig.cycle(0x7FFF - rig.number - 20)
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        rig.run()
        assert rig.ended.outcome == "completed"
        assert rig.session.counters.missed == 0


class TestStop:
    def test_stop_brings_the_motion_to_rest_on_its_path_and_leaves(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(400)
        rig.session.stop()
        rig.session.stop("once more")
        rig.run()
        assert source.stops == 1
        assert rig.ended == MotionEnded("stopped", "a stop was asked for", 0, rig.ended.cycle)
        commanded = rig.records["commanded_position"]
        moved = commanded[np.isfinite(commanded[:, 0])]
        np.testing.assert_allclose(moved[:, 1:], START[1:] + 0 * moved[:, 1:], atol=1e-6)
        assert np.abs(np.diff(moved[-5:, 0])).max() == 0.0

    def test_a_motion_that_has_not_begun_is_dropped(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.session.stop("changed my mind")
        rig.close()
        assert rig.ended.outcome == "stopped"
        rig.open()
        rig.cycle(10)
        assert rig.seen(MotionStarted) == []

    def test_stop_while_holding_leaves_open_mode(self):
        rig = Rig()
        rig.open()
        rig.session.stop()
        rig.cycle()
        assert rig.exits_asked == 1
        assert rig.state is State.EXITING

    def test_stop_with_axes_closed_changes_nothing(self):
        rig = Rig()
        rig.close()
        rig.session.stop()
        rig.modes = Mode.POSITION
        rig.cycle(3)
        assert rig.exits_asked == 0


class TestRequest:
    def test_only_one_motion_at_a_time(self):
        rig = Rig()
        rig.session.request(still(3))
        with pytest.raises(RequestError, match="another motion"):
            rig.session.request(still(3))

    def test_none_while_open_mode_is_being_left(self):
        rig = Rig()
        rig.open()
        rig.session.stop()
        rig.cycle()
        with pytest.raises(RequestError) as caught:
            rig.session.request(still(3))
        assert caught.value.state == "exiting"

    def test_none_after_the_end_of_the_session(self):
        rig = Rig()
        rig.close()
        rig.modes = Mode.END_OF_SESSION
        rig.cycle()
        with pytest.raises(RequestError, match="new one"):
            rig.session.request(still(3))


class TestRecords:
    def test_one_record_per_answered_cyclic_packet_with_the_packet_in_si(self):
        rig = Rig()
        rig.start(cold=True)
        rig.status = 0
        rig.cycle(4)
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

    def test_records_of_an_interval_hold_what_was_commanded_and_nothing_else_does(self):
        rig = Rig()
        source = smooth_move(MOVE, 300)
        rig.session.request(source)
        rig.open()
        rig.run()
        rig.cycle(5)
        inside = rig.records[rig.records["interval"] == 0]
        outside = rig.records[rig.records["interval"] == -1]
        # first set-point, 300 more, 5 of settling of which the last asks for exit
        assert len(inside) == 306
        np.testing.assert_allclose(inside["commanded_position"][:301], source.positions, atol=1e-7)
        np.testing.assert_allclose(
            inside["commanded_velocity"][1:301], source.velocities[1:], atol=1e-4
        )
        assert set(inside["state"]) == {State.OPEN, State.EXITING}
        assert np.isnan(outside["commanded_position"]).all()

    def test_the_commanded_velocity_is_the_one_on_the_wire(self):
        rig = Rig()
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        answer = rig.cycle(150)
        sent = rig.train.joint_velocity(answer.axes["d"][:, 1].astype(np.float64), PERIOD)
        np.testing.assert_allclose(rig.records[-1]["commanded_velocity"], sent, rtol=1e-6)
