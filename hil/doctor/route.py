"""Which card leads to the controller, from the kernel's tables. No packet is sent."""

from __future__ import annotations

import ipaddress
import re
import struct
from dataclasses import dataclass

from .system import System

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
