"""The CAN transport on buses of python-can: contract, errors, complete sessions."""

from __future__ import annotations

import itertools
import os
import queue
import subprocess
import sys
import tempfile
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.slcan import slcanBus

from drivers import CyclicPacket, GapSeen, MotionEnded, PacketRejected, State, TransportClosed
from drivers.transports.base import TransportError
from drivers.transports.can.profile import (
    SEGMENT_UP,
    BusRates,
    CanAxesError,
    CanBusLoadError,
    CanModeError,
    CanValueError,
    Frame,
    segments,
)
from drivers.transports.can.transport import CanSpec, CanTransport, lock_bus
from sim_fixtures.can_link import open_controller_link
from tests.drivers.can_bench import (
    HOME,
    MOVE,
    PERIOD,
    PROFILES,
    CanContract,
    Cycles,
    Far,
    Run,
    SlcanBus,
    decoded,
    init_packet,
    ns16_controller,
    session_on,
    virtual_ends,
)

GROUP = "239.74.163.77"
_ports = itertools.count(20000 + os.getpid() % 10000)


@pytest.fixture(params=PROFILES)
def profile(request):
    return request.param


def closed_after(near, far):
    """Both ends as the contract needs them; closed after the test."""
    yield near, Far(far)
    near.close()
    far.close()


class TestVirtual(CanContract):
    @pytest.fixture
    def link(self, profile):
        yield from closed_after(*virtual_ends(profile))


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
        spec = CanSpec("udp_multicast", f"{GROUP}/{next(_ports)}", profile, period=PERIOD)
        yield from closed_after(spec.open(), open_controller_link(spec))


def slcan(port: str, profile: str = "fd") -> CanSpec:
    return CanSpec("slcan", port, profile, period=PERIOD, options={"sleep_after_open": 0.0})


@pytest.fixture
def adapters():
    bus = SlcanBus()
    yield bus
    bus.close()


class TestSlcan(CanContract):
    """Through pyserial on a pseudo-terminal to a small emulated adapter."""

    @pytest.fixture
    def link(self, profile, adapters):
        near = slcan(adapters.ports[0], profile).open()
        far = open_controller_link(slcan(adapters.ports[1], profile))
        far.receive(0.0)
        yield from closed_after(near, far)
        assert adapters.refused == []

    def test_bit_rates_are_sent_to_the_adapter(self, profile):
        bus = SlcanBus()
        slcan(bus.ports[0], profile).open().close()
        bus.close()
        rates = ["S8", "Y5"] if profile == "fd" else ["S8"]
        assert bus.rates[0] == rates
        # Before the adapter is on the bus: it would be there with the rates of its last use.
        opened = bus.set_up[0].index("O")
        assert [line for line in bus.set_up[0][:opened] if line != "C"] == rates

    def test_disconnected_adapter_is_a_closed_link(self):
        bus = SlcanBus()
        near = slcan(bus.ports[0]).open()
        bus.close()
        with pytest.raises(TransportClosed):
            for _ in range(20):
                near.receive(0.01)
        near.close()

    def test_adapter_that_refuses_the_bit_rate_is_closed(self, monkeypatch, adapters):
        refused = []

        def refuse(bus, *_):
            refused.append(bus)
            raise ValueError("no such rate")

        monkeypatch.setattr(slcanBus, "set_bitrate", refuse)
        with pytest.raises(TransportError, match="no such rate"):
            slcan(adapters.ports[0]).open()
        assert not refused[0].serialPortOrig.is_open


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.skipif(
    not Path("/sys/class/net/vcan0").exists(),
    reason="no vcan0: ip link add dev vcan0 type vcan && ip link set vcan0 mtu 72 up",
)
class TestSocketCan(CanContract):
    """The real kernel's CAN sockets."""

    @staticmethod
    def ends(profile):
        spec = CanSpec("socketcan", "vcan0", profile, period=PERIOD)
        return spec.open(), open_controller_link(spec)

    @pytest.fixture
    def link(self, profile):
        yield from closed_after(*self.ends(profile))

    def test_complete_motion(self, profile):
        run = Run(profile, ends=self.ends(profile), cycles=250, missed_replies=50)
        (ended,) = run.seen(MotionEnded)
        assert ended.outcome == "completed", ended.reason

    def test_overflow_of_the_receive_queue_is_a_gap(self, profile):
        """The kernel stores some hundred frames and drops the others without an error."""
        near, far = self.ends(profile)
        far.send(init_packet())
        assert near.receive(5.0) is not None
        for number in range(11, 3011):
            far.send(CyclicPacket.zeros(number, 6).encode())
        numbers = []
        while (received := near.receive(0.1)) is not None:
            numbers.append(CyclicPacket.decode(received, 6).number)
        assert numbers == sorted(set(numbers))
        assert len(numbers) < 3000
        for number in range(3011, 3031):
            far.send(CyclicPacket.zeros(number, 6).encode())
            if (received := near.receive(0.5)) is not None:
                break
        assert CyclicPacket.decode(received, 6).number == number
        near.close()
        far.close()


def cyclic_link(profile: str):
    near, far = virtual_ends(profile)
    far.send(init_packet())
    near.receive(1.0)
    return near, far


def open_packet(number: int) -> bytes:
    packet = CyclicPacket.zeros(number, 6)
    packet.axes["mode"] = 4
    return CyclicPacket(number, bytes((5, 0, 0, 0)), bytes(4), packet.axes).encode()


ON_ARM_2 = np.full((4, 10), 255)
ON_ARM_2[1, :6] = range(6)


class TestRefusals:
    @pytest.mark.parametrize(
        ("profile", "axis", "column", "value", "error", "words"),
        [
            *((profile, 2, 4, 0.5, CanModeError, "mode 4") for profile in PROFILES),
            *(
                (profile, 5, 0, value, CanValueError, "slot 5")
                for profile in PROFILES
                for value in (np.nan, np.inf)
            ),
            ("classic", 5, 0, 1024.0, CanValueError, "slot 5"),
        ],
    )
    def test_reply_becomes_drive_off(self, profile, axis, column, value, error, words):
        """A reply that frames cannot carry requests drive-off and closes the link."""
        near, far = cyclic_link(profile)
        far.send(open_packet(11))
        near.receive(1.0)
        reply = CyclicPacket.zeros(12, 6)
        reply.axes["mode"] = 4
        reply.axes["d"][axis, column] = value
        with pytest.raises(TransportClosed, match=words) as caught:
            near.send(reply.encode())
        assert isinstance(caught.value.__cause__, error)
        assert (decoded(far.receive(1.0)).axes["mode"] == 505).all()
        with pytest.raises(TransportClosed):
            near.receive(0.0)

    @pytest.mark.parametrize(
        ("profile", "fields", "error", "words"),
        [
            ("fd", {"n_axes": 7}, CanAxesError, "7 axes"),
            ("classic", {"n_axes": 7}, CanAxesError, "7 axes"),
            ("fd", {"open_axes_map": ON_ARM_2}, CanAxesError, "arm 2"),
            ("classic", {"sample_time": 1}, CanBusLoadError, r"135\.0 %"),
        ],
    )
    def test_session_that_the_bus_cannot_carry(self, profile, fields, error, words):
        init = init_packet(**fields)
        near, far = virtual_ends(profile)
        with pytest.raises(error, match=words):
            far.send(init)
        size = 64 if profile == "fd" else 8
        far.send_frames([Frame(SEGMENT_UP, part) for part in segments(init, size, 0)])
        with pytest.raises(TransportClosed, match=words):
            near.receive(1.0)

    def test_invalid_init_packet_is_passed_to_the_session(self, profile):
        near, far = virtual_ends(profile)
        broken = init_packet(open_axes_map=np.full((4, 10), 3))
        far.send(broken)
        assert near.receive(1.0) == broken
        far.send(open_packet(11))
        assert near.receive(1.0) == open_packet(11), "as segments: no cyclic frames were agreed on"

    def test_settings_are_checked_before_opening(self):
        CanSpec("virtual", "0", period=0.001).check(mode=4)
        CanSpec("virtual", "0", "classic", period=0.001, n_axes=2).check()
        with pytest.raises(CanBusLoadError, match=r"10 classic frames .* 135\.0 %"):
            CanSpec("virtual", "0", "classic", period=0.001).open()
        with pytest.raises(CanBusLoadError):
            CanSpec("virtual", "0", data_bitrate=1_000_000, period=0.001).check()
        with pytest.raises(CanAxesError, match="7 axes"):
            CanSpec("virtual", "0", period=0.002, n_axes=7).check()
        for mode in (1, 2, 3, 8, 9, 10):
            with pytest.raises(CanModeError, match=f"mode {mode} "):
                CanSpec("virtual", "0", period=0.002).check(mode=mode)
        with pytest.raises(TransportError, match=r"135\.0 % of a cycle of 1 ms"):
            open_controller_link(CanSpec("virtual", "0", "classic", period=0.001))

    def test_missing_bus_has_a_remedy(self):
        for interface, channel, remedy in (
            ("socketcan", "vcan77", "ip link set vcan77"),
            ("slcan", "/dev/no-such-port", "dialout"),
            ("no-such-interface", "0", "python-can"),
        ):
            with pytest.raises(TransportError, match=remedy) as caught:
                CanSpec(interface, channel, period=0.001).open()
            assert caught.value.__cause__ is not None
        with pytest.raises(TransportError, match="vcan77"):
            open_controller_link(CanSpec("socketcan", "vcan77", period=0.002))

    def test_python_can_prints_nothing_of_its_own(self):
        """A program without logging shows only our error."""
        opening = (
            "from drivers.transports.can.transport import CanSpec\n"
            "CanSpec('udp_multicast', '1.2.3.4', period=0.001).open()\n"
        )
        command = [sys.executable, "-c", opening]
        shown = subprocess.run(command, capture_output=True, text=True).stderr
        assert "not properly shut down" not in shown and "route for multicast" in shown


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


class TestBus:
    def test_foreign_frames_are_counted(self, profile):
        near, far = cyclic_link(profile)
        fd = profile == "fd"
        for message in (
            {"arbitration_id": 0x7FF, "is_extended_id": False, "is_fd": fd},
            {"arbitration_id": 0x110, "is_extended_id": True, "is_fd": fd},
            {"arbitration_id": 0x110, "is_extended_id": False, "is_fd": not fd},
            {"is_error_frame": True},
        ):
            data = b"" if "is_error_frame" in message else b"hello"
            far._bus.send(can.Message(data=data, **message))
        far.send(open_packet(11))
        assert near.receive(1.0) is not None
        assert near.rejected() == {"foreign": 3, "bus_error": 1}
        assert near.rejected() == {}

    def test_receive_ends_in_a_flood_of_foreign_frames(self):
        class Flood(Failing):
            def _recv_internal(self, timeout):
                return can.Message(arbitration_id=0x7FF, is_extended_id=False, is_fd=True), True

        near = CanTransport(Flood(None), BusRates("fd"))
        assert near.receive(0.01) is None
        assert near.rejected()["foreign"] >= 1000
        near.close()

    def test_cyclic_frames_before_the_init_packet(self, profile):
        near, far = cyclic_link(profile)
        late = CanTransport(can.Bus(far._bus.channel_id, "virtual"), BusRates(profile))
        far.send(open_packet(11))
        assert late.receive(0.05) is None
        assert late.rejected() == {"unannounced": 2 if profile == "fd" else 7}
        late.close()
        near.close()

    @pytest.mark.parametrize(
        "error",
        [
            can.CanOperationError("adapter gone"),
            OSError(19, "no such device"),
            ValueError("bad fd"),
        ],
    )
    def test_failed_bus_is_a_closed_link_with_its_cause(self, error):
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
        "error", [can.CanOperationError("no buffers", 105), can.CanTimeoutError("no acknowledge")]
    )
    def test_frame_not_accepted_by_the_bus_is_unsent(self, error):
        near = CanTransport(Failing(error), BusRates("fd"))
        near.send(bytes(48))
        assert near.rejected() == {"unsent": 1}
        near.close()


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


class TestLock:
    def test_bus_in_use_names_the_process(self) -> None:
        first = lock_bus("socketcan", "can0")
        used = rf"another program uses it \(process {os.getpid()}\)"
        with pytest.raises(TransportError, match=used):
            lock_bus("socketcan", "can0")
        os.close(lock_bus("socketcan", "can1"))
        assert lock_bus("virtual", "0") is None, "a bus within one process has no lock"
        os.close(first)
        os.close(lock_bus("socketcan", "can0"))

    def test_lock_ends_with_the_transport(self, adapters) -> None:
        spec = slcan(adapters.ports[0])
        near = spec.open()
        with pytest.raises(TransportError, match="another program uses it"):
            spec.open()
        near.close()
        spec.open().close()

    def test_two_names_of_one_serial_port_are_one_bus(self, tmp_path: Path) -> None:
        port, name = tmp_path / "ttyACM0", tmp_path / "by-id"
        port.touch()
        name.symlink_to(port)
        held = lock_bus("slcan", str(port))
        with pytest.raises(TransportError, match="another program uses it"):
            lock_bus("slcan", str(name))
        os.close(held)

    def test_lock_does_not_follow_symbolic_links(self, tmp_path: Path) -> None:
        (tmp_path / "hil-can-socketcan_can0.lock").symlink_to(tmp_path / "victim")
        with pytest.raises(TransportError, match="cannot be opened"):
            lock_bus("socketcan", "can0")
        assert not (tmp_path / "victim").exists()


class Overflowing(queue.Queue):
    """The kernel's receive queue, which drops frames when full."""

    ROOM = 7

    def put(self, item, block=True, timeout=None):
        if self.qsize() < self.ROOM:
            super().put(item, block, timeout)


@pytest.fixture(scope="module", params=PROFILES)
def run(request):
    return Run(request.param)


class TestSession:
    def test_complete_motion(self, run):
        (ended,) = run.seen(MotionEnded)
        assert ended.outcome == "completed", ended.reason
        assert run.session.state is State.ENDED
        assert None not in run.link.replies
        assert run.controller.rejected_replies == 0
        assert not run.seen(GapSeen)
        assert not run.seen(PacketRejected)
        np.testing.assert_allclose(run.controller.plant.position, HOME + MOVE, atol=1e-3)

    def test_ages_in_the_records(self, run):
        """25 slow values are sent in turn: of six joints, the oldest is 5 to 24 cycles old."""
        moving = run.records[run.records["interval"] >= 0]
        assert (moving["age"][:, [0, 2, 3, 4]] == 0).all()
        slow = moving["age"][:, [1, 5, 6, 7]]
        assert (slow.min() >= 5, slow.max()) == (True, 24)
        first = run.records[0]
        assert (first["age"][[1, 5, 6, 7]] == 0xFFFF).all()
        assert np.isnan(first["model_current"][1:]).all()
        assert np.isfinite(run.records[30]["model_current"]).all()

    def test_motion_with_lost_cycles(self, profile):
        run = Run(profile, lost=range(60, 2000, 7), missed_replies=5)
        (ended,) = run.seen(MotionEnded)
        assert ended.outcome == "completed", ended.reason
        assert len(run.seen(GapSeen)) > 10

    def test_overflow_of_the_receive_queue_is_a_gap(self, profile):
        clock = Cycles()
        near, far = ends = virtual_ends(profile, clock)
        on = {"clock": clock, "ends": ends, "controller": ns16_controller(cold_start=False)}
        link, session = session_on(profile, until=lambda link: link.cycle == 40, **on)
        session.events()
        full, bus = Overflowing(), near._bus
        bus.channel[bus.channel.index(bus.queue)] = full
        bus.queue = full
        for _ in range(10):
            far.send(link.controller.next_packet())
            link.controller.accept(None)
        session_on(profile, until=lambda link: link.cycle == 20, session=session, **on)
        gaps = [event for event in session.events() if isinstance(event, GapSeen)]
        assert sum(gap.missed for gap in gaps) >= 6, "room for three sets of ten at most"
        assert session.counters.malformed == 0
        link.close()
