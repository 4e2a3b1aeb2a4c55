"""Ctrl-C while libraries are imported."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn


@contextmanager
def leave_if_interrupted() -> Iterator[None]:
    """Leave at once on Ctrl-C: an interrupted import fails in ways of its own, and holds nothing.

    Where somebody else heeds the signal, or a shell has it ignored, nothing is changed.
    """
    before: Any = signal.getsignal(signal.SIGINT)
    ours = (
        before is signal.default_int_handler
        and threading.current_thread() is threading.main_thread()
    )
    if ours:
        signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def _leave(signum: int, frame: FrameType | None) -> NoReturn:
    del signum, frame
    sys.stderr.write("stopped: interrupted\n")
    sys.stderr.flush()
    if "--json" in sys.argv:
        sys.stdout.write(
            '{"error": "interrupted", "kind": "OperatorStopError", "exit_code": 130}\n'
        )
        sys.stdout.flush()
    os._exit(130)
