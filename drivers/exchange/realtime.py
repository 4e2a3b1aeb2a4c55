"""Real-time settings of a process: scheduling, memory, idle states, timers, garbage collection."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import struct
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

CPU_LATENCY: Final = Path("/dev/cpu_dma_latency")
"""Open with value 0 it excludes the slow idle states of the processors."""
LIMITS_FILE: Final = "/etc/security/limits.d/90-hil.conf"
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4
_PR_SET_TIMERSLACK = 29
_HEAP_RESERVE_BYTES: Final = 32 << 20
"""Bytes of heap allocated, and so locked, before the first cycle."""
_ARENAS: Final = 8
"""Arenas of CPython for objects of at most 512 bytes, of 1 MiB each, locked before the first cycle:
they do not come from the heap, and the 256 page faults of one would fall into a single cycle."""
_SMALL_BYTES: Final = 400
_SMALL_PER_ARENA: Final = (1 << 20) // 512
"""Fewer than an arena holds, so that keeping one in this many keeps every arena."""
_reserved_arenas: list[bytes] = []
_open_files: list[int] = []


@dataclass(frozen=True)
class RealTimeSettings:
    """Requested settings; a refusal is reported and never fatal.

    `priority` of SCHED_FIFO, 1..99; 0 for ordinary scheduling. `cpu` is the only processor to run
    on; None for all. `hold_cpu_awake` holds `/dev/cpu_dma_latency` at 0 until the process ends.
    """

    priority: int = 50
    cpu: int | None = None
    lock_memory: bool = True
    hold_cpu_awake: bool = True


@dataclass(frozen=True)
class RealTimeReport:
    """Granted settings; `scheduling` is "SCHED_FIFO" with its priority, or "ordinary".

    `refused` has one sentence per refusal, with its remedy; `memory_in_use_locked` says that only
    memory in use at the start is locked, as the limit is finite.
    """

    scheduling: str
    memory_locked: bool
    cpu_awake: bool
    refused: tuple[str, ...] = ()
    memory_in_use_locked: bool = False


def enter(settings: RealTimeSettings) -> RealTimeReport:
    """Apply the settings to this process, after `without_pauses`."""
    refused: list[str] = []
    without_pauses()
    locked = _lock_memory(refused) if settings.lock_memory else "nothing"
    awake = settings.hold_cpu_awake and _hold_cpu_awake(refused)
    if settings.cpu is not None:
        _pin(settings.cpu, refused)
    scheduling = _schedule(settings.priority, refused)
    return RealTimeReport(
        scheduling, locked == "all", awake, tuple(refused), memory_in_use_locked=locked == "in use"
    )


def without_pauses() -> None:
    """Switch the garbage collector off, and have waits of this thread end when they are due.

    No permission is needed for it. From here on the process must not create reference cycles.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    with suppress(OSError, AttributeError):  # the default slack is 50 µs
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def _schedule(priority: int, refused: list[str]) -> str:
    if priority > 0:
        try:
            # Child processes must not inherit the class.
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(priority))
        except (OSError, ValueError) as error:
            refused.append(
                f"SCHED_FIFO {priority} was refused ({error}); permit it with the line "
                f"'@realtime - rtprio 98' in {LIMITS_FILE}, join that group and log in again"
            )
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    if policy == os.SCHED_FIFO:
        return f"SCHED_FIFO {os.sched_getparam(0).sched_priority}"
    return "ordinary"


def _lock_memory(refused: list[str]) -> Literal["all", "in use", "nothing"]:
    """Lock the memory of this process, and return which part."""
    remedy = (
        f"permit it with the line '@realtime - memlock unlimited' in {LIMITS_FILE}, join that "
        "group and log in again"
    )
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    privileged = os.geteuid() == 0
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (hard, hard))
    libc = ctypes.CDLL(None, use_errno=True)
    # Memory returned to the system would cost page faults in later cycles.
    libc.mallopt(_M_TRIM_THRESHOLD, -1)
    libc.mallopt(_M_MMAP_MAX, 0)
    # With a finite limit MCL_FUTURE would make a later allocation fail.
    finite = hard != resource.RLIM_INFINITY and not privileged
    flags = _MCL_CURRENT if finite else _MCL_CURRENT | _MCL_FUTURE
    if libc.mlockall(flags) != 0:
        refused.append(f"locking memory was refused ({os.strerror(ctypes.get_errno())}); {remedy}")
        return "nothing"
    if finite:
        refused.append(f"only memory in use now is locked (the limit is {hard} bytes); {remedy}")
        return "in use"
    reserve = bytearray(_HEAP_RESERVE_BYTES)
    del reserve
    small = [bytes(_SMALL_BYTES) for _ in range(_ARENAS * _SMALL_PER_ARENA)]
    _reserved_arenas.extend(small[::_SMALL_PER_ARENA])
    return "all"


def _hold_cpu_awake(refused: list[str]) -> bool:
    try:
        fd = os.open(CPU_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
        os.write(fd, struct.pack("=i", 0))
    except OSError as error:
        refused.append(
            f"{CPU_LATENCY} could not be held at 0 ({error.strerror}); permit it with the udev "
            'rule \'KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"\''
        )
        return False
    _open_files.append(fd)  # closing it would end the request
    return True


def _pin(cpu: int, refused: list[str]) -> None:
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        available = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
        refused.append(
            f"processor {cpu} cannot be used ({error.strerror}); choose one of {available}"
        )
