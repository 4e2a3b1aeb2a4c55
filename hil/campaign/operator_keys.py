"""Keys of the operator on the screen of a run: hold, resume, stop and override."""

from __future__ import annotations

import contextlib
import os
import re
import select
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, Literal, TextIO

from hil.control.motion_watch import OperatorRequest

OVERRIDE_STEP: Final = 0.1
"""Step of the override per key, and its least value."""
_MAX_TYPED_KEYS: Final = 3
"""Most keys at once from an operator; of more, which are pasted, only stop and hold count.

So of keys together with Esc, as a terminal sends those pressed with Alt.
"""
HELP: Final = "h hold   space resume   s stop   + - override   1…9: 10…90 %   0: 100 %"
ACTIONS: Final[dict[str, Literal["hold", "resume", "stop"]]] = {
    **dict.fromkeys("hH\x1b", "hold"),
    **dict.fromkeys(" rR", "resume"),
    **dict.fromkeys("sSqQ", "stop"),
}
_SEQUENCES: Final = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]?|\x1bO.?", re.DOTALL)
"""Sequences of arrow and function keys; the last one may be incomplete."""
_UNFINISHED: Final = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*|O)?\Z")
_ESCAPE_TIMEOUT: Final = 0.05
"""s to wait for the rest of a sequence; without it, it is the key Esc."""
_READ_BYTES: Final = 256
_LFLAG_INDEX = 3
_CC_INDEX = 6
_IFLAG_INDEX = 0
KEY_POLL_PERIOD: Final = 0.1
"""Period of polling keys and stop requests, s."""


def typed(chunk: str) -> str:
    """Return the keys in what a terminal sent, without sequences of arrow and function keys."""
    keys = _SEQUENCES.sub("", chunk)
    if len(keys) > _MAX_TYPED_KEYS or "\x1b" in keys:
        keys = "".join(key for key in keys if ACTIONS.get(key) in ("stop", "hold"))
    return keys


def after(request: OperatorRequest, key: str, override: float) -> OperatorRequest:
    """Return the request after a key; the `override` of the motion may be below the requested."""
    action = ACTIONS.get(key)
    if action in ("hold", "resume"):
        return replace(request, held=action == "hold")
    if key in "+=-_":
        tenths = round(
            (override + (OVERRIDE_STEP if key in "+=" else -OVERRIDE_STEP)) / OVERRIDE_STEP
        )
        return replace(request, override=min(1.0, max(OVERRIDE_STEP, tenths * OVERRIDE_STEP)))
    if key.isascii() and key.isdigit():
        return replace(request, override=(int(key) or 10) * OVERRIDE_STEP)
    return request


def can_read(stream: TextIO) -> bool:
    """Return whether single keys can be read: a terminal with this program in its foreground."""
    try:
        fd = stream.fileno()
        return os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
    except (OSError, ValueError):
        return False


@contextmanager
def single_keys(fd: int) -> Iterator[None]:
    r"""Read keys as they are pressed, without echo; restore the terminal at the end.

    Ctrl-C and Ctrl-\ stay signals. Ctrl-Z is disabled: a suspended program sends no heartbeat, and
    the arm would be stopped. So is Ctrl-S, which would freeze the screen.
    """
    before = termios.tcgetattr(fd)
    settings: list[Any] = [part[:] if isinstance(part, list) else part for part in before]
    settings[_LFLAG_INDEX] &= ~(termios.ICANON | termios.ECHO)
    settings[_IFLAG_INDEX] &= ~termios.IXON
    settings[_CC_INDEX][termios.VMIN] = 1
    settings[_CC_INDEX][termios.VTIME] = 0
    settings[_CC_INDEX][termios.VSUSP] = os.fpathconf(fd, "PC_VDISABLE").to_bytes(1, "little")
    termios.tcsetattr(fd, termios.TCSADRAIN, settings)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Keyboard:
    """Reads keys of the terminal in a thread; `failure` is why they are no longer read, or None."""

    def __init__(self, take: Callable[[str], None]) -> None:
        self._take = take
        self.over = threading.Event()
        self.attached = False
        self.failure: Exception | None = None

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read keys meanwhile, if standard input is a terminal."""
        if not can_read(sys.stdin):
            yield
            return
        fd = sys.stdin.fileno()
        thread = threading.Thread(target=self.read, args=(fd,), daemon=True)
        with single_keys(fd):
            self.attached = True
            thread.start()
            try:
                yield
            finally:
                self.over.set()
                thread.join()
                self.attached = False

    def read(self, fd: int) -> None:
        """Pass keys on until `over` is set, or the terminal is gone."""
        try:
            while not self.over.is_set():
                if select.select([fd], [], [], KEY_POLL_PERIOD)[0]:
                    for key in typed(_chunk(fd).decode(errors="replace")):
                        self._take(key)
        except Exception as error:  # the operator is informed that keys have no effect
            self.failure = error
            self.attached = False


def _chunk(fd: int) -> bytes:
    """Return what a terminal has sent; raise EOFError if it is gone."""
    chunk = os.read(fd, _READ_BYTES)
    if not chunk:
        raise EOFError("the terminal is gone")
    while _UNFINISHED.search(chunk) and select.select([fd], [], [], _ESCAPE_TIMEOUT)[0]:
        more = os.read(fd, _READ_BYTES)
        if not more:
            break
        chunk += more
    return chunk
