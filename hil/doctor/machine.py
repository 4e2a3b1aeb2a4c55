"""The computer itself: permissions, disk, clock, processor, kernel, load."""

from __future__ import annotations

import getpass
import gzip
import os
import re
import resource
from dataclasses import dataclass
from pathlib import Path

from drivers.exchange.realtime import LIMITS_FILE, RealTimeReport, RealTimeSettings
from hil.archive.process import STALL_LIMIT

from .check import Check, System, bad, ok, unknown, warn

GROUP = "realtime"
RULE_FILE = "/etc/udev/rules.d/90-hil.rules"
_LOG_IN_AGAIN = "# log out and in again, then: ulimit -r; ulimit -l"


def permissions(given: RealTimeReport | None, system: System) -> list[Check]:
    """What the operating system allows; `given` is None where the probe failed."""
    return [
        user(os.geteuid()),
        scheduling(given, _limit(resource.RLIMIT_RTPRIO)),
        memory_lock(given, _limit(resource.RLIMIT_MEMLOCK)),
        processor_awake(given, system),
    ]


def user(uid: int) -> Check:
    """Who is asking: what root may do says nothing about the operator."""
    if uid:
        return ok("user", f"{_name()}, not root")
    return warn("user", "root", "# run hil doctor as the user who will run hil")


def scheduling(given: RealTimeReport | None, limit: int) -> Check:
    """Whether real-time priority was given to a process that asked for it; limit -1 for none."""
    limited = "no limit" if limit < 0 else f"rtprio limit {limit}"
    if given is None:
        return unknown("real-time priority", f"the probe gave no answer; {limited}")
    if "FIFO" in given.scheduling.upper():
        return ok("real-time priority", f"{given.scheduling} given ({limited})")
    found = f"refused, its scheduling is {given.scheduling or 'ordinary'}; {limited}"
    throttled = "cat /proc/sys/kernel/sched_rt_runtime_us   # 0 forbids real-time programs"
    too_low = 0 <= limit < RealTimeSettings().priority
    return bad(
        "real-time priority",
        found,
        *_limit_lines("rtprio", "98"),
        *([] if too_low else [throttled]),
    )


def memory_lock(given: RealTimeReport | None, limit: int) -> Check:
    """Whether memory may be locked in RAM; limit in bytes, -1 for none."""
    limited = "no limit" if limit < 0 else f"memlock limit {limit // 1024} KiB"
    if given is None:
        return unknown("memory lock", f"the probe gave no answer; {limited}")
    if given.memory_locked:
        return ok("memory lock", f"given ({limited})")
    remedy = _limit_lines("memlock", "unlimited")
    if any(sentence.startswith("only memory") for sentence in given.refused):
        return warn("memory lock", f"only what is in use at the start; {limited}", *remedy)
    return bad("memory lock", f"refused; {limited}", *remedy)


def processor_awake(given: RealTimeReport | None, system: System) -> Check:
    """Whether /dev/cpu_dma_latency may be held at 0."""
    if given is not None and given.cpu_awake:
        return ok("processor idle latency", "/dev/cpu_dma_latency can be held at 0")
    if not system.path("/dev/cpu_dma_latency").exists():
        return unknown("processor idle latency", "this kernel has no /dev/cpu_dma_latency")
    if given is None:
        return unknown("processor idle latency", "the probe gave no answer")
    rule = f'KERNEL=="cpu_dma_latency", GROUP="{GROUP}", MODE="0660"'
    return warn(
        "processor idle latency",
        "/dev/cpu_dma_latency may not be written",
        _join(),
        f"echo '{rule}' | sudo tee {RULE_FILE}",
        "sudo udevadm control --reload && sudo udevadm trigger --name-match=cpu_dma_latency",
        "# log out and in again, then: ls -l /dev/cpu_dma_latency; groups",
    )


def _limit_lines(item: str, value: str) -> tuple[str, ...]:
    line = f"echo '@{GROUP} - {item} {value}' | sudo tee -a {LIMITS_FILE}"
    return (_join(), line, _LOG_IN_AGAIN)


def _join() -> str:
    return f"sudo groupadd -f {GROUP} && sudo usermod -aG {GROUP} {_name()}"


def _limit(limit: int) -> int:
    """The limit in force; -1 for none."""
    return resource.getrlimit(limit)[0]


def _name() -> str:
    try:
        return os.environ.get("SUDO_USER") or getpass.getuser()
    except (OSError, KeyError):
        return str(os.getuid())


BYTES_PER_CYCLE = 400
"""Archived bytes per cycle of six axes, generously."""
_SLOW, _TOO_SLOW = 0.1 * STALL_LIMIT, 0.5 * STALL_LIMIT
"""s of one write."""
_MOVE = "# or put the campaign folder on another, local disk"


@dataclass(frozen=True)
class DiskTrial:
    """What came of writing to the place of the archives.

    Attributes:
        folder: where it was tried.
        free: bytes.
        seconds: of each write, empty if writing failed.
        error: why it failed.
    """

    folder: str
    free: int
    seconds: tuple[float, ...] = ()
    error: str = ""


def disk_checks(place: Path, trial: DiskTrial | None) -> list[Check]:
    """Room and write time; None stands for a disk that gave no answer in time."""
    if trial is None:
        return [bad("disk", f"no answer from the disk of {place}", f"df -h {place}", _MOVE)]
    hours = trial.free / (BYTES_PER_CYCLE * 3_600_000)
    found = f"{trial.free / 1e9:.1f} GB free at {trial.folder}: {hours:.1f} h of recording at 1 ms"
    look = f"du -xh {trial.folder} | sort -h | tail"
    poor = warn if hours >= 0.5 else bad
    room = ok("disk space", found) if hours >= 2 else poor(found, look)
    if not trial.seconds:
        refused = f"cannot write to {trial.folder}: {trial.error or 'no figures'}"
        return [room, bad("disk write", refused, f"ls -ld {trial.folder}; id", _MOVE)]
    worst, middle = max(trial.seconds), sorted(trial.seconds)[len(trial.seconds) // 2]
    found = f"64 KiB are safe after {1e3 * middle:.1f} ms, {1e3 * worst:.1f} ms at worst"
    if worst < _SLOW:
        return [room, ok("disk write", found)]
    return [room, (warn if worst < _TOO_SLOW else bad)("disk write", found, _MOVE)]


_CPU = "/sys/devices/system/cpu"
_GOOD_CLOCKS = {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"}
_UNSTATED = "not stated by the kernel"


def computer(system: System, *, no_sleep: bool) -> list[Check]:
    """The processor, the kernel and what lies below them.

    Args:
        system: the computer.
        no_sleep: whether an exchange keeps the processor from idle states.
    """
    return [
        clock_source(system),
        governor(system),
        idle_states(system, no_sleep=no_sleep),
        isolation(system),
        preemption(system),
        virtualisation(system),
    ]


def cpus(system: System) -> list[str]:
    """Names of the processors ("cpu0", ...)."""
    return [name for name in system.names(_CPU) if re.fullmatch(r"cpu\d+", name)]


def clock_source(system: System) -> Check:
    """Whether reading the clock is cheap."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = system.text(f"{folder}/current_clocksource")
    if not source:
        return unknown("clock source", _UNSTATED)
    if source in _GOOD_CLOCKS:
        return ok("clock source", source)
    offered = (system.text(f"{folder}/available_clocksource") or "").split()
    remedy = [f"echo tsc | sudo tee {folder}/current_clocksource"] if "tsc" in offered else []
    return warn("clock source", source, *remedy)


def governor(system: System) -> Check:
    """Whether processors keep their full frequency."""
    found = {system.text(f"{_CPU}/{cpu}/cpufreq/scaling_governor") for cpu in cpus(system)}
    names = sorted(name for name in found if name)
    if not names:
        return ok("frequency governor", "no frequency scaling on this machine")
    if names == ["performance"]:
        return ok("frequency governor", "performance")
    setting = f"echo performance | sudo tee {_CPU}/cpu*/cpufreq/scaling_governor"
    return warn("frequency governor", ", ".join(names), setting)


def idle_states(system: System, *, no_sleep: bool) -> Check:
    """Exit latency of the deepest idle state in use; no matter if none is entered."""
    folders = [
        f"{_CPU}/{cpu}/cpuidle/{state}"
        for cpu in cpus(system)
        for state in system.names(f"{_CPU}/{cpu}/cpuidle")
    ]
    latencies = {
        folder: latency
        for folder in folders
        if (latency := system.number(f"{folder}/latency")) is not None
        and latency >= 0
        and system.number(f"{folder}/disable") != 1
    }
    if not latencies:
        driver = system.text(f"{_CPU}/cpuidle/current_driver")
        return ok(
            "idle states",
            f"idle driver {driver}" if driver not in (None, "none") else "none listed",
        )
    deepest = max(latencies, key=lambda folder: latencies[folder])
    name = system.text(f"{deepest}/name") or deepest.rpartition("/")[2]
    found = f"deepest is {name}, {latencies[deepest]} µs to wake"
    if no_sleep:
        return ok("idle states", f"{found}; not entered during an exchange")
    if latencies[deepest] <= 50:
        return ok("idle states", found)
    remedy = "# see 'processor idle latency': with that right, no idle state matters"
    return warn("idle states", found, remedy)


def isolation(system: System) -> Check:
    """Whether a processor is isolated from other programs."""
    if names := system.text(f"{_CPU}/isolated"):
        return ok("isolated processors", names)
    count = len(cpus(system))
    if count < 4:
        return ok("isolated processors", f"none; with {count} there is none to spare")
    last = count - 1
    return warn(
        "isolated processors",
        f"none of {count}",
        f"# add to GRUB_CMDLINE_LINUX_DEFAULT in /etc/default/grub: "
        f"isolcpus=managed_irq,domain,{last} nohz_full={last} rcu_nocbs={last}",
        "sudo update-grub && sudo reboot",
    )


def preemption(system: System) -> Check:
    """The kernel's preemption model."""
    version = system.text("/proc/version") or ""
    if "PREEMPT_RT" in version or system.text("/sys/kernel/realtime") == "1":
        return ok("kernel preemption", "PREEMPT_RT")
    model = _preemption_model(system)
    if model in ("full", "lazy"):
        return ok("kernel preemption", model)
    install = (
        "sudo apt install linux-image-rt-amd64   # Debian; Ubuntu: sudo pro enable realtime-kernel"
    )
    if model is None:
        return unknown("kernel preemption", _UNSTATED, install)
    if "PREEMPT_DYNAMIC" not in version:
        return warn("kernel preemption", model, install)
    return warn(
        "kernel preemption",
        model,
        install,
        "# or add preempt=full to GRUB_CMDLINE_LINUX_DEFAULT in /etc/default/grub:",
        "sudo update-grub && sudo reboot",
    )


def _preemption_model(system: System) -> str | None:
    """From the scheduler's own file (root), the command line, or how the kernel was built."""
    for pattern, name in (
        (r"\((\w+)\)", "/sys/kernel/debug/sched/preempt"),
        (r"\bpreempt=(\w+)", "/proc/cmdline"),
    ):
        if stated := re.search(pattern, system.text(name) or ""):
            return stated[1]
    try:
        with gzip.open(system.path("/proc/config.gz"), "rt", errors="replace") as file:
            config = file.read()
    except (OSError, EOFError):
        release = system.text("/proc/sys/kernel/osrelease") or ""
        config = system.text(f"/boot/config-{release}") or ""
    for option, model in (
        ("PREEMPT_NONE", "none"),
        ("PREEMPT_VOLUNTARY", "voluntary"),
        ("PREEMPT_LAZY", "lazy"),
        ("PREEMPT", "full"),
    ):
        if re.search(rf"^CONFIG_{option}=y$", config, re.MULTILINE):
            return model
    return None


def virtualisation(system: System) -> Check:
    """Whether another operating system runs between this one and the hardware."""
    flags = re.search(r"^flags\s*:(.*)$", system.text("/proc/cpuinfo") or "", re.MULTILINE)
    product = system.text("/sys/class/dmi/id/product_name") or ""
    makers = r"\b(KVM|QEMU|VirtualBox|VMware|Virtual Machine)\b"
    if not (flags and "hypervisor" in flags[1].split()) and not re.search(
        makers, product, re.IGNORECASE
    ):
        return ok("virtual machine", "no sign of one")
    share = stolen_share(system.text("/proc/stat") or "")
    found = "yes" if share is None else f"yes; {100 * share:.2f} % of its time stolen since boot"
    return warn(
        "virtual machine",
        found,
        "# for simulated controllers only; run an arm from a PC of its own",
    )


def stolen_share(stat: str, since: str = "") -> float | None:
    """Share of processor time that the host gave to others, from texts of /proc/stat.

    Args:
        stat: the text now.
        since: an earlier one; since boot if left out.
    """
    now, before = _ticks(stat), _ticks(since) or [0] * 8
    if now is None:
        return None
    spent = [late - early for late, early in zip(now, before, strict=True)]
    return spent[7] / sum(spent) if sum(spent) > 0 else None


def _ticks(stat: str) -> list[int] | None:
    line = re.search(r"^cpu +((?:\d+ +){7}\d+)", stat, re.MULTILINE)
    return None if line is None else [int(word) for word in line[1].split()]


def stolen(before: str, after: str) -> Check:
    """How much processor time the host gave to others during the measurement."""
    share = stolen_share(after, before)
    if share is None:
        return unknown("stolen time while measuring", _UNSTATED)
    found = f"{100 * share:.2f} %"
    if share < 1e-4:
        return ok("stolen time while measuring", found)
    return warn(
        "stolen time while measuring",
        found,
        "# ask for dedicated processors, or use a PC of its own",
    )


def load(system: System) -> Check:
    """What else is running."""
    try:
        minute = float((system.text("/proc/loadavg") or "").split()[0])
    except (IndexError, ValueError):
        return unknown("other load", _UNSTATED, "uptime")
    count = max(len(cpus(system)), 1)
    found = f"{minute:g} waiting or running over the last minute, {count} processors"
    if minute <= 0.5 * count:
        return ok("other load", found)
    return warn("other load", found, "top   # and end what is not needed")
