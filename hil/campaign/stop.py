"""The operator's request to stop, as a flag that every loop looks at."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Final

REQUESTS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, whoever ends programs, and the end of the terminal."""


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
    """Turn SIGINT, SIGTERM and SIGHUP into a request to stop on the path.

    A second one is the ordinary interrupt: it ends the program at once. In virtual time the
    controller is then on its own; on a real link the exchange process notices, and still brings
    the arm to rest. With `twice` the second is a request too, `insisted`, and the third ends.
    A signal that is ignored (SIGHUP under nohup) stays ignored.
    """
    stop = Stop()

    def request(signum: int, frame: FrameType | None) -> None:
        if stop.insisted or (stop.requested and not twice):
            signal.default_int_handler(signum, frame)
        stop.insisted = stop.requested
        stop.requested = True

    with ExitStack() as undo:
        for signum in REQUESTS:
            previous = signal.getsignal(signum)
            if signum is signal.SIGHUP and previous is signal.SIG_IGN:
                continue
            signal.signal(signum, request)
            undo.callback(signal.signal, signum, previous)
        yield stop
