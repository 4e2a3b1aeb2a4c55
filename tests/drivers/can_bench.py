"""Sessions over CAN on a bench: packets for both ends, and a link paced by its packets."""

from __future__ import annotations

import itertools
import tomllib
from math import radians

import numpy as np
from can.interfaces.virtual import VirtualBus

from drivers import CyclicPacket, DriveTrain, GuardLimits, InitPacket, TransportClosed
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.ends import ControllerEnd, PcEnd
from drivers.transports.can.transport import CanTransport
from sim_fixtures import ControllerSettings, PlantTruth, SimulatedController, SimulatedDrive, ns16
from sim_fixtures.can_end import CanFarEnd

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
    """A clock that only the packets move: no stall of this machine tears a set of frames."""

    def __init__(self) -> None:
        self.time = 1.0

    def __call__(self) -> float:
        return self.time


class UnstampedBus(VirtualBus):
    """A virtual bus whose frames carry no time of arrival."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel, preserve_timestamps=True)


def virtual_ends(profile: str, clock=None, **options) -> tuple[CanTransport, CanFarEnd]:
    """Both ends on a virtual bus of their own."""
    channel = f"bench-{next(_channels)}"
    rates = BusRates(profile)
    clock = clock if clock is not None else Cycles()
    far = CanFarEnd(UnstampedBus(channel), rates, clock=clock, **options)
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
            # What others said on the bus waits there already.
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


def _cell() -> dict:
    return tomllib.loads(ns16.CELL_PATH.read_text())


def ns16_train() -> DriveTrain:
    table = _cell()["drive_train"]
    return DriveTrain(
        gear_ratio=np.array(table["gear_ratio"]),
        calibration=np.array(table["calibration"]),
        joint_sign=np.array(table["joint_sign"]),
        joint_offset=np.radians(table["joint_offset_deg"]),
        torque_constant=np.array(table["torque_constant"]),
        current_limit=np.array(table["current_limit"]),
        k54=table["k54"],
        k64=table["k64"],
        k65=table["k65"],
    )


def wide_limits() -> GuardLimits:
    return GuardLimits(
        lower=np.full(N, -4.0),
        upper=np.full(N, 4.0),
        velocity=np.full(N, 2.0),
        acceleration=np.full(N, 8.0),
        jerk=np.full(N, 100.0),
        following_error=np.full(N, 1.0),
        current=np.array(_cell()["drive_train"]["current_limit"]),
    )


def ns16_controller(**settings) -> SimulatedController:
    """The simulated NS 16, one opening, short phases."""
    cell = _cell()
    table = cell["drive_train"]
    drive = SimulatedDrive(
        gear_ratio=table["gear_ratio"],
        calibration=table["calibration"],
        joint_sign=table["joint_sign"],
        joint_offset=[radians(a) for a in table["joint_offset_deg"]],
        torque_constant=table["torque_constant"],
        current_limit=table["current_limit"],
        following_error=table["following_error"],
        encoder_counts=table["encoder_counts_per_revolution"],
        k54=table["k54"],
        k64=table["k64"],
        k65=table["k65"],
    )
    names = ("rotor_inertia", "coulomb", "viscous", "third")
    truth = PlantTruth(*(np.array(cell["simulation"][name]) for name in names))
    figures = {"period": 0.002, "open_intervals": 1, "cold_start": True, **settings}
    return SimulatedController(
        ns16.urdf_text(),
        drive,
        truth,
        ControllerSettings(**figures),
        seed=1,
        initial_position=HOME,
    )
