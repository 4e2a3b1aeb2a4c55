"""A real link with scripted faults on it: packets that are lost, doubled, changed or held back."""

from __future__ import annotations

import time
from collections.abc import Sequence
from heapq import heappop, heappush
from math import inf
from typing import Final, Protocol

from drivers.transports.faults import FaultyLink
from sim_fixtures.far_end import FarEnd

Delayed = tuple[float, int, bytes]


class Clock(Protocol):
    """What time it is, and waiting; a test's clock need not be the real one."""

    def now(self) -> float:
        """Seconds since whenever, never falling."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let that much time pass."""
        ...


class MonotonicClock:
    """The machine's own clock."""

    def now(self) -> float:
        """Seconds."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


class Wire:
    """A far end whose packets go through `faults`.

    What is held back leaves or arrives when its time has come, as long as somebody waits here
    (`receive` or `sleep_until`), which the server of a controller always does.
    """

    def __init__(self, far_end: FarEnd, faults: FaultyLink | None, clock: Clock) -> None:
        self._far_end = far_end
        self._faults: Final = faults
        self._clock = clock
        self._leaving: list[Delayed] = []
        self._arriving: list[Delayed] = []
        self._order = 0

    def send(self, cycle: int, packet: bytes) -> None:
        """Send the packet of a cycle."""
        if self._faults is None:
            self._far_end.send(packet)
            return
        self._hold(self._leaving, self._faults.carry(cycle, "to_pc", packet))
        self._release()

    def receive(self, cycle: int, until: float) -> bytes | None:
        """What arrives by the time `until`, None if nothing does.

        Looks into the link at least once, even if `until` has passed: what lies there already
        arrived while this program was not running.
        """
        if self._faults is None:
            return self._far_end.receive(max(0.0, until - self._clock.now()))
        while True:
            now = self._release()
            if self._arriving and self._arriving[0][0] <= now:
                return heappop(self._arriving)[2]
            next_event = min(until, _due(self._leaving), _due(self._arriving))
            packet = self._far_end.receive(max(0.0, next_event - now))
            if packet is not None:
                self._hold(self._arriving, self._faults.carry(cycle, "to_controller", packet))
            elif now >= until:
                return None

    @property
    def waited(self) -> float:
        """S that the packet received last lay in the kernel's queue, as far as is known."""
        # What is held back by a fault arrives when its time has come.
        return 0.0 if self._faults is not None else float(getattr(self._far_end, "waited", 0.0))

    def sleep_until(self, moment: float) -> None:
        """Wait; what is due meanwhile leaves."""
        while True:
            now = self._release()
            if now >= moment:
                return
            self._clock.sleep(min(moment, _due(self._leaving)) - now)

    def _hold(self, queue: list[Delayed], deliveries: Sequence[tuple[float, bytes]]) -> None:
        now = self._clock.now()
        for delay, packet in deliveries:
            heappush(queue, (now + delay, self._order, packet))
            self._order += 1

    def _release(self) -> float:
        """Send what is due; the time."""
        now = self._clock.now()
        while self._leaving and self._leaving[0][0] <= now:
            self._far_end.send(heappop(self._leaving)[2])
        return now


def _due(queue: list[Delayed]) -> float:
    return queue[0][0] if queue else inf
