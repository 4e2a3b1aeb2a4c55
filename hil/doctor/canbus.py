"""The CAN interface of the cell: there, up, and at the right bit rates."""

from __future__ import annotations

import json
from typing import Any

from .check import Check, Status
from .link import CanLink
from .system import System

_ARPHRD_CAN = "280"


def can_check(link: CanLink, system: System) -> Check:
    """Whether the bus can be opened as the cell says; a bus without a kernel device is not tried.

    Opening an adapter puts it on the bus, which acknowledges frames: that is left to the exchange.
    """
    why = "a node at another bit rate disturbs every frame on the bus"
    name = f"CAN {link.interface} {link.channel}"
    if link.interface != "socketcan":
        found = "not a kernel device; it is opened, and so checked, by the exchange only"
        return Check(name, Status.UNKNOWN, found, why)
    folder = f"/sys/class/net/{link.channel}"
    if not system.path(folder).exists():
        look = ("ip -brief link show type can", "sudo modprobe can_raw   # and the card's driver")
        return Check(name, Status.BAD, "does not exist", why, look)
    if system.text(f"{folder}/type") != _ARPHRD_CAN:
        return Check(name, Status.BAD, "is no CAN interface", why, ("ip -brief link",))
    bring_up = _bring_up(link)
    state = system.text(f"{folder}/operstate") or "unknown"
    if state == "down":
        return Check(name, Status.BAD, "down", why, bring_up)
    details = _details(link.channel, system)
    if details.get("info_kind") == "vcan":
        return Check(name, Status.OK, "virtual bus, no bit rate", why)
    data = details.get("info_data")
    return _timing(name, why, link, state, data if isinstance(data, dict) else {})


def _timing(name: str, why: str, link: CanLink, state: str, details: dict[str, Any]) -> Check:
    nominal = _rate(details, "bittiming")
    data = _rate(details, "data_bittiming")
    if nominal is None:
        look = (f"ip -details link show {link.channel}",)
        return Check(name, Status.UNKNOWN, f"{state}; bit rate not stated", why, look)
    found = f"{state}, {nominal} bit/s" + (f", data {data} bit/s" if data else "")
    wrong = link.bitrate is not None and nominal != link.bitrate
    wrong |= link.fd and data is None
    wrong |= link.fd and link.data_bitrate is not None and data != link.data_bitrate
    if not wrong:
        return Check(name, Status.OK, found, why)
    down = f"sudo ip link set {link.channel} down"
    return Check(
        name, Status.BAD, f"{found}; the cell needs otherwise", why, (down, *_bring_up(link))
    )


def _bring_up(link: CanLink) -> tuple[str, ...]:
    rates = f"bitrate {link.bitrate or 1_000_000}"
    if link.fd:
        rates += f" dbitrate {link.data_bitrate or 5_000_000} fd on"
    return (f"sudo ip link set {link.channel} up txqueuelen 100 type can {rates}",)


def _details(channel: str, system: System) -> dict[str, Any]:
    """`linkinfo` of `ip`, empty if it cannot be had."""
    answer = system.run(["ip", "-details", "-json", "link", "show", channel])
    try:
        found = json.loads(answer.output)[0]["linkinfo"] if answer else {}
    except (ValueError, LookupError, TypeError):
        return {}
    return found if isinstance(found, dict) else {}


def _rate(details: dict[str, Any], timing: str) -> int | None:
    table = details.get(timing)
    rate = table.get("bitrate") if isinstance(table, dict) else None
    return rate if isinstance(rate, int) and rate > 0 else None
