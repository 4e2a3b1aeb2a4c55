"""Whether this user can listen where the cell says, and who else does."""

from __future__ import annotations

import errno
import re
import socket
from dataclasses import dataclass
from pathlib import Path

from .check import Check, Status
from .system import System

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
