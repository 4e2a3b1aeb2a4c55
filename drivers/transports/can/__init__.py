"""The link over CAN: a profile of our own in frames that a DBC file describes; see docs/can.md."""

from __future__ import annotations

from drivers.transports.can.bus_load import (
    LOAD_LIMIT,
    BusRates,
    CanAxesError,
    CanBusLoadError,
    CanError,
    CanModeError,
    CanValueError,
)
from drivers.transports.can.transport import MOVABLE, CanSpec, CanTransport

__all__ = [
    "LOAD_LIMIT",
    "MOVABLE",
    "BusRates",
    "CanAxesError",
    "CanBusLoadError",
    "CanError",
    "CanModeError",
    "CanSpec",
    "CanTransport",
    "CanValueError",
]
