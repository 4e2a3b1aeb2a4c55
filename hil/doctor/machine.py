"""Checks of the computer: permissions, disk, clock, processor, kernel, load."""

from __future__ import annotations

import gzip
import os
import re
import resource
from dataclasses import dataclass
from pathlib import Path

from drivers.exchange.realtime import LIMITS_FILE, RealTimeReport, RealTimeSettings
from hil.archive.process import STALL_LIMIT

from .check import Check, System, bad, named, ok, unknown, warn

GROUP = "realtime"
RULE_FILE = "/etc/udev/rules.d/90-hil.rules"
_JOIN = f'sudo groupadd -f {GROUP} && sudo usermod -aG {GROUP} "$USER"'
_LOG_IN_AGAIN = "# log out and in again, then: ulimit -r; ulimit -l"


def permissions(given: RealTimeReport | None, system: System) -> list[Check]:
    """Check permissions; `given` is None if the probe failed."""
    return [
        user(os.geteuid()),
        scheduling(given, resource.getrlimit(resource.RLIMIT_RTPRIO)[0]),
        memory_lock(given, resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]),
        processor_awake(given, system),
    ]


@named("user")
def user(uid: int) -> Check:
    """Hil does not need root, and the permissions of root are not those of other users."""
    if uid:
        return ok(f"number {uid}, not root")
    return warn("root", "# run hil doctor as the user who will run hil")


@named("real-time priority")
def scheduling(given: RealTimeReport | None, limit: int) -> Check:
    """Without it other programs delay replies."""
    limited = "no limit" if limit < 0 else f"rtprio limit {limit}"
    if given is None:
        return unknown(f"the probe gave no answer; {limited}")
    if "FIFO" in given.scheduling.upper():
        return ok(f"{given.scheduling} given ({limited})")
    found = f"refused, its scheduling is {given.scheduling or 'ordinary'}; {limited}"
    remedy = _limit_lines("rtprio", "98")
    if not 0 <= limit < RealTimeSettings().priority:
        remedy += ("cat /proc/sys/kernel/sched_rt_runtime_us   # 0 forbids real-time programs",)
    return bad(found, *remedy)


@named("memory lock")
def memory_lock(given: RealTimeReport | None, limit: int) -> Check:
    """A page fault costs many cycles."""
    limited = "no limit" if limit < 0 else f"memlock limit {limit // 1024} KiB"
    if given is None:
        return unknown(f"the probe gave no answer; {limited}")
    if given.memory_locked:
        return ok(f"given ({limited})")
    remedy = _limit_lines("memlock", "unlimited")
    if any(sentence.startswith("only memory") for sentence in given.refused):
        return warn(f"only what is in use at the start; {limited}", *remedy)
    return bad(f"refused; {limited}", *remedy)


@named("processor idle latency")
def processor_awake(given: RealTimeReport | None, system: System) -> Check:
    """Excluding idle states halves the usual wake-up time."""
    if given is not None and given.cpu_awake:
        return ok("/dev/cpu_dma_latency can be held at 0")
    if not system.path("/dev/cpu_dma_latency").exists():
        return unknown("this kernel has no /dev/cpu_dma_latency")
    if given is None:
        return unknown("the probe gave no answer")
    rule = f'KERNEL=="cpu_dma_latency", GROUP="{GROUP}", MODE="0660"'
    return warn(
        "/dev/cpu_dma_latency may not be written",
        _JOIN,
        f"echo '{rule}' | sudo tee {RULE_FILE}",
        "sudo udevadm control --reload && sudo udevadm trigger --name-match=cpu_dma_latency",
        "# log out and in again, then: ls -l /dev/cpu_dma_latency; groups",
    )


def _limit_lines(item: str, value: str) -> tuple[str, ...]:
    line = f"echo '@{GROUP} - {item} {value}' | sudo tee -a {LIMITS_FILE}"
    return (_JOIN, line, _LOG_IN_AGAIN)


BYTES_PER_CYCLE = 400
"""Upper bound of the archived bytes per cycle of six axes."""
_SLOW, _TOO_SLOW = 0.1 * STALL_LIMIT, 0.5 * STALL_LIMIT
"""Limits of the time of one write, s."""
_MOVE = "# or put the campaign folder on another, local disk"


@dataclass(frozen=True)
class DiskTrial:
    """Free bytes and write times [s] of the archives' folder; none if writing failed."""

    folder: str
    free: int
    seconds: tuple[float, ...] = ()
    error: str = ""


def disk_checks(place: Path, trial: DiskTrial | None) -> list[Check]:
    """Check free space and write time; `trial` is None if the disk did not respond."""
    return [*([] if trial is None else [disk_space(trial)]), disk_write(place, trial)]


@named("disk space")
def disk_space(trial: DiskTrial) -> Check:
    """A full disk stops the motion; what was archived is complete."""
    hours = trial.free / (BYTES_PER_CYCLE * 3_600_000)
    found = f"{trial.free / 1e9:.1f} GB free at {trial.folder}: {hours:.1f} h of recording at 1 ms"
    if hours >= 2:
        return ok(found)
    return (warn if hours >= 0.5 else bad)(found, f"du -xh {trial.folder} | sort -h | tail")


@named("disk write")
def disk_write(place: Path, trial: DiskTrial | None) -> Check:
    """A motion is stopped if a write takes several seconds."""
    if trial is None:
        return bad(f"the disk of {place} does not respond", f"df -h {place}", _MOVE)
    if not trial.seconds:
        refused = f"cannot write to {trial.folder}: {trial.error or 'no result'}"
        return bad(refused, f"ls -ld {trial.folder}; id", _MOVE)
    worst, middle = max(trial.seconds), sorted(trial.seconds)[len(trial.seconds) // 2]
    found = f"64 KiB written in {1e3 * middle:.1f} ms, at most {1e3 * worst:.1f} ms"
    return ok(found) if worst < _SLOW else (warn if worst < _TOO_SLOW else bad)(found, _MOVE)


_CPU = "/sys/devices/system/cpu"
_GOOD_CLOCKS = {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"}
_UNSTATED = "not reported by the kernel"


def computer(system: System, *, no_sleep: bool) -> list[Check]:
    """Check processor, kernel and host; `no_sleep`: an exchange prevents idle states."""
    return [
        clock_source(system),
        governor(system),
        idle_states(system, no_sleep=no_sleep),
        isolation(system),
        preemption(system),
        virtualisation(system),
    ]


def cpus(system: System) -> list[str]:
    """Return the names of the processors ("cpu0", ...)."""
    return [name for name in system.names(_CPU) if re.fullmatch(r"cpu\d+", name)]


@named("clock source")
def clock_source(system: System) -> Check:
    """The clock is read several times a cycle; a slow source costs µs each time."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = system.text(f"{folder}/current_clocksource")
    if not source:
        return unknown(_UNSTATED)
    if source in _GOOD_CLOCKS:
        return ok(source)
    offered = (system.text(f"{folder}/available_clocksource") or "").split()
    remedy = [f"echo tsc | sudo tee {folder}/current_clocksource"] if "tsc" in offered else []
    return warn(source, *remedy)


@named("frequency governor")
def governor(system: System) -> Check:
    """A processor at reduced frequency replies late."""
    found = {system.text(f"{_CPU}/{cpu}/cpufreq/scaling_governor") for cpu in cpus(system)}
    names = sorted(filter(None, found))
    if names in ([], ["performance"]):
        return ok("".join(names) or "no frequency scaling on this machine")
    setting = f"echo performance | sudo tee {_CPU}/cpu*/cpufreq/scaling_governor"
    return warn(", ".join(names), setting)


@named("idle states")
def idle_states(system: System, *, no_sleep: bool) -> Check:
    """A processor in an idle state has to wake before it can reply."""
    latencies = {}
    for cpu in cpus(system):
        for state in system.names(f"{_CPU}/{cpu}/cpuidle"):
            folder = f"{_CPU}/{cpu}/cpuidle/{state}"
            latency = system.number(f"{folder}/latency")
            if latency is not None and latency >= 0 and system.number(f"{folder}/disable") != 1:
                latencies[folder] = latency
    if not latencies:
        driver = system.text(f"{_CPU}/cpuidle/current_driver")
        return ok(f"idle driver {driver}" if driver not in (None, "none") else "none listed")
    deepest = max(latencies, key=lambda folder: latencies[folder])
    name = system.text(f"{deepest}/name") or deepest.rpartition("/")[2]
    found = f"deepest is {name}, {latencies[deepest]} µs to wake"
    if no_sleep:
        return ok(f"{found}; not entered during an exchange")
    if latencies[deepest] <= 50:
        return ok(found)
    return warn(
        found, "# see 'processor idle latency': with that permission idle states are not entered"
    )


@named("isolated processors")
def isolation(system: System) -> Check:
    """No other program runs on an isolated processor; of use only if the latency is too large."""
    if names := system.text(f"{_CPU}/isolated"):
        return ok(names)
    count = len(cpus(system))
    last = count - 1
    if count < 4:
        return ok(f"none; not useful with {count}")
    return warn(
        f"none of {count}",
        f"# add to GRUB_CMDLINE_LINUX_DEFAULT in /etc/default/grub: "
        f"isolcpus=managed_irq,domain,{last} nohz_full={last} rcu_nocbs={last}",
        "sudo update-grub && sudo reboot",
    )


@named("kernel preemption")
def preemption(system: System) -> Check:
    """Without it the kernel completes its own work before a waiting program runs."""
    version = system.text("/proc/version") or ""
    if "PREEMPT_RT" in version or system.text("/sys/kernel/realtime") == "1":
        return ok("PREEMPT_RT")
    model = _preemption_model(system)
    if model in ("full", "lazy"):
        return ok(model)
    remedy = [
        "sudo apt install linux-image-rt-amd64   # Debian; Ubuntu: sudo pro enable realtime-kernel"
    ]
    if model is None:
        return unknown(_UNSTATED, *remedy)
    if "PREEMPT_DYNAMIC" in version:
        remedy += [
            "# or add preempt=full to GRUB_CMDLINE_LINUX_DEFAULT in /etc/default/grub:",
            "sudo update-grub && sudo reboot",
        ]
    return warn(model, *remedy)


def _preemption_model(system: System) -> str | None:
    """Read the model from the scheduler (root), the command line, or the build configuration."""
    release = system.text("/proc/sys/kernel/osrelease") or ""
    try:
        with gzip.open(system.path("/proc/config.gz"), "rt", errors="replace") as file:
            config = file.read()
    except (OSError, EOFError):
        config = system.text(f"/boot/config-{release}") or ""
    for pattern, text in (
        (r"\((\w+)\)", system.text("/sys/kernel/debug/sched/preempt") or ""),
        (r"\bpreempt=(\w+)", system.text("/proc/cmdline") or ""),
        (r"^CONFIG_PREEMPT(?:_(NONE|VOLUNTARY|LAZY))?=y$", config),
    ):
        if stated := re.search(pattern, text, re.MULTILINE):
            return (stated[1] or "full").lower()
    return None


@named("virtual machine")
def virtualisation(system: System) -> Check:
    """The host may suspend it for milliseconds without notice."""
    flags = re.search(r"^flags\s*:(.*)$", system.text("/proc/cpuinfo") or "", re.MULTILINE)
    product = system.text("/sys/class/dmi/id/product_name") or ""
    makers = r"\b(KVM|QEMU|VirtualBox|VMware|Virtual Machine)\b"
    in_one = flags is not None and "hypervisor" in flags[1].split()
    if not in_one and not re.search(makers, product, re.IGNORECASE):
        return ok("not detected")
    share = stolen_share(system.text("/proc/stat") or "")
    found = "yes" if share is None else f"yes; {100 * share:.2f} % of its time stolen since boot"
    return warn(found, "# for simulated controllers only; use a dedicated PC for an arm")


def stolen_share(stat: str, since: str = "") -> float | None:
    """Return the share of processor time used by the host, from texts of /proc/stat."""
    lines = (re.search(r"^cpu +((?:\d+ +){7}\d+)", text, re.MULTILINE) for text in (stat, since))
    now, before = ([int(word) for word in line[1].split()] if line else [0] * 8 for line in lines)
    spent = [late - early for late, early in zip(now, before, strict=True)]
    return spent[7] / sum(spent) if sum(spent) > 0 else None


@named("stolen time while measuring")
def stolen(before: str, after: str) -> Check:
    """The host suspends a virtual machine in this time."""
    share = stolen_share(after, before)
    if share is None:
        return unknown(_UNSTATED)
    found = f"{100 * share:.2f} %"
    if share < 1e-4:
        return ok(found)
    return warn(found, "# use dedicated processors or a dedicated PC")


@named("other load")
def load(system: System) -> Check:
    """Real-time priority has precedence over programs, not over interrupts and disk."""
    try:
        minute = float((system.text("/proc/loadavg") or "").split()[0])
    except (IndexError, ValueError):
        return unknown(_UNSTATED, "uptime")
    count = max(len(cpus(system)), 1)
    found = f"{minute:g} programs running or waiting over the last minute, {count} processors"
    return (
        ok(found)
        if minute <= 0.5 * count
        else warn(found, "top   # end programs that are not needed")
    )
