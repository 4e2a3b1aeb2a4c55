"""Ctrl-C during imports."""

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
    """Exit on Ctrl-C during an import, which could otherwise fail with any exception."""
    before: Any = signal.getsignal(signal.SIGINT)
    is_default = (
        before is signal.default_int_handler
        and threading.current_thread() is threading.main_thread()
    )
    if is_default:
        signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        if is_default:
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
