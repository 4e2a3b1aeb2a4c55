"""The CAN transport on buses of python-can: contract, errors, complete sessions."""

from __future__ import annotations

import itertools
import os
import pickle
import queue
import tempfile
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.slcan import slcanBus

from drivers import (
    CycleRing,
    CyclicPacket,
    GapSeen,
    Guard,
    MotionEnded,
    PacketRejected,
    Session,
    State,
    TransportClosed,
    exchange,
)
from drivers.transports.base import TransportError
from drivers.transports.can.ends import Segmenter
from drivers.transports.can.layout import (
    SEGMENT_UP,
    BusRates,
    CanAxesError,
    CanBusLoadError,
    CanModeError,
    CanValueError,
    Frame,
)
from drivers.transports.can.transport import BusLock, CanSpec, CanTransport
from sim_fixtures.can_link import CanControllerLink, open_controller_link
from sim_fixtures.serve import ControllerLinkError
from tests.drivers.can_bench import (
    HOME,
    MOVE,
    NS16,
    PERIOD,
    PROFILES,
    CanContract,
    Cycles,
    Far,
    N,
    PacedByPackets,
    Run,
    SlcanBus,
    init_packet,
    ns16_controller,
    virtual_ends,
    wide_limits,
)

GROUP = "239.74.163.77"
_ports = itertools.count(20000 + os.getpid() % 10000)


@pytest.fixture(params=PROFILES)
def profile(request):
    return request.param


class TestVirtual(CanContract):
    @pytest.fixture
    def link(self, profile):
        near, far = virtual_ends(profile)
        yield near, Far(far)
        near.close()
        far.close()


def multicast_works() -> bool:
    """Whether this machine hands a multicast datagram back to itself."""
    try:
        with can.Bus(GROUP, "udp_multicast", port=next(_ports), hop_limit=0) as bus:
            other = can.Bus(GROUP, "udp_multicast", port=bus._multicast.port, hop_limit=0)
            with other:
                bus.send(can.Message(arbitration_id=1, data=b"?"))
                return other.recv(0.5) is not None
    except (can.CanError, OSError, ImportError):
        return False


@pytest.mark.skipif(not multicast_works(), reason="no msgpack, or no route for multicast")
class TestUdpMulticast(CanContract):
    @pytest.fixture
    def link(self, profile):
        channel = f"{GROUP}/{next(_ports)}"
        near = CanSpec("udp_multicast", channel, profile, period=0.002).open()
        far = open_controller_link(CanSpec("udp_multicast", channel, profile, period=0.002))
        yield near, Far(far)
        near.close()
        far.close()


def slcan(port: str, profile: str = "fd", period: float = 0.002) -> CanSpec:
    return CanSpec("slcan", port, profile, period=period, options={"sleep_after_open": 0.0})


class TestSlcan(CanContract):
    """Through pyserial on a pseudo-terminal to a small emulated adapter."""

    @pytest.fixture
    def link(self, profile):
        bus = SlcanBus()
        near = slcan(bus.ports[0], profile).open()
        far = open_controller_link(slcan(bus.ports[1], profile))
        far.receive(0.0)
        yield near, Far(far)
        near.close()
        far.close()
        bus.close()
        assert bus.refused == []

    def test_bit_rates_are_sent_to_the_adapter(self, profile):
        bus = SlcanBus()
        slcan(bus.ports[0], profile).open().close()
        bus.close()
        assert [rate for rate in bus.rates[0] if rate] == (
            ["S8", "Y5"] if profile == "fd" else ["S8"]
        )

    def test_disconnected_adapter_is_a_closed_link(self):
        bus = SlcanBus()
        near = slcan(bus.ports[0]).open()
        bus.close()
        with pytest.raises(TransportClosed):
            for _ in range(20):
                near.receive(0.01)
        near.close()


def cyclic_link(profile: str):
    near, far = virtual_ends(profile)
    far.send(init_packet())
    near.receive(1.0)
    return near, far


def assert_refused(near, far, kind: type, words: str, axis: int, column: int, value: float) -> None:
    """An answer with one such number becomes drive-off and closes the link."""
    far.send(open_packet(11))
    near.receive(1.0)
    reply = CyclicPacket.zeros(12, 6)
    reply.axes["mode"] = 4
    reply.axes["d"][axis, column] = value
    with pytest.raises(TransportClosed, match=words) as caught:
        near.send(reply.encode())
    assert isinstance(caught.value.__cause__, kind)
    assert (CyclicPacket.decode(far.receive(1.0), 6).axes["mode"] == 505).all()
    with pytest.raises(TransportClosed):
        near.receive(0.0)


def open_packet(number: int) -> bytes:
    packet = CyclicPacket.zeros(number, 6)
    packet.axes["mode"] = 4
    return CyclicPacket(number, bytes((5, 0, 0, 0)), bytes(4), packet.axes).encode()


def test_reply_without_code_becomes_drive_off(profile):
    assert_refused(*cyclic_link(profile), CanModeError, "mode 4", 2, 4, 0.5)


@pytest.mark.parametrize(
    ("profile", "value"),
    [("fd", np.nan), ("fd", np.inf), ("classic", np.nan), ("classic", np.inf), ("classic", 1024.0)],
)
def test_target_out_of_range_becomes_drive_off(profile, value):
    assert_refused(*cyclic_link(profile), CanValueError, "slot 5", 5, 0, value)


def test_more_axes_are_refused_at_both_ends(profile):
    init = init_packet(7, 2)
    near, far = virtual_ends(profile)
    with pytest.raises(CanAxesError, match="7 axes"):
        far.send(init)
    segments = CanControllerLink(can.Bus("seven", "virtual"), BusRates("fd"))
    near = CanTransport(can.Bus("seven", "virtual"), BusRates("fd"))
    segments._port.send([Frame(SEGMENT_UP, part) for part in Segmenter(64).split(init)])
    with pytest.raises(TransportClosed, match="7 axes"):
        near.receive(1.0)


def test_axes_of_another_arm_are_refused(profile):
    table = np.full((4, 10), 255)
    table[1, :6] = range(6)
    _, far = virtual_ends(profile)
    with pytest.raises(CanAxesError, match="arm 2"):
        far.send(init_packet(open_axes_map=table))


def test_cycle_too_short_for_the_bus_is_refused():
    _, far = virtual_ends("classic")
    with pytest.raises(CanBusLoadError, match=r"135\.0 %"):
        far.send(init_packet(6, 1))


def test_invalid_init_packet_is_passed_to_the_session(profile):
    near, far = virtual_ends(profile)
    broken = init_packet(open_axes_map=np.full((4, 10), 3))
    far.send(broken)
    assert near.receive(1.0) == broken
    far.send(open_packet(11))
    assert near.receive(1.0) == open_packet(11), "as segments: no cyclic frames were agreed on"


def test_foreign_frames_are_counted(profile):
    near, far = cyclic_link(profile)
    bus = far._port._bus
    fd = profile == "fd"
    bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"hello", is_fd=fd))
    bus.send(can.Message(arbitration_id=0x110, is_extended_id=True, data=b"hello", is_fd=fd))
    bus.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=b"hello", is_fd=not fd))
    bus.send(can.Message(is_error_frame=True))
    far.send(open_packet(11))
    assert near.receive(1.0) is not None
    assert near.rejected() == {"foreign": 3, "bus_error": 1}
    assert near.rejected() == {}


def test_receive_ends_in_a_flood_of_foreign_frames():
    class Flood(Failing):
        def _recv_internal(self, timeout):
            return can.Message(arbitration_id=0x7FF, is_extended_id=False, is_fd=True), True

    near = CanTransport(Flood(None), BusRates("fd"))
    assert near.receive(0.01) is None
    assert near.rejected()["foreign"] >= 1000
    near.close()


def test_cyclic_frames_before_the_init_packet(profile):
    near, far = cyclic_link(profile)
    late = CanTransport(can.Bus(far._port._bus.channel_id, "virtual"), BusRates(profile))
    far.send(open_packet(11))
    assert late.receive(0.05) is None
    assert late.rejected() == {"unannounced": 2 if profile == "fd" else 7}
    late.close()
    near.close()


class Failing(can.BusABC):
    """A bus that raises what it is given."""

    def __init__(self, error):
        super().__init__("failing")
        self.error = error

    def send(self, msg, timeout=None):
        raise self.error

    def _recv_internal(self, timeout):
        raise self.error

    def shutdown(self):
        super().shutdown()
        raise can.CanOperationError("nothing left to close")


@pytest.mark.parametrize(
    "error",
    [can.CanOperationError("adapter gone"), OSError(19, "no such device"), ValueError("bad fd")],
)
def test_failed_bus_is_a_closed_link_with_its_cause(error):
    near = CanTransport(Failing(error), BusRates("fd"))
    with pytest.raises(TransportClosed) as caught:
        near.receive(0.0)
    assert caught.value.__cause__ is error
    near.close()
    near.close()
    near = CanTransport(Failing(OSError(9, "bad file descriptor")), BusRates("fd"))
    with pytest.raises(TransportClosed, match="bad file"):
        near.send(bytes(48))
    near.close()


@pytest.mark.parametrize(
    "error", [can.CanOperationError("no buffers", 105), can.CanTimeoutError("no acknowledgement")]
)
def test_frame_not_accepted_by_the_bus_is_unsent(error):
    near = CanTransport(Failing(error), BusRates("fd"))
    near.send(bytes(48))
    assert near.rejected() == {"unsent": 1}
    near.close()


def test_missing_bus_has_a_remedy():
    with pytest.raises(TransportError, match="ip link set vcan77") as caught:
        CanSpec("socketcan", "vcan77", period=0.001).open()
    assert caught.value.__cause__ is not None
    with pytest.raises(TransportError, match="dialout"):
        CanSpec("slcan", "/dev/no-such-port", period=0.001).open()
    with pytest.raises(TransportError, match="python-can"):
        CanSpec("no-such-interface", "0", period=0.001).open()
    with pytest.raises(ControllerLinkError, match="vcan77"):
        open_controller_link(CanSpec("socketcan", "vcan77", period=0.002))


def test_adapter_that_refuses_the_bit_rate_is_closed(monkeypatch):
    refused = []

    def refuse(bus, *_):
        refused.append(bus)
        raise ValueError("no such rate")

    monkeypatch.setattr(slcanBus, "set_bitrate", refuse)
    adapter = SlcanBus()
    with pytest.raises(TransportError, match="no such rate"):
        slcan(adapter.ports[0]).open()
    assert not refused[0].serialPortOrig.is_open
    adapter.close()


def test_settings_are_checked_before_opening():
    CanSpec("virtual", "0", period=0.001).check(mode=4)
    with pytest.raises(CanBusLoadError, match=r"10 classic frames .* 135\.0 %"):
        CanSpec("virtual", "0", "classic", period=0.001).open()
    CanSpec("virtual", "0", "classic", period=0.001, n_axes=2).check()
    with pytest.raises(CanBusLoadError):
        CanSpec("virtual", "0", data_bitrate=1_000_000, period=0.001).check()
    with pytest.raises(CanAxesError, match="7 axes"):
        CanSpec("virtual", "0", period=0.002, n_axes=7).check()
    for mode in (1, 2, 3, 8, 9, 10):
        with pytest.raises(CanModeError, match=f"mode {mode} "):
            CanSpec("virtual", "0", period=0.002).check(mode=mode)
    with pytest.raises(ControllerLinkError, match=r"135\.0 % of a cycle of 1 ms"):
        open_controller_link(CanSpec("virtual", "0", "classic", period=0.001))


def test_settings_and_errors_pickle():
    spec = CanSpec("slcan", "/dev/ttyACM0", "classic", 500_000, period=0.004, n_axes=3)
    assert pickle.loads(pickle.dumps(spec)) == spec
    for error in (
        CanAxesError("seven"),
        CanBusLoadError("full"),
        CanModeError("no room"),
        CanValueError("little"),
    ):
        copy = pickle.loads(pickle.dumps(error))
        assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))
        assert isinstance(error, TransportError)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_bus_in_use_names_the_process() -> None:
    first = BusLock("socketcan", "can0")
    with pytest.raises(TransportError, match=rf"another program uses it \(process {os.getpid()}\)"):
        BusLock("socketcan", "can0")
    BusLock("socketcan", "can1").release()
    BusLock("virtual", "0")
    BusLock("virtual", "0")  # a bus within one process has no lock
    first.release()
    first.release()
    BusLock("socketcan", "can0").release()


def test_two_names_of_one_serial_port_are_one_bus(tmp_path: Path) -> None:
    port, name = tmp_path / "ttyACM0", tmp_path / "by-id"
    port.touch()
    name.symlink_to(port)
    held = BusLock("slcan", str(port))
    with pytest.raises(TransportError, match="another program uses it"):
        BusLock("slcan", str(name))
    held.release()


def test_lock_does_not_follow_symbolic_links(tmp_path: Path) -> None:
    (tmp_path / "hil-can-socketcan_can0.lock").symlink_to(tmp_path / "victim")
    with pytest.raises(TransportError, match="cannot be opened"):
        BusLock("socketcan", "can0")
    assert not (tmp_path / "victim").exists()


@pytest.fixture(scope="module", params=PROFILES)
def run(request):
    return Run(request.param)


def test_complete_motion(run):
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert run.session.state is State.ENDED
    assert None not in run.link.replies
    assert run.controller.rejected_replies == 0
    assert not run.seen(GapSeen)
    assert not run.seen(PacketRejected)
    np.testing.assert_allclose(run.controller.plant.position, HOME + MOVE, atol=1e-3)


def test_ages_in_the_records(run):
    """25 slow values are sent in turn: of six joints, the oldest is 5 to 24 cycles old."""
    moving = run.records[run.records["interval"] >= 0]
    assert (moving["age"][:, [0, 2, 3, 4]] == 0).all()
    slow = moving["age"][:, [1, 5, 6, 7]]
    assert (slow.min() >= 5, slow.max()) == (True, 24)
    first = run.records[0]
    assert (first["age"][[1, 5, 6, 7]] == 0xFFFF).all()
    assert np.isnan(first["model_current"][1:]).all()
    assert np.isfinite(run.records[30]["model_current"]).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_motion_with_lost_cycles(profile):
    run = Run(profile, lost=range(60, 2000, 7), missed_replies=5)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert len(run.seen(GapSeen)) > 10


class Overflowing(queue.Queue):
    """The kernel's receive queue, which drops frames when full."""

    ROOM = 7

    def put(self, item, block=True, timeout=None):
        if self.qsize() < self.ROOM:
            super().put(item, block, timeout)


@pytest.mark.parametrize("profile", PROFILES)
def test_overflow_of_the_receive_queue_is_a_gap(profile):
    clock = Cycles()
    near, far = virtual_ends(profile, clock)
    bus = near._port._bus
    session = Session(NS16.drive_train, Guard(wide_limits(), PERIOD), CycleRing(N, 64))
    link = PacedByPackets(near, far, ns16_controller(cold_start=False), clock=clock)
    exchange(link, session, until=lambda: link.cycle == 40)
    session.events()
    full = Overflowing()
    bus.channel[bus.channel.index(bus.queue)] = full
    bus.queue = full
    for _ in range(10):
        far.send(link.controller.next_packet())
        link.controller.accept(None)
    exchange(link, session, until=lambda: link.cycle == 60)
    gaps = [event for event in session.events() if isinstance(event, GapSeen)]
    assert sum(gap.missed for gap in gaps) >= 6, "room for three sets of ten at most"
    assert session.counters.malformed == 0
    link.close()
