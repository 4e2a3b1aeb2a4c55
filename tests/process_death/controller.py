"""A simulated C4G controller in its own process, with an account of its cycles."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path

from drivers.c4g_packets import packet_number
from hil.cell import Cell
from hil.control.simulated_cell import controller_settings, simulated_controller
from hil.control.simulator_on_link import Buttons, realtime_process, serve_session
from sim_fixtures import SimulatedController
from sim_fixtures.serve import Request, ServeCounts, UdpControllerLink
from tests.process_death.page import WAIT, Life, Page, die_with_parent
from tests.process_death.rounds import Round


def listening(port: int) -> bool:
    """Whether a process of this computer has a UDP port."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(line.split()[1].endswith(f":{port:04X}") for line in lines)


class WaitingLink:
    """A link that waits for a reply as long as the exchange process lives."""

    def __init__(self, host: str, port: int, page: Page) -> None:
        self.number = 0
        self.deserted = self._began = False
        self._link = UdpControllerLink(host, port)
        self._port = port
        self._page = page
        self._exchange = Life()

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

    page.serving = 1
    with realtime_process(None):
        serve_session(
            lambda: simulated_controller(cell, settings=settings, seed=played.seed),
            end,
            _PageButtons(page),
            patience=WAIT,
            cycle_extension=WAIT,
            watch=note,
        )
