"""When the kernel received what a socket delivers, on the monotonic clock."""

from __future__ import annotations

import socket
import struct
import time
from typing import Final

SO_TIMESTAMPNS: Final = 35
"""Socket option by which each message has its time of arrival; the socket module lacks it."""
_TIMESPEC: Final = struct.Struct("@qq")
CONTROL_BYTES: Final = socket.CMSG_SPACE(_TIMESPEC.size)
"""Space that `recvmsg` needs for it."""
_MAX_CLOCK_STEP: Final = 1e-3
"""Change of the difference between wall and monotonic clock that means that one was set, s."""


class ArrivalClock:
    """Converts times of arrival of one socket from the wall clock to the monotonic clock."""

    def __init__(self) -> None:
        self._earliest = time.monotonic()  # nothing later arrived before
        self._offset = time.time() - self._earliest

    def arrival(self, control: list[tuple[int, int, bytes]]) -> float | None:
        """Return when the message received last arrived, s; None if the system did not say.

        It is not before the previous one. If the system's clock was set in between, it is the time
        at which the message was read.

        Args:
            control: ancillary data of `recvmsg`.
        """
        if not control:
            return None
        seconds, nanoseconds = _TIMESPEC.unpack(control[0][2])
        wall = time.time()
        now = time.monotonic()
        offset = self._offset
        self._offset = wall - now
        if abs(self._offset - offset) > _MAX_CLOCK_STEP:
            arrived = now
        else:
            # The queue is in order: an older stamp means that the clock was set since.
            queued = wall - seconds - 1e-9 * nanoseconds
            arrived = min(now, max(now - queued, self._earliest))
        self._earliest = arrived
        return arrived
