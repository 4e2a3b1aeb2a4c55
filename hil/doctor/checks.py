"""Checks of this PC: permissions, processor, disk, and the link to the controller."""

from __future__ import annotations

import ipaddress
import json
import resource
import shutil
import socket
import subprocess
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.errors import DriverError
from drivers.exchange.realtime import RealTimeReport
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
from hil.doctor.findings import (
    CanInterface,
    CanState,
    CheckStatus,
    DiskRefused,
    DiskSilent,
    DiskSpace,
    DoctorCheck,
    Governors,
    IdleStates,
    LockedMemory,
    MemoryLock,
    NoLink,
    Port,
    ProbeFailed,
    Route,
    RouteState,
    RtdeReply,
    RtdeSilent,
    Scheduling,
    UncheckedLink,
    WriteTimes,
)

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


def scheduling(given: RealTimeReport, limit: int) -> DoctorCheck:
    """Check the priority of a real-time process, and the limit RLIMIT_RTPRIO of this one."""
    found = Scheduling(given.scheduling, limit)
    return DoctorCheck(CheckStatus.OK if found.is_real_time else CheckStatus.BAD, found)


def memory_lock(given: RealTimeReport, limit: int) -> DoctorCheck:
    """Check whether memory can be locked, and the limit RLIMIT_MEMLOCK: page faults cost cycles."""
    status, extent = CheckStatus.BAD, LockedMemory.NONE
    if given.memory_locked:
        status, extent = CheckStatus.OK, LockedMemory.ALL
    elif given.memory_in_use_locked:
        status, extent = CheckStatus.WARN, LockedMemory.IN_USE_AT_START
    return DoctorCheck(status, MemoryLock(extent, limit))


_CPU = "/sys/devices/system/cpu"


def governor(system: System) -> DoctorCheck:
    """Check that the processors are not slowed down."""
    governors = {*system.texts(f"{_CPU}/cpu[0-9]*/cpufreq/scaling_governor").values()} - {""}
    status = CheckStatus.OK if governors <= {"performance"} else CheckStatus.WARN
    return DoctorCheck(status, Governors(tuple(sorted(governors))))


def idle_states(*, cpu_awake: bool) -> DoctorCheck:
    """Check that an exchange can exclude the idle states, by /dev/cpu_dma_latency."""
    status = CheckStatus.OK if cpu_awake else CheckStatus.WARN
    return DoctorCheck(status, IdleStates(excluded=cpu_awake))


def computer_checks(given: RealTimeReport | None, system: System) -> list[DoctorCheck]:
    """Check permissions and processor; `given` is None if the probe failed."""
    if given is None:
        rights = [DoctorCheck(CheckStatus.BAD, ProbeFailed("permissions"))]
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
_ENOUGH_HOURS = 2.0
_MIN_HOURS = 0.5
"""Hours of recording for which the disk has space: enough, and the least that is tolerated."""


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
        return [DoctorCheck(CheckStatus.BAD, DiskSilent(str(folder)))]
    hours = trial.free / (BYTES_PER_CYCLE * 3_600_000)
    status = CheckStatus.OK if hours >= _ENOUGH_HOURS else CheckStatus.WARN
    if hours < _MIN_HOURS:
        status = CheckStatus.BAD
    space = DoctorCheck(status, DiskSpace(trial.folder, trial.free, hours))
    if not trial.seconds:
        return [space, DoctorCheck(CheckStatus.BAD, DiskRefused(trial.folder, trial.error))]
    longest = max(trial.seconds)
    middle = sorted(trial.seconds)[len(trial.seconds) // 2]
    status = CheckStatus.WARN if longest >= _SLOW_WRITE_SECONDS else CheckStatus.OK
    if longest >= _MAX_WRITE_SECONDS:
        status = CheckStatus.BAD
    return [space, DoctorCheck(status, WriteTimes(middle, longest))]


_ARPHRD_CAN = "280"


def can_check(bus: CanBus, system: System) -> DoctorCheck:
    """Check that a CAN interface is up at the bit rate of the cell; another one corrupts frames."""
    # An adapter is not opened here: on the bus it would acknowledge frames.
    if bus.interface != "socketcan":
        return DoctorCheck(CheckStatus.UNKNOWN, CanInterface(bus, CanState.NOT_EXAMINED))
    folder = f"/sys/class/net/{bus.channel}"
    if system.text(f"{folder}/type") != _ARPHRD_CAN:
        return DoctorCheck(CheckStatus.BAD, CanInterface(bus, CanState.NO_INTERFACE))
    if system.text(f"{folder}/operstate") == "down":
        return DoctorCheck(CheckStatus.BAD, CanInterface(bus, CanState.DOWN))
    shown = system.ip("-details", "link", "show", bus.channel) or [{}]
    details = shown[0].get("linkinfo", {})
    if details.get("info_kind") == "vcan":
        return DoctorCheck(CheckStatus.OK, CanInterface(bus, CanState.VIRTUAL))
    timings = details.get("info_data", {})
    rate, data = (timings.get(of, {}).get("bitrate") for of in ("bittiming", "data_bittiming"))
    if not rate:
        return DoctorCheck(CheckStatus.UNKNOWN, CanInterface(bus, CanState.UNSTATED))
    if rate == (bus.bitrate or rate) and data and data == (bus.data_bitrate or data):
        return DoctorCheck(CheckStatus.OK, CanInterface(bus, CanState.AS_WANTED, rate, data))
    return DoctorCheck(CheckStatus.BAD, CanInterface(bus, CanState.OTHER_RATES, rate, data))


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
    return DoctorCheck(CheckStatus.BAD if error else CheckStatus.OK, Port(wanted, error))


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
    address = _address_of(host, system)
    if address is None:
        return DoctorCheck(CheckStatus.BAD, Route(host, RouteState.UNKNOWN_HOST))
    routes = system.ip("route", "get", address)
    if routes is None:
        return DoctorCheck(CheckStatus.UNKNOWN, Route(host, RouteState.NO_TOOL))
    if not routes:
        return DoctorCheck(CheckStatus.BAD, Route(host, RouteState.NONE, address))
    (route, *_) = routes
    device = route.get("dev", "")
    if route.get("type") == "local":
        return DoctorCheck(CheckStatus.OK, Route(host, RouteState.LOCAL, address))
    if "gateway" in route:
        found = Route(host, RouteState.GATEWAY, address, device, route["gateway"])
        return DoctorCheck(CheckStatus.BAD, found)
    if system.text(f"/sys/class/net/{device}/carrier") == "0":
        return DoctorCheck(CheckStatus.BAD, Route(host, RouteState.NO_CARRIER, address, device))
    return DoctorCheck(CheckStatus.OK, Route(host, RouteState.DIRECT, address, device))


def link_checks(link: TransportSpec | None, system: System) -> list[DoctorCheck]:
    """Check what a link needs of this PC; None without a cell, or with a simulated one."""
    if link is None:
        return [DoctorCheck(CheckStatus.OK, NoLink())]
    if not link.needs:
        return [DoctorCheck(CheckStatus.UNKNOWN, UncheckedLink(link.description))]
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
        return DoctorCheck(CheckStatus.BAD, RtdeSilent(where, error.reason, error.remedy))
    except (DriverError, OSError) as error:
        return DoctorCheck(CheckStatus.BAD, RtdeSilent(where, str(error)))
    if problem := version_problem(version):
        return DoctorCheck(CheckStatus.WARN, RtdeReply(where, str(version), problem))
    return DoctorCheck(CheckStatus.OK, RtdeReply(where, str(version)))
