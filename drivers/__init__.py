"""The PC's end of the link to the robot's controller: packets, session, transports, drive train.

A sans-I/O core (`Session`, guarded by a `Guard`) that any `Transport` feeds through `exchange`;
knows nothing of plans, robot dynamics or files.
"""

from __future__ import annotations

from drivers.drive_train import DriveTrain
from drivers.errors import (
    AccelerationLimit,
    AxisLeft,
    CurrentLimit,
    DriverError,
    DriveTrainError,
    FirstSetPoint,
    FollowingError,
    GuardError,
    JerkLimit,
    MotionHeld,
    MotionNotCarriedOn,
    NotAtStandstill,
    NotFinite,
    PacketError,
    PositionLimit,
    RefusalError,
    RequestError,
    SourceFailed,
    TransportClosed,
    VelocityLimit,
    VelocityMismatch,
)
from drivers.events import (
    Counters,
    Event,
    GapSeen,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    Outcome,
    PacketRejected,
    Refused,
    StateChanged,
)
from drivers.exchange import exchange
from drivers.guard import Guard, GuardLimits
from drivers.motion_source import BoundsName, MotionSource
from drivers.packets import CyclicPacket, InitPacket, Mode
from drivers.record import CycleRing, cycle_dtype
from drivers.session import Session
from drivers.states import State
from drivers.transports import (
    Corrupt,
    Duplicate,
    Fault,
    Lose,
    Peer,
    SimulatedTransport,
    Transport,
)

__all__ = [
    "AccelerationLimit",
    "AxisLeft",
    "BoundsName",
    "Corrupt",
    "Counters",
    "CurrentLimit",
    "CycleRing",
    "CyclicPacket",
    "DriveTrain",
    "DriveTrainError",
    "DriverError",
    "Duplicate",
    "Event",
    "Fault",
    "FirstSetPoint",
    "FollowingError",
    "GapSeen",
    "Guard",
    "GuardError",
    "GuardLimits",
    "InitPacket",
    "InitReceived",
    "JerkLimit",
    "LinkLost",
    "Lose",
    "Mode",
    "MotionEnded",
    "MotionHeld",
    "MotionNotCarriedOn",
    "MotionSource",
    "MotionStarted",
    "NotAtStandstill",
    "NotFinite",
    "Outcome",
    "PacketError",
    "PacketRejected",
    "Peer",
    "PositionLimit",
    "RefusalError",
    "Refused",
    "RequestError",
    "Session",
    "SimulatedTransport",
    "SourceFailed",
    "State",
    "StateChanged",
    "Transport",
    "TransportClosed",
    "VelocityLimit",
    "VelocityMismatch",
    "cycle_dtype",
    "exchange",
]
