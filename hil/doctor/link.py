"""The link to the controller: port or bus, card, route, and what lies on the way."""

from __future__ import annotations

import errno
import ipaddress
import json
import re
import socket
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.reading import text_of, toml_of

from .check import Check, Status, System

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
    from hil.cell.errors import UnknownFieldsError
    from hil.cell.schema import ControllerTable

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


_UP = 0x1
_REJECT = 0x200
_COMPLETE = 0x2
_PERMANENT = 0x4
LOOPBACK = "lo"


@dataclass(frozen=True)
class Route:
    """How packets to an address leave: card, and gateway (None if it is on the card's network)."""

    device: str
    gateway: str | None
    is_default: bool = False


@dataclass(frozen=True)
class Neighbour:
    """An entry of the ARP table."""

    address: str
    mac: str
    device: str
    complete: bool
    permanent: bool


def address_of(host: str, system: System) -> str | None:
    """An IPv4 address as written, or by name from /etc/hosts; None otherwise. No DNS."""
    try:
        return str(ipaddress.IPv4Address(host))
    except ValueError:
        pass
    for line in (system.text("/etc/hosts") or "").splitlines():
        words = line.split("#")[0].split()
        if host in words[1:] and re.fullmatch(r"[\d.]+", words[0]):
            return words[0]
    return None


def routes(system: System) -> list[tuple[ipaddress.IPv4Network, int, Route]]:
    """Network, metric and way of every usable line of /proc/net/route."""
    found = []
    for line in (system.text("/proc/net/route") or "").splitlines()[1:]:
        words = line.split()
        try:
            flags, metric = int(words[3], 16), int(words[6])
            target, gateway, mask = (_dotted(words[i]) for i in (1, 2, 7))
            network = ipaddress.IPv4Network(f"{target}/{mask}", strict=False)
        except (IndexError, ValueError, struct.error):
            continue
        if not flags & _UP or flags & _REJECT:
            continue
        way = Route(words[0], None if gateway == "0.0.0.0" else gateway, network.prefixlen == 0)
        found.append((network, metric, way))
    return found


def route_to(address: str, system: System) -> Route | None:
    """The way the main routing table gives: the longest prefix, then the lowest metric."""
    target = ipaddress.IPv4Address(address)
    if target.is_loopback or address in own_addresses(system):
        return Route(LOOPBACK, None)
    fits = [(-net.prefixlen, metric, way) for net, metric, way in routes(system) if target in net]
    return min(fits, key=lambda fit: fit[:2])[2] if fits else None


def default_devices(system: System) -> set[str]:
    """Cards that carry a default route."""
    return {way.device for _, _, way in routes(system) if way.is_default}


def own_addresses(system: System) -> set[str]:
    """IPv4 addresses of this PC, from the local part of /proc/net/fib_trie."""
    text = system.text("/proc/net/fib_trie") or ""
    return set(re.findall(r"\|-- ([\d.]+)\n\s+/32 host LOCAL", text))


def neighbour(address: str, device: str, system: System) -> Neighbour | None:
    """The ARP entry of an address on a card."""
    for line in (system.text("/proc/net/arp") or "").splitlines()[1:]:
        words = line.split()
        if len(words) < 6 or words[0] != address or words[5] != device:
            continue
        try:
            flags = int(words[2], 16)
        except ValueError:
            continue
        complete = bool(flags & _COMPLETE) and words[3] != "00:00:00:00:00:00"
        return Neighbour(words[0], words[3], words[5], complete, bool(flags & _PERMANENT))
    return None


def _dotted(word: str) -> str:
    """An address of /proc/net/route: hexadecimal in the processor's (little-endian) order."""
    return str(ipaddress.IPv4Address(struct.unpack("<I", struct.pack(">I", int(word, 16)))[0]))


_NET = "/sys/class/net"
_SPARE_USECS = 50
"""µs that a card may gather packets before it interrupts."""


def route_check(host: str, address: str | None, route: Route | None) -> Check:
    """Whether the controller is reached over a card of its own network."""
    why = "a router or a wrong card in between adds delay, or nothing arrives at all"
    name = "route to the controller"
    if address is None:
        remedy = f"# write the address in the cell file: host = 10.2.12.150 or the like, not {host}"
        return Check(
            name, Status.BAD, f"{host!r} is no IPv4 address nor in /etc/hosts", why, (remedy,)
        )
    if route is None:
        own = _neighbouring(address)
        remedies = (
            "ip -brief link   # which card is the controller's?",
            f"sudo ip addr add {own}/24 dev CARD && sudo ip link set CARD up",
        )
        return Check(name, Status.BAD, f"none to {address}", why, remedies)
    if route.device == LOOPBACK:
        return Check(name, Status.OK, f"{address} is this PC itself (a simulated controller)", why)
    if route.gateway is not None:
        own = _neighbouring(address)
        remedy = f"sudo ip addr add {own}/24 dev CARD   # CARD: the one cabled to the controller"
        found = f"over gateway {route.gateway} on {route.device}"
        return Check(name, Status.BAD, found, why, (remedy,))
    return Check(name, Status.OK, f"{address} directly on {route.device}", why)


def device_check(device: str, system: System) -> Check:
    """Whether the card is up, wired, fast and its own."""
    folder = f"{_NET}/{device}"
    why = "packets of the controller come every millisecond; nothing else should share the card"
    name = f"card {device}"
    if device == LOOPBACK:
        return Check(name, Status.OK, "loopback", why)
    if not system.path(folder).exists():
        return Check(name, Status.BAD, "does not exist", why, ("ip -brief link",))
    up = f"sudo ip link set {device} up"
    state = system.text(f"{folder}/operstate") or "unknown"
    if state not in ("up", "unknown") or system.text(f"{folder}/carrier") == "0":
        return Check(name, Status.BAD, f"{state}, no carrier", why, (up, "# check the cable"))
    if system.path(f"{folder}/wireless").exists() or system.path(f"{folder}/phy80211").exists():
        return Check(name, Status.BAD, "is wireless", why, ("# use a cable",))
    speed, duplex = system.number(f"{folder}/speed"), system.text(f"{folder}/duplex")
    found = ", ".join(
        word
        for word in (
            state,
            f"{speed} Mbit/s" if speed and speed > 0 else "speed not stated",
            f"{duplex} duplex" if duplex in ("half", "full") else "",
            f"driver {_driver(folder, system)}",
        )
        if word
    )
    if duplex == "half" or (speed is not None and 0 < speed < 100):
        return Check(name, Status.BAD, found, why, (f"sudo ethtool -s {device} autoneg on",))
    if device in default_devices(system):
        remedy = "# give the controller a card of its own; this one carries the default route too"
        return Check(name, Status.WARN, f"{found}; shared with other traffic", why, (remedy,))
    return Check(name, Status.OK, found, why)


def _driver(folder: str, system: System) -> str:
    link = system.path(f"{folder}/device/driver")
    try:
        return link.resolve(strict=True).name
    except OSError:
        return "none (virtual)"


def coalescing(device: str, system: System) -> Check | None:
    """Whether the card holds packets back to interrupt less often; None on loopback."""
    if device == LOOPBACK:
        return None
    name, why = f"interrupt coalescing of {device}", "a card that gathers packets delays each"
    remedy = f"sudo ethtool -C {device} adaptive-rx off rx-usecs 0"
    answer = system.run(["ethtool", "-c", device])
    if answer is None:
        look = ("sudo apt install ethtool", f"ethtool -c {device}")
        return Check(name, Status.UNKNOWN, "ethtool is not installed", why, look)
    if answer.status != 0:
        if "not supported" in answer.errors.lower():
            return Check(name, Status.OK, "the card has none", why)
        found = answer.errors.strip().splitlines()[-1:] or ["ethtool failed"]
        return Check(name, Status.UNKNOWN, found[0], why, (f"sudo ethtool -c {device}",))
    usecs = re.search(r"^rx-usecs:\s*(\d+)", answer.output, re.MULTILINE)
    adaptive = re.search(r"^Adaptive RX:\s*on", answer.output, re.MULTILINE) is not None
    wait = int(usecs[1]) if usecs else 0
    found_words = f"rx-usecs {usecs[1] if usecs else 'not stated'}{', adaptive' * adaptive}"
    poor = adaptive or wait > _SPARE_USECS
    return Check(name, Status.WARN if poor else Status.OK, found_words, why, (remedy,) * poor)


def neighbour_check(address: str, device: str, entry: Neighbour | None) -> Check | None:
    """Whether the controller's hardware address is fixed; None on loopback."""
    if device == LOOPBACK:
        return None
    name = "ARP entry of the controller"
    why = "an entry that expires is asked for anew in mid-motion, and answers wait for it"
    mac = entry.mac if entry is not None and entry.complete else "MAC"
    remedy = f"sudo ip neigh replace {address} lladdr {mac} dev {device} nud permanent"
    if entry is None or not entry.complete:
        hint = "# MAC: read it off the controller; a C4G's begins with 00:04:50"
        found = "none (the table was read, no request was sent)"
        return Check(name, Status.WARN, found, why, (remedy, hint))
    if entry.permanent:
        return Check(name, Status.OK, f"{entry.mac}, permanent", why)
    return Check(name, Status.WARN, f"{entry.mac}, will expire", why, (remedy,))


def firewall(address: str, port: int, system: System) -> Check:
    """Whether a packet filter may drop the controller's packets; only root can read its rules."""
    name, why = "firewall", "a filtered controller looks exactly like one that is switched off"
    allow = f"sudo nft insert rule inet filter input ip saddr {address} udp dport {port} accept"
    allow += "   # if table and chain are called so"
    commands = (["nft", "list", "ruleset"], ["iptables", "-S"])
    outputs = [answer for command in commands if (answer := system.run(command)) is not None]
    look = "sudo nft list ruleset; sudo iptables -S"
    if any(_may_drop(answer.output) for answer in outputs if answer.status == 0):
        found = "there are rules that drop or reject incoming packets"
        ufw = f"# with ufw: sudo ufw allow from {address} to any port {port} proto udp"
        return Check(name, Status.WARN, found, why, (look, allow, ufw))
    if any(answer.status != 0 for answer in outputs):
        return Check(name, Status.UNKNOWN, "its rules may be read by root only", why, (look,))
    if outputs:
        return Check(name, Status.OK, "no rule drops incoming packets", why)
    if not system.path("/proc/net/netfilter").exists():
        return Check(name, Status.OK, "this kernel has no packet filter", why)
    install = "sudo apt install nftables"
    found = "neither nft nor iptables is installed to read its rules"
    return Check(name, Status.UNKNOWN, found, why, (install, look))


def _may_drop(rules: str) -> bool:
    """Whether nft or iptables hold a rule that may drop what comes in, in any chain jumped to."""
    nft = "hook input" in rules and re.search(r"\b(drop|reject)\b", rules) is not None
    policy = re.search(r"^-P INPUT (DROP|REJECT)", rules, re.MULTILINE)
    input_rule = re.search(r"^-A INPUT\b", rules, re.MULTILINE)
    target = re.search(r"^-A .*-j (DROP|REJECT)\b", rules, re.MULTILINE)
    return nft or policy is not None or (input_rule is not None and target is not None)


def _neighbouring(address: str) -> str:
    """An address for this PC on the controller's network, beside the controller's own."""
    head, last = address.rsplit(".", 1)
    return f"{head}.{int(last) - 1 if int(last) > 1 else int(last) + 1}"


def network_checks(host: str, port: int, address: str | None, system: System) -> list[Check]:
    """Everything between this PC and the controller."""
    route = None if address is None else route_to(address, system)
    first = route_check(host, address, route)
    checks: list[Check | None] = [first]
    # The card of a wrong route is not the one that matters.
    if address is not None and route is not None and first.status is Status.OK:
        device = route.device
        entry = neighbour(address, device, system)
        checks += [
            device_check(device, system),
            coalescing(device, system),
            neighbour_check(address, device, entry),
        ]
        if device != LOOPBACK:
            checks.append(firewall(address, port, system))
    return [check for check in checks if check is not None]
