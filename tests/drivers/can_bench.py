"""Test bench for CAN: packets, buses, an emulated adapter, the contract of a CAN transport."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import select
import threading
import tty

import numpy as np
from can.interfaces.virtual import VirtualBus

from drivers import (
    CycleRing,
    CyclicPacket,
    Guard,
    GuardLimits,
    InitPacket,
    Session,
    TransportClosed,
    exchange,
)
from drivers.packets import next_number
from drivers.transports.can.ends import ControllerEnd, PcEnd
from drivers.transports.can.layout import BusRates
from drivers.transports.can.transport import CanTransport
from hil.cell import Cell
from hil.simulation import planted_truth, simulated_drive
from sim_fixtures import ControllerSettings, SimulatedController, ns16
from sim_fixtures.can_link import CanControllerLink
from tests.drivers.rig import MOVE, limits, smooth_move
from tests.drivers.transport_contract import TransportContract

N = 6
PROFILES = ("fd", "classic")
HOME = np.radians([0.0, 0.0, -90.0, 0.0, 90.0, 0.0])
_channels = itertools.count()


def init_packet(n_axes: int = N, sample_time: int = 2, **fields) -> bytes:
    return InitPacket.build(n_axes, sample_time, {}, **fields).encode()


def random_packet(rng, number: int, n_axes: int = N, *, mode: int = 4, status: int = 5) -> bytes:
    """A cyclic packet whose every number differs and is a whole count of every field."""
    packet = CyclicPacket.zeros(number, n_axes)
    counts = rng.integers(-(2**20), 2**20, (n_axes, 2)) / 2**16
    packet.axes["mode"] = mode
    packet.axes["d"][:, 2] = counts[:, 0]
    packet.axes["d"][:, 0] = counts[:, 0] + rng.integers(-(2**15), 2**15, n_axes) / 2**16
    packet.axes["d"][:, 1] = rng.normal(size=n_axes)
    packet.axes["d"][:, 3] = rng.normal(size=n_axes)
    packet.axes["d"][:, 4] = rng.integers(-2000, 2000, n_axes) / 64
    packet.axes["extra"] = rng.normal(size=(n_axes, 3))
    functionality = bytes(rng.integers(0, 256, 4, dtype=np.uint8))
    return CyclicPacket(number, bytes((status, 0, 0, 0)), functionality, packet.axes).encode()


def decoded(packet: bytes, n_axes: int = N) -> CyclicPacket:
    return CyclicPacket.decode(packet, n_axes)


class Wire:
    """Both ends without a bus; frames pass at `time`, a cycle of 2 ms each."""

    def __init__(self, profile: str, *, n_axes: int = N, sample_time: int = 2) -> None:
        rates = BusRates(profile)
        self.far, self.near = ControllerEnd(rates), PcEnd(rates)
        self.n_axes = n_axes
        self.time = 1000.0
        packet = init_packet(n_axes, sample_time)
        assert self.up(packet) == packet

    def up(self, packet: bytes) -> bytes | None:
        self.time += 0.002
        return self.take(self.far.packet(packet))

    def take(self, frames) -> bytes | None:
        out = None
        for frame in frames:
            packet = self.near.receive(frame, self.time)
            assert packet is None or out is None
            out = packet if packet is not None else out
        return out

    def down(self, reply: bytes) -> bytes | None:
        out = None
        for frame in self.near.reply(reply):
            packet = self.far.receive(frame, self.time)
            out = packet if packet is not None else out
        return out


class Cycles:
    """A clock advanced by packets only: a pause of this computer does not truncate a set."""

    def __init__(self) -> None:
        self.time = 1.0

    def __call__(self) -> float:
        return self.time


class UnstampedBus(VirtualBus):
    """A virtual bus whose frames carry no time of arrival."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel, preserve_timestamps=True)


def virtual_ends(profile: str, clock=None, **options) -> tuple[CanTransport, CanControllerLink]:
    """Both ends on a virtual bus of their own."""
    channel = f"bench-{next(_channels)}"
    rates = BusRates(profile)
    clock = clock if clock is not None else Cycles()
    far = CanControllerLink(UnstampedBus(channel), rates, clock=clock, **options)
    return CanTransport(UnstampedBus(channel), rates, clock=clock), far


class PacedByPackets:
    """A transport in one thread with its controller: each `receive` is one cycle of it.

    Bytes go over whatever bus the two ends are on; time is a count of cycles.
    """

    def __init__(self, near, far, controller, *, lost=(), clock=None) -> None:
        self.near, self.far, self.controller = near, far, controller
        self.lost = frozenset(lost)
        self.cycle = 0
        self.clock = clock if clock is not None else Cycles()
        self.replies: list[bytes | None] = []
        self._awaiting = False

    @property
    def now(self) -> float:
        return self.cycle * self.controller.period

    @property
    def ages(self):
        return self.near.ages

    def receive(self, timeout: float) -> bytes | None:
        if timeout <= 0.0:
            return self.near.receive(0.0)
        if self._awaiting:
            # Frames of other nodes are queued already.
            if (waiting := self.near.receive(0.0)) is not None:
                return waiting
            self._hand_over(None)
        packet = self.controller.next_packet()
        if packet is None:
            raise TransportClosed("the controller's end has no more packets")
        self.cycle += 1
        self.clock.time += self.controller.period
        self._awaiting = True
        if self.cycle in self.lost:
            return None
        self.far.send(packet)
        return self.near.receive(0.5)

    def send(self, packet: bytes) -> None:
        self.near.send(packet)
        self._hand_over(self.far.receive(0.5))

    def _hand_over(self, reply: bytes | None) -> None:
        self._awaiting = False
        self.replies.append(reply)
        self.controller.accept(reply)

    def rejected(self) -> dict[str, int]:
        return self.near.rejected()

    def forget_peer(self) -> None:
        self.near.forget_peer()

    def close(self) -> None:
        self.near.close()
        self.far.close()


NS16 = Cell.load(ns16.CELL_PATH)


def wide_limits() -> GuardLimits:
    far, current = np.full(N, 4.0), NS16.drive_train.current_limit
    return limits(lower=-far, upper=far, following_error=np.ones(N), current=current)


def ns16_controller(**settings) -> SimulatedController:
    """The simulated NS 16, one opening, short phases."""
    figures = {"period": 0.002, "open_intervals": 1, "cold_start": True, **settings}
    return SimulatedController(
        ns16.urdf_text(),
        simulated_drive(NS16),
        planted_truth(NS16),
        ControllerSettings(**figures),
        seed=1,
        initial_position=HOME,
    )


PERIOD = 0.002


class Run:
    """One session from cold start to its end, paced by its packets."""

    def __init__(self, profile, *, ends=None, cycles=300, lost=(), mode=4, **settings):
        clock = Cycles()
        self.near, self.far = ends or virtual_ends(profile, clock)
        self.controller = ns16_controller(open_mode=mode, **settings)
        self.link = PacedByPackets(self.near, self.far, self.controller, lost=lost, clock=clock)
        self.ring = CycleRing(N, 8192)
        guard = Guard(wide_limits(), PERIOD)
        self.session = Session(NS16.drive_train, guard, self.ring, settle_cycles=20, mode=mode)
        self.session.request(smooth_move(MOVE, cycles, start=HOME))
        self.events = []
        exchange(self.link, self.session, until=self._until)
        self.link.close()
        self.events += self.session.events()

    def _until(self):
        self.events += self.session.events()
        return self.link.cycle > 5000

    def seen(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def records(self):
        return self.ring.last(self.ring.capacity)


_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_OK, _BELL = b"\r", b"\a"


class _Adapter:
    """One adapter: its end of the pseudo-terminal and the commands that it got."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.open = False
        self.rates: list[str] = []
        self.waiting = bytearray()
        self._line = bytearray()
        os.set_blocking(self.master, False)

    def hand_over(self) -> None:
        """Give the host as much of what waits for it as it takes."""
        with contextlib.suppress(BlockingIOError):
            del self.waiting[: os.write(self.master, self.waiting)]

    def lines(self) -> list[str]:
        """Commands that have come in whole."""
        self._line += os.read(self.master, 4096)
        *whole, rest = self._line.split(b"\r")
        self._line = bytearray(rest)
        return [line.decode("ascii") for line in whole]

    def close(self) -> None:
        os.close(self.master)
        os.close(self._slave)


def _is_frame(line: str) -> bool:
    """Whether a command is a well-formed data frame with a standard identifier."""
    if len(line) < 5 or line[0] not in "tdb":
        return False
    length = int(line[4], 16)
    if line[0] == "t" and length > 8:
        return False
    return len(line) == 5 + 2 * _LENGTHS[length] and int(line[1:4], 16) < 0x800


class SlcanBus:
    """Two adapters joined by a bus, served by a thread.

    Attributes:
        ports: the two serial devices.
        refused: commands that were answered with the bell.
    """

    def __init__(self) -> None:
        self._adapters = (_Adapter(), _Adapter())
        self.ports = tuple(adapter.port for adapter in self._adapters)
        self.refused: list[str] = []
        self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def rates(self) -> list[list[str]]:
        """The bit rate commands each adapter was given."""
        return [adapter.rates for adapter in self._adapters]

    def _serve(self) -> None:
        masters = {adapter.master: adapter for adapter in self._adapters}
        ending = False
        while True:
            # Commands written before the end are still executed.
            sources = [*masters] if ending else [*masters, self._wake[0]]
            full = [adapter.master for adapter in self._adapters if adapter.waiting]
            ready, free, _ = select.select(sources, full, [], 0.0 if ending else None)
            if ending and not ready:
                return
            for master in free:
                masters[master].hand_over()
            ending = ending or self._wake[0] in ready
            for master in ready:
                if master not in masters:
                    continue
                adapter = masters[master]
                other = next(a for a in self._adapters if a is not adapter)
                for line in adapter.lines():
                    self._execute(adapter, other, line)

    def _execute(self, adapter: _Adapter, other: _Adapter, line: str) -> None:
        answer = _OK
        if line == "O":
            adapter.open = True
        elif line in ("C", ""):
            adapter.open = adapter.open and line == ""
        elif line[0] in "SY":
            adapter.rates.append(line)
        elif adapter.open and _is_frame(line):
            if other.open:
                other.waiting += line.encode() + b"\r"
            answer = b"z\r"
        else:
            self.refused.append(line)
            answer = _BELL
        adapter.waiting += answer

    def close(self) -> None:
        os.write(self._wake[1], b"x")
        self._thread.join()
        for adapter in self._adapters:
            adapter.close()
        for end in self._wake:
            os.close(end)


class Far:
    """The controller's end as the contract needs it."""

    def __init__(self, end: CanControllerLink) -> None:
        self.end = end
        self.replies: list[bytes] = []

    def send(self, packet: bytes) -> None:
        self.end.send(packet)

    def wait(self) -> None:
        reply = self.end.receive(2.0)
        assert reply is not None
        self.replies.append(reply)


class CanContract(TransportContract):
    """The contract of every transport, and the cyclic frames."""

    def test_cyclic_packets_after_an_init_packet(self, link):
        near, far = link
        # Cycles so long that a pause of this computer does not truncate a set of frames.
        begin = init_packet(sample_time=100)
        far.send(begin)
        init = near.receive(2.0)
        assert init == begin
        near.send(init)
        far.wait()
        rng = np.random.default_rng(1)
        for number in (11, 12, 13):
            sent = random_packet(rng, number)
            far.send(sent)
            received = CyclicPacket.decode(near.receive(2.0), 6)
            wanted = CyclicPacket.decode(sent, 6)
            assert received.number == number
            assert received.status == wanted.status
            for column in (0, 2, 4):
                np.testing.assert_array_equal(
                    received.axes["d"][:, column], wanted.axes["d"][:, column]
                )
            axes = wanted.axes.copy()
            axes["d"][:, 1:] = axes["extra"] = 0.0
            reply = CyclicPacket(next_number(number), bytes(4), bytes(4), axes).encode()
            near.send(reply)
            far.wait()
            arrived = CyclicPacket.decode(far.replies[-1], 6)
            np.testing.assert_array_equal(arrived.axes["d"][:, 0], axes["d"][:, 0])
            assert arrived.number == next_number(number)
        assert near.rejected() == {}
