"""Account of a simulated controller's cycles, in memory that the watching process shares."""

from __future__ import annotations

import ctypes
import mmap
import os
import select
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_fixtures import Phase

Rows = NDArray[np.void]


def row_dtype(joints: int) -> np.dtype[np.void]:
    """Return the layout of one cycle in the account of an arm.

    Wire number of its packet, phase after it, whether a valid answer came, whether the exchange
    process was found dead, answers rejected so far, and the plant's joints after it [rad, rad/s].
    """
    return np.dtype(
        [
            ("number", "<i4"),
            ("phase", "u1"),
            ("replied", "?"),
            ("deserted", "?"),
            ("rejected", "<i4"),
            ("position", "<f8", (joints,)),
            ("velocity", "<f8", (joints,)),
        ]
    )


CAPACITY: Final = 40_000
_HEADER: Final = 128
WAIT: Final = 60.0  # s that a living PC is waited for
REST: Final = 10  # Cycles without motion after which an arm is at rest
STILL: Final = 0.01  # rad/s below which no joint moves
_PDEATHSIG: Final = 1


def _word(place: int) -> Any:
    """A number in a page's header."""

    def set_to(page: Page, value: int) -> None:
        page.words[place] = value

    return property(lambda page: int(page.words[place]), set_to)


class Page:
    """Memory shared by the controller's process, with so many joints, and the one that watches."""

    count = _word(0)  # cycles written down
    finished = _word(1)  # whether the controller's program is to end once the axes are closed
    abandoned = _word(2)  # whether the controller is to fall silent
    serving = _word(4)  # whether the controller serves
    exchange = _word(3)  # process id of the exchange that it waits for, 0 as long as there is none

    def __init__(self, joints: int) -> None:
        row = row_dtype(joints)
        memory = mmap.mmap(-1, _HEADER + CAPACITY * row.itemsize)
        self.words = memoryview(memory)[:_HEADER].cast("q")
        self._all: Rows = np.frombuffer(memory, row, CAPACITY, _HEADER)

    def add(self, row: tuple[object, ...]) -> None:
        self._all[self.count % CAPACITY] = row
        self.count += 1

    def rows(self) -> Rows:
        """A copy of all cycles."""
        if self.count > CAPACITY:
            raise RuntimeError("the session was longer than any of these rounds should be")
        return self._all[: self.count].copy()


class Life:
    """Whether a process has ended; an unknown one counts as alive."""

    def __init__(self) -> None:
        self._descriptor = -1
        self._dead = False

    def over(self, pid: int) -> bool:
        if self._dead or not pid:
            return self._dead
        try:
            if self._descriptor < 0:
                self._descriptor = os.pidfd_open(pid)
            self._dead = bool(select.select([self._descriptor], [], [], 0.0)[0])
        except ProcessLookupError:
            self._dead = True
        return self._dead


def die_with_parent(how: int = signal.SIGTERM) -> None:
    """Have this process sent a signal when its parent dies."""
    ctypes.CDLL(None).prctl(_PDEATHSIG, int(how))


def forked(serve: Callable[[], int | None]) -> int:
    """Process id of a child that runs `serve` and exits with the status that it returns."""
    pid = os.fork()
    if pid:
        return pid
    status = 70
    try:
        status = serve() or 0
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(Exception):
            sys.stderr.flush()
        os._exit(status)


def at_rest(rows: Rows) -> bool:
    """Whether the arm has stood, with axes closed, for the last cycles."""
    last = rows[-REST:]
    closed = ~np.isin(last["phase"], (Phase.OPENING, Phase.OPEN, Phase.CLOSING, Phase.TRIPPED))
    return bool(len(last) == REST and closed.all() and np.abs(last["velocity"]).max() < STILL)
