"""Drive, open mode or link go away while the arm moves: it always ends in a stop."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    AxisLeft,
    CyclicPacket,
    InitReceived,
    Mode,
    State,
)
from tests.drivers.rig import (
    Cruise,
    N,
    Rig,
    all_drive_off,
    assert_refused,
    moving,
    still,
)


class TestLostMotion:
    def test_the_drive_going_off_in_open_mode_ends_the_motion(self):
        rig, source = moving()
        rig.status = 0
        packet = rig.packet()
        answer = CyclicPacket.decode(rig.send(packet), N)
        assert rig.state is State.DRIVE_OFF
        assert (rig.ended.outcome, rig.ended.reason) == ("lost", "the drive went off")
        np.testing.assert_array_equal(answer.axes, CyclicPacket.decode(packet, N).axes)
        advances = source.advances
        rig.cycle(5)
        assert source.advances == advances

    def test_a_drive_that_comes_back_in_open_mode_is_switched_off_again(self):
        rig, _ = moving()
        rig.status = 0
        rig.cycle()
        rig.status = 5
        assert all_drive_off(rig.cycle())
        assert rig.state is State.FAULTED

    @pytest.mark.parametrize(
        ("mode", "state"),
        [
            (Mode.CLOSED, State.CLOSED),
            (Mode.DRIVING_ON, State.DRIVING_ON),
            (Mode.PAUSE_BY_CONTROLLER, State.FREEZING),
            (Mode.FOLLOWING_ERROR, State.FAULTED),
            (Mode.END_OF_SESSION, State.ENDED),
        ],
    )
    def test_open_mode_going_away_ends_the_motion(self, mode, state):
        rig, _ = moving()
        rig.modes = mode
        rig.cycle()
        assert rig.state is state
        assert rig.ended.outcome == "lost"

    def test_one_axis_leaving_open_mode_while_moving_asks_for_drive_off(self):
        rig, _ = moving()
        rig.axes["mode"][2] = Mode.CLOSED
        error = assert_refused(rig, rig.cycle(), AxisLeft)
        assert (error.joint, error.mode, error.wanted) == (2, 0, 4)

    def test_one_axis_leaving_open_mode_while_held_lets_the_others_be_held(self):
        rig = Rig()
        rig.open()
        rig.cycle(3)
        rig.axes["mode"][2] = Mode.CLOSED
        answer = rig.cycle()
        assert rig.state is State.EXITING
        np.testing.assert_array_equal(answer.axes["mode"], rig.axes["mode"])

    def test_silence_ends_the_motion(self):
        rig, source = moving()
        rig.session.tick(rig.now + 1.0)
        rig.events += rig.session.events()
        assert rig.ended.outcome == "lost"
        assert rig.state is State.FAULTED
        advances = source.advances
        assert all_drive_off(rig.cycle())
        assert source.advances == advances
        assert rig.records["interval"][-2:].tolist() == [0, -1]

    def test_an_init_in_a_running_session_aborts_the_motion_and_starts_over(self):
        rig, source = moving()
        reply = rig.send(rig.init.encode())
        assert reply[:4] == bytes([11, 0, 0, 0])
        assert rig.state is State.INIT
        assert (rig.ended.outcome, rig.ended.reason) == ("lost", "the controller started over")
        assert len(rig.seen(InitReceived)) == 2
        rig.number = 10
        advances = source.advances
        assert all_drive_off(rig.cycle()), "open axes right after init are not believed"
        rig.modes = Mode.CLOSED
        rig.cycle()
        assert rig.state is State.CLOSED
        assert source.advances == advances

    @pytest.mark.parametrize("pause", [Mode.PAUSE_BY_PC, Mode.PAUSE_BY_CONTROLLER])
    def test_after_a_pause_the_axes_have_to_close_first(self, pause):
        rig, _ = moving()
        rig.modes = pause
        rig.cycle()
        rig.modes = Mode.POSITION
        assert all_drive_off(rig.cycle())
        assert rig.state is State.FAULTED
        rig.axes["d"][:, [1, 3]] = 0.0
        rig.open()
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("pause", [Mode.PAUSE_BY_PC, Mode.PAUSE_BY_CONTROLLER])
    def test_a_pause_does_not_lead_from_a_fault_to_open_mode(self, pause):
        rig = Rig()
        rig.close()
        rig.session.tick(rig.now + 2.0)
        assert rig.state is State.FAULTED
        rig.modes = pause
        rig.cycle()
        rig.modes = Mode.POSITION
        assert all_drive_off(rig.cycle())

    def test_a_waiting_motion_is_lost_when_the_controller_starts_over(self):
        rig = Rig()
        rig.close()
        rig.session.request(still(3))
        rig.send(rig.init.encode())
        assert rig.ended.outcome == "lost"
        assert rig.ended.interval == -1

    @pytest.mark.parametrize("pause", [Mode.PAUSE_BY_PC, Mode.PAUSE_BY_CONTROLLER])
    def test_a_waiting_motion_is_lost_by_a_pause(self, pause):
        rig = Rig()
        rig.close()
        rig.session.request(still(3))
        rig.modes = pause
        rig.cycle()
        assert (rig.ended.outcome, rig.ended.interval) == ("lost", -1)
        assert rig.ended.reason == "the controller paused the exchange"
        rig.session.request(still(3))
        rig.cycle(3)
        rig.open()
        rig.run()
        assert rig.ended.outcome == "completed"

    def test_a_motion_asked_for_while_axes_of_the_last_are_open_was_in_no_interval(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.open()
        while rig.session.requested:
            rig.cycle()
            rig.status = 0 if rig.state is State.EXITING else 5  # as a corrupted packet says
        assert (rig.ended.outcome, rig.ended.interval) == ("completed", 0)
        rig.session.request(still(3))
        rig.status = 5
        assert all_drive_off(rig.cycle())
        assert (rig.ended.outcome, rig.ended.interval) == ("lost", -1)

    @pytest.mark.parametrize("mode", [Mode.CLOSED, Mode.DRIVING_ON])
    def test_a_waiting_motion_is_lost_when_the_drive_goes_off(self, mode):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.start()
        rig.modes = mode
        rig.cycle()
        assert rig.session.requested
        rig.status = 0
        rig.cycle()
        assert (rig.ended.outcome, rig.ended.reason) == ("lost", "the drive went off")
        rig.status = 5
        rig.open()
        rig.cycle(10)
        assert source.begun_at is None

    def test_a_waiting_motion_is_lost_when_the_drive_is_switched_on_again(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        rig.modes = Mode.DRIVING_ON
        rig.cycle()
        assert (rig.ended.outcome, rig.ended.reason) == ("lost", "the drive was switched on again")

    def test_a_motion_requested_while_the_drive_is_off_waits_for_it(self):
        rig = Rig()
        rig.close()
        rig.status = 0
        rig.cycle()
        rig.session.request(still(3))
        rig.cycle(3)
        rig.status, rig.modes = 5, Mode.DRIVING_ON
        rig.cycle(3)
        rig.open()
        rig.run()
        assert rig.ended.outcome == "completed"
