"""Signs of life to the exchange process, given only while the supervision itself is alive.

A thread that beats whatever happens would hide a supervisor that hangs: nobody would pass on a stop
any more, and the arm would go on. So the beats end where a motion is supervised and the loop that
supervises it does not turn; the exchange then brings the arm to rest as for any dead supervisor.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Final

from drivers.exchange import NO_SUPERVISOR

BEAT: Final = 0.05
"""s between two heartbeats; the exchange stops the arm after 0.5 s without one."""
STALL: Final = 1.0
"""s within which the loop that supervises a motion must have turned."""
_STARVED: Final = 0.4
"""s between two beats that are told: the exchange may have missed them."""


class Heartbeat:
    """Beats for a link.

    Args:
        beat: gives one sign of life.
        clock: s, monotonic.
    """

    def __init__(
        self, beat: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._beat, self._clock = beat, clock
        self._turned: float | None = None
        self._stalled = self._starved = 0.0
        self._last = clock()
        self._over = False

    def start(self) -> None:
        """Beat in a thread until `end`."""
        threading.Thread(target=self._go_on, daemon=True).start()

    def end(self) -> None:
        """Beat no more."""
        self._over = True

    def begin(self) -> None:
        """A motion is asked for: what went before is no cause of what happens to it."""
        self._stalled = self._starved = 0.0
        self.turn()

    def turn(self) -> None:
        """The loop that supervises a motion turns; it must again within `STALL` s, until `rest`."""
        self._turned = self._clock()

    def rest(self) -> None:
        """No motion is supervised any more: other work may take as long as it likes."""
        self._turned = None

    def look(self) -> None:
        """Beat, unless the supervision stands still."""
        now, turned = self._clock(), self._turned
        self._starved, self._last = max(self._starved, now - self._last), now
        stalled = 0.0 if turned is None else now - turned
        if stalled > STALL:
            self._stalled = max(self._stalled, stalled)
        else:
            self._beat()

    def explained(self, text: str) -> str:
        """What the exchange says, with the cause where it missed our signs of life."""
        if NO_SUPERVISOR not in text:
            return text
        if self._stalled:
            cause = (
                f"whatever looks at the motion (show, wish) did not return for "
                f"{self._stalled:.1f} s, and nobody could have passed on a stop"
            )
        elif (starved := max(self._starved, self._clock() - self._last)) > _STARVED:
            cause = (
                f"this program got no processor time for {starved:.1f} s, load average "
                f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors: end what else runs here"
            )
        else:
            return text
        return text.replace(NO_SUPERVISOR, f"{NO_SUPERVISOR} ({cause})")

    def _go_on(self) -> None:
        while not self._over:
            self.look()
            time.sleep(BEAT)
