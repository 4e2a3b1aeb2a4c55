"""Axes that are open while nothing is moved are given back their target: if that can be held."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import FollowingError, Mode, NotFinite, Refused, State
from drivers.errors import TargetNotFinite
from drivers.packets import DRIVE_ON, CyclicPacket
from tests.drivers.rig import (
    START,
    Cruise,
    N,
    Rig,
    all_drive_off,
    init_packet,
    still,
)

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
        rig.modes = Mode.POSITION
        assert all_drive_off(rig.cycle())
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
        rig = Rig()
        rig.open()
        rig.cycle(5)
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
    rig = Rig()
    rig.close()
    rig.session.request(source := still(3, START))
    rig.modes = [4, 4, 4, 4, 4, 3]
    assert all_drive_off(rig.cycle())
    assert rig.state is State.FAULTED
    assert rig.ended.outcome == "lost"
    assert source.index == 0
