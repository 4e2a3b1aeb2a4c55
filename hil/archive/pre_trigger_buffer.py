"""What came while no archive was open, for one that is to begin with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.events import InitReceived
from drivers.exchange import ExchangeEvent
from drivers.packet_records import PACKET_DTYPE

Records = NDArray[np.void]

RECENT: Final = 5000
"""Cycles kept."""
_PACKETS_PER_CYCLE = 2


class Session(NamedTuple):
    """What belongs to one session with the controller; its init packet is not news any more."""

    records: Records
    events: list[ExchangeEvent]
    packets: Records


@dataclass
class Recent:
    """The newest records, events and raw packets; the oldest go as others come."""

    _records: list[Records] = field(default_factory=list)
    _packets: list[Records] = field(default_factory=list)
    _events: list[ExchangeEvent] = field(default_factory=list)

    def keep(
        self, records: Records, events: Sequence[ExchangeEvent], packets: Records | None = None
    ) -> None:
        """Take in what has come; `packets` None where they are not kept."""
        _keep_newest(self._records, records, RECENT)
        self._events = [*self._events, *events][-RECENT:]
        if packets is not None:
            _keep_newest(self._packets, packets, _PACKETS_PER_CYCLE * RECENT)

    def taken(self) -> Session:
        """What belongs to the session that began last; nothing is kept of it here."""
        records, events, packets = self._records, self._events, self._packets
        self._records, self._events, self._packets = [], [], []
        inits = [index for index, event in enumerate(events) if isinstance(event, InitReceived)]
        return Session(
            _after_restart(records, np.dtype(np.void(0).dtype), least=1),
            events[inits[-1] + 1 :] if inits else events,
            # Several packets may belong to one cycle.
            _after_restart(packets, PACKET_DTYPE, least=0),
        )


def _keep_newest(parts: list[Records], rows: Records, count: int) -> None:
    """Append rows; parts go that hold none of the newest `count`."""
    if len(rows):
        parts.append(rows)
    while sum(map(len, parts[1:])) >= count:
        parts.pop(0)


def _after_restart(parts: list[Records], dtype: np.dtype[np.void], *, least: int) -> Records:
    """The rows since the cycles last began anew: since they grew by less than `least`."""
    if not parts:
        return np.zeros(0, dtype)
    rows = np.concatenate(parts)
    restarts = np.flatnonzero(np.diff(rows["cycle"]) < least)
    return rows[int(restarts[-1]) + 1 :] if restarts.size else rows
