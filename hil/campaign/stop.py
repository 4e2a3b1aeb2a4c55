"""The operator's wish to stop, as a flag that every loop looks at."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType


@dataclass
class Stop:
    """Set by Ctrl-C; the link then brings the arm to rest on its path.

    Attributes:
        requested: once.
        insisted: again, where that is asked for.
    """

    requested: bool = False
    insisted: bool = False


@contextmanager
def stop_on_interrupt(*, twice: bool = False) -> Iterator[Stop]:
    """Turn SIGINT into a request to stop on the path.

    A second one is the ordinary interrupt: it ends the program at once. In virtual time the
    controller is then on its own; on a real link the exchange process notices, and still brings
    the arm to rest. With `twice` the second is a request too, `insisted`, and the third ends.
    """
    stop = Stop()

    def request(signum: int, frame: FrameType | None) -> None:
        if stop.insisted or (stop.requested and not twice):
            signal.default_int_handler(signum, frame)
        stop.insisted = stop.requested
        stop.requested = True

    previous = signal.signal(signal.SIGINT, request)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)
