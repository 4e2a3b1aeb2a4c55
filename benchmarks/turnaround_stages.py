"""Where the exchange process spends the time from a packet's arrival to its reply.

Imported by the exchange process of `benchmarks.turnaround --stages`. It wraps the functions of
`STAGES` and counts the time of each without that of those inside, which takes some 25 us a cycle.
"""

from __future__ import annotations

import atexit
import os
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers import c4g_wire, open_mode, session
from drivers.cycle_records import CycleRing
from drivers.drive_train import MotorSide
from drivers.exchange import loop
from drivers.execution import Execution
from drivers.guard import Guard
from drivers.transports.udp import UdpTransport

FILE: Final = "HIL_TURNAROUND_STAGES"
"""Environment variable with the file that receives the stages."""
CAPACITY: Final = 200_000
STAGES: Final[tuple[tuple[str, tuple[tuple[type, str], ...]], ...]] = (
    ("wake-up", ()),
    ("receive", ((UdpTransport, "receive"), (loop.ReceiveQueue, "receive"))),
    ("decode", ((c4g_wire.C4gWire, "receive"),)),
    ("decide", ((session.Session, "_apply"),)),
    ("record", ((session.Session, "_record"), (MotorSide, "to_joints"), (CycleRing, "commit"))),
    ("session", ((session.Session, "reply"),)),
    ("open mode", ((open_mode.SetPointGenerator, "reply"),)),
    ("motion", ((Execution, "advance"),)),
    (
        "guard",
        (
            (Guard, "check_feedback"),
            (Guard, "check_set_point"),
            (open_mode.SentSetPoints, "check"),
        ),
    ),
    (
        "pack",
        (
            (c4g_wire.C4gWire, "fill_safe"),
            (c4g_wire.C4gWire, "finish"),
            (c4g_wire.C4gWire, "write"),
        ),
    ),
    ("send", ((UdpTransport, "send"),)),
)
NAMES: Final = tuple(name for name, _ in STAGES)


class _Clock:
    """Time per stage of the present cycle, ns, and of all cycles before it."""

    def __init__(self) -> None:
        self.cycles = np.zeros((CAPACITY, len(STAGES)), np.int64)
        self.count = 0
        self.now = [0] * len(STAGES)
        self.stack: list[int] = []
        self.since = 0

    def enter(self, stage: int) -> None:
        now = time.perf_counter_ns()
        if self.stack:
            self.now[self.stack[-1]] += now - self.since
        self.stack.append(stage)
        self.since = now

    def leave(self) -> None:
        now = time.perf_counter_ns()
        self.now[self.stack.pop()] += now - self.since
        self.since = now

    def begin(self, wake_up: int) -> None:
        """Begin with the return of the system call that received the packet."""
        self.now[:] = [0] * len(self.now)
        self.now[0] = wake_up
        self.since = time.perf_counter_ns()

    def end(self) -> None:
        self.cycles[self.count % CAPACITY] = self.now
        self.count += 1


_clock: Final = _Clock()


def _timed(stage: int, function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def timed(*args: Any, **kwargs: Any) -> Any:
        _clock.enter(stage)
        try:
            return function(*args, **kwargs)
        finally:
            _clock.leave()

    return timed


def install() -> None:
    """Wrap the functions of the stages."""
    for stage, (_, functions) in enumerate(STAGES):
        for owner, name in functions:
            raw = vars(owner)[name]
            if isinstance(raw, classmethod):
                setattr(owner, name, classmethod(_timed(stage, raw.__func__)))
            else:
                setattr(owner, name, _timed(stage, raw))
    set_up = UdpTransport.__init__

    def initialised(self: UdpTransport, *args: Any, **kwargs: Any) -> None:
        set_up(self, *args, **kwargs)
        receive = self._receive

        def received(*arguments: Any) -> Any:
            answer = receive(*arguments)
            seconds, nanoseconds = np.frombuffer(answer[1][0][2], np.int64).tolist()
            _clock.begin(time.time_ns() - 10**9 * seconds - nanoseconds)
            return answer

        self._receive = received

    UdpTransport.__init__ = initialised  # type: ignore[method-assign]
    send = UdpTransport.send

    def sent(self: UdpTransport, packet: bytes) -> None:
        send(self, packet)
        _clock.end()

    UdpTransport.send = sent  # type: ignore[method-assign]


def save(path: Path) -> None:
    """Write the cycles (k, stages), ns; other processes have none."""
    if _clock.count:
        np.save(path, _clock.cycles[: min(_clock.count, CAPACITY)])


if FILE in os.environ:
    install()
    atexit.register(save, Path(os.environ[FILE]))
