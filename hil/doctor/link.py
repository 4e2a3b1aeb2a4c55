"""Which link is to be looked at: the part of a cell file that concerns this PC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil.cell import Cell


@dataclass(frozen=True)
class UdpLink:
    """A UDP link: the controller's address, and where this PC listens."""

    host: str
    port: int
    bind: str = "0.0.0.0"


@dataclass(frozen=True)
class CanLink:
    """A CAN link, in python-can's words; bit rates in bit/s, None if the bus is set up already."""

    interface: str
    channel: str
    fd: bool
    bitrate: int | None = None
    data_bitrate: int | None = None


Link = UdpLink | CanLink
"""None stands for a simulated controller: there is no link to look at."""


def link_of(cell: Cell) -> Link | None:
    """The link of a cell, None if its controller is simulated.

    Raises:
        CellError: the cell has no `[controller]`.
    """
    table = cell.controller
    if table.transport == "udp":
        return UdpLink(table.host, table.port, table.bind)
    if table.transport == "can" and table.can is not None:
        bus = table.can
        return CanLink(
            bus.interface, bus.channel, bus.profile == "fd", bus.bitrate, bus.data_bitrate
        )
    return None
