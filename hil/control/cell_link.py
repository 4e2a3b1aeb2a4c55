"""Open the link of a cell: a real one, or a simulated controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hil.archive.live import LiveView, LiveViewError
from hil.cell import Cell
from hil.control.link import MotionLink
from hil.control.live_link import LiveLink
from hil.control.motion_watch import Stop
from hil.control.simulated_cell import simulated_link


@contextmanager
def cell_link(
    cell: Cell,
    *,
    only_axis: int | None = None,
    live: LiveView | None = None,
    report: Callable[[str], object] = str,
    stop: Stop | None = None,
) -> Iterator[MotionLink]:
    """Open the link of a cell; leaving the context stops the arm and closes the link.

    With transport "simulated" the controller is simulated in this process, in virtual time.

    Args:
        cell: the cell.
        only_axis: the only axis, from 1, to be open.
        live: where viewers may connect.
        report: receives what is waited for.
        stop: ends the wait.

    Raises:
        ControllerError: the link cannot be opened.
        LiveViewError: the live view cannot be served, or time is virtual.
    """
    if cell.controller.transport == "simulated":
        require_real_time(cell, live)
        yield simulated_link(cell, only_axis=only_axis)
        return
    with LiveLink.open(cell, only_axis=only_axis, live=live, report=report, stop=stop) as link:
        yield link


def require_real_time(cell: Cell, live: LiveView | None) -> None:
    """Raise `LiveViewError` for a live view of a cell simulated in virtual time."""
    if live is not None and cell.controller.transport == "simulated":
        raise LiveViewError(
            None,
            "--live needs real time; this run is simulated in virtual time",
            remedy="leave it out, or run against `hil simulate` over the loopback",
        )
