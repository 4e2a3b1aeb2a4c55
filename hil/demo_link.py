"""A simulated controller in a process of its own, and a real link to it on this computer."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket
from typing import IO, Any

from drivers.transports.base import TransportSpec
from drivers.transports.udp import UdpSpec
from hil.archive.live import LiveView
from hil.campaign.live_link import LiveLink
from hil.cell import Cell
from hil.cell.schema import CanTable
from hil.errors import ControllerFault

LOOPBACK = "127.0.0.1"
CAN = CanTable(interface="udp_multicast", channel="239.74.163.31")
"""A CAN bus within this computer: python-can's, without an adapter."""
SIMULATE = (sys.executable, "-m", "hil", "simulate")
END_TIMEOUT = 20.0
"""s a simulated controller may take to end its session."""


@dataclass(eq=False)
class SimulatorProcess:
    """`hil simulate`, running.

    Attributes:
        process: the child; `terminate` lets it end its session properly.
    """

    process: subprocess.Popen[bytes]
    _words: IO[bytes] = field(repr=False)
    _figures: IO[bytes] = field(repr=False)

    @classmethod
    def start(cls, cell: Path, *options: str) -> SimulatorProcess:
        """Start a controller for a cell file."""
        words, figures = (tempfile.TemporaryFile() for _ in range(2))  # noqa: SIM115 - for its life
        process = subprocess.Popen(
            [*SIMULATE, str(cell), "--json", *options],
            stdin=subprocess.DEVNULL,
            stdout=figures,
            stderr=words,
            start_new_session=True,
        )
        return cls(process, words, figures)

    @property
    def running(self) -> bool:
        """Whether its session goes on, or has yet to begin."""
        return self.process.poll() is None

    def finish(self) -> None:
        """Ask it to end the session: the arm stands, the drive goes off, then mode 504."""
        if self.running:
            self.process.send_signal(signal.SIGTERM)

    def failure(self) -> str | None:
        """What it said before it failed; None while it runs, or if it ended properly."""
        if not self.process.poll():
            return None
        said = [line for line in _lines(self._words) if any(letter.isalpha() for letter in line)]
        errors = [line for line in said if line.startswith("error:")]
        return (errors or said or [f"exit status {self.process.returncode}"])[-1]

    def end(self) -> dict[str, Any]:
        """Wait for its end, or kill it; what it counted (`docs/simulate.md`), nothing if killed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(END_TIMEOUT)
        if self.running:
            self.process.kill()
            self.process.wait()
        lines = _lines(self._figures)
        self._words.close()
        self._figures.close()
        return json.loads(lines[-1]) if lines else {}


def _lines(file: IO[bytes]) -> list[str]:
    file.seek(0)
    return [line.strip() for line in file.read().decode(errors="replace").splitlines()]


@contextmanager
def loopback_link(
    cell: Cell,
    *,
    simulated_by: Path | None = None,
    options: tuple[str, ...] = (),
    live: LiveView | None = None,
) -> Iterator[LiveLink]:
    """A `LiveLink` to a simulated controller of `cell` that runs beside this program.

    Over the cell's own transport, "udp" or "can", but always within this computer: UDP takes a
    free port of the loopback device, CAN the bus that the cell names. `simulated_by` is a cell
    file for the controller, if not the cell's own, `options` are further ones of `hil simulate`.
    """
    spec: TransportSpec
    if cell.controller.can is not None and cell.controller.transport == "can":
        table = cell.controller.can
        spec = cell.transport_spec()
        far = ("--can", f"{table.interface}:{table.channel}:{table.profile}")
    else:
        port = free_port()
        spec = UdpSpec(peer_host=LOOPBACK, port=port, bind=LOOPBACK)
        far = ("--udp", f"{LOOPBACK}:{port}")
    simulator = SimulatorProcess.start(simulated_by or cell.path, *far, *options)
    try:
        with LiveLink.open(cell, transport=spec, finish=simulator.finish, live=live) as link:
            yield link
    except ControllerFault as fault:
        if (failure := simulator.failure()) is not None:
            raise ControllerFault(f"the simulated controller failed: {failure}") from fault
        raise
    finally:
        simulator.finish()
        simulator.end()


def free_port() -> int:
    """A UDP port of the loopback device that nobody uses now."""
    with socket(AF_INET, SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
    return port
