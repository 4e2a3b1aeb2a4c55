"""Which link is to be looked at: the part of a cell file that concerns this PC."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hil.reading import text_of, toml_of

if TYPE_CHECKING:
    from hil.cell.schema import ControllerTable


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


def controller_in(path: Path) -> ControllerTable:
    """`[controller]` of a cell file, which may have other figures still to be filled in.

    Raises:
        CellError: the file cannot be used, or `[controller]` is not known.
    """
    from hil.cell import Cell
    from hil.cell.schema import ControllerTable
    from hil.cell.unknown import UnknownFieldsError

    try:
        return Cell.load(path).controller
    except UnknownFieldsError as unknown:
        table = toml_of(text_of(path)).get("controller")
        if table is None or any(name.startswith("controller.") for name in unknown.fields):
            raise
        try:
            return ControllerTable.model_validate(table)
        except ValueError:
            raise unknown from None


def link_of(table: ControllerTable) -> Link | None:
    """The link that `[controller]` names, None if it is simulated."""
    if table.transport == "udp":
        return UdpLink(table.host, table.port, table.bind)
    if table.transport == "can" and table.can is not None:
        bus = table.can
        return CanLink(
            bus.interface, bus.channel, bus.profile == "fd", bus.bitrate, bus.data_bitrate
        )
    return None
