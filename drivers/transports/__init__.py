"""Links that move bytes and time, nothing else."""

from __future__ import annotations

from drivers.transports.base import Transport
from drivers.transports.faults import Corrupt, Direction, Duplicate, Fault, Lose
from drivers.transports.simulated import Peer, SimulatedTransport

__all__ = [
    "Corrupt",
    "Direction",
    "Duplicate",
    "Fault",
    "Lose",
    "Peer",
    "SimulatedTransport",
    "Transport",
]
