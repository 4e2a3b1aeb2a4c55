"""A link of a cell to a simulated controller in another process, over the loopback device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.transports.udp import UdpSpec
from hil.archive.live import LiveView
from hil.base.errors import ControllerError, ExecutionError
from hil.cell import Cell
from hil.control.live_link import LiveLink
from hil.control.simulator_process import LOOPBACK, SimulatorProcess, free_port


def on_loopback(cell: Cell, port: int | None = None) -> Cell:
    """Return the cell with its controller on this computer, on this port or a free one."""
    bound = free_port() if port is None else port
    return cell.with_link(transport="udp", host=LOOPBACK, bind=LOOPBACK, port=bound)


@contextmanager
def loopback_link(
    cell: Cell,
    *,
    simulated_by: Path | None = None,
    options: tuple[str, ...] = (),
    live: LiveView | None = None,
) -> Iterator[LiveLink]:
    """Start a simulated controller in another process and connect a `LiveLink` to it.

    `simulated_by` is the cell file of the controller (default: that of `cell`); `options` are
    further ones of `hil simulate`.
    """
    port = free_port()
    spec = UdpSpec(peer_host=LOOPBACK, port=port, bind=LOOPBACK)
    address = ("--udp", f"{LOOPBACK}:{port}")
    simulator = SimulatorProcess.start(simulated_by or cell.path, *address, *options)
    try:
        with LiveLink.open(cell, transport=spec, finish=simulator.finish, live=live) as link:
            yield link
    except ExecutionError as fault:
        if (failure := simulator.failure()) is not None:
            raise ControllerError(f"the simulated controller failed: {failure}") from fault
        raise
    finally:
        simulator.finish()
        simulator.end()
