"""The real kernel's CAN sockets on a virtual interface `vcan0`.

Skipped where there is none. `tests/qemu` runs this file in an emulated machine that has one; by
hand: ``ip link add dev vcan0 type vcan && ip link set vcan0 mtu 72 up``.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers import CyclicPacket, MotionEnded
from drivers.transports.can.transport import CanSpec
from sim_fixtures.can_link import open_controller_link
from tests.drivers.can_bench import PERIOD, PROFILES, CanContract, Far, Run, init_packet

CHANNEL = "vcan0"
pytestmark = pytest.mark.skipif(
    not Path("/sys/class/net", CHANNEL).exists(), reason=f"no interface {CHANNEL}"
)


@pytest.fixture(params=PROFILES)
def ends(request):
    near = CanSpec("socketcan", CHANNEL, request.param, period=PERIOD).open()
    far = open_controller_link(CanSpec("socketcan", CHANNEL, request.param, period=PERIOD))
    yield near, far
    near.close()
    far.close()


class TestSocketCan(CanContract):
    @pytest.fixture
    def link(self, ends):
        near, far = ends
        return near, Far(far)


@pytest.mark.parametrize("profile", PROFILES)
def test_complete_motion(profile):
    near = CanSpec("socketcan", CHANNEL, profile, period=PERIOD).open()
    ends = near, open_controller_link(CanSpec("socketcan", CHANNEL, profile, period=PERIOD))
    # An emulated machine may stall for longer than a set of frames may take; it is truncated then.
    run = Run(profile, ends=ends, cycles=250, missed_replies=50)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason


def test_overflow_of_the_receive_queue_is_a_gap(ends):
    """The kernel stores some hundred frames and drops the others without an error."""
    near, far = ends
    far.send(init_packet())
    assert near.receive(5.0) is not None
    for number in range(11, 3011):
        packet = CyclicPacket.zeros(number, 6)
        far.send(packet.encode())
    numbers = []
    while (received := near.receive(0.1)) is not None:
        numbers.append(int.from_bytes(received[:4], "little"))
    assert numbers == sorted(set(numbers))
    assert len(numbers) < 3000
    for number in range(3011, 3031):
        far.send(CyclicPacket.zeros(number, 6).encode())
        if (received := near.receive(0.5)) is not None:
            break
    assert CyclicPacket.decode(received, 6).number == number
