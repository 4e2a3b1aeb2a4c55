"""What the exchange process says of itself, in the same log as the session's events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from drivers.events import Event
from drivers.exchange.realtime import RealTimeReport

NO_SUPERVISOR: Final = "the supervisor gives no sign of life"
"""Why the exchange leaves that missed the heartbeats of the process that started it."""
NO_ARCHIVE: Final = "the archive process gives no sign of life"
"""Why a motion is stopped during which that process did not get on."""


@dataclass(frozen=True)
class ExchangeStarted:
    """The link is open.

    Attributes:
        pid: of the process.
        realtime: what the system granted.
        notes: options of the link that the system refused, in words.
    """

    pid: int
    realtime: RealTimeReport
    notes: tuple[str, ...]


@dataclass(frozen=True)
class OverrideRefused:
    """The motion going on cannot change its speed, for the reason given."""

    fraction: float
    reason: str


@dataclass(frozen=True)
class HoldRefused:
    """Nothing is held, for the reason given; a motion requested later begins as usual."""

    reason: str


@dataclass(frozen=True)
class ResumeRefused:
    """The motion cannot be resumed, for the reason given."""

    reason: str


@dataclass(frozen=True)
class EventsLost:
    """So many events were overwritten before this reader had them; the reader itself says so."""

    count: int


@dataclass(frozen=True)
class Leaving:
    """No motion is accepted any more; what goes on is brought to rest and open mode left."""

    reason: str


@dataclass(frozen=True)
class ExchangeEnded:
    """The last thing a process says that ends properly."""

    reason: str


@dataclass(frozen=True)
class ExchangeFailed:
    """The last thing a process says that ends because of an error in itself.

    The controller's own watch has to act.
    """

    trace: str


ExchangeEvent = (
    Event
    | ExchangeStarted
    | OverrideRefused
    | HoldRefused
    | ResumeRefused
    | EventsLost
    | Leaving
    | ExchangeEnded
    | ExchangeFailed
)
"""Everything in an event log."""
