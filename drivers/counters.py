"""Packets that got no answer: counted, and reported once per drain instead of once per packet."""

from __future__ import annotations

from drivers.errors import PacketError
from drivers.events import Counters, PacketRejected


class Tally:
    """Counts fates of packets.

    Attributes:
        counters: since the session was made.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._untold: dict[str, int] = {}
        self._why: dict[str, str] = {}

    def malformed(self, packet: bytes, error: PacketError) -> None:
        """One was not the packet it should be."""
        self.counters.malformed += 1
        self._tell("malformed", 1)
        self._why["malformed"] = f"{len(packet)} bytes: {error}"

    def stale(self, number: int, last: int) -> None:
        """One cannot be a later packet of this session."""
        self.counters.stale += 1
        self._tell("stale", 1)
        self._why["stale"] = f"number {number} does not follow {last}"

    def ended(self) -> None:
        """One came after the end of the session."""
        self.counters.ended += 1
        self._tell("ended", 1)

    def discarded(self, kind: str, count: int) -> None:
        """The link dropped `count` packets of this kind before the session saw them."""
        if count <= 0:
            return
        self.counters.discarded[kind] = self.counters.discarded.get(kind, 0) + count
        self._tell(kind, count)

    def drain(self) -> list[PacketRejected]:
        """One event per kind since the last call."""
        why = self._why
        events = [PacketRejected(kind, n, why.get(kind, "")) for kind, n in self._untold.items()]
        self._untold.clear()
        return events

    def _tell(self, kind: str, count: int) -> None:
        self._untold[kind] = self._untold.get(kind, 0) + count
