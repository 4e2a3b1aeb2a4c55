"""What the operating system allows the exchange process to do, and how to be allowed."""

from __future__ import annotations

import getpass
import os
import resource
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.exchange.realtime import LIMITS_FILE, RealTimeSettings

from .check import Check, Status
from .system import System

GROUP = "realtime"
RULE_FILE = "/etc/udev/rules.d/90-hil.rules"
_LOG_IN_AGAIN = "# log out and in again, then: ulimit -r; ulimit -l"


@dataclass(frozen=True)
class Obtained:
    """What a process like the exchange was really given (see `drivers.exchange.realtime`).

    Attributes:
        scheduling: scheduling class it runs in.
        memory_locked: its memory stays in RAM.
        cpu_awake: processors may not sleep while it runs.
        refused: what was not given, one sentence each.
    """

    scheduling: str
    memory_locked: bool
    cpu_awake: bool
    refused: tuple[str, ...] = ()

    @classmethod
    def from_mapping(cls, given: Mapping[str, object]) -> Obtained:
        """From the probe's answer."""
        refused = given.get("refused", ())
        return cls(
            scheduling=str(given.get("scheduling", "")),
            memory_locked=given.get("memory_locked") is True,
            cpu_awake=given.get("cpu_awake") is True,
            refused=tuple(map(str, refused)) if isinstance(refused, list | tuple) else (),
        )


def user(uid: int | None = None) -> Check:
    """Who is asking: what root may do says nothing about the operator."""
    who = os.geteuid() if uid is None else uid
    why = "nothing of hil needs root, and what root may do says nothing about other users"
    if who != 0:
        return Check("user", Status.OK, f"{_name()}, not root", why)
    return Check(
        "user", Status.WARN, "root", why, ("# run hil doctor as the user who will run hil",)
    )


def scheduling(obtained: Obtained | None, limit: int | None = None) -> Check:
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


def memory_lock(obtained: Obtained | None, limit: int | None = None) -> Check:
    """Whether memory may be kept in RAM."""
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


def processor_awake(obtained: Obtained | None, system: System) -> Check:
    """Whether /dev/cpu_dma_latency may be held at 0."""
    why = "halves the usual wake-up time; matters more than the programming language"
    name = "processor kept awake"
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
