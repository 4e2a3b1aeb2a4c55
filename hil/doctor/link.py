"""Whether this user can listen where the cell says, and who else does."""

from __future__ import annotations

import errno
import json
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.reading import text_of, toml_of

from .check import Check, Status
from .system import System

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


_START = "/proc/sys/net/ipv4/ip_unprivileged_port_start"
_PRIORITY, _TOS, _BUSY_POLL_US = 6, 0x28, 50
_SO_BUSY_POLL = 46
"""Linux's number; Python 3.11 does not name it."""


@dataclass(frozen=True)
class SocketTrial:
    """What a socket like the exchange's was allowed.

    Attributes:
        error: errno of the bind, 0 if it worked.
        refused: options that were refused, by name.
        buffer: bytes of the receive buffer.
    """

    error: int
    refused: tuple[str, ...] = ()
    buffer: int = 0


def try_port(bind: str, port: int) -> SocketTrial:
    """Bind the address for an instant; a running exchange keeps it and is not disturbed."""
    refused = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        for name, level, option, value in (
            ("SO_PRIORITY", socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY),
            ("IP_TOS", socket.IPPROTO_IP, socket.IP_TOS, _TOS),
            ("SO_BUSY_POLL", socket.SOL_SOCKET, _SO_BUSY_POLL, _BUSY_POLL_US),
        ):
            try:
                trial.setsockopt(level, option, value)
            except OSError:
                refused.append(name)
        size = trial.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        try:
            trial.bind((bind, port))
        except OSError as error:
            return SocketTrial(error.errno or -1, tuple(refused), size)
    return SocketTrial(0, tuple(refused), size)


def port_check(bind: str, port: int, trial: SocketTrial, system: System) -> Check:
    """Whether the port can be bound, and what to do if not."""
    name, why = f"UDP port {port}", "the controller sends to this port and no other"
    if trial.error == 0:
        return Check(name, Status.OK, f"can be bound on {bind}", why)
    if trial.error == errno.EADDRINUSE:
        user = owner_of(port, system)
        found = f"in use{f' by {user}' if user else ' by a program of another user'}"
        return Check(name, Status.BAD, found, why, (f"sudo ss -lunp sport = :{port}",))
    if trial.error == errno.EADDRNOTAVAIL:
        look = "ip -brief addr   # then set controller.bind in the cell file, or 0.0.0.0"
        return Check(name, Status.BAD, f"{bind} is no address of this PC", why, (look,))
    if trial.error in (errno.EACCES, errno.EPERM):
        start = system.number(_START)
        lowest = f"ports below {start} need a privilege" if start is not None else "not permitted"
        setting = f"net.ipv4.ip_unprivileged_port_start={port}"
        remedy = (
            f"echo '{setting}' | sudo tee /etc/sysctl.d/90-hil.conf && sudo sysctl --system",
            "# once, and for good: hil itself then needs no privilege for it",
        )
        return Check(name, Status.BAD, lowest, why, remedy)
    return Check(name, Status.BAD, f"cannot be bound ({_words(trial.error)})", why)


def options_check(trial: SocketTrial) -> Check:
    """Which socket options the system offers; none of them is indispensable."""
    why = "priority in the card's queue and polling shorten the way of a packet a little"
    found = f"receive buffer {trial.buffer // 1024} KiB"
    if not trial.refused:
        return Check("socket options", Status.OK, found, why)
    found += f"; refused: {', '.join(trial.refused)}"
    # Only busy polling is commonly refused: before Linux 5.11 it needs CAP_NET_ADMIN.
    only_polling = set(trial.refused) <= {"SO_BUSY_POLL"}
    remedy = () if only_polling else ("uname -r   # Linux 5.11 or newer grants them to anyone",)
    return Check("socket options", Status.OK if only_polling else Status.WARN, found, why, remedy)


def owner_of(port: int, system: System) -> str | None:
    """Program and process that listen on a UDP port, as far as this user may see."""
    inodes = set()
    for line in (system.text("/proc/net/udp") or "").splitlines()[1:]:
        words = line.split()
        local = re.fullmatch(r"[0-9A-F]{8}:([0-9A-F]{4})", words[1]) if len(words) > 9 else None
        if local and int(local[1], 16) == port:
            inodes.add(words[9])
    for process in system.names("/proc"):
        if process.isdigit() and _holds(system.path(f"/proc/{process}/fd"), inodes):
            return f"{system.text(f'/proc/{process}/comm') or 'a program'} (process {process})"
    return None


def _holds(folder: Path, inodes: set[str]) -> bool:
    try:
        return any(
            re.fullmatch(r"socket:\[(\d+)\]", (target := str(link.readlink()))) is not None
            and target[8:-1] in inodes
            for link in folder.iterdir()
        )
    except OSError:
        return False


def _words(number: int) -> str:
    return errno.errorcode.get(number, f"error {number}")
