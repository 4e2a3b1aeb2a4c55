"""Frequent events are summed up before they are reported: a poor link must not drown the rest."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

from drivers.events import AnswersLost, Event, GapSeen, LinkLost, MotionEnded, PacketRejected

EVERY: Final = 0.1
"""s between two events of the same sort."""
_Mergeable = PacketRejected | GapSeen | AnswersLost


class Digest:
    """Lets one rejection of each kind, one gap and one loss of answers through each 0.1 s.

    Those that follow sooner are added up; their sum, with the cycle of the last, comes when the
    time is over. Everything else passes at once. Before the end of a motion or of the link comes
    what was held back till then.
    """

    def __init__(self) -> None:
        self._held: dict[str, _Mergeable] = {}
        self._quiet_until: dict[str, float] = {}

    def take(self, events: Iterable[Event], now: float) -> list[Event]:
        """What is to be reported at this moment, in order."""
        released: list[Event] = []
        for event in events:
            if isinstance(event, PacketRejected | GapSeen | AnswersLost):
                sort = _sort(event)
                held = self._held.get(sort)
                self._held[sort] = event if held is None else _sum(held, event)
                self._release(sort, now, released)
            else:
                if isinstance(event, MotionEnded | LinkLost):
                    released += self.rest()
                released.append(event)
        for sort in tuple(self._held):
            self._release(sort, now, released)
        return released

    def rest(self) -> list[Event]:
        """All that is held back."""
        held: list[Event] = list(self._held.values())
        self._held.clear()
        return held

    def _release(self, sort: str, now: float, released: list[Event]) -> None:
        if now >= self._quiet_until.get(sort, -math.inf):
            released.append(self._held.pop(sort))
            self._quiet_until[sort] = now + EVERY


def _sort(event: _Mergeable) -> str:
    return f"rejected: {event.kind}" if isinstance(event, PacketRejected) else type(event).__name__


def _sum(earlier: _Mergeable, later: _Mergeable) -> _Mergeable:
    """Of two of the same sort."""
    if isinstance(earlier, PacketRejected) and isinstance(later, PacketRejected):
        return PacketRejected(later.kind, earlier.count + later.count, later.why)
    if isinstance(earlier, GapSeen) and isinstance(later, GapSeen):
        return GapSeen(earlier.missed + later.missed, later.cycle)
    assert isinstance(earlier, AnswersLost) and isinstance(later, AnswersLost)
    return AnswersLost(earlier.count + later.count, later.cycle)
