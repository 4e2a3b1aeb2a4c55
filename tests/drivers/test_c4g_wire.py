"""C4G Open as a session reads it: sorts of packets, and packets made on this computer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.c4g_packets import DRIVE_ON, CyclicPacket, InitPacket, Mode
from drivers.c4g_wire import C4gProtocol, PacketClassifier
from drivers.wire import ArmSettings
from tests.drivers.rig import PERIOD, N, drive_train

pytestmark = pytest.mark.safety

CLOSED, OPEN = Mode.CLOSED, Mode.POSITION
POSITION = np.linspace(-0.4, 0.6, N)
LIMITS = np.arange(1.0, 1.0 + N), np.arange(11.0, 11.0 + N)
TRAIN = replace(drive_train(), k54=0.1, k64=0.2, k65=0.3)


def own_packets():
    return C4gProtocol().own_packets(TRAIN, POSITION, PERIOD, LIMITS)


def test_a_packet_states_no_cause_of_its_own():
    classifier = PacketClassifier(np.arange(N), (1,) * N, 1, OPEN)
    report = classifier.classify(bytes(4), np.full(N, CLOSED, np.int32))
    assert (report.cause, report.remedy) == ("", "")
    assert report.misplacement(2) == "joint 3 is in mode 0; the motion needs 4"


def test_a_sort_is_known_by_length_status_and_modes():
    wire = C4gProtocol().wire(
        ArmSettings(TRAIN, PERIOD, mode=OPEN, arm=1, other_axes=(), only_axis=None,
                    silence_timeout=1.0)
    )  # fmt: skip
    packets = own_packets()
    assert wire.sort(packets.first()).starts
    closed, later, opened = (packets.next(opened=o) for o in (False, False, True))
    sorts = [wire.sort(packet) for packet in (closed, later, opened)]
    assert [sort.number for sort in sorts] == [11, 12, 13]
    assert not any(sort.starts for sort in sorts)
    assert sorts[0].kind == sorts[1].kind != sorts[2].kind
    assert wire.sort(closed + bytes(4)).kind != sorts[0].kind


def test_own_packets_are_of_the_arm_at_rest():
    packets = own_packets()
    init = InitPacket.decode(packets.first())
    assert (init.n_axes, init.period) == (N, PERIOD)
    assert init.wrist_coupling(1) == pytest.approx((0.1, 0.2, 0.3))
    assert not init.kinematic_influence[0, :3].any()
    np.testing.assert_array_equal(init.stated("following_error", 1, N), LIMITS[0])
    np.testing.assert_array_equal(init.stated("current_limit", 1, N), LIMITS[1])
    packet = CyclicPacket.decode(packets.next(opened=True), N)
    assert (packet.number, packet.status[0]) == (11, DRIVE_ON)
    assert packet.axes["mode"].tolist() == [OPEN] * N
    motors = np.float32(TRAIN.motor_revolutions(POSITION))
    np.testing.assert_array_equal(packet.axes["d"][:, 0], motors)
    np.testing.assert_array_equal(packet.axes["d"][:, 2], motors)
    assert not packet.axes["d"][:, [1, 3, 4]].any()
