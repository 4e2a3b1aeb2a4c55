"""A simulated controller in its own process, with an account of its cycles in shared memory."""

from __future__ import annotations

import ctypes
import mmap
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.packets import packet_number
from hil.cell import Cell
from hil.control.simulated_cell import controller_settings, simulated_controller
from hil.control.simulator_on_link import Buttons, realtime_process, serve_session
from sim_fixtures import Phase, SimulatedController
from sim_fixtures.serve import Request, ServeCounts, UdpControllerLink
from tests.process_death.rounds import Round

Rows = NDArray[np.void]

ROW: Final = np.dtype(
    [
        ("number", "<i4"),
        ("phase", "u1"),
        ("replied", "?"),
        ("deserted", "?"),
        ("rejected", "<i4"),
        ("position", "<f8", (2,)),
        ("velocity", "<f8", (2,)),
    ]
)
"""One cycle: wire number of its packet, phase after it, whether a valid answer came, whether the
exchange process was found dead, answers rejected so far, and the plant's joints after it [rad,
rad/s]."""
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
    """Memory shared by the controller's process and the one that watches."""

    count = _word(0)  # cycles written down
    finished = _word(1)  # whether the controller's program is to end once the axes are closed
    abandoned = _word(2)  # whether the controller is to fall silent
    exchange = _word(3)  # process id of the exchange that it waits for, 0 as long as there is none

    def __init__(self) -> None:
        memory = mmap.mmap(-1, _HEADER + CAPACITY * ROW.itemsize)
        self.words = memoryview(memory)[:_HEADER].cast("q")
        self._all: Rows = np.frombuffer(memory, ROW, CAPACITY, _HEADER)

    def add(self, row: tuple[object, ...]) -> None:
        self._all[self.count % CAPACITY] = row
        self.count += 1

    def rows(self) -> Rows:
        """A copy of all cycles."""
        if self.count > CAPACITY:
            raise RuntimeError("the session was longer than any of these rounds should be")
        return self._all[: self.count].copy()


def listening(port: int) -> bool:
    """Whether a process of this computer has a UDP port."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(line.split()[1].endswith(f":{port:04X}") for line in lines)


class _Life:
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


class WaitingLink:
    """A link that waits for a reply as long as the exchange process lives."""

    def __init__(self, host: str, port: int, page: Page) -> None:
        self.number = 0
        self.deserted = self._began = False
        self._link = UdpControllerLink(host, port)
        self._port = port
        self._page = page
        self._exchange = _Life()

    def send(self, packet: bytes) -> None:
        """Send, once the port is open."""
        self.number = packet_number(packet)
        while not (self._began or self._page.abandoned):
            self._began = listening(self._port)
            time.sleep(0.005)
        self._link.send(packet)

    def receive(self, timeout: float) -> bytes | None:
        """The next packet of the PC, None if none came or none can come any more."""
        until = time.monotonic() + timeout
        while not self._page.abandoned:
            self.deserted = self._exchange.over(self._page.exchange)
            if self.deserted:
                return self._link.receive(0.0)
            left = until - time.monotonic()
            packet = self._link.receive(max(0.0, min(left, 0.02)))
            if packet is not None or left <= 0.0:
                return packet
        return None

    def close(self) -> None:
        self._link.close()


class _PageButtons(Buttons):
    """Ends program and session as the page requests."""

    def __init__(self, page: Page) -> None:
        super().__init__()
        self._page = page

    def request(self) -> Request:
        if self._page.abandoned:
            return Request.ABORT
        return Request.END if self._page.finished else Request.CONTINUE


def serve(cell: Cell, played: Round, page: Page) -> None:
    """Simulate the controller of a round until its session or the parent ends, or on request."""
    die_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end = WaitingLink(cell.controller.host or "", cell.controller.port or 0, page)
    settings = replace(
        controller_settings(cell),
        while_silent=played.while_silent,
        missed_replies=played.missed_replies,
        opening_stagger=played.stagger,
        silence_limit=500,
    )
    cycles = replies = 0

    def note(controller: SimulatedController, tally: ServeCounts) -> None:
        nonlocal cycles, replies
        if tally.cycles < 2:  # the first packet is repeated until it is answered
            cycles = replies = 0
        if tally.cycles == cycles:
            return
        replied = tally.replies > replies
        cycles = tally.cycles
        replies = tally.replies
        plant = controller.plant
        rejected = controller.rejected_replies + tally.rejected
        page.add((
            end.number, controller.phase, replied, end.deserted, rejected,
            plant.position, plant.velocity,
        ))  # fmt: skip

    with realtime_process(None):
        serve_session(
            lambda: simulated_controller(cell, settings=settings, seed=played.seed),
            end,
            _PageButtons(page),
            patience=WAIT,
            cycle_extension=WAIT,
            watch=note,
        )


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
