"""How long a person waits for what is left of a run, from what was seen of it so far."""

from __future__ import annotations

from hil.campaign.operator import RunStatus

_KNOWN_AFTER = 2.0
"""s of motion and of waiting after which the pace of virtual time is told."""

_BETWEEN = 0.6
"""s from motion to motion, as if seen once before: drives go off and on."""


class Pace:
    """Waiting time per second of motion, and between two motions.

    Between two motions the drives go off and on, an archive is closed and a repetition judged.

    Args:
        virtual: whether the controller's time is virtual; else a second of motion takes one.
    """

    def __init__(self, *, virtual: bool) -> None:
        self._virtual = virtual
        self._waited = self._moved = 0.0
        self._between = self._gaps = 0.0
        self._last: tuple[float, RunStatus] | None = None

    def take(self, status: RunStatus, now: float, *, held: bool) -> None:
        """Learn from a status that came `now` [s, any monotonic clock]; not while it is held."""
        if self._last is not None and not held:
            came, last = self._last
            waited, moved = now - came, last.time_left - status.time_left
            between = status.motion is None or last.motion is None
            self._gaps += 0.5 * ((status.motion is None) != (last.motion is None))  # begin, end
            if between or moved == 0.0:
                self._between += waited
            elif moved > 0.0:  # another override makes what is left longer
                self._waited += waited
                self._moved += moved
                self._between += 0.0 if self._virtual else waited - moved
        self._last = (now, status)

    def pause(self) -> None:
        """What passes until the next status is a person's time."""
        self._last = None

    def left(self, status: RunStatus) -> float | None:
        """Waiting time to the end of the run [s]; None where it cannot be told yet."""
        changes = status.motions_left + (status.motion is None)
        between = changes * (_BETWEEN + self._between) / (1.0 + self._gaps)
        if not self._virtual:
            return status.time_left + between
        if min(self._waited, self._moved) < _KNOWN_AFTER:
            return None
        return status.time_left * self._waited / self._moved + between
