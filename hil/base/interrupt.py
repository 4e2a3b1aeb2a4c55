"""Immediate exit of a program on a signal."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_KIND: Final = "OperatorStopError"


@contextmanager
def leave_if_interrupted() -> Iterator[None]:
    """Exit on Ctrl-C during an import, which could otherwise fail with any exception."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with leave_on((signal.SIGINT,), "interrupted", say="stopped: interrupted"):
            yield
    else:
        yield


@contextmanager
def leave_on(signals: Sequence[signal.Signals], text: str, *, say: str = "") -> Iterator[None]:
    """Exit immediately on a signal, even if the shell made a background program ignore it.

    Its children and theirs are killed, so that files must be whole at any time. In another thread
    than the main one, which cannot handle signals, it does nothing.

    Args:
        signals: that end the program, with the status 128 + number of a shell.
        text: the reason, for `--json`.
        say: the line on stderr, by default `text`.
    """

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        del frame
        leave_now(128 + number, text, say or text)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[signal.Signals, Callable[..., Any] | int | None] = {
        one: signal.signal(one, leave) for one in signals
    }
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, signal.SIG_DFL if handler is None else handler)


def leave_now(status: int, text: str, say: str) -> NoReturn:
    """Kill the children and exit: one line on stderr, with `--json` an object on stdout."""
    # A child that still imports does not watch its parent yet.
    for child in descendants(os.getpid()):
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    sys.stderr.write(f"{say}\n")
    sys.stderr.flush()
    if "--json" in sys.argv:
        import json  # not at every start of the program

        sys.stdout.write(json.dumps({"error": text, "kind": _KIND, "exit_code": status}) + "\n")
        sys.stdout.flush()
    os._exit(status)


def descendants(pid: int) -> list[int]:
    """Return the children of a process and theirs."""
    found = []
    with suppress(OSError):  # it has ended
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += [int(child), *descendants(int(child))]
    return found
