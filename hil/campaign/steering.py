"""One motion under way: its operator's requests passed on to it, and what is to be seen of it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import TURN, DriveTrain
from drivers.errors import RequestError
from drivers.exchange.control import quantile
from drivers.exchange.event_log import ExchangeEvent
from drivers.exchange.process import ExchangeProcess
from drivers.guard import Guard
from drivers.motion_source import MotionSource
from drivers.packets import InitPacket
from drivers.session import Session
from drivers.states import State
from hil.archive.recorder import describe
from hil.cell import Cell
from hil.errors import ControllerFault

from .operator import Latency, MotionProgress, MotionWatch, Stop

NOT_BEGUN: Final = "it had not begun"
"""Why a motion ends that was stopped before it was asked for."""
ASKED_EVERY: Final = 0.02
"""s between two questions for a request where nothing else is to be done."""


class Steering:
    """Takes the requests of one motion's watch to the motion.

    Args:
        watch: has the requests.
        most: largest fraction of the planned speed, whatever is requested.

    Attributes:
        fraction: asked of the motion last.
        held: whether it was asked to rest.

    Raises:
        ValueError: `most` is not one of 0..1.
    """

    def __init__(self, watch: MotionWatch, most: float) -> None:
        if not 0.0 < most <= 1.0:
            raise ValueError(f"an override of {most!r} is not above 0 and at most 1")
        self._watch, self._most = watch, most
        self.fraction, self.held = most, False

    def begin(
        self, source: MotionSource, stop: Stop, meanwhile: Callable[[], object] = lambda: None
    ) -> bool:
        """Have a motion begin at the speed requested; waits while a hold is requested.

        Args:
            source: the motion.
            stop: ends the waiting.
            meanwhile: called again and again while it waits.

        Returns:
            Whether it may be asked for now; False once a stop is asked for.

        Raises:
            ControllerFault: it is to be slower than planned and knows no override.
        """
        request = self._watch.request()
        while request.held and not stop.requested:
            meanwhile()
            time.sleep(ASKED_EVERY)
            request = self._watch.request()
        if stop.requested:
            return False
        self.fraction = min(self._most, request.override)
        change = getattr(source, "override", None)
        if callable(change):
            change(self.fraction)
        elif self.fraction < 1.0:
            raise ControllerFault(
                f"a {type(source).__name__} knows no override and cannot be run at "
                f"{100.0 * self.fraction:.0f} %; nothing was sent"
            )
        return True

    def unchanged(self, stop: Stop) -> bool:
        """Whether a motion may begin as `begin` left it; not if it is to be slower or to rest."""
        request = self._watch.request()
        return not (stop.requested or request.held or request.override < self.fraction)

    def follow(self, motion: Session | ExchangeProcess, messages: deque[str]) -> None:
        """Pass on what is requested now. A motion held before it began begins at rest.

        Args:
            motion: what is steered.
            messages: takes what it refuses, in words.
        """
        request = self._watch.request()
        fraction = min(self._most, request.override)
        commands: list[Callable[[], None]] = []
        if fraction != self.fraction:
            self.fraction = fraction
            commands.append(partial(motion.override, fraction))
        if request.held is not self.held:
            self.held = request.held
            commands.append(motion.hold if request.held else motion.resume)
        for command in commands:
            try:
                command()
            except RequestError as error:
                messages.append(str(error))


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
