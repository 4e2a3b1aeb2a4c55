"""Whether another process still gives signs of life."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

LONGEST_LOOK: Final = 0.5
"""s between two looks that count at most; in a longer time this process was held up itself."""


class Pulse:
    """How long a heartbeat has stood still while somebody was awake to see it.

    Its age would not do: a machine that was suspended wakes with every heartbeat old.

    Args:
        beat: the heartbeat, any number; 0 before the first.
        longest_look: s; `LONGEST_LOOK` for somebody who looks more often.
    """

    def __init__(self, beat: Callable[[], float], *, longest_look: float = LONGEST_LOOK) -> None:
        self._beat, self._longest = beat, longest_look
        self._last, self._seen = beat(), time.monotonic()
        self._quiet = 0.0

    def quiet(self) -> float:
        """Seconds since the last beat; 0 before the first. To be called often."""
        now, beat = time.monotonic(), self._beat()
        if beat != self._last or beat == 0.0:
            self._last, self._quiet = beat, 0.0
        else:
            self._quiet += min(now - self._seen, self._longest)
        self._seen = now
        return self._quiet
