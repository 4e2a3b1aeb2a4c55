"""The computer itself: clock, processor, kernel, load, Python."""

from __future__ import annotations

import getpass
import gzip
import os
import platform
import re
import resource
import sys
import sysconfig
import time
from dataclasses import dataclass
from pathlib import Path

from drivers.exchange.realtime import LIMITS_FILE, RealTimeReport, RealTimeSettings
from hil.archive.process import STALL_LIMIT

from .check import Check, Status, System

GROUP = "realtime"
RULE_FILE = "/etc/udev/rules.d/90-hil.rules"
_LOG_IN_AGAIN = "# log out and in again, then: ulimit -r; ulimit -l"


def user(uid: int | None = None) -> Check:
    """Who is asking: what root may do says nothing about the operator."""
    who = os.geteuid() if uid is None else uid
    why = "nothing of hil needs root, and what root may do says nothing about other users"
    if who != 0:
        return Check("user", Status.OK, f"{_name()}, not root", why)
    return Check(
        "user", Status.WARN, "root", why, ("# run hil doctor as the user who will run hil",)
    )


def scheduling(obtained: RealTimeReport | None, limit: int | None = None) -> Check:
    """Whether real-time priority was given to a process that asked for it."""
    allowed = _limit(resource.RLIMIT_RTPRIO) if limit is None else limit
    limited = "no limit" if allowed < 0 else f"rtprio limit {allowed}"
    why = "without it any other program may be served before the controller's packet"
    name = "real-time priority"
    if obtained is None:
        return Check(name, Status.UNKNOWN, f"the probe gave no answer; {limited}", why)
    if "FIFO" in obtained.scheduling.upper():
        return Check(name, Status.OK, f"{obtained.scheduling} given ({limited})", why)
    found = f"refused, its scheduling is {obtained.scheduling or 'ordinary'}; {limited}"
    remedy = _limit_lines("rtprio", "98")
    if 0 <= allowed < RealTimeSettings().priority:
        return Check(name, Status.BAD, found, why, remedy)
    throttled = "cat /proc/sys/kernel/sched_rt_runtime_us   # 0 forbids real-time programs"
    return Check(name, Status.BAD, found, why, (*remedy, throttled))


def memory_lock(obtained: RealTimeReport | None, limit: int | None = None) -> Check:
    """Whether memory may be locked in RAM."""
    allowed = _limit(resource.RLIMIT_MEMLOCK) if limit is None else limit
    limited = "no limit" if allowed < 0 else f"memlock limit {allowed // 1024} KiB"
    why = "a page that has to be fetched from disk costs many cycles"
    name = "memory lock"
    if obtained is None:
        return Check(name, Status.UNKNOWN, f"the probe gave no answer; {limited}", why)
    if obtained.memory_locked:
        return Check(name, Status.OK, f"given ({limited})", why)
    partly = any(sentence.startswith("only memory") for sentence in obtained.refused)
    found = f"{'only what is in use at the start' if partly else 'refused'}; {limited}"
    status = Status.WARN if partly else Status.BAD
    return Check(name, status, found, why, _limit_lines("memlock", "unlimited"))


def processor_awake(obtained: RealTimeReport | None, system: System) -> Check:
    """Whether /dev/cpu_dma_latency may be held at 0."""
    why = "halves the usual wake-up time; matters more than the programming language"
    name = "processor idle latency"
    if obtained is not None and obtained.cpu_awake:
        return Check(name, Status.OK, "/dev/cpu_dma_latency can be held at 0", why)
    if not system.path("/dev/cpu_dma_latency").exists():
        return Check(name, Status.UNKNOWN, "this kernel has no /dev/cpu_dma_latency", why)
    if obtained is None:
        return Check(name, Status.UNKNOWN, "the probe gave no answer", why)
    rule = f'KERNEL=="cpu_dma_latency", GROUP="{GROUP}", MODE="0660"'
    return Check(
        name,
        Status.WARN,
        "/dev/cpu_dma_latency may not be written",
        why,
        (
            _join(),
            f"echo '{rule}' | sudo tee {RULE_FILE}",
            "sudo udevadm control --reload && sudo udevadm trigger --name-match=cpu_dma_latency",
            "# log out and in again, then: ls -l /dev/cpu_dma_latency; groups",
        ),
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
        why = f"a motion is stopped if the disk keeps the archive waiting for {STALL_LIMIT:g} s"
        look = (f"df -h {place}", _MOVE)
        return [Check("disk", Status.BAD, f"no answer from the disk of {place}", why, look)]
    return [_room(trial), _write_time(trial)]


def _room(trial: DiskTrial) -> Check:
    hours = trial.free / (BYTES_PER_CYCLE * 3_600_000)
    return Check(
        "disk space",
        Status.OK if hours >= 2 else Status.WARN if hours >= 0.5 else Status.BAD,
        f"{trial.free / 1e9:.1f} GB free at {trial.folder}: {hours:.1f} h of recording at 1 ms",
        "a full disk ends the motion: the arm is stopped, what was archived stays whole",
        () if hours >= 2 else (f"du -xh {trial.folder} | sort -h | tail",),
    )


def _write_time(trial: DiskTrial) -> Check:
    name = "disk write"
    why = f"a motion is stopped if the disk keeps the archive waiting for {STALL_LIMIT:g} s"
    if not trial.seconds:
        found = f"cannot write to {trial.folder}: {trial.error or 'no figures'}"
        return Check(name, Status.BAD, found, why, (f"ls -ld {trial.folder}; id", _MOVE))
    worst, middle = max(trial.seconds), sorted(trial.seconds)[len(trial.seconds) // 2]
    found = f"64 KiB are safe after {1e3 * middle:.1f} ms, {1e3 * worst:.1f} ms at worst"
    status = Status.OK if worst < _SLOW else Status.WARN if worst < _TOO_SLOW else Status.BAD
    return Check(name, status, found, why, () if status is Status.OK else (_MOVE,))


_CPU = "/sys/devices/system/cpu"
_GOOD_CLOCKS = {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"}


def cpus(system: System) -> list[str]:
    """Names of the processors ("cpu0", ...)."""
    return [name for name in system.names(_CPU) if re.fullmatch(r"cpu\d+", name)]


def timer_resolution(resolution: float | None = None) -> Check:
    """Whether timers are finer than the scheduler's tick; `resolution` in s."""
    step = time.clock_getres(time.CLOCK_MONOTONIC) if resolution is None else resolution
    return Check(
        "timer resolution",
        Status.OK if step <= 1e-6 else Status.BAD,
        f"{step * 1e9:.0f} ns" if step < 1e-6 else f"{step * 1e3:g} ms",
        "time-outs of the exchange are fractions of a millisecond",
        () if step <= 1e-6 else ("cat /proc/cmdline   # remove highres=off, nohighres",),
    )


def clock_source(system: System) -> Check:
    """Whether reading the clock is cheap."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = system.text(f"{folder}/current_clocksource")
    why = "the clock is read several times a cycle; a slow one costs microseconds each time"
    if not source:
        return Check("clock source", Status.UNKNOWN, "not stated by the kernel", why)
    if source in _GOOD_CLOCKS:
        return Check("clock source", Status.OK, source, why)
    offered = (system.text(f"{folder}/available_clocksource") or "").split()
    remedy = f"echo tsc | sudo tee {folder}/current_clocksource" if "tsc" in offered else ""
    return Check("clock source", Status.WARN, source, why, (remedy,) if remedy else ())


def governor(system: System) -> Check:
    """Whether processors keep their full frequency."""
    found = {system.text(f"{_CPU}/{cpu}/cpufreq/scaling_governor") for cpu in cpus(system)}
    names = sorted(name for name in found if name)
    why = "a processor that clocks down answers its first packet late"
    if not names:
        return Check("frequency governor", Status.OK, "no frequency scaling on this machine", why)
    if names == ["performance"]:
        return Check("frequency governor", Status.OK, "performance", why)
    return Check(
        "frequency governor",
        Status.WARN,
        ", ".join(names),
        why,
        (f"echo performance | sudo tee {_CPU}/cpu*/cpufreq/scaling_governor",),
    )


def idle_states(system: System, *, no_sleep: bool) -> Check:
    """Exit latency of the deepest idle state in use; no matter if none is entered."""
    deepest, slowest = "", -1
    for cpu in cpus(system):
        for state in system.names(f"{_CPU}/{cpu}/cpuidle"):
            folder = f"{_CPU}/{cpu}/cpuidle/{state}"
            latency = system.number(f"{folder}/latency")
            if latency is None or system.number(f"{folder}/disable") == 1:
                continue
            if latency > slowest:
                deepest, slowest = system.text(f"{folder}/name") or state, latency
    why = "a sleeping processor has to wake before it can answer"
    if slowest < 0:
        driver = system.text(f"{_CPU}/cpuidle/current_driver")
        found = f"idle driver {driver}" if driver and driver != "none" else "none listed"
        return Check("idle states", Status.OK, found, why)
    found = f"deepest is {deepest}, {slowest} µs to wake"
    if no_sleep:
        return Check("idle states", Status.OK, f"{found}; not entered during an exchange", why)
    bad = slowest > 50
    remedy = "see 'processor idle latency': with that right, no idle state matters"
    return Check(
        "idle states", Status.WARN if bad else Status.OK, found, why, (f"# {remedy}",) * bad
    )


def isolation(system: System) -> Check:
    """Whether a processor is isolated from other programs."""
    isolated = system.text(f"{_CPU}/isolated")
    why = "other programs and interrupts stay off an isolated processor"
    if isolated:
        return Check("isolated processors", Status.OK, isolated, why)
    count = len(cpus(system))
    if count < 4:
        return Check(
            "isolated processors", Status.OK, f"none; with {count} there is none to spare", why
        )
    last = count - 1
    return Check(
        "isolated processors",
        Status.WARN,
        f"none of {count}",
        why + "; worth it only if the latency measured below is not good enough",
        (
            f"# add to GRUB_CMDLINE_LINUX_DEFAULT in /etc/default/grub: "
            f"isolcpus=managed_irq,domain,{last} nohz_full={last} rcu_nocbs={last}",
            "sudo update-grub && sudo reboot",
        ),
    )


def preemption(system: System) -> Check:
    """The kernel's preemption model."""
    why = "how long the kernel may finish its own work before it lets a waiting program run"
    version = system.text("/proc/version") or ""
    if "PREEMPT_RT" in version or system.text("/sys/kernel/realtime") == "1":
        return Check("kernel preemption", Status.OK, "PREEMPT_RT", why)
    model = _preemption_model(system)
    if model in ("full", "lazy"):
        return Check("kernel preemption", Status.OK, model, why)
    remedy = [
        "sudo apt install linux-image-rt-amd64   # Debian; Ubuntu: sudo pro enable realtime-kernel"
    ]
    if model is None:
        found = "not stated by the kernel"
        return Check("kernel preemption", Status.UNKNOWN, found, why, tuple(remedy))
    if "PREEMPT_DYNAMIC" in version:
        remedy.append("# or add preempt=full to GRUB_CMDLINE_LINUX_DEFAULT in /etc/default/grub:")
        remedy.append("sudo update-grub && sudo reboot")
    return Check("kernel preemption", Status.WARN, model, why, tuple(remedy))


def _preemption_model(system: System) -> str | None:
    """From the scheduler's own file (root), the command line, or how the kernel was built."""
    current = re.search(r"\((\w+)\)", system.text("/sys/kernel/debug/sched/preempt") or "")
    if current:
        return current[1]
    chosen = re.search(r"\bpreempt=(\w+)", system.text("/proc/cmdline") or "")
    if chosen:
        return chosen[1]
    config = _kernel_config(system)
    for option, model in (
        ("PREEMPT_NONE", "none"),
        ("PREEMPT_VOLUNTARY", "voluntary"),
        ("PREEMPT_LAZY", "lazy"),
        ("PREEMPT", "full"),
    ):
        if re.search(rf"^CONFIG_{option}=y$", config, re.MULTILINE):
            return model
    return None


def _kernel_config(system: System) -> str:
    try:
        with gzip.open(system.path("/proc/config.gz"), "rt", errors="replace") as file:
            return file.read()
    except (OSError, EOFError):
        pass
    release = system.text("/proc/sys/kernel/osrelease") or ""
    return system.text(f"/boot/config-{release}") or ""


def virtualisation(system: System) -> Check:
    """Whether another operating system stands between this one and the hardware."""
    why = "the host may stop a virtual machine for milliseconds, and no program in it can tell"
    flags = re.search(r"^flags\s*:(.*)$", system.text("/proc/cpuinfo") or "", re.MULTILINE)
    product = system.text("/sys/class/dmi/id/product_name") or ""
    virtual = (flags is not None and "hypervisor" in flags[1].split()) or bool(
        re.search(r"\b(KVM|QEMU|VirtualBox|VMware|Virtual Machine)\b", product, re.IGNORECASE)
    )
    if not virtual:
        return Check("virtual machine", Status.OK, "no sign of one", why)
    share = stolen_share(system.text("/proc/stat") or "")
    found = "yes" if share is None else f"yes; {100 * share:.2f} % of its time stolen since boot"
    advice = ("# for simulated controllers only; run an arm from a PC of its own",)
    return Check("virtual machine", Status.WARN, found, why, advice)


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
    name, why = "stolen time while measuring", "time in which a virtual machine did not run at all"
    if share is None:
        return Check(name, Status.UNKNOWN, "not stated by the kernel", why)
    status = Status.OK if share < 1e-4 else Status.WARN
    remedy = () if share < 1e-4 else ("# ask for dedicated processors, or use a PC of its own",)
    return Check(name, status, f"{100 * share:.2f} %", why, remedy)


def load(system: System) -> Check:
    """What else is running."""
    why = "real-time priority goes before other programs, but not before their interrupts and disk"
    try:
        minute = float((system.text("/proc/loadavg") or "").split()[0])
    except (IndexError, ValueError):
        return Check("other load", Status.UNKNOWN, "not stated by the kernel", why, ("uptime",))
    count = max(len(cpus(system)), 1)
    found = f"{minute:g} waiting or running over the last minute, {count} processors"
    if minute <= 0.5 * count:
        return Check("other load", Status.OK, found, why)
    return Check("other load", Status.WARN, found, why, ("top   # and end what is not needed",))


def python() -> Check:
    """The interpreter."""
    built = platform.python_version()
    debug = bool(sysconfig.get_config_var("Py_DEBUG"))
    found = f"{platform.python_implementation()} {built}{', debug build' if debug else ''}"
    fit = not debug and sys.implementation.name == "cpython"
    return Check(
        "Python",
        Status.OK if fit else Status.WARN,
        found,
        "figures hold for the release build of CPython",
    )
