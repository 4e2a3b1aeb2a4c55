"""What is to be seen of a motion while it goes on, put together from records and counters."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import TURN, DriveTrain
from drivers.exchange import ExchangeEvent
from drivers.exchange.control import quantile
from drivers.guard import Guard
from drivers.packets import InitPacket
from drivers.states import State
from hil.archive.recorder import describe
from hil.cell import Cell

from .motion_watch import Latency, MotionProgress, MotionWatch
from .steering import Steering

SHOWN_EVERY: Final = 0.1
"""s between two looks of the watch."""
REMEMBERED: Final = 8
"""Events that are shown."""


@dataclass(frozen=True)
class PacketCounts:
    """Fates of packets of one session up to a moment; see `drivers.events.Counters`."""

    answered: int = 0
    missed: int = 0
    late: int = 0
    untaken: int = 0
    latencies: tuple[int, ...] = ()
    worst: float = math.inf


@dataclass(eq=False)
class ProgressDisplay:
    """What is to be seen of one motion.

    Attributes:
        drives: in force, for the shares.
        guard: narrowed to the limits in force.
        steering: of the motion.
        duration: s, of the planned motion; None if unknown.
        before: counts when the motion was asked for.
        messages: events in words, the last ones.
    """

    drives: DriveTrain
    guard: Guard
    steering: Steering
    duration: float | None
    before: PacketCounts
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _last: NDArray[np.void] | None = None
    _due: float = -math.inf

    @property
    def due(self) -> bool:
        """Whether the watch is to look again."""
        return time.monotonic() >= self._due

    def note(self, events: Iterable[ExchangeEvent]) -> None:
        """Take events in."""
        for event in events:
            self.messages.append(describe(event))

    def take(self, records: NDArray[np.void]) -> None:
        """Take cycle records in; the last one counts."""
        if len(records):
            self._last = records[-1:].copy()

    def show(
        self,
        watch: MotionWatch,
        state: State,
        counts: PacketCounts,
        motion_time: float,
        rate: float,
    ) -> None:
        """Let the watch look."""
        self._due = time.monotonic() + SHOWN_EVERY
        before, position = self.before, None
        error = error_share = current = current_share = None
        if self._last is not None:
            position = self._last["position"][0].copy()
            error = self._last["target_position"][0] - position
            turns = np.abs(error @ self.drives.motor_from_joint.T) / TURN
            error_share = turns / self.guard.following_error
            current = self._last["target_current"][0].copy()
            current_share = np.abs(current) / self.guard.current
        watch.show(
            MotionProgress(
                motion_time=_number(motion_time),
                duration=self.duration,
                cycles=counts.answered - before.answered,
                missed=counts.missed - before.missed,
                late=counts.late - before.late,
                untaken=counts.untaken - before.untaken,
                state=state,
                position=position,
                following_error=error,
                following_share=error_share,
                current=current,
                current_share=current_share,
                override=self.steering.fraction,
                rate=_number(rate),
                held=self.steering.held,
                latency=_latency(counts, before),
                events=tuple(self.messages),
            )
        )


def guard_in_force(cell: Cell, drives: DriveTrain, init: InitPacket | None) -> Guard:
    """A guard with the limits in force: the narrower of the cell's and the controller's."""
    guard = Guard(cell.guard_limits, cell.period)
    if init is not None:
        row, axes = cell.controller.arm - 1, slice(0, len(cell.joint_names))
        current = np.fmin(init.current_limit[row, axes], drives.current_limit)
        guard.narrow(init.following_error[row, axes].astype(np.float64), current)
    return guard


def duration_of(source: object) -> float | None:
    """Duration of a motion [s], if it says so."""
    duration = getattr(source, "duration", None)
    return float(duration) if isinstance(duration, int | float) else None


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def _latency(latest: PacketCounts, before: PacketCounts) -> Latency | None:
    counts: Sequence[int] = latest.latencies
    if before.latencies:
        counts = [now - then for now, then in zip(counts, before.latencies, strict=True)]
    shares = [quantile(counts, share) for share in (0.5, 0.99, 1.0)]
    median, p99, worst = (None if value is None else min(value, latest.worst) for value in shares)
    if median is None or p99 is None or worst is None:
        return None
    return Latency(median, p99, worst)
