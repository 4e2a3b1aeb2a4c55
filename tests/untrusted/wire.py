"""A network of one's own: PC, controller and stranger, each a host of its own on one switch.

Made of network namespaces, so it needs root and `ip`; nothing of it is seen outside.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

HOSTS = {"pc": "10.77.0.1", "controller": "10.77.0.2", "stranger": "10.77.0.3"}
SWITCH = "switch"
BROADCAST = "10.77.0.255"


@dataclass(frozen=True)
class Wire:
    """The hosts, by the names in `HOSTS`."""

    prefix: str

    def command(self, host: str, *command: str) -> list[str]:
        """What runs a command on one of the hosts."""
        return ["ip", "netns", "exec", f"{self.prefix}{host}", *command]

    def start(self, host: str, *command: str, **more: Any) -> subprocess.Popen[bytes]:
        """Start a command on one of the hosts."""
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.Popen(self.command(host, *command), env=environment, **more)

    def ports(self, host: str) -> list[int]:
        """UDP ports that programs on a host have."""
        done = subprocess.run(
            self.command(host, "cat", "/proc/net/udp"), capture_output=True, check=True
        )
        lines = done.stdout.decode().splitlines()[1:]
        return [int(line.split()[1].rpartition(":")[2], 16) for line in lines]

    def await_port(self, host: str, port: int, seconds: float) -> bool:
        """Wait until somebody on a host has a UDP port."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if port in self.ports(host):
                return True
            time.sleep(0.1)
        return False


def missing() -> str:
    """What keeps this computer from making such a network; "" if nothing does."""
    if shutil.which("ip") is None:
        return "there is no command `ip` (iproute2)"
    name = f"hil{os.getpid()}try"
    done = subprocess.run(["ip", "netns", "add", name], capture_output=True, check=False)
    if done.returncode:
        return f"network namespaces are not permitted ({done.stderr.decode().strip()})"
    _ip("netns", "del", name)
    return ""


@contextmanager
def wire() -> Iterator[Wire]:
    """Make the network, and take it away again."""
    made = Wire(f"hil{os.getpid()}")
    try:
        _make(made.prefix)
        yield made
    finally:
        for host in (*HOSTS, SWITCH):
            subprocess.run(
                ["ip", "netns", "del", made.prefix + host], capture_output=True, check=False
            )


def _make(prefix: str) -> None:
    switch = prefix + SWITCH
    _ip("netns", "add", switch)
    _ip("-n", switch, "link", "add", "br0", "type", "bridge")
    _ip("-n", switch, "link", "set", "br0", "up")
    for host, address in HOSTS.items():
        space, plug = prefix + host, f"to_{host}"[:15]
        _ip("netns", "add", space)
        _ip(
            "-n",
            switch,
            "link",
            "add",
            plug,
            "type",
            "veth",
            "peer",
            "name",
            "eth0",
            "netns",
            space,
        )
        _ip("-n", switch, "link", "set", plug, "master", "br0")
        _ip("-n", switch, "link", "set", plug, "up")
        _ip("-n", space, "addr", "add", f"{address}/24", "brd", "+", "dev", "eth0")
        for device in ("lo", "eth0"):
            _ip("-n", space, "link", "set", device, "up")


def _ip(*words: str) -> None:
    arguments: Sequence[str] = ("ip", *words)
    subprocess.run(arguments, capture_output=True, check=True)
