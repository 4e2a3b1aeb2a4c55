"""The PC's end of the link to the robot's controller: packets, session, transports, drive train.

A sans-I/O core (`Session`, guarded by a `Guard`) that any `Transport` feeds through `exchange`;
knows nothing of plans, robot dynamics or files. Every refusal is a class of `drivers.errors`.
"""

from __future__ import annotations

from drivers.c4g_packets import MODE_FIELDS, CyclicPacket, InitPacket, Mode
from drivers.cycle_records import CycleRing, cycle_dtype
from drivers.drive_train import DriveTrain
from drivers.errors import (
    DriverError,
    DriveTrainError,
    GuardError,
    PacketError,
    RefusalError,
    RequestError,
    SourceFailed,
    TransportClosed,
)
from drivers.events import (
    Counters,
    Event,
    GapSeen,
    HoldChanged,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    OverrideChanged,
    PacketRejected,
    Refused,
    RepliesLost,
    StateChanged,
)
from drivers.exchange.loop import exchange
from drivers.guard import Guard, GuardLimits
from drivers.motion_source import BoundsName, MotionSource
from drivers.session import Session
from drivers.states import Outcome, State
from drivers.transports.base import Transport, TransportError, TransportSpec
from drivers.transports.simulated import (
    Corrupt,
    Delay,
    Duplicate,
    Fault,
    FaultyLink,
    Lose,
    Peer,
    Reorder,
    SimulatedTransport,
)
from drivers.transports.udp import UdpSpec, UdpTransport

__all__ = [
    "RepliesLost",
    "BoundsName",
    "Corrupt",
    "Counters",
    "CycleRing",
    "CyclicPacket",
    "Delay",
    "DriveTrain",
    "DriveTrainError",
    "DriverError",
    "Duplicate",
    "Event",
    "Fault",
    "FaultyLink",
    "GapSeen",
    "HoldChanged",
    "Guard",
    "GuardError",
    "GuardLimits",
    "InitPacket",
    "InitReceived",
    "LinkLost",
    "Lose",
    "MODE_FIELDS",
    "Mode",
    "MotionEnded",
    "MotionSource",
    "MotionStarted",
    "OverrideChanged",
    "Outcome",
    "PacketError",
    "PacketRejected",
    "Peer",
    "RefusalError",
    "Refused",
    "Reorder",
    "RequestError",
    "Session",
    "SimulatedTransport",
    "SourceFailed",
    "State",
    "StateChanged",
    "Transport",
    "TransportClosed",
    "TransportError",
    "TransportSpec",
    "UdpSpec",
    "UdpTransport",
    "cycle_dtype",
    "exchange",
]
