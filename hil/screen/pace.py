"""How long a person waits for a second of motion: as long, unless time is virtual."""

from __future__ import annotations

from hil.campaign.operator import RunStatus

_KNOWN_AFTER = 2.0
"""s of motion and of waiting after which the pace is told."""
_PAUSE = 30.0
"""s without news that are no part of the pace."""


class Pace:
    """Waiting time per time of motion, from what was seen of the run so far.

    Args:
        virtual: whether the controller's time is virtual; else both pass alike.
    """

    def __init__(self, *, virtual: bool) -> None:
        self._virtual = virtual
        self._waited = self._moved = 0.0
        self._last: tuple[float, float] | None = None

    def take(self, status: RunStatus, now: float, *, held: bool) -> None:
        """Learn from a status that came `now` [s, any monotonic clock]; not while it is held."""
        left = status.time_left
        if self._last is not None and not held:
            waited, moved = now - self._last[0], self._last[1] - left
            # A motion that is run again, or another override, makes what is left longer.
            if moved >= 0.0 and waited < _PAUSE:
                self._waited += waited
                self._moved += moved
        self._last = (now, left)

    def pause(self) -> None:
        """What passes until the next status is a person's time."""
        self._last = None

    def left(self, time_left: float) -> float | None:
        """Waiting time for so much time of motion [s]; None where it cannot be told yet."""
        if not self._virtual:
            return time_left
        if min(self._waited, self._moved) < _KNOWN_AFTER:
            return None
        return time_left * self._waited / self._moved
