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
from drivers.transports.can.frames import (
    UP,
    BusRates,
    CanBusLoadError,
    payloads,
)
from drivers.transports.can.transport import CanSpec, CanTransport, lock_bus
from sim_fixtures.can_link import open_controller_link
from tests.drivers.can_bench import (
    HOME,
    MOVE,
    PERIOD,
    CanContract,
    Cycles,
    Far,
    Run,
    SlcanBus,
    init_packet,
    ns16_controller,
    session_on,
    virtual_ends,
)

GROUP = "239.74.163.77"
_ports = itertools.count(20000 + os.getpid() % 10000)


def closed_after(near, far):
    """Both ends as the contract needs them; closed after the test."""
    yield near, Far(far)
    near.close()
    far.close()


class TestVirtual(CanContract):
    @pytest.fixture
    def link(self):
        yield from closed_after(*virtual_ends())


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
    def link(self):
        spec = CanSpec("udp_multicast", f"{GROUP}/{next(_ports)}", period=PERIOD)
        yield from closed_after(spec.open(), open_controller_link(spec))


def slcan(port: str) -> CanSpec:
    return CanSpec("slcan", port, period=PERIOD, options={"sleep_after_open": 0.0})


@pytest.fixture
def adapters():
    bus = SlcanBus()
    yield bus
    bus.close()


class TestSlcan(CanContract):
    """Through pyserial on a pseudo-terminal to a small emulated adapter."""

    @pytest.fixture
    def link(self, adapters):
        near = slcan(adapters.ports[0]).open()
        far = open_controller_link(slcan(adapters.ports[1]))
        far.receive(0.0)
        adapters.await_open()
        yield from closed_after(near, far)
        assert adapters.refused == []

    def test_bit_rates_are_sent_to_the_adapter(self):
        bus = SlcanBus()
        slcan(bus.ports[0]).open().close()
        bus.close()
        rates = ["S8", "Y5"]
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


@pytest.mark.skipif(
    not Path("/sys/class/net/vcan0").exists(),
    reason="no vcan0: ip link add dev vcan0 type vcan && ip link set vcan0 mtu 72 up",
)
class TestSocketCan(CanContract):
    """The real kernel's CAN sockets."""

    @staticmethod
    def ends():
        spec = CanSpec("socketcan", "vcan0", period=PERIOD)
        return spec.open(), open_controller_link(spec)

    @pytest.fixture
    def link(self):
        yield from closed_after(*self.ends())

    def test_complete_motion(self):
        run = Run(ends=self.ends(), cycles=250, missed_replies=50)
        (ended,) = run.seen(MotionEnded)
        assert ended.outcome == "completed", ended.reason

    def test_overflow_of_the_receive_queue_is_a_gap(self):
        """The kernel stores some hundred frames and drops the others without an error."""
        near, far = self.ends()
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


def cyclic_link():
    near, far = virtual_ends()
    far.send(init_packet())
    near.receive(1.0)
    return near, far


def open_packet(number: int) -> bytes:
    packet = CyclicPacket.zeros(number, 6)
    packet.axes["mode"] = 4
    return CyclicPacket(number, bytes((5, 0, 0, 0)), bytes(4), packet.axes).encode()


class TestRefusals:
    def test_session_that_the_bus_cannot_carry(self):
        """At both ends, by its init packet."""
        init = init_packet(sample_time=1)
        near, far = virtual_ends()
        with pytest.raises(CanBusLoadError, match=r"135\.7 %"):
            far.send(init)
        for payload in payloads(init, 0):
            far._bus.send(can.Message(arbitration_id=UP, data=payload, is_extended_id=False,
                                      is_fd=True))  # fmt: skip
        with pytest.raises(TransportClosed, match=r"135\.7 %"):
            near.receive(1.0)
        with pytest.raises(TransportClosed):
            near.receive(0.0)

    def test_settings_are_checked_before_opening(self):
        CanSpec("virtual", "0", period=0.002).check(mode=8)
        CanSpec("virtual", "0", period=0.001, n_axes=2).check()
        CanSpec("virtual", "0", period=0.004, n_axes=7).check()
        with pytest.raises(CanBusLoadError, match=r"8 frames .* 135\.7 %"):
            CanSpec("virtual", "0", period=0.001).open()
        with pytest.raises(CanBusLoadError):
            CanSpec("virtual", "0", data_bitrate=2_000_000, period=0.002).check()
        with pytest.raises(TransportError, match=r"135\.7 % of a cycle of 1 ms"):
            open_controller_link(CanSpec("virtual", "0", period=0.001))

    def test_missing_bus_has_a_remedy(self):
        for interface, channel, remedy in (
            ("socketcan", "vcan77", "ip link set vcan77"),
            ("slcan", "/dev/no-such-port", "dialout"),
            ("no-such-interface", "0", "python-can"),
        ):
            with pytest.raises(TransportError, match=remedy) as caught:
                CanSpec(interface, channel, period=0.002).open()
            assert caught.value.__cause__ is not None
        with pytest.raises(TransportError, match="vcan77"):
            open_controller_link(CanSpec("socketcan", "vcan77", period=0.002))

    def test_python_can_prints_nothing_of_its_own(self):
        """A program without logging shows only our error."""
        opening = (
            "from drivers.transports.can.transport import CanSpec\n"
            "CanSpec('udp_multicast', '1.2.3.4', period=0.002).open()\n"
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
    def test_foreign_frames_are_counted(self):
        near, far = cyclic_link()
        for message in (
            {"arbitration_id": 0x7FF, "is_extended_id": False, "is_fd": True},
            {"arbitration_id": 0x110, "is_extended_id": True, "is_fd": True},
            {"arbitration_id": 0x110, "is_extended_id": False, "is_fd": False},
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

        near = CanTransport(Flood(None), BusRates())
        assert near.receive(0.01) is None
        assert near.rejected()["foreign"] >= 1000
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
        near = CanTransport(Failing(error), BusRates())
        with pytest.raises(TransportClosed) as caught:
            near.receive(0.0)
        assert caught.value.__cause__ is error
        near.close()
        near.close()
        near = CanTransport(Failing(OSError(9, "bad file descriptor")), BusRates())
        with pytest.raises(TransportClosed, match="bad file"):
            near.send(bytes(48))
        near.close()

    @pytest.mark.parametrize(
        "error", [can.CanOperationError("no buffers", 105), can.CanTimeoutError("no acknowledge")]
    )
    def test_frame_not_accepted_by_the_bus_is_unsent(self, error):
        near = CanTransport(Failing(error), BusRates())
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
        port = tmp_path / "ttyACM0"
        name = tmp_path / "by-id"
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


@pytest.fixture(scope="module")
def run():
    return Run()


@pytest.mark.safety
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

    def test_records_have_every_value(self, run):
        """Nothing is sent in turn: the first record is as whole as the last."""
        assert np.isfinite(run.records["model_current"]).all()

    def test_motion_with_lost_cycles(self):
        run = Run(lost=range(60, 2000, 7), missed_replies=5)
        (ended,) = run.seen(MotionEnded)
        assert ended.outcome == "completed", ended.reason
        assert len(run.seen(GapSeen)) > 10

    def test_overflow_of_the_receive_queue_is_a_gap(self):
        clock = Cycles()
        near, far = ends = virtual_ends(clock)
        on = {"clock": clock, "ends": ends, "controller": ns16_controller(cold_start=False)}
        link, session = session_on(until=lambda link: link.cycle == 40, **on)
        session.events()
        full = Overflowing()
        bus = near._bus
        bus.channel[bus.channel.index(bus.queue)] = full
        bus.queue = full
        for _ in range(10):
            far.send(link.controller.next_packet())
            link.controller.accept(None)
        session_on(until=lambda link: link.cycle == 20, session=session, **on)
        gaps = [event for event in session.events() if isinstance(event, GapSeen)]
        assert sum(gap.missed for gap in gaps) >= 6, "room for one packet at most"
        assert session.counters.malformed == 0
        link.close()
