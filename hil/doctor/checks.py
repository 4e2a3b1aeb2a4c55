"""Checks of this PC: permissions, processor, disk, and the link to the controller."""

from __future__ import annotations

import errno
import ipaddress
import json
import resource
import shutil
import socket
import subprocess
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from drivers.errors import DriverError
from drivers.exchange.realtime import LIMITS_FILE, RealTimeReport, RealTimeSettings
from drivers.transports.base import (
    CanBus,
    DirectRoute,
    FreePort,
    Need,
    RtdeServer,
    TransportError,
    TransportSpec,
)
from drivers.ur.connection import RtdeConnection, connected
from drivers.ur.wire import version_problem
from hil.archive.process import STALL_LIMIT


class CheckStatus(StrEnum):
    """Result of a check: works, may cost latency, fails, is not known."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class DoctorCheck:
    """The result of one check: status, facts, shell commands as remedy."""

    name: str
    status: CheckStatus
    facts: str
    remedy: tuple[str, ...] = ()


COMMAND_TIMEOUT = 3.0
"""Time limit of a command, s."""
_PROGRAMS = "/usr/sbin:/usr/bin:/sbin:/bin:/usr/local/bin"


class System:
    """Files and commands of the operating system; `root` is the prefix of every path."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def run(self, *command: str) -> str | None:
        """Return the output of a command; None if it is not installed or exceeds its time."""
        path = shutil.which(command[0], path=_PROGRAMS)
        if path is None:
            return None
        try:
            return subprocess.run(
                [path, *command[1:]],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=COMMAND_TIMEOUT,
                check=False,
            ).stdout
        except (OSError, subprocess.TimeoutExpired):
            return None

    def path(self, name: str) -> Path:
        """Return the path of the file `name` (absolute)."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """Return the stripped text of a file; empty if it cannot be read."""
        try:
            return self.path(name).read_text("utf-8", errors="replace").strip()
        except OSError:
            return ""

    def texts(self, pattern: str) -> dict[Path, str]:
        """Return the texts of the files that match a pattern, by path."""
        paths = sorted(self.root.glob(pattern.lstrip("/")))
        return {path: self.text(str(path.relative_to(self.root))) for path in paths}

    def ip(self, *arguments: str) -> list[dict[str, Any]] | None:
        """Return the output of `ip`; empty if it fails, None if it is not installed."""
        output = self.run("ip", "-json", *arguments)
        try:
            return None if output is None else [*json.loads(output)]
        except ValueError:
            return []


GROUP = "realtime"
RULE_FILE = "/etc/udev/rules.d/90-hil.rules"
_JOIN = f'sudo groupadd -f {GROUP} && sudo usermod -aG {GROUP} "$USER"'
_LOG_IN_AGAIN = "# log out and in again, then: ulimit -r; ulimit -l"


def _limit_lines(item: str, value: str) -> tuple[str, ...]:
    line = f"echo '@{GROUP} - {item} {value}' | sudo tee -a {LIMITS_FILE}"
    return (_JOIN, line, _LOG_IN_AGAIN)


def scheduling(given: RealTimeReport, limit: int) -> DoctorCheck:
    """Check the priority of a real-time process, and the limit RLIMIT_RTPRIO of this one."""
    name = "real-time priority"
    limited = "no limit" if limit < 0 else f"rtprio limit {limit}"
    if "FIFO" in given.scheduling.upper():
        return DoctorCheck(name, CheckStatus.OK, f"{given.scheduling} given ({limited})")
    message = f"refused, its scheduling is {given.scheduling or 'ordinary'}; {limited}"
    remedy = _limit_lines("rtprio", "98")
    if not 0 <= limit < RealTimeSettings().priority:
        remedy += ("cat /proc/sys/kernel/sched_rt_runtime_us   # 0 forbids real-time programs",)
    return DoctorCheck(name, CheckStatus.BAD, message, remedy)


def memory_lock(given: RealTimeReport, limit: int) -> DoctorCheck:
    """Check whether memory can be locked, and the limit RLIMIT_MEMLOCK: page faults cost cycles."""
    limited = "no limit" if limit < 0 else f"memlock limit {limit // 1024} KiB"
    name = "memory lock"
    remedy = _limit_lines("memlock", "unlimited")
    if given.memory_locked:
        return DoctorCheck(name, CheckStatus.OK, f"given ({limited})")
    if given.memory_in_use_locked:
        return DoctorCheck(
            name, CheckStatus.WARN, f"only what is in use at the start; {limited}", remedy
        )
    return DoctorCheck(name, CheckStatus.BAD, f"refused; {limited}", remedy)


_CPU = "/sys/devices/system/cpu"


def governor(system: System) -> DoctorCheck:
    """Check that the processors are not slowed down."""
    name = "frequency governor"
    governors = sorted(
        {*system.texts(f"{_CPU}/cpu[0-9]*/cpufreq/scaling_governor").values()} - {""}
    )
    if governors in ([], ["performance"]):
        return DoctorCheck(
            name, CheckStatus.OK, "".join(governors) or "no frequency scaling on this machine"
        )
    setting = f"echo performance | sudo tee {_CPU}/cpu*/cpufreq/scaling_governor"
    return DoctorCheck(name, CheckStatus.WARN, ", ".join(governors), (setting,))


def idle_states(*, cpu_awake: bool) -> DoctorCheck:
    """Check that an exchange can exclude the idle states, by /dev/cpu_dma_latency."""
    name = "idle states"
    if cpu_awake:
        return DoctorCheck(name, CheckStatus.OK, "not entered during an exchange")
    rule = f'KERNEL=="cpu_dma_latency", GROUP="{GROUP}", MODE="0660"'
    remedy = (
        _JOIN,
        f"echo '{rule}' | sudo tee {RULE_FILE}",
        "sudo udevadm control --reload && sudo udevadm trigger --name-match=cpu_dma_latency",
        "# log out and in again, then: ls -l /dev/cpu_dma_latency; groups",
    )
    return DoctorCheck(name, CheckStatus.WARN, "/dev/cpu_dma_latency may not be written", remedy)


def computer_checks(given: RealTimeReport | None, system: System) -> list[DoctorCheck]:
    """Check permissions and processor; `given` is None if the probe failed."""
    if given is None:
        command = ("python -m hil.doctor.probe permissions   # prints the error",)
        rights = [DoctorCheck("permissions", CheckStatus.BAD, "the probe failed", command)]
    else:
        limits = [
            resource.getrlimit(limit)[0]
            for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK)
        ]
        rights = [scheduling(given, limits[0]), memory_lock(given, limits[1])]
    awake = given is not None and given.cpu_awake
    return [*rights, governor(system), idle_states(cpu_awake=awake)]


BYTES_PER_CYCLE = 600
"""Upper bound of the archived bytes per cycle of six axes; 534 by `benchmarks.archive`."""
_SLOW_WRITE_SECONDS = 0.1 * STALL_LIMIT
_MAX_WRITE_SECONDS = 0.5 * STALL_LIMIT
"""Limits of the time of one write, s; a motion is stopped if a write takes several seconds."""
_MOVE = "# or put the campaign folder on another, local disk"


@dataclass(frozen=True)
class DiskTrial:
    """Free bytes and write times [s] of the archives' folder; none if writing failed."""

    folder: str
    free: int
    seconds: tuple[float, ...] = ()
    error: str = ""


def disk_checks(folder: Path, trial: DiskTrial | None) -> list[DoctorCheck]:
    """Check free space and write time; `trial` is None if the disk did not respond."""
    if trial is None:
        message = f"the disk of {folder} does not respond"
        return [DoctorCheck("disk write", CheckStatus.BAD, message, (f"df -h {folder}", _MOVE))]
    hours = trial.free / (BYTES_PER_CYCLE * 3_600_000)
    status = CheckStatus.OK if hours >= 2 else CheckStatus.WARN if hours >= 0.5 else CheckStatus.BAD
    message = (
        f"{trial.free / 1e9:.1f} GB free at {trial.folder}: {hours:.1f} h of recording at 1 ms"
    )
    remedy = () if hours >= 2 else (f"du -xh {trial.folder} | sort -h | tail",)
    space = DoctorCheck("disk space", status, message, remedy)
    if not trial.seconds:
        refused = f"cannot write to {trial.folder}: {trial.error or 'no result'}"
        look = (f"ls -ld {trial.folder}; id", _MOVE)
        return [space, DoctorCheck("disk write", CheckStatus.BAD, refused, look)]
    worst = max(trial.seconds)
    middle = sorted(trial.seconds)[len(trial.seconds) // 2]
    status = (
        CheckStatus.OK
        if worst < _SLOW_WRITE_SECONDS
        else CheckStatus.WARN
        if worst < _MAX_WRITE_SECONDS
        else CheckStatus.BAD
    )
    message = f"64 KiB written in {1e3 * middle:.1f} ms, at most {1e3 * worst:.1f} ms"
    return [
        space,
        DoctorCheck("disk write", status, message, () if worst < _SLOW_WRITE_SECONDS else (_MOVE,)),
    ]


_ARPHRD_CAN = "280"


def can_check(bus: CanBus, system: System) -> DoctorCheck:
    """Check that a CAN interface is up at the bit rate of the cell; another one corrupts frames."""
    # An adapter is not opened here: on the bus it would acknowledge frames.
    name = f"CAN {bus.interface} {bus.channel}"
    if bus.interface != "socketcan":
        message = "not a kernel device; it is opened by the exchange only"
        return DoctorCheck(name, CheckStatus.UNKNOWN, message)
    folder = f"/sys/class/net/{bus.channel}"
    if system.text(f"{folder}/type") != _ARPHRD_CAN:
        look = ("ip -brief link show type can", "sudo modprobe can_raw   # and the card's driver")
        return DoctorCheck(name, CheckStatus.BAD, "is not a CAN interface", look)
    rates = f"bitrate {bus.bitrate or 1_000_000} dbitrate {bus.data_bitrate or 5_000_000} fd on"
    bring_up = f"sudo ip link set {bus.channel} up txqueuelen 100 type can {rates}"
    if system.text(f"{folder}/operstate") == "down":
        return DoctorCheck(name, CheckStatus.BAD, "down", (bring_up,))
    shown = system.ip("-details", "link", "show", bus.channel) or [{}]
    details = shown[0].get("linkinfo", {})
    if details.get("info_kind") == "vcan":
        return DoctorCheck(name, CheckStatus.OK, "virtual bus, no bit rate")
    timings = details.get("info_data", {})
    nominal, data = (timings.get(of, {}).get("bitrate") for of in ("bittiming", "data_bittiming"))
    if not nominal:
        remedy = (f"ip -details link show {bus.channel}",)
        return DoctorCheck(name, CheckStatus.UNKNOWN, "bit rate not stated", remedy)
    message = f"up, {nominal} bit/s" + (f", data {data} bit/s" if data else "")
    if nominal == (bus.bitrate or nominal) and data and data == (bus.data_bitrate or data):
        return DoctorCheck(name, CheckStatus.OK, message)
    down = f"sudo ip link set {bus.channel} down"
    return DoctorCheck(
        name, CheckStatus.BAD, f"{message}; the cell needs {rates}", (down, bring_up)
    )


def try_port(wanted: FreePort) -> int:
    """Bind the address, release it, and return the error number, 0 without one."""
    kind = socket.SOCK_DGRAM if wanted.protocol == "UDP" else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as trial:
        try:
            trial.bind((wanted.bind, wanted.port))
        except OSError as error:
            return error.errno or -1
    return 0


def port_check(wanted: FreePort, error: int) -> DoctorCheck:
    """Judge the error number of `try_port`."""
    bind = wanted.bind
    port = wanted.port
    name = f"{wanted.protocol} port {port}"
    if error == 0:
        return DoctorCheck(name, CheckStatus.OK, f"can be bound on {bind}")
    message = f"cannot be bound ({errno.errorcode.get(error, f'error {error}')})"
    remedy: tuple[str, ...] = ()
    if error == errno.EADDRINUSE:
        message = "in use by another program"
        remedy = (f"sudo ss -l{wanted.protocol[0].lower()}np sport = :{port}   # names it",)
    elif error == errno.EADDRNOTAVAIL:
        message = f"{bind} is not an address of this PC"
        remedy = ("ip -brief addr   # then set controller.bind in the cell file, or 0.0.0.0",)
    elif error in (errno.EACCES, errno.EPERM):
        message = "needs a privilege"
        setting = f"net.ipv4.ip_unprivileged_port_start={port}"
        remedy = (
            f"echo '{setting}' | sudo tee /etc/sysctl.d/90-hil.conf && sudo sysctl --system",
            "# once; hil then needs no privilege for this port",
        )
    return DoctorCheck(name, CheckStatus.BAD, message, remedy)


def _address_of(host: str, system: System) -> str | None:
    """Return an IPv4 address, also of a name in /etc/hosts; None otherwise. No DNS."""
    lines = [line.split("#")[0].split() for line in system.text("/etc/hosts").splitlines()]
    for text in (host, *(fields[0] for fields in lines if host in fields[1:])):
        try:
            return str(ipaddress.IPv4Address(text))
        except ValueError:
            continue
    return None


def route_check(host: str, system: System) -> DoctorCheck:
    """Check that the controller is reached directly: a router adds delay, or loses all packets."""
    name = "route to the controller"
    address = _address_of(host, system)
    if address is None:
        message = f"{host!r} is neither an IPv4 address nor in /etc/hosts"
        remedy = (f"# write an address in the cell file: host = 10.2.12.150, not {host}",)
        return DoctorCheck(name, CheckStatus.BAD, message, remedy)
    routes = system.ip("route", "get", address)
    if routes is None:
        return DoctorCheck(
            name, CheckStatus.UNKNOWN, "ip is not installed", ("sudo apt install iproute2",)
        )
    head, last = address.rsplit(".", 1)
    pc_address = f"{head}.{int(last) - 1 if int(last) > 1 else int(last) + 1}"
    add = f"sudo ip addr add {pc_address}/24 dev CARD   # CARD: the one cabled to the controller"
    if not routes:
        return DoctorCheck(name, CheckStatus.BAD, f"none to {address}", ("ip -brief link", add))
    route = routes[0]
    if route.get("type") == "local":
        message = f"{address} is this PC itself (a simulated controller)"
        return DoctorCheck(name, CheckStatus.OK, message)
    if "gateway" in route:
        message = f"over gateway {route['gateway']} on {route['dev']}"
        return DoctorCheck(name, CheckStatus.BAD, message, (add,))
    device = route.get("dev", "")
    if system.text(f"/sys/class/net/{device}/carrier") == "0":
        bring_up = (f"sudo ip link set {device} up", "# check the cable")
        return DoctorCheck(name, CheckStatus.BAD, f"{device} has no carrier", bring_up)
    return DoctorCheck(name, CheckStatus.OK, f"{address} directly on {device}")


def link_checks(link: TransportSpec | None, system: System) -> list[DoctorCheck]:
    """Check what a link needs of this PC; None without a cell, or with a simulated one."""
    if link is None:
        return [DoctorCheck("controller link", CheckStatus.OK, "none: no cell, or a simulated one")]
    if not link.needs:
        return [
            DoctorCheck("controller link", CheckStatus.UNKNOWN, f"not checked: {link.description}")
        ]
    return [_check_of(need, system) for need in link.needs]


def _check_of(need: Need, system: System) -> DoctorCheck:
    match need:
        case DirectRoute():
            return route_check(need.host, system)
        case FreePort():
            return port_check(need, try_port(need))
        case CanBus():
            return can_check(need, system)
        case RtdeServer():
            return rtde_check(need)


def rtde_check(server: RtdeServer) -> DoctorCheck:
    """Connect to a controller and ask for its version; nothing is claimed by that."""
    where = f"{server.host}:{server.port}"
    try:
        with closing(connected(server)) as connection:
            version = RtdeConnection(connection).version
    except TransportError as error:
        return DoctorCheck(
            "RTDE", CheckStatus.BAD, f"{where}: {error.reason}", (f"# {error.remedy}",)
        )
    except (DriverError, OSError) as error:
        remedy = "# make sure that this is the RTDE port (30004)"
        return DoctorCheck("RTDE", CheckStatus.BAD, f"{where}: {error}", (remedy,))
    facts = f"{where} replies: software {version}"
    if problem := version_problem(version):
        return DoctorCheck("RTDE", CheckStatus.WARN, f"{facts} (recorded only; {problem})")
    return DoctorCheck("RTDE", CheckStatus.OK, facts)
