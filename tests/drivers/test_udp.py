"""The UDP link, on the loopback device."""

from __future__ import annotations

import pickle
import socket
import struct
import time
from unittest.mock import patch

import pytest

from drivers import (
    CycleRing,
    CyclicPacket,
    Guard,
    Mode,
    PacketRejected,
    Session,
    State,
    exchange,
)
from drivers.exchange import loop
from drivers.transports.base import TransportError
from drivers.transports.udp import MAX_FOREIGN, UdpSpec, UdpTransport
from tests.drivers.rig import N, Rig, drive_train, init_packet, limits
from tests.drivers.transport_contract import TransportContract

HOST = "127.0.0.1"
OTHER_HOST = "127.0.0.2"
PATIENCE = 5.0


class Controller:
    """A socket of the controller's host."""

    def __init__(self, port: int, host: str = HOST, own_port: int = 0):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, own_port))
        self.socket.connect((HOST, port))
        self.socket.settimeout(PATIENCE)
        self.replies: list[bytes] = []

    def send(self, packet: bytes) -> None:
        self.socket.send(packet)

    def wait(self) -> None:
        self.replies.append(self.socket.recv(2048))

    def heard_nothing(self) -> bool:
        self.socket.setblocking(False)
        try:
            self.socket.recv(2048)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(PATIENCE)
        return False

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def near():
    transport = UdpSpec(HOST, 0, HOST).open()
    yield transport
    transport.close()


@pytest.fixture
def controller(near):
    far = Controller(near.address[1])
    yield far
    far.close()


@pytest.fixture
def another(near):
    """Another port of the controller's host."""
    far = Controller(near.address[1])
    yield far
    far.close()


@pytest.fixture
def other_host(near):
    far = Controller(near.address[1], OTHER_HOST)
    yield far
    far.close()


class TestContract(TransportContract):
    @pytest.fixture
    def link(self, near, controller):
        # A datagram of a plausible length decides the port; the contract also sends shorter ones.
        controller.send(bytes(48))
        near.receive(PATIENCE)
        return near, controller


class TestPeer:
    def test_other_host_gets_no_reply_and_is_counted(self, near, other_host):
        other_host.send(bytes(48))
        assert near.receive(0.05) is None
        near.send(bytes(48))
        assert other_host.heard_nothing()
        assert near.rejected() == {"foreign": 1, "unsent": 1}
        assert near.rejected() == {}

    def test_first_sender_is_the_peer_until_forgotten(self, near, controller, another):
        controller.send(b"a" * 48)
        assert near.receive(PATIENCE) == b"a" * 48
        another.send(b"b" * 48)
        assert near.receive(0.05) is None
        assert near.rejected() == {"foreign": 1}
        near.forget_peer()
        near.send(bytes(48))
        assert controller.heard_nothing()
        another.send(b"c" * 48)
        assert near.receive(PATIENCE) == b"c" * 48
        near.send(b"answer")
        another.wait()
        assert another.replies == [b"answer"]
        assert controller.heard_nothing()

    @pytest.mark.parametrize("length", [0, 11, 1501, 9000])
    def test_sender_of_implausible_lengths_is_not_the_peer(self, near, controller, another, length):
        another.send(bytes(length))
        controller.send(b"x" * 48)
        assert near.receive(PATIENCE) == b"x" * 48
        assert near.rejected() == {"malformed": 1}

    @pytest.mark.parametrize("length", [12, 47])
    def test_header_alone_is_answered(self, near, controller, length):
        """Of sync packets nothing is known but that they are shorter than the init packet."""
        rig = Rig()
        controller.send(struct.pack("<i", 3) + bytes(length - 4))
        exchange(near, rig.session, until=lambda: rig.session.counters.answered > 0)
        controller.wait()
        assert controller.replies == [struct.pack("<i", 4) + bytes(length - 4)]

    def test_too_long_datagram_is_malformed(self, near, controller):
        controller.send(bytes(1500))
        assert near.receive(PATIENCE) == bytes(1500)
        controller.send(bytes(1501))
        assert near.receive(0.05) is None
        assert near.rejected() == {"malformed": 1}

    def test_other_hosts_neither_extend_the_wait_nor_hide_packets(
        self, near, controller, other_host
    ):
        for _ in range(200):
            other_host.send(bytes(48))
        before = time.monotonic()
        assert near.receive(0.05) is None
        assert 0.05 <= time.monotonic() - before < 5.0
        for _ in range(20):
            other_host.send(bytes(48))
        controller.send(b"x" * 48)
        assert near.receive(PATIENCE) == b"x" * 48
        assert near.rejected() == {"foreign": 220}

    def test_packet_behind_other_hosts_without_wait(self, near, controller, other_host):
        controller.send(b"a" * 48)
        assert near.receive(PATIENCE) == b"a" * 48
        for number in range(10):
            for _ in range(3):
                other_host.send(bytes(48))
            controller.send(bytes([number]) * 48)
        received = [near.receive(timeout) for timeout in (0.0, -1.0, 1e-9, 0.0, -1e-9)]
        assert received == [bytes([number]) * 48 for number in range(5)]
        while (packet := near.receive(0.0)) is not None:
            received.append(packet)
        assert received == [bytes([number]) * 48 for number in range(10)]
        assert near.rejected() == {"foreign": 30}

    def test_flood_of_other_hosts_ends_without_wait(self, near, other_host):
        kernel = near._receive

        def endless(*arguments):
            other_host.send(bytes(48))
            return kernel(*arguments)

        near._receive = endless
        assert near.receive(0.0) is None
        assert near.rejected() == {"foreign": MAX_FOREIGN + 1}


class TestWaiting:
    def test_wait_is_not_shorter_than_requested(self, near):
        for timeout in (1e-9, 0.0005, 0.003, 0.0101, 0.03, 0.0, 0.02, 0.02):
            before = time.monotonic()
            assert near.receive(timeout) is None
            assert timeout <= time.monotonic() - before < timeout + 5.0

    def test_datagrams_dropped_by_the_kernel_are_overruns(self, near, controller):
        controller.send(bytes(48))
        near.receive(PATIENCE)
        for _ in range(3000):
            controller.send(bytes(1200))
        received = 0
        while near.receive(0.0) is not None:
            received += 1
        assert received < 3000
        assert near.rejected() == {"overrun": 3000 - received}
        assert near.rejected() == {}


class TestArrival:
    def test_arrival_is_the_time_in_the_kernel(self, near, controller):
        before = time.monotonic()
        controller.send(bytes(48))
        sent = time.monotonic()
        time.sleep(0.05)
        assert near.receive(PATIENCE) is not None
        assert before - 1e-5 <= near.arrived <= sent + 1e-5

    def test_arrivals_increase(self, near, controller):
        arrivals = []
        for _ in range(50):
            controller.send(bytes(48))
            near.receive(PATIENCE)
            arrivals.append(near.arrived)
            assert near.arrived <= near.now
        assert arrivals == sorted(arrivals)

    @pytest.mark.parametrize("step", [-3600.0, -1.0, -0.01, 0.01, 0.5, 0.999, 5.0, 3600.0])
    def test_clock_set_meanwhile_makes_no_packet_old(self, near, controller, step):
        wall = time.time
        controller.send(bytes(48))
        near.receive(PATIENCE)
        controller.send(bytes(48))
        time.sleep(0.02)
        before = near.now
        with patch("time.time", lambda: wall() + step):
            near.receive(PATIENCE)
        assert before <= near.arrived <= near.now, "it is taken to have come when it was received"
        controller.send(bytes(48))
        before = near.now
        near.receive(PATIENCE)
        assert before <= near.arrived <= near.now, "and the clock may be set back"

    @pytest.mark.parametrize("step", [-0.5, 0.5])
    def test_queued_packets_after_a_clock_change_are_not_old(self, near, controller, step):
        wall = time.time
        for _ in range(5):
            controller.send(bytes(48))
        before = near.now
        with patch("time.time", lambda: wall() + step):
            for _ in range(5):
                near.receive(PATIENCE)
                assert before <= near.arrived <= near.now

    def test_arrivals_are_valid_again_after_a_clock_change(self, near, controller):
        # The kernel's clock cannot be set here: to the link it was, and was set back.
        wall = time.time
        controller.send(bytes(48))
        with patch("time.time", lambda: wall() + 5.0):
            near.receive(PATIENCE)
        controller.send(bytes(48))
        near.receive(PATIENCE)
        controller.send(bytes(48))
        sent = near.now
        time.sleep(0.05)
        near.receive(PATIENCE)
        assert near.arrived <= sent + 1e-5

    def test_long_queueing_time_is_reported(self, near, controller):
        controller.send(bytes(48))
        sent = near.now
        clock, wall = time.monotonic, time.time
        with (
            patch("time.monotonic", lambda: clock() + 60.0),
            patch("time.time", lambda: wall() + 60.0),
        ):
            near.receive(PATIENCE)
            assert near.arrived == pytest.approx(sent, abs=0.02)

    def test_arrival_without_time_stamps_is_unknown(self):
        option = socket.socket.setsockopt

        def refuse(self, level, name, value):
            if name == 35:
                raise PermissionError(1, "not permitted")
            option(self, level, name, value)

        with patch("socket.socket.setsockopt", refuse):
            near = UdpTransport(HOST, 0, HOST)
        far = Controller(near.address[1])
        far.send(bytes(48))
        assert near.receive(PATIENCE) == bytes(48)
        assert near.arrived is None
        assert any("SO_TIMESTAMPNS" in note for note in near.notes)
        near.close()
        far.close()


class TestOpening:
    def test_port_in_use_has_a_remedy(self, near):
        port = near.address[1]
        with pytest.raises(TransportError, match="another program uses it") as caught:
            UdpTransport(HOST, port, HOST)
        assert str(port) in str(caught.value)
        assert f"ss -ulnp sport = :{port}" in caught.value.remedy

    def test_privileged_port_has_a_remedy(self):
        with (
            patch("socket.socket.bind", side_effect=PermissionError(13, "Permission denied")),
            pytest.raises(TransportError, match="privileged") as caught,
        ):
            UdpTransport(HOST, 1000)
        assert "net.ipv4.ip_unprivileged_port_start=1000" in caught.value.remedy

    @pytest.mark.parametrize(
        ("address", "words"),
        [
            ((HOST, 0, "192.0.2.1"), "no network device"),
            (("no host", 0), "controller's address is unknown"),
            ((HOST, -1), "no such port"),
            ((HOST, 65536), "no such port"),
        ],
    )
    def test_invalid_address_is_refused(self, address, words):
        with pytest.raises(TransportError, match=words):
            UdpTransport(*address)

    def test_closed_link_frees_its_port(self, near):
        port = near.address[1]
        near.close()
        UdpTransport(HOST, port, HOST).close()

    def test_refused_options_are_notes(self):
        with patch("socket.socket.setsockopt", side_effect=PermissionError(1, "not permitted")):
            transport = UdpTransport(HOST, 0)
        transport.close()
        assert len(transport.notes) == 4
        assert any("SO_PRIORITY" in note for note in transport.notes)

    def test_settings_and_error_pickle(self):
        spec = UdpSpec("10.2.12.150", 1000, "10.2.12.149")
        assert pickle.loads(pickle.dumps(spec)) == spec
        error = TransportError("UDP port 1000", "taken", "free it")
        copy = pickle.loads(pickle.dumps(error))
        assert (str(copy), vars(copy)) == (str(error), vars(error))


class TestSession:
    """A session behind the port: the controller's words arrive as they are, answers go back."""

    SYNC = (1).to_bytes(4, "little") + bytes(728)

    @pytest.fixture
    def session(self):
        guard = Guard(limits(), 0.002)
        return Session(drive_train(), guard, CycleRing(N))

    def serve(self, near, session, packets: int) -> None:
        """Until so many packets were received, whatever became of them."""
        seen = 0
        receive = near.receive

        def counted(timeout):
            nonlocal seen
            packet = receive(timeout)
            seen += packet is not None
            return packet

        near.receive = counted
        end = time.monotonic() + 2.0
        exchange(near, session, until=lambda: seen >= packets or time.monotonic() > end)
        assert seen == packets

    def packet(self, number: int) -> bytes:
        axes = CyclicPacket.zeros(1, N).axes
        axes["mode"] = Mode.CLOSED
        axes["d"][:, :2] = number
        return CyclicPacket(number, bytes([5, 0, 0, 0]), bytes(4), axes).encode()

    def test_duplicated_reordered_and_short_datagrams(self, near, controller, session):
        first, second, third = (self.packet(number) for number in (11, 12, 13))
        sent = [init_packet().encode(), first, first, third, second, third[:100], self.packet(14)]
        for packet in sent:
            controller.send(packet)
            self.serve(near, session, 1)
        for _ in range(5):
            controller.wait()
        assert controller.heard_nothing()
        numbers = [int.from_bytes(reply[:4], "little") for reply in controller.replies]
        assert numbers == [11, 12, 12, 14, 15]
        assert controller.replies[1] == controller.replies[2]
        assert session.counters.duplicates == 1
        assert session.counters.stale == 1
        assert session.counters.malformed == 1
        assert session.counters.missed == 1
        assert session.state is State.CLOSED

    def test_foreign_packet_is_an_event(self, near, controller, other_host, session):
        other_host.send(self.packet(11))
        controller.send(init_packet().encode())
        self.serve(near, session, 1)
        exchange(near, session, until=iter([False, True]).__next__)
        assert session.counters.discarded["foreign"] == 1  # a busy computer may answer late as well
        assert PacketRejected("foreign", 1) in session.events()
        assert other_host.heard_nothing()

    def test_other_port_does_not_take_over_a_start(self, near, controller, another, session):
        controller.send(self.SYNC)
        loops = 0

        def until():
            nonlocal loops
            loops += 1
            if loops in (2, 4):
                another.send(init_packet().encode())
                controller.send(loops.to_bytes(4, "little") + bytes(728))
            elif loops == 6:
                controller.send(init_packet().encode())
            return session.state is State.INIT or loops > 20

        exchange(near, session, until=until)
        for _ in range(4):
            controller.wait()
        assert another.heard_nothing()
        assert session.state is State.INIT

    def test_stray_datagram_does_not_exclude_the_controller(
        self, near, controller, another, session
    ):
        another.send(b"\xff" * 60)
        self.serve(near, session, 1)
        controller.send(init_packet().encode())
        self.serve(near, session, 1)
        controller.wait()
        assert session.state is State.INIT
        another.send(init_packet().encode())
        assert near.receive(0.02) is None, "now the session has its port"

    def test_flood_before_the_init_packet_does_not_exclude_it(
        self, near, controller, another, session
    ):
        end = time.monotonic() + 5.0

        def flood(packet):
            for _ in range(20):
                another.send(packet)

        for packet in (bytes(228), self.SYNC, b"\xff" * 228):
            flood(packet)
        controller.send(init_packet().encode())
        flood(b"\xff" * 228)
        exchange(
            near,
            session,
            until=lambda: session.state is State.INIT or time.monotonic() > end,
        )
        controller.wait()
        assert session.state is State.INIT

    def test_abandoned_start_does_not_exclude_the_controller(
        self, near, controller, another, session, monkeypatch
    ):
        monkeypatch.setattr(loop, "PEER_TIMEOUT", 0.2)
        end = time.monotonic() + 5.0
        another.send(self.SYNC)

        def until():
            controller.send(init_packet().encode())
            return session.state is State.INIT or time.monotonic() > end

        exchange(near, session, until=until)
        controller.wait()
        assert session.state is State.INIT

    def test_lost_session_is_resumed_from_another_port(self, near, controller, another, session):
        session = Session(drive_train(), Guard(limits(), 0.002), CycleRing(N), silence_timeout=0.15)
        controller.send(init_packet().encode())
        controller.send(self.packet(11))
        self.serve(near, session, 2)
        another.send(init_packet().encode())
        assert near.receive(0.02) is None
        exchange(near, session, until=lambda: session.state is State.FAULTED)
        another.send(init_packet().encode())
        self.serve(near, session, 1)
        another.wait()
        assert session.state is State.INIT
