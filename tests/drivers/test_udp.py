"""The UDP link, on the loopback device."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from contextlib import closing
from unittest.mock import patch

import pytest

from drivers import CycleRing, CyclicPacket, Guard, Session, State, exchange
from drivers.errors import TransportClosed
from drivers.transports.base import TransportError
from drivers.transports.udp import MAX_FOREIGN_PACKETS, UdpSpec, UdpTransport
from tests.drivers.rig import N, Rig, drive_train, init_packet, limits
from tests.drivers.transport_contract import TransportContract

HOST = "127.0.0.1"
OTHER_HOST = "127.0.0.2"
PATIENCE = 5.0


class Controller:
    """A socket of the controller's host."""

    def __init__(self, transport, host: str = HOST):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, 0))
        self.socket.connect((HOST, transport.address[1]))
        self.socket.settimeout(PATIENCE)
        self.send = self.socket.send
        self.close = self.socket.close
        self.replies: list[bytes] = []

    def wait(self) -> None:
        self.replies.append(self.socket.recv(2048))

    def received_nothing(self) -> bool:
        return not select.select([self.socket], [], [], 0.0)[0]


@pytest.fixture
def transport():
    transport = UdpSpec(HOST, 0, HOST).open()
    yield transport
    transport.close()


@pytest.fixture
def ends(transport):
    """The controller, another port of its host, and another host."""
    made = [Controller(transport, host) for host in (HOST, HOST, OTHER_HOST)]
    yield made
    for end in made:
        end.close()


@pytest.fixture
def controller(ends):
    return ends[0]


@pytest.fixture
def another(ends):
    return ends[1]


@pytest.fixture
def other_host(ends):
    return ends[2]


class TestContract(TransportContract):
    @pytest.fixture
    def link(self, transport, controller):
        # A datagram of a plausible length decides the port; the contract also sends shorter ones.
        controller.send(bytes(48))
        transport.receive(PATIENCE)
        return transport, controller


class TestWait:
    def test_it_leaves_the_packet(self, transport, controller):
        controller.send(bytes(48))
        assert transport.wait(PATIENCE)
        assert transport.wait(0.0)
        assert transport.receive(0.0) == bytes(48)
        assert not transport.wait(0.0)

    def test_it_is_of_the_precision_of_timers(self, transport):
        """Once in a hundred times, however busy the computer is: not one scheduler tick."""

        def duration():
            before = time.monotonic()
            assert not transport.wait(2e-4)
            return time.monotonic() - before

        durations = [duration() for _ in range(100)]
        assert 2e-4 <= min(durations) < 1e-3

    def test_a_closed_link_is_not_waited_for(self, transport):
        transport.close()
        assert transport.wait(PATIENCE)

    def test_a_link_closed_meanwhile_is_left_to_receive(self, transport, monkeypatch):
        kernel = select.select

        def closing(*arguments):
            transport.close()
            return kernel(*arguments)

        monkeypatch.setattr(select, "select", closing)
        assert transport.wait(PATIENCE)
        with pytest.raises(TransportClosed):
            transport.receive(PATIENCE)

    def test_a_descriptor_too_high_for_select_is_not_waited_for(self, transport, monkeypatch):
        monkeypatch.setattr(transport, "_socket", 1024)  # FD_SETSIZE
        assert transport.wait(PATIENCE)


class TestPolling:
    @pytest.fixture
    def yields(self, monkeypatch):
        """Times at which the processor was left to other threads."""
        times = []
        monkeypatch.setattr(os, "sched_yield", lambda: times.append(time.monotonic()))
        return times

    def test_threads_of_its_priority_run_meanwhile(self, transport, controller, monkeypatch):
        """Such as that of the network card's interrupt, without which no packet comes."""
        monkeypatch.setattr(os, "sched_yield", lambda: controller.send(bytes(48)))
        transport.polls_until = transport.now + PATIENCE
        assert transport.receive(PATIENCE) == bytes(48)

    def test_it_ends_with_the_time_out(self, transport, yields):
        transport.polls_until = transport.now + PATIENCE
        before = transport.now
        assert transport.receive(0.01) is None
        assert before < yields[0] <= yields[-1] <= before + 0.02

    def test_once_it_has_ended_the_process_sleeps(self, transport, controller, yields):
        transport.polls_until = end = transport.now + 0.01
        assert transport.receive(0.05) is None
        assert transport.now > end + 0.03
        assert yields[-1] < end + 0.02
        controller.send(bytes(48))
        assert transport.receive(PATIENCE) == bytes(48)

    def test_without_time_a_packet_is_received_at_once_or_not(self, transport, controller):
        transport.polls_until = transport.now + PATIENCE
        assert transport.receive(0.0) is None
        controller.send(bytes(48))
        assert transport.wait(PATIENCE)
        assert transport.receive(0.0) == bytes(48)

    def test_other_hosts_do_not_prolong_it(self, transport, other_host, monkeypatch):
        monkeypatch.setattr(os, "sched_yield", lambda: other_host.send(bytes(48)))
        transport.polls_until = transport.now + PATIENCE
        before = transport.now
        assert transport.receive(0.02) is None
        assert transport.now < before + 0.2


class TestLoopback:
    @pytest.fixture
    def loopback(self):
        with closing(UdpTransport.loopback()) as link:
            yield link

    @pytest.mark.parametrize("length", [48, 1200])
    def test_it_receives_what_it_sends(self, loopback, length):
        loopback.send(bytes(length))
        assert loopback.receive(PATIENCE) == bytes(length)
        assert loopback.arrived <= loopback.now

    def test_it_receives_nothing_else(self, loopback, controller):
        controller.socket.sendto(bytes(48), loopback.address)
        assert loopback.receive(0.05) is None
        assert loopback.rejected() == {"foreign": 1}


class TestPeer:
    def test_first_sender_is_the_peer_until_forgotten(self, transport, controller, another):
        controller.send(b"a" * 48)
        assert transport.receive(PATIENCE) == b"a" * 48
        another.send(b"b" * 48)
        assert transport.receive(0.05) is None
        assert transport.rejected() == {"foreign": 1}
        transport.forget_peer()
        transport.send(bytes(48))
        assert controller.received_nothing()
        another.send(b"c" * 48)
        assert transport.receive(PATIENCE) == b"c" * 48
        transport.send(b"answer")
        another.wait()
        assert another.replies == [b"answer"]
        assert controller.received_nothing()
        assert transport.rejected() == {"unsent": 1}

    @pytest.mark.parametrize("length", [0, 11, 1501, 9000])
    def test_sender_of_implausible_lengths_is_not_the_peer(
        self, transport, controller, another, length
    ):
        another.send(bytes(length))
        controller.send(b"x" * 1500)
        assert transport.receive(PATIENCE) == b"x" * 1500
        controller.send(bytes(1501))
        assert transport.receive(0.05) is None
        assert transport.rejected() == {"malformed": 2}

    @pytest.mark.parametrize("length", [12, 47])
    def test_header_alone_is_answered(self, transport, controller, length):
        """Of sync packets nothing is known but that they are shorter than the init packet."""
        rig = Rig()
        controller.send(struct.pack("<i", 3) + bytes(length - 4))
        exchange(transport, rig.session, ends_when=lambda: rig.session.counters.replied > 0)
        controller.wait()
        assert controller.replies == [struct.pack("<i", 4) + bytes(length - 4)]

    def test_other_hosts_neither_extend_the_wait_nor_hide_packets(
        self, transport, controller, other_host
    ):
        for _ in range(200):
            other_host.send(bytes(48))
        before = time.monotonic()
        assert transport.receive(0.05) is None
        assert 0.05 <= time.monotonic() - before < 5.0
        for _ in range(20):
            other_host.send(bytes(48))
        controller.send(b"x" * 48)
        assert transport.receive(PATIENCE) == b"x" * 48
        assert transport.rejected() == {"foreign": 220}

    def test_packet_behind_other_hosts_without_wait(self, transport, controller, other_host):
        controller.send(b"a" * 48)
        assert transport.receive(PATIENCE) == b"a" * 48
        for number in range(10):
            for _ in range(3):
                other_host.send(bytes(48))
            controller.send(bytes([number]) * 48)
        received = [transport.receive(timeout) for timeout in (0.0, -1.0, 1e-9, 0.0, -1e-9)]
        assert received == [bytes([number]) * 48 for number in range(5)]
        while (packet := transport.receive(0.0)) is not None:
            received.append(packet)
        assert received == [bytes([number]) * 48 for number in range(10)]
        assert transport.rejected() == {"foreign": 30}

    def test_flood_of_other_hosts_ends_without_wait(self, transport, other_host):
        kernel = transport._receive

        def endless(*arguments):
            other_host.send(bytes(48))
            return kernel(*arguments)

        transport._receive = endless
        assert transport.receive(0.0) is None
        assert transport.rejected() == {"foreign": MAX_FOREIGN_PACKETS + 1}


class TestWaiting:
    def test_wait_is_not_shorter_than_requested(self, transport):
        for timeout in (1e-9, 0.0005, 0.003, 0.0101, 0.03, 0.0, 0.02, 0.02):
            before = time.monotonic()
            assert transport.receive(timeout) is None
            assert timeout <= time.monotonic() - before < timeout + 5.0

    def test_datagrams_dropped_by_the_kernel_are_overruns(self, transport, controller):
        controller.send(bytes(48))
        transport.receive(PATIENCE)
        for _ in range(3000):
            controller.send(bytes(1200))
        received = 0
        while transport.receive(0.0) is not None:
            received += 1
        assert received < 3000
        assert transport.rejected() == {"overrun": 3000 - received}
        assert transport.rejected() == {}


class TestArrival:
    def test_arrival_is_the_time_in_the_kernel(self, transport, controller):
        before = time.monotonic()
        controller.send(bytes(48))
        sent = time.monotonic()
        time.sleep(0.05)
        assert transport.receive(PATIENCE) is not None
        assert before - 1e-5 <= transport.arrived <= sent + 1e-5

    @pytest.mark.parametrize("step", [-3600.0, -1.0, -0.01, 0.01, 0.5, 0.999, 5.0, 3600.0])
    def test_clock_set_meanwhile_makes_no_packet_old(self, transport, controller, step):
        """To the link it was set, and set back; the kernel's clock cannot be set here."""
        wall = time.time
        controller.send(bytes(48))
        transport.receive(PATIENCE)
        before = transport.now
        for _ in range(5):
            controller.send(bytes(48))
        time.sleep(0.02)
        with patch("time.time", lambda: wall() + step):
            for _ in range(5):
                transport.receive(PATIENCE)
                assert before <= transport.arrived <= transport.now
        for pause in (0.0, 0.05):
            controller.send(bytes(48))
            sent = transport.now
            time.sleep(pause)
            transport.receive(PATIENCE)
            assert before <= transport.arrived <= transport.now
        assert transport.arrived <= sent + 1e-5, "valid again, of the kernel"

    def test_long_queueing_time_is_reported(self, transport, controller):
        controller.send(bytes(48))
        sent = transport.now
        clock = time.monotonic
        wall = time.time
        with (
            patch("time.monotonic", lambda: clock() + 60.0),
            patch("time.time", lambda: wall() + 60.0),
        ):
            transport.receive(PATIENCE)
            assert transport.arrived == pytest.approx(sent, abs=0.02)

    def test_arrival_without_time_stamps_is_unknown(self):
        option = socket.socket.setsockopt

        def refuse(self, level, name, value):
            if name == 35:
                raise PermissionError(1, "not permitted")
            option(self, level, name, value)

        with patch("socket.socket.setsockopt", refuse):
            transport = UdpTransport(HOST, 0, HOST)
        end = Controller(transport)
        end.send(bytes(48))
        assert transport.receive(PATIENCE) == bytes(48)
        assert transport.arrived is None
        assert any("SO_TIMESTAMPNS" in note for note in transport.notes)
        transport.close()
        end.close()


class TestOpening:
    def test_port_in_use_has_a_remedy(self, transport):
        port = transport.address[1]
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
        ("address", "message"),
        [
            ((HOST, 0, "192.0.2.1"), "no network device"),
            (("no host", 0), "controller's address is unknown"),
            ((HOST, -1), "no such port"),
            ((HOST, 65536), "no such port"),
        ],
    )
    def test_invalid_address_is_refused(self, address, message):
        with pytest.raises(TransportError, match=message):
            UdpTransport(*address)

    def test_closed_link_frees_its_port(self, transport):
        port = transport.address[1]
        transport.close()
        UdpTransport(HOST, port, HOST).close()

    def test_refused_options_are_notes(self):
        with patch("socket.socket.setsockopt", side_effect=PermissionError(1, "not permitted")):
            transport = UdpTransport(HOST, 0)
        transport.close()
        assert len(transport.notes) == 4
        assert any("SO_PRIORITY" in note for note in transport.notes)


class TestSession:
    """A session on the link: peers, duplicates, lost sessions."""

    SYNC = (1).to_bytes(4, "little") + bytes(728)

    @pytest.fixture
    def session(self):
        guard = Guard(limits(), 0.002)
        return Session(drive_train(), guard, CycleRing(N), silence_timeout=0.15)

    def test_other_port_does_not_take_over_a_start(self, transport, controller, another, session):
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

        exchange(transport, session, ends_when=until)
        for _ in range(4):
            controller.wait()
        assert another.received_nothing()
        assert session.state is State.INIT

    def test_duplicated_reordered_and_short_datagrams(self, transport, controller, session):
        first, second, third, fourth = (CyclicPacket.zeros(k, N).encode() for k in range(11, 15))
        counters = session.counters
        for count, packet in enumerate(
            [init_packet().encode(), first, first, third, second, third[:100], fourth], 1
        ):
            controller.send(packet)

            def handled(count=count):
                lost = counters.stale + counters.malformed
                return counters.replied + counters.duplicates + lost == count

            exchange(transport, session, ends_when=handled)
        for _ in range(5):
            controller.wait()
        assert controller.received_nothing()
        numbers = [int.from_bytes(reply[:4], "little") for reply in controller.replies]
        assert numbers == [11, 12, 12, 14, 15]
        assert controller.replies[1] == controller.replies[2]
        assert (counters.duplicates, counters.stale, counters.malformed) == (1, 1, 1)
        assert counters.missed == 1

    def test_lost_session_is_resumed_from_another_port(
        self, transport, controller, another, session
    ):
        def serve(until):
            exchange(transport, session, ends_when=until)

        controller.send(init_packet().encode())
        controller.send(CyclicPacket.zeros(11, N).encode())
        serve(lambda: session.counters.replied == 2)
        another.send(init_packet().encode())
        assert transport.receive(0.02) is None
        serve(lambda: session.state is State.FAULTED)
        another.send(init_packet().encode())
        serve(lambda: session.state is State.INIT)
        another.wait()
