"""The link that a cell file names, opened: a real one, or the simulated controller."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hil.archive.live import LiveView, LiveViewError
from hil.campaign.live_link import LiveLink
from hil.campaign.motion_link import MotionLink
from hil.cell import Cell
from hil.simulation import simulated_link


@contextmanager
def cell_link(
    cell: Cell,
    *,
    accept_init: bool = False,
    only_axis: int | None = None,
    live: LiveView | None = None,
) -> Iterator[MotionLink]:
    """Open the cell's own link; leaving it brings the arm to rest and ends the connection.

    With transport "simulated" the controller is simulated in this process, in virtual time, and
    forgets everything afterwards.

    Args:
        cell: names the link.
        accept_init: use the controller's gear ratios, calibration and coupling where they differ
            from the cell's.
        only_axis: the axis, from 1, that alone is to be open; None for all.
        live: lets viewers look at what is recorded, in real time.

    Raises:
        ControllerFault: the link cannot be opened.
        LiveViewError: the live view cannot be served, or time is virtual.
    """
    if cell.controller.transport == "simulated":
        require_watchable(cell, live)
        yield simulated_link(cell, only_axis=only_axis)
        return
    with LiveLink.open(cell, accept_init=accept_init, only_axis=only_axis, live=live) as link:
        yield link


def require_watchable(cell: Cell, live: LiveView | None) -> None:
    """Refuse a live view of what is simulated in virtual time.

    Raises:
        LiveViewError: one is wanted of a cell with the transport "simulated".
    """
    if live is not None and cell.controller.transport == "simulated":
        raise LiveViewError(
            None,
            "--live shows real time; this run is simulated in virtual time",
            remedy="leave it out, or run against `hil simulate` over the loopback",
        )
