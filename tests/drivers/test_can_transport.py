"""The PC's end on buses of python-can: the contract, what can go wrong, whole sessions."""

from __future__ import annotations

import gc
import itertools
import os
import pickle
import queue
import tempfile
from pathlib import Path

import can
import numpy as np
import pytest

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
from drivers.transports.can.bus_load import (
    BusRates,
    CanAxesError,
    CanBusLoadError,
    CanModeError,
    CanValueError,
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

    def test_the_adapter_is_told_the_bit_rates(self, profile):
        bus = SlcanBus()
        slcan(bus.ports[0], profile).open().close()
        bus.close()
        assert [rate for rate in bus.rates[0] if rate] == (
            ["S8", "Y5"] if profile == "fd" else ["S8"]
        )

    def test_an_adapter_that_is_pulled_out_is_a_closed_link(self):
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


def test_an_answer_that_cannot_be_carried_becomes_drive_off_and_closes_the_link(profile):
    assert_refused(*cyclic_link(profile), CanModeError, "mode 4", 2, 4, 0.5)


@pytest.mark.parametrize(
    ("profile", "value"),
    [("fd", np.nan), ("fd", np.inf), ("classic", np.nan), ("classic", np.inf), ("classic", 1024.0)],
)
def test_a_target_that_is_no_number_or_out_of_its_field_never_leaves(profile, value):
    assert_refused(*cyclic_link(profile), CanValueError, "slot 5", 5, 0, value)


def test_a_session_with_more_axes_is_refused_by_both_ends(profile):
    init = init_packet(7, 2)
    near, far = virtual_ends(profile)
    with pytest.raises(CanAxesError, match="7 axes"):
        far.send(init)
    segments = CanControllerLink(can.Bus("seven", "virtual"), BusRates("fd"))
    near = CanTransport(can.Bus("seven", "virtual"), BusRates("fd"))
    segments._port.send(_as_segments(init))
    with pytest.raises(TransportClosed, match="7 axes"):
        near.receive(1.0)


def _as_segments(packet):
    from drivers.transports.can.ends import Segmenter
    from drivers.transports.can.layout import SEGMENT_UP, Frame

    return [Frame(SEGMENT_UP, payload) for payload in Segmenter(64).split(packet)]


def test_axes_of_another_arm_are_refused(profile):
    table = np.full((4, 10), 255)
    table[1, :6] = range(6)
    _, far = virtual_ends(profile)
    with pytest.raises(CanAxesError, match="arm 2"):
        far.send(init_packet(open_axes_map=table))


def test_a_controller_with_a_cycle_too_short_for_the_bus_is_refused():
    _, far = virtual_ends("classic")
    with pytest.raises(CanBusLoadError, match=r"135\.0 %"):
        far.send(init_packet(6, 1))


def test_an_init_packet_that_makes_no_sense_is_left_to_the_session(profile):
    near, far = virtual_ends(profile)
    broken = init_packet(open_axes_map=np.full((4, 10), 3))
    far.send(broken)
    assert near.receive(1.0) == broken
    far.send(open_packet(11))
    assert near.receive(1.0) == open_packet(11), "as segments: no cyclic frames were agreed on"


def test_frames_of_others_are_ignored_and_counted(profile):
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


def test_strangers_do_not_lengthen_the_wait(profile):
    near, far = cyclic_link(profile)
    for _ in range(500):
        far._port._bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
    before = near.now
    assert near.receive(0.0) is None
    assert near.now - before < 0.5


def test_an_endless_flood_of_strangers_does_not_hold_the_loop_up():
    class Flood(Failing):
        def _recv_internal(self, timeout):
            return can.Message(arbitration_id=0x7FF, is_extended_id=False, is_fd=True), True

    near = CanTransport(Flood(None), BusRates("fd"))
    assert near.receive(0.01) is None
    assert near.rejected()["foreign"] >= 1000
    near.close()


def test_cyclic_frames_before_any_init_packet_are_counted(profile):
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
def test_a_bus_that_fails_is_a_closed_link_with_its_cause(error):
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
    "error", [can.CanOperationError("no buffers", 105), can.CanTimeoutError("nobody acknowledges")]
)
def test_a_frame_that_the_bus_does_not_take_is_lost_and_counted(error):
    near = CanTransport(Failing(error), BusRates("fd"))
    near.send(bytes(48))
    assert near.rejected() == {"unsent": 1}
    near.close()


def test_a_bus_that_is_not_there_is_named_with_its_remedy():
    with pytest.raises(TransportError, match="ip link set vcan77") as caught:
        CanSpec("socketcan", "vcan77", period=0.001).open()
    assert caught.value.__cause__ is not None
    with pytest.raises(TransportError, match="dialout"):
        CanSpec("slcan", "/dev/no-such-port", period=0.001).open()
    with pytest.raises(TransportError, match="python-can"):
        CanSpec("no-such-interface", "0", period=0.001).open()
    with pytest.raises(ControllerLinkError, match="vcan77"):
        open_controller_link(CanSpec("socketcan", "vcan77", period=0.002))


@pytest.mark.parametrize(
    ("interface", "channel"), [("udp_multicast", "nonsense"), ("slcan", "/dev/no-such-port")]
)
def test_of_a_bus_that_cannot_be_opened_python_can_has_nothing_left_to_say(
    interface, channel, caplog
):
    with pytest.raises(TransportError, match=channel) as caught:
        CanSpec(interface, channel, period=0.002).open()
    del caught
    gc.collect()
    assert caplog.messages == []


def test_an_adapter_that_refuses_the_bit_rate_is_let_go(monkeypatch, caplog):
    def refuse(*_):
        raise ValueError("no such rate")

    monkeypatch.setattr(can.interfaces.slcan.slcanBus, "set_bitrate", refuse)
    bus = SlcanBus()
    with pytest.raises(TransportError, match="no such rate") as caught:
        slcan(bus.ports[0]).open()
    del caught
    gc.collect()
    bus.close()
    assert caplog.messages == []


def test_the_controllers_end_is_checked_before_the_bus_is_opened():
    with pytest.raises(ControllerLinkError, match=r"135\.0 % of a cycle of 1 ms") as caught:
        open_controller_link(CanSpec("virtual", "0", "classic", period=0.001))
    assert isinstance(caught.value.__cause__, CanBusLoadError)
    with pytest.raises(ControllerLinkError, match="mode 8") as caught:
        open_controller_link(CanSpec("virtual", "0", period=0.002), mode=8)
    assert isinstance(caught.value.__cause__, CanModeError)
    with pytest.raises(ControllerLinkError, match="7 axes"):
        open_controller_link(CanSpec("virtual", "0", period=0.002, n_axes=7))


def test_a_description_is_checked_before_the_bus_is_opened():
    CanSpec("virtual", "0", period=0.001).check(mode=4)
    with pytest.raises(CanBusLoadError, match=r"10 classic frames .* 135\.0 %"):
        CanSpec("virtual", "0", "classic", period=0.001).open()
    CanSpec("virtual", "0", "classic", period=0.001, n_axes=2).check()
    with pytest.raises(CanBusLoadError):
        CanSpec("virtual", "0", data_bitrate=1_000_000, period=0.001).check()
    with pytest.raises(CanAxesError, match="7 axes"):
        CanSpec("virtual", "0", period=0.002, n_axes=7).check()
    with pytest.raises(ValueError, match="profile"):
        CanSpec("virtual", "0", "xl", period=0.002).check()


@pytest.mark.parametrize("mode", [1, 2, 8, 9, 10, 14, 3])
def test_modes_that_do_not_fit_are_refused_by_name(profile, mode):
    spec = CanSpec("virtual", "0", profile, period=0.002)
    with pytest.raises(CanModeError, match=f"mode {mode} ") as caught:
        spec.check(mode=mode)
    assert f"mode {mode} " in str(caught.value)


def test_descriptions_and_errors_pickle():
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


def test_a_bus_that_another_program_has_is_refused_with_its_number() -> None:
    first = BusLock("socketcan", "can0")
    with pytest.raises(TransportError, match=rf"another program uses it \(process {os.getpid()}\)"):
        BusLock("socketcan", "can0")
    BusLock("socketcan", "can1").release()
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


def test_a_bus_within_one_process_needs_none(tmp_path: Path) -> None:
    BusLock("virtual", "0")
    BusLock("virtual", "0")
    assert not list(tmp_path.iterdir())


def test_a_lock_that_is_a_link_to_elsewhere_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "hil-can-socketcan_can0.lock").symlink_to(tmp_path / "victim")
    with pytest.raises(TransportError, match="cannot be opened"):
        BusLock("socketcan", "can0")
    assert not (tmp_path / "victim").exists()


@pytest.fixture(scope="module", params=PROFILES)
def run(request):
    return Run(request.param)


def test_a_whole_motion_completes(run):
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert run.session.state is State.ENDED
    assert None not in run.link.replies
    assert run.controller.rejected_replies == 0
    assert not run.seen(GapSeen)
    assert not run.seen(PacketRejected)


def test_the_arm_is_where_the_motion_led_it(run):
    np.testing.assert_allclose(run.controller.plant.position, HOME + MOVE, atol=1e-3)


def test_what_is_fresh_and_how_old_the_rest_is_stands_in_every_record(run):
    moving = run.records[run.records["interval"] >= 0]
    assert (moving["age"][:, [0, 2, 3, 4]] == 0).all()
    slow = moving["age"][:, [1, 5, 6, 7]]
    assert slow.max() == 24, "25 slow values take turns, so the oldest is 24 cycles old"
    assert slow.min() >= 5, "of six joints' values the oldest was sent five turns ago at least"


def test_slow_values_are_not_known_before_their_first_turn(run):
    first = run.records[0]
    assert (first["age"][[1, 5, 6, 7]] == 0xFFFF).all()
    assert np.isnan(first["model_current"][1:]).all()
    assert np.isfinite(run.records[30]["model_current"]).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_a_motion_survives_lost_cycles(profile):
    run = Run(profile, lost=range(60, 2000, 7), missed_replies=5)
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert len(run.seen(GapSeen)) > 10


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
def test_a_whole_session_over_two_serial_adapters(profile):
    bus = SlcanBus()
    ends = (
        slcan(bus.ports[0], profile, PERIOD).open(),
        open_controller_link(slcan(bus.ports[1], profile, PERIOD)),
    )
    run = Run(profile, ends=ends, cycles=250, missed_replies=50)
    bus.close()
    (ended,) = run.seen(MotionEnded)
    assert ended.outcome == "completed", ended.reason
    assert bus.refused == []


class Overflowing(queue.Queue):
    """The kernel's receive queue: what finds it full is dropped, without a notice."""

    ROOM = 7

    def put(self, item, block=True, timeout=None):
        if self.qsize() < self.ROOM:
            super().put(item, block, timeout)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_receiver_too_slow_for_the_bus_loses_frames_and_sees_gaps_in_the_numbers(profile):
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
