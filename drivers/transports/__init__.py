"""Links that move bytes and time, nothing else."""

from __future__ import annotations

from drivers.transports.base import Transport, TransportError, TransportSpec
from drivers.transports.faults import (
    Corrupt,
    Delay,
    Direction,
    Duplicate,
    Fault,
    FaultyLink,
    Lose,
    Reorder,
)
from drivers.transports.simulated import Peer, SimulatedTransport
from drivers.transports.udp import UdpSpec, UdpTransport

__all__ = [
    "Corrupt",
    "Delay",
    "Direction",
    "Duplicate",
    "Fault",
    "FaultyLink",
    "Lose",
    "Peer",
    "Reorder",
    "SimulatedTransport",
    "Transport",
    "TransportError",
    "TransportSpec",
    "UdpSpec",
    "UdpTransport",
]
