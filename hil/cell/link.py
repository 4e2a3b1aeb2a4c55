"""What a cell file says about the link, as the drivers want it."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Any

from drivers.errors import DriverError
from planner.toml_text import toml_value

from .errors import CellError
from .schema import CanTable
from .text import replaced_value

if TYPE_CHECKING:
    from drivers.transports.base import TransportSpec

    from .cell import Cell

_WITHIN_THIS_COMPUTER = frozenset(("virtual", "udp_multicast"))
"""Interfaces of python-can that need no adapter."""


def transport_spec(cell: Cell) -> TransportSpec:
    """What opens the cell's link.

    Raises:
        CellError: the cell is a simulated one, or its CAN bus cannot carry the arm.
    """
    table = cell.controller
    if table.transport == "udp":
        from drivers.transports.udp import UdpSpec

        return UdpSpec(peer_host=table.host, port=table.port, bind=table.bind)
    if table.transport == "can" and table.can is not None:
        from drivers.transports.can import CanSpec

        spec = CanSpec(**table.can.model_dump(), period=cell.period, n_axes=len(cell.joint_names))
        try:
            spec.check(table.mode)
        except (DriverError, ValueError) as error:
            raise CellError(
                cell.path, "controller.can", None, str(error), "name what the bus can carry"
            ) from error
        return spec
    raise CellError(
        cell.path,
        "controller.transport",
        table.transport,
        "a simulated controller in virtual time has no link to open",
        'write "udp" or "can"',
    )


def only_simulated(cell: Cell) -> bool:
    """Whether nothing but a simulated controller on this computer can be at the far end."""
    table = cell.controller
    if table.transport == "udp":
        return _is_loopback(table.host)
    if table.transport == "can":
        return table.can is not None and table.can.interface in _WITHIN_THIS_COMPUTER
    return True


def stays_here(spec: TransportSpec) -> bool:
    """Whether a link ends on this computer; of a kind that is not known here it is not assumed."""
    from drivers.transports.can import CanSpec
    from drivers.transports.udp import UdpSpec

    if isinstance(spec, UdpSpec):
        return _is_loopback(spec.peer_host)
    return isinstance(spec, CanSpec) and spec.interface in _WITHIN_THIS_COMPUTER


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def session_settings(
    cell: Cell, *, accept_init: bool = False, only_axis: int | None = None
) -> dict[str, Any]:
    """Keyword arguments of `drivers.Session`."""
    table, campaign = cell.controller, cell.file.campaign
    settings: dict[str, Any] = {
        "mode": table.mode,
        "arm": table.arm,
        "max_gap": table.max_gap,
        "accept_init": accept_init,
        "other_axes": frozenset(table.other_axes),
    }
    if only_axis is not None:
        settings["only_axis"] = only_axis
    if campaign is not None:
        settings["settle_cycles"] = max(1, round(campaign.settle_s / cell.period))
    return settings


def with_link(
    text: str,
    *,
    transport: str | None = None,
    host: str | None = None,
    port: int | None = None,
    bind: str | None = None,
    cycle_ms: int | None = None,
    can: CanTable | None = None,
) -> str:
    """The text of a cell file with another link; None keeps what stands there."""
    given = {"transport": transport, "host": host, "port": port, "bind": bind, "cycle_ms": cycle_ms}
    for key, value in given.items():
        if value is not None:
            text = replaced_value(text, "controller", key, toml_value(value))
    if can is None:
        return text
    table = "controller.can"
    if f"[{table}]" not in text:
        text += f"\n[{table}]\n"
    for key, value in can.model_dump(exclude_none=True).items():
        text = replaced_value(text, table.replace(".", r"\."), key, toml_value(value))
    return text
