"""Checks of the link to the controller: port or bus, network card, route, firewall."""

from __future__ import annotations

import errno
import ipaddress
import re
import socket
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.reading import parse_toml, read_text

from .check import Check, Status, System, bad, named, ok, unknown, warn

if TYPE_CHECKING:
    from hil.cell.schema import CanTable, ControllerTable


def controller_in(path: Path) -> ControllerTable:
    """Return `[controller]` of a cell file, otherwise perhaps incomplete, or raise CellError."""
    from hil.cell import Cell
    from hil.cell.errors import UnknownFieldsError
    from hil.cell.schema import ControllerTable

    try:
        return Cell.load(path).controller
    except UnknownFieldsError as unknown:
        table = parse_toml(read_text(path)).get("controller")
        if table is None or any(name.startswith("controller.") for name in unknown.fields):
            raise
        try:
            return ControllerTable.model_validate(table)
        except ValueError:
            raise unknown from None


_ARPHRD_CAN = "280"


@named("CAN {0.interface} {0.channel}")
def can_check(bus: CanTable, system: System) -> Check:
    """A node at another bit rate corrupts every frame on the bus."""
    # An adapter is not opened here: on the bus it would acknowledge frames.
    fd = bus.profile == "fd"
    if bus.interface != "socketcan":
        return unknown("not a kernel device; it is opened by the exchange only")
    folder = f"/sys/class/net/{bus.channel}"
    if not system.path(folder).exists():
        driver = "sudo modprobe can_raw   # and the card's driver"
        return bad("does not exist", "ip -brief link show type can", driver)
    if system.text(f"{folder}/type") != _ARPHRD_CAN:
        return bad("is not a CAN interface", "ip -brief link")
    rates = f"bitrate {bus.bitrate or 1_000_000}"
    if fd:
        rates += f" dbitrate {bus.data_bitrate or 5_000_000} fd on"
    bring_up = f"sudo ip link set {bus.channel} up txqueuelen 100 type can {rates}"
    state = system.text(f"{folder}/operstate") or "unknown"
    if state == "down":
        return bad("down", bring_up)
    shown = system.ip("-details", "link", "show", bus.channel) or [{}]
    details = shown[0].get("linkinfo", {})
    if details.get("info_kind") == "vcan":
        return ok("virtual bus, no bit rate")
    timings = details.get("info_data", {})
    nominal, data = (timings.get(of, {}).get("bitrate") for of in ("bittiming", "data_bittiming"))
    if not nominal:
        return unknown(f"{state}; bit rate not stated", f"ip -details link show {bus.channel}")
    found = f"{state}, {nominal} bit/s" + (f", data {data} bit/s" if data else "")
    wanted = bus.data_bitrate or data if fd else data
    if nominal == (bus.bitrate or nominal) and data == wanted and (data or not fd):
        return ok(found)
    down = f"sudo ip link set {bus.channel} down"
    return bad(f"{found}; the cell needs {rates}", down, bring_up)


def try_port(bind: str, port: int) -> int:
    """Bind the address, release it, and return the error number, 0 without one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind((bind, port))
        except OSError as error:
            return error.errno or -1
    return 0


@named("UDP port {1}")
def port_check(bind: str, port: int, error: int, system: System) -> Check:
    """The controller sends to this port only."""
    # `error` is that of `try_port`.
    if error == 0:
        return ok(f"can be bound on {bind}")
    if error == errno.EADDRINUSE:
        answer = system.run(["ss", "-lunpH", f"sport = :{port}"])
        user = re.search(r'"(.*?)",pid=(\d+)', "" if answer is None else answer.output)
        who = f"{user[1]} (process {user[2]})" if user else "a program of another user"
        return bad(f"in use by {who}", f"sudo ss -lunp sport = :{port}")
    if error == errno.EADDRNOTAVAIL:
        look = "ip -brief addr   # then set controller.bind in the cell file, or 0.0.0.0"
        return bad(f"{bind} is not an address of this PC", look)
    if error in (errno.EACCES, errno.EPERM):
        start = system.number("/proc/sys/net/ipv4/ip_unprivileged_port_start")
        setting = f"net.ipv4.ip_unprivileged_port_start={port}"
        return bad(
            f"ports below {start} need a privilege" if start is not None else "not permitted",
            f"echo '{setting}' | sudo tee /etc/sysctl.d/90-hil.conf && sudo sysctl --system",
            "# once; hil then needs no privilege for this port",
        )
    return bad(f"cannot be bound ({errno.errorcode.get(error, f'error {error}')})")


def address_of(host: str, system: System) -> str | None:
    """Return an IPv4 address, or that of a name in /etc/hosts; None otherwise. No DNS."""
    lines = (line.split("#")[0].split() for line in (system.text("/etc/hosts") or "").splitlines())
    for text in (host, *(words[0] for words in lines if host in words[1:])):
        try:
            return str(ipaddress.IPv4Address(text))
        except ValueError:
            continue
    return None


_SPARE_USECS = 50
"""Longest interrupt coalescing, µs."""


@named("route to the controller")
def route_check(host: str, address: str | None, route: Mapping[str, Any] | None) -> Check:
    """A router or a wrong network card adds delay or loses all packets."""
    # `route` is that of `ip route get`: empty without a route, None if `ip` is not installed.
    if address is None:
        remedy = f"# write the address in the cell file: host = 10.2.12.150 or the like, not {host}"
        return bad(f"{host!r} is neither an IPv4 address nor in /etc/hosts", remedy)
    if route is None:
        return unknown("ip is not installed", "sudo apt install iproute2")
    add = f"sudo ip addr add {_neighbouring(address)}/24 dev CARD"
    if not route:
        look = "ip -brief link   # which card is the controller's?"
        return bad(f"none to {address}", look, f"{add} && sudo ip link set CARD up")
    if route.get("type") == "local":
        return ok(f"{address} is this PC itself (a simulated controller)")
    if "gateway" in route:
        found = f"over gateway {route['gateway']} on {route['dev']}"
        return bad(found, f"{add}   # CARD: the one cabled to the controller")
    return ok(f"{address} directly on {route['dev']}")


@named("card {0}")
def device_check(device: str, system: System) -> Check:
    """Packets of the controller come every millisecond; other traffic delays them."""
    folder = f"/sys/class/net/{device}"
    if not system.path(folder).exists():
        return bad("does not exist", "ip -brief link")
    state = system.text(f"{folder}/operstate") or "unknown"
    if state not in ("up", "unknown") or system.text(f"{folder}/carrier") == "0":
        return bad(f"{state}, no carrier", f"sudo ip link set {device} up", "# check the cable")
    if any(system.path(f"{folder}/{name}").exists() for name in ("wireless", "phy80211")):
        return bad("is wireless", "# use a cable")
    speed, duplex = system.number(f"{folder}/speed"), system.text(f"{folder}/duplex")
    facts = [state, f"{speed} Mbit/s" if speed and speed > 0 else "speed not stated"]
    facts += [f"{duplex} duplex"] if duplex in ("half", "full") else []
    driver = system.path(f"{folder}/device/driver")
    facts.append(f"driver {driver.resolve().name if driver.exists() else 'none (virtual)'}")
    found = ", ".join(facts)
    if duplex == "half" or (speed is not None and 0 < speed < 100):
        return bad(found, f"sudo ethtool -s {device} autoneg on")
    if any(one.get("dev") == device for one in system.ip("route", "show", "default") or ()):
        remedy = "# give the controller a card of its own; this one carries the default route too"
        return warn(f"{found}; shared with other traffic", remedy)
    return ok(found)


@named("interrupt coalescing of {0}")
def coalescing(device: str, system: System) -> Check:
    """A network card that collects packets before an interrupt delays each."""
    answer = system.run(["ethtool", "-c", device])
    if answer is None:
        remedy = "sudo apt install ethtool", f"ethtool -c {device}"
        return unknown("ethtool is not installed", *remedy)
    if answer.status != 0:
        if "not supported" in answer.errors.lower():
            return ok("the card has none")
        errors = answer.errors.strip().splitlines() or ["ethtool failed"]
        return unknown(errors[-1], f"sudo ethtool -c {device}")
    usecs = re.search(r"^rx-usecs:\s*(\d+)", answer.output, re.MULTILINE)
    adaptive = re.search(r"^Adaptive RX:\s*on", answer.output, re.MULTILINE) is not None
    found = f"rx-usecs {usecs[1] if usecs else 'not stated'}{', adaptive' * adaptive}"
    if adaptive or (usecs and int(usecs[1]) > _SPARE_USECS):
        return warn(found, f"sudo ethtool -C {device} adaptive-rx off rx-usecs 0")
    return ok(found)


@named("ARP entry of the controller")
def neighbour_check(address: str, device: str, system: System) -> Check:
    """An entry that expires during a motion is requested again, and replies wait for it."""
    entries = system.ip("neigh", "show", "to", address, "dev", device) or []
    entry = next((one for one in entries if "lladdr" in one), {})
    mac = entry.get("lladdr", "MAC")
    remedy = f"sudo ip neigh replace {address} lladdr {mac} dev {device} nud permanent"
    if not entry:
        hint = "# MAC: read it off the controller; a C4G's begins with 00:04:50"
        return warn("none (no request was sent)", remedy, hint)
    permanent = "PERMANENT" in entry.get("state", ())
    return ok(f"{mac}, permanent") if permanent else warn(f"{mac}, will expire", remedy)


@named("firewall")
def firewall(address: str, port: int, system: System) -> Check:
    """Packets of a blocked controller do not arrive, as if it were switched off."""
    commands = (["nft", "list", "ruleset"], ["iptables", "-S"])  # only root can read them
    outputs = [answer for command in commands if (answer := system.run(command)) is not None]
    look = "sudo nft list ruleset; sudo iptables -S"
    if any(_may_drop(answer.output) for answer in outputs if answer.status == 0):
        return warn(
            "there are rules that drop or reject incoming packets",
            look,
            f"sudo nft insert rule inet filter input ip saddr {address} udp dport {port} accept"
            "   # if table and chain have these names",
            f"# with ufw: sudo ufw allow from {address} to any port {port} proto udp",
        )
    if any(answer.status != 0 for answer in outputs):
        return unknown("its rules are readable by root only", look)
    if outputs:
        return ok("no rule drops incoming packets")
    if not system.path("/proc/net/netfilter").exists():
        return ok("this kernel has no packet filter")
    found = "neither nft nor iptables is installed to read its rules"
    return unknown(found, "sudo apt install nftables", look)


def _may_drop(rules: str) -> bool:
    """Whether rules of nft or iptables, in any chain, may drop incoming packets."""
    nft = "hook input" in rules and re.search(r"\b(drop|reject)\b", rules) is not None
    policy = re.search(r"^-P INPUT (DROP|REJECT)", rules, re.MULTILINE)
    input_rule = re.search(r"^-A INPUT\b", rules, re.MULTILINE)
    target = re.search(r"^-A .*-j (DROP|REJECT)\b", rules, re.MULTILINE)
    return nft or policy is not None or (input_rule is not None and target is not None)


def _neighbouring(address: str) -> str:
    """Return an address for this PC in the controller's network."""
    head, last = address.rsplit(".", 1)
    return f"{head}.{int(last) - 1 if int(last) > 1 else int(last) + 1}"


def network_checks(host: str, port: int, system: System) -> list[Check]:
    """Check the network between this PC and the controller."""
    address, route = address_of(host, system), None
    if address is not None and (routes := system.ip("route", "get", address)) is not None:
        route = next(iter(routes), {})
    first = route_check(host, address, route)
    # Without a direct route the network card is not known.
    if address is None or not route or first.status is not Status.OK or "type" in route:
        return [first]
    device = route["dev"]
    return [
        first,
        device_check(device, system),
        coalescing(device, system),
        neighbour_check(address, device, system),
        firewall(address, port, system),
    ]


def link_checks(table: ControllerTable | None, system: System) -> list[Check]:
    """Check the link of a cell; None without a cell."""
    if table is None or table.transport == "simulated":
        why = "routes, ports and buses are checked for a cell with a real link"
        return [replace(ok("none: no cell, or a simulated one"), name="controller link", why=why)]
    if table.can is not None and table.transport == "can":
        return [can_check(table.can, system)]
    return [
        *network_checks(table.host, table.port, system),
        port_check(table.bind, table.port, try_port(table.bind, table.port), system),
    ]
