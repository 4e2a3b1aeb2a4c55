"""What a session knows of a controller's protocol: cycles in, replies out, whatever the bytes.

A `Wire` makes a `MeasuredCycle` of the packet of each cycle, and bytes of the reply that the
session decides on. `drivers.c4g_wire` is for C4G Open, `drivers.ur.wire` for Universal
Robots.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.drive_train import DriveTrain, MotorSide
from drivers.events import ControllerDescription, InitReceived
from drivers.guard import Joints
from drivers.packet_losses import LossTracker
from drivers.states import AxesReport, Input, State


@dataclass(frozen=True, eq=False)
class Repeated:
    """The packet before, once more: it gets the same reply again."""


@dataclass(frozen=True)
class Stale:
    """A packet that does not follow the last one; it gets no reply."""

    reason: str


@dataclass(frozen=True)
class Remark:
    """A packet without a cycle: what the controller says in words. It gets no reply."""

    text: str


@dataclass(frozen=True, eq=False)
class Handshake:
    """A packet before the cyclic exchange.

    Attributes:
        cause: `Input.SYNC` or `Input.INIT`.
        reply: to it.
        received: how the controller that introduced itself compares with the cell; None with SYNC.
        restarted: a requested motion is lost, because the controller restarted unnoticed.
    """

    cause: Input
    reply: bytes
    received: InitReceived | None = None
    restarted: bool = False


class MeasuredCycle(NamedTuple):
    """A new packet of the cyclic exchange.

    Attributes:
        number: of the packet.
        cycle: of the controller since it introduced itself, missed ones included.
        missed: packets before this one that never came.
        axes: what it says of the axes.
    """

    number: int
    cycle: int
    missed: int
    axes: AxesReport


Received: TypeAlias = Repeated | Stale | Remark | Handshake | MeasuredCycle


class Wire(Protocol):
    """One session's end of the protocol of its controller."""

    @property
    def description(self) -> ControllerDescription | None:
        """What the controller stated of itself; None before."""

    @property
    def motors(self) -> MotorSide | None:
        """The arm on the motor side, with the values read last; None if it cannot be moved."""

    @property
    def opened(self) -> Joints:
        """Joints that are to be open (n,)."""

    @property
    def reports_use(self) -> bool:
        """Whether the controller states itself which replies it did not use."""

    def receive(self, packet: bytes, state: State, losses: LossTracker) -> Received:
        """Interpret a packet that arrived in this state.

        Raises:
            PacketError: it is none of this protocol.
        """

    def forget(self) -> None:
        """Forget the controller: it starts over."""

    def lost(self) -> None:
        """A silence ended the sequence of packets: the next, whichever it is, is new."""

    def limits(self) -> tuple[Array, Array]:
        """Return the controller's own limits (n,) of following error and current; NaN for none."""

    def record(self, measured: Array) -> None:
        """Write the values of the packet into (8, n), joint side in SI; also into `motors`."""

    def record_state(self, state: NDArray[np.void]) -> None:
        """Write what the packet says beyond that into (1,) of `ControllerProtocol.state`."""

    def fill_safe(self, requested: bool, cycle: int) -> None:
        """Begin a reply that moves nothing; `requested` is whether a motion waits or runs.

        Raises:
            RefusalError: the controller's state does not permit that motion.
        """

    def fill_refusal(self, offending: int | None) -> None:
        """Make the reply ask for an end of all motion, because of a joint or of another reason."""

    def require_targets(self, cycle: int) -> None:
        """Require that open axes can be held by their targets; raises RefusalError."""

    def require_other_targets(self, cycle: int) -> None:
        """Require targets of open axes that are not joints of the arm; raises RefusalError."""

    def not_used(self) -> int:
        """Return how many replies since the last packet the controller states not to have used."""

    def write(self, position: Array, step: Array) -> None:
        """Put set-points (n,) into the reply, motor revolutions and their change in this cycle."""

    def write_rest(self, position: Array, where: Joints) -> None:
        """Put set-points (n,) at rest into the reply for the joints `where`."""

    def request_exit(self) -> None:
        """Ask for the end of open mode in this reply."""

    def finish(self) -> bytes:
        """Return the reply."""

    def sort(self, packet: bytes) -> PacketSort:
        """Return what makes packets of a backlog alike, without interpreting them."""

    def ahead(self, later: int, earlier: int) -> int:
        """Return how many packets one number is ahead of another."""


class PacketSort(NamedTuple):
    """Sort of a packet: of one sort only the newest gets a reply.

    Attributes:
        starts: it begins a session.
        kind: equal for packets of one sort.
        number: of the packet.
    """

    starts: bool
    kind: bytes
    number: int


class OwnPackets(Protocol):
    """Packets of a controller that rests, made on this computer."""

    def first(self) -> bytes:
        """Return the packet that introduces the controller."""

    def next(self, *, opened: bool) -> bytes:
        """Return the packet of the next cycle, with axes open or closed."""


@dataclass(frozen=True, eq=False)
class ArmSettings:
    """What a wire needs to know of the arm.

    Attributes:
        drive_train: of the arm.
        period: the controller's cycle, s.
        mode, arm, other_axes, only_axis: see `drivers.Session`.
        silence_timeout: silence that ends a session, s.
    """

    drive_train: DriveTrain
    period: float
    mode: int
    arm: int
    other_axes: Collection[tuple[int, int]]
    only_axis: int | None
    silence_timeout: float


class ControllerProtocol(Protocol):
    """Protocol of a kind of controller."""

    @property
    def state(self) -> np.dtype[np.void] | None:
        """Layout of what its packets contain beyond other controllers' packets; None if nothing."""

    def wire(self, settings: ArmSettings) -> Wire:
        """Return the wire of one session; ValueError for settings that it cannot have."""

    def own_packets(
        self, drive_train: DriveTrain, position: Array, period: float, limits: tuple[Array, Array]
    ) -> OwnPackets:
        """Return packets of an arm at rest.

        Args:
            drive_train: of the cell.
            position: of the arm (n,) [rad].
            period: of a cycle [s].
            limits: largest following error and current of each joint (n,).
        """


def state_of(session: Mapping[str, Any]) -> np.dtype[np.void] | None:
    """Return the `state` of the protocol in keyword arguments of a `Session`."""
    protocol: ControllerProtocol | None = session.get("protocol")
    return None if protocol is None else protocol.state
