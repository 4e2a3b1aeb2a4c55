"""Test bench for CAN: packets, buses, an emulated adapter, the contract of a CAN transport."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import select
import threading
import time
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
from drivers.c4g_packets import next_number
from drivers.transports.can.frames import DOWN, PAYLOADS_FD, UP, BusRates, CanEndpoint
from drivers.transports.can.transport import CanTransport
from hil.cell import Cell
from hil.control.planted_arm import planted_truth
from hil.control.simulated_cell import simulated_drive
from sim_fixtures import ControllerSettings, SimulatedController, ns16
from sim_fixtures.can_link import CanControllerLink
from tests.drivers.rig import MOVE, limits, smooth_move
from tests.drivers.transport_contract import PATIENCE, TransportContract

N = 6
HOME = np.radians([0.0, 0.0, -90.0, 0.0, 90.0, 0.0])
_channels = itertools.count()


def init_packet(n_axes: int = N, sample_time: int = 2, **fields) -> bytes:
    return InitPacket.build(n_axes, sample_time, {}, **fields).encode()


def random_packet(rng, number: int, n_axes: int = N, *, mode: int = 4, status: int = 5) -> bytes:
    """A cyclic packet whose every number differs."""
    packet = CyclicPacket.zeros(number, n_axes)
    packet.axes["mode"] = mode
    packet.axes["d"] = rng.normal(size=(n_axes, 5))
    packet.axes["extra"] = rng.normal(size=(n_axes, 3))
    functionality = bytes(rng.integers(0, 256, 4, dtype=np.uint8))
    return CyclicPacket(number, bytes((status, 0, 0, 0)), functionality, packet.axes).encode()


def decoded(packet: bytes, n_axes: int = N) -> CyclicPacket:
    return CyclicPacket.decode(packet, n_axes)


class Wire:
    """Both ends without a bus; frames pass at `time`, a cycle of 2 ms each."""

    def __init__(self, *, n_axes: int = N, sample_time: int = 2) -> None:
        self.far = CanEndpoint(BusRates(), UP)
        self.near = CanEndpoint(BusRates(), DOWN)
        self.n_axes = n_axes
        self.time = 1000.0
        packet = init_packet(n_axes, sample_time)
        assert self.up(packet) == packet

    def up(self, packet: bytes) -> bytes | None:
        self.time += 0.002
        return self._passed(self.near, self.far.frames(packet))

    def down(self, reply: bytes) -> bytes | None:
        return self._passed(self.far, self.near.frames(reply))

    def _passed(self, end, frames) -> bytes | None:
        packets = [packet for frame in frames if (packet := end.receive(frame, self.time))]
        assert len(packets) <= 1
        return packets[0] if packets else None


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


def virtual_ends(clock=None, **options) -> tuple[CanTransport, CanControllerLink]:
    """Both ends on a virtual bus of their own."""
    channel = f"bench-{next(_channels)}"
    rates = BusRates()
    clock = clock if clock is not None else Cycles()
    far = CanControllerLink(UnstampedBus(channel), rates, clock=clock, **options)
    return CanTransport(UnstampedBus(channel), rates, clock=clock), far


class PacedByPackets:
    """A transport in one thread with its controller: each `receive` is one cycle of it.

    Bytes go over whatever bus the two ends are on; time is a count of cycles.
    """

    def __init__(self, near, far, controller, *, lost=(), clock) -> None:
        self.near = near
        self.far = far
        self.controller = controller
        self.lost = frozenset(lost)
        self.cycle = 0
        self.clock = clock
        self.replies: list[bytes | None] = []
        self._awaiting = False
        self.rejected = near.rejected
        self.forget_peer = near.forget_peer

    @property
    def now(self) -> float:
        return self.cycle * self.controller.period

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

    def close(self) -> None:
        self.near.close()
        self.far.close()


NS16 = Cell.load(ns16.CELL_PATH)


def wide_limits() -> GuardLimits:
    far = np.full(N, 4.0)
    current = NS16.drive_train.current_limit
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


def session_on(*, until, clock=None, ends=None, controller=None, session=None, lost=()):
    """Run a session, paced by its packets, until `until(link)`; returns link and session."""
    clock = clock if clock is not None else Cycles()
    near, far = ends or virtual_ends(clock)
    controller = controller or ns16_controller()
    link = PacedByPackets(near, far, controller, lost=lost, clock=clock)
    guard = Guard(wide_limits(), controller.period)
    session = session or Session(NS16.drive_train, guard, CycleRing(N, 64))
    exchange(link, session, ends_when=lambda: until(link))
    return link, session


class Run:
    """One session from cold start to its end."""

    def __init__(self, *, ends=None, cycles=300, lost=(), mode=4, **settings):
        self.controller = ns16_controller(open_mode=mode, **settings)
        self.ring = CycleRing(N, 8192)
        guard = Guard(wide_limits(), PERIOD)
        self.session = Session(NS16.drive_train, guard, self.ring, settle_cycles=20, mode=mode)
        self.session.request(smooth_move(MOVE, cycles, start=HOME))
        self.events = []
        self.link, _ = session_on(
            until=self._until,
            ends=ends,
            controller=self.controller,
            session=self.session,
            lost=lost,
        )
        self.link.close()
        self.events += self.session.events()

    def _until(self, link):
        self.events += self.session.events()
        return link.cycle > 5000

    def seen(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def records(self):
        return self.ring.last(self.ring.capacity)


class SlcanBus:
    """Two emulated serial adapters joined by a bus, served by a thread.

    `ports` are the serial devices, `rates` the bit rate commands of each, `set_up` these and what
    opens and closes, `refused` the commands that were answered with the bell.
    """

    def __init__(self) -> None:
        self._terminals = [pty.openpty() for _ in range(2)]
        self.ports = tuple(os.ttyname(slave) for _, slave in self._terminals)
        self.rates: tuple[list[str], list[str]] = ([], [])
        self.set_up: tuple[list[str], list[str]] = ([], [])
        self.refused: list[str] = []
        self._open = [False, False]
        self._waiting = bytearray(), bytearray()
        self._ending = threading.Event()
        for master, slave in self._terminals:
            tty.setraw(slave)
            os.set_blocking(master, False)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        masters = [master for master, _ in self._terminals]
        parts = [b"", b""]
        while True:
            # Commands written before the end are still executed.
            ending = self._ending.is_set()
            full = [master for master, data in zip(masters, self._waiting, strict=True) if data]
            ready, free, _ = select.select(masters, full, [], 0.0 if ending else 0.01)
            if ending and not ready:
                return
            for side, master in enumerate(masters):
                if master in free:
                    with contextlib.suppress(BlockingIOError):
                        del self._waiting[side][: os.write(master, self._waiting[side])]
                if master in ready:
                    *lines, parts[side] = (parts[side] + os.read(master, 4096)).split(b"\r")
                    for line in lines:
                        self._execute(side, line.decode("ascii"))

    def _execute(self, side: int, line: str) -> None:
        answer = b"\r"
        if line[:1] in ("O", "C", "S", "Y"):
            self.set_up[side].append(line)
        if line in ("O", "C"):
            self._open[side] = line == "O"
        elif line[:1] in ("S", "Y"):
            self.rates[side].append(line)
        elif self._open[side] and self._is_frame(line):
            if self._open[1 - side]:
                self._waiting[1 - side].extend(line.encode() + b"\r")
            answer = b"z\r"
        elif line:
            self.refused.append(line)
            answer = b"\a"
        self._waiting[side].extend(answer)

    def await_open(self) -> None:
        """Wait until both adapters are on the bus.

        The kernel hands over the two terminals independently: a frame may overtake the other
        side's command to open, and is then lost, as on a real bus.
        """
        end = time.monotonic() + PATIENCE
        while not all(self._open):
            assert time.monotonic() < end, f"an adapter did not open: {self.set_up}"
            time.sleep(0.001)

    @staticmethod
    def _is_frame(line: str) -> bool:
        """Whether a command is a well-formed data frame with a standard identifier."""
        if len(line) < 5 or line[0] not in "tdb":
            return False
        length = int(line[4], 16)
        fits = line[0] != "t" or length <= 8
        return fits and len(line) == 5 + 2 * PAYLOADS_FD[length] and int(line[1:4], 16) < 0x800

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        for descriptor in (each for pair in self._terminals for each in pair):
            os.close(descriptor)


class Far:
    """The controller's end as the contract needs it."""

    def __init__(self, end: CanControllerLink) -> None:
        self.end = end
        self.send = end.send
        self.replies: list[bytes] = []

    def wait(self) -> None:
        reply = self.end.receive(2.0)
        assert reply is not None
        self.replies.append(reply)


class CanContract(TransportContract):
    """The contract of every transport, and cyclic packets."""

    def test_cyclic_packets_after_an_init_packet(self, link):
        near, far = link
        begin = init_packet(sample_time=100)
        far.send(begin)
        assert near.receive(2.0) == begin
        near.send(begin)
        far.wait()
        rng = np.random.default_rng(1)
        for number in (11, 12, 13):
            sent = random_packet(rng, number)
            far.send(sent)
            assert near.receive(2.0) == sent
            reply = next_number(number).to_bytes(4, "little") + sent[4:]
            near.send(reply)
            far.wait()
            assert far.replies[-1] == reply
        assert near.rejected() == {}
