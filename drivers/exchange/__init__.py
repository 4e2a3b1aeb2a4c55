"""The exchange: answering a controller's packets, in this process or in one of its own."""

from __future__ import annotations

from drivers.exchange.control import ArchiveState, ControlBlock, Ended
from drivers.exchange.event_log import (
    NO_ARCHIVE,
    NO_SUPERVISOR,
    EventReader,
    EventsLost,
    EventWriter,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    ExchangeStarted,
    HoldRefused,
    Leaving,
    OverrideRefused,
    ResumeRefused,
)
from drivers.exchange.loop import exchange
from drivers.exchange.process import (
    ExchangeError,
    ExchangeProcess,
    ExchangeSettings,
    WithdrawnError,
)
from drivers.exchange.realtime import RealTimeReport, RealTimeSettings
from drivers.record import (
    CycleRing,
    PacketReader,
    PacketRing,
    RingReader,
)

__all__ = [
    "NO_ARCHIVE",
    "NO_SUPERVISOR",
    "ArchiveState",
    "ControlBlock",
    "Ended",
    "EventReader",
    "EventWriter",
    "EventsLost",
    "ExchangeEnded",
    "ExchangeError",
    "ExchangeEvent",
    "ExchangeFailed",
    "ExchangeProcess",
    "ExchangeSettings",
    "ExchangeStarted",
    "HoldRefused",
    "Leaving",
    "OverrideRefused",
    "PacketReader",
    "RealTimeReport",
    "RealTimeSettings",
    "ResumeRefused",
    "RingReader",
    "CycleRing",
    "PacketRing",
    "WithdrawnError",
    "exchange",
]
