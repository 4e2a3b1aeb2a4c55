"""Single keys of a terminal, and what they mean for the motion."""

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

from hil.campaign.operator import OperatorRequest

STEP: Final = 0.1
"""Of override, per key."""
LEAST: Final = 0.1
"""Override that keys go down to; to rest, there is the hold."""
LONGEST_TYPED: Final = 3
"""Keys that come at once from a person; more of them are pasted, and make nothing faster."""
HELP: Final = "h hold   space resume   s stop   + - override   1…9: 10…90 %   0: 100 %"
SHORT_HELP: Final = "h hold  r resume  s stop  + - 1…0 %"

Action = Literal["hold", "resume", "stop"]
_ACTIONS: Final[dict[str, Action]] = {
    "h": "hold", "H": "hold", "\x1b": "hold",
    " ": "resume", "r": "resume", "R": "resume",
    "s": "stop", "S": "stop", "q": "stop", "Q": "stop",
}  # fmt: skip
_SEQUENCES: Final = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]?|\x1bO.?", re.DOTALL)
"""What a terminal sends of arrows and the like; the last may be cut off."""
_AFTER_ESCAPE: Final = re.compile(r"\x1b([^\x1b])", re.DOTALL)
_UNFINISHED: Final = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*|O)?\Z")
_SEQUENCE_WAIT: Final = 0.05
"""s for the rest of such a sequence; after that the key Esc was meant."""
_LOOK: Final = 0.1
_CHUNK: Final = 256
_LOCAL, _CONTROL, _INPUT = 3, 6, 0


def typed(chunk: str) -> str:
    """Keys among what a terminal sent: arrows and the like come as several characters.

    Esc holds. With whatever comes together with it (so a terminal sends Alt, too) it never does
    less: a stop or a hold counts as itself, any other key as the hold.
    """
    keys = _AFTER_ESCAPE.sub(_urgent, _SEQUENCES.sub("", chunk))
    if len(keys) <= LONGEST_TYPED:
        return keys
    return "".join(filter(_is_urgent, keys))


def _is_urgent(key: str) -> bool:
    return _ACTIONS.get(key) in ("stop", "hold")


def _urgent(after_escape: re.Match[str]) -> str:
    return after_escape[1] if _is_urgent(after_escape[1]) else "\x1b"


def after(request: OperatorRequest, key: str, override: float) -> OperatorRequest:
    """The request after a key.

    Args:
        request: before it.
        key: one character.
        override: of the motion that is going on; it may be below what is requested.
    """
    action = _ACTIONS.get(key)
    if action in ("hold", "resume"):
        return replace(request, held=action == "hold")
    if key in "+=" or key in "-_":
        step = STEP if key in "+=" else -STEP
        tenths = round((override + step) / STEP)
        return replace(request, override=min(1.0, max(LEAST, tenths * STEP)))
    if key.isascii() and key.isdigit():
        return replace(request, override=(int(key) or 10) * STEP)
    return request


def stops(key: str) -> bool:
    """Whether a key asks for a stop."""
    return _ACTIONS.get(key) == "stop"


def can_read(stream: TextIO) -> bool:
    """Whether single keys can be read: a terminal, with this program in its foreground."""
    try:
        fd = stream.fileno()
        return os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
    except (OSError, ValueError):
        return False


@contextmanager
def single_keys(fd: int) -> Iterator[None]:
    r"""Give keys as they are pressed and unseen; the terminal is put back on every way out.

    Ctrl-C and Ctrl-\ stay signals. Ctrl-Z does nothing: a program that is suspended gives no sign
    of life, and the arm would be stopped. Nor does Ctrl-S, which would freeze the screen.
    """
    before = termios.tcgetattr(fd)
    settings: list[Any] = [part[:] if isinstance(part, list) else part for part in before]
    settings[_LOCAL] &= ~(termios.ICANON | termios.ECHO)
    settings[_INPUT] &= ~termios.IXON
    settings[_CONTROL][termios.VMIN], settings[_CONTROL][termios.VTIME] = 1, 0
    settings[_CONTROL][termios.VSUSP] = os.fpathconf(fd, "PC_VDISABLE").to_bytes(1, "little")
    termios.tcsetattr(fd, termios.TCSADRAIN, settings)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Keyboard:
    """Reads keys in a thread of its own; a context manager.

    Args:
        take: gets each key.
        stream: of the terminal; nothing is read where it is none.

    Attributes:
        attached: whether keys are read.
        failure: why they are not read any more, None for nothing.
    """

    def __init__(self, take: Callable[[str], None], stream: TextIO | None = None) -> None:
        self._stream = sys.stdin if stream is None else stream
        self._take = take
        self._undo = contextlib.ExitStack()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self.attached = False
        self.failure: Exception | None = None

    def __enter__(self) -> Keyboard:
        if can_read(self._stream):
            fd = self._stream.fileno()
            self._undo.enter_context(single_keys(fd))
            self.attached = True
            self._over.clear()
            self._thread = threading.Thread(target=self._read, args=(fd,), daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()
        self._thread, self.attached = None, False
        self._undo.close()

    def _read(self, fd: int) -> None:
        try:
            while not self._over.is_set():
                if select.select([fd], [], [], _LOOK)[0]:
                    for key in typed(_chunk(fd).decode(errors="replace")):
                        self._take(key)
        except Exception as error:  # whatever it is, the person is to know that keys do nothing
            self.failure, self.attached = error, False


def _chunk(fd: int) -> bytes:
    """What a terminal sent at once.

    Raises:
        EOFError: it is gone.
    """
    chunk = os.read(fd, _CHUNK)
    if not chunk:
        raise EOFError("the terminal is gone")
    while _UNFINISHED.search(chunk) and select.select([fd], [], [], _SEQUENCE_WAIT)[0]:
        more = os.read(fd, _CHUNK)
        if not more:
            break
        chunk += more
    return chunk
