"""Steering of a running motion: requests of the operator, and its display."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
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
from drivers.session import Session
from drivers.states import State
from hil.archive.recorder import describe
from hil.errors import ControllerFault

from .operator import Latency, MotionProgress, MotionWatch, Stop

REQUEST_PERIOD: Final = 0.02  # Period of reading the operator's request during a hold, s
SHOW_PERIOD: Final = 0.1  # Period of showing the motion, s
EVENTS_SHOWN: Final = 8


@dataclass(frozen=True)
class PacketCounts:
    """Packets of one session up to a moment; see `drivers.events.Counters`."""

    answered: int
    missed: int
    late: int
    not_accepted: int
    latencies: tuple[int, ...] = ()
    worst: float = math.inf


class Steering:
    """Applies the requests of a motion's watch to the motion, and shows the motion to it.

    Args:
        most: largest fraction of the planned speed, whatever is requested.
        counts: returns the present packet counts.

    Attributes:
        fraction: applied to the motion last.
        held: whether a hold was applied last.

    Raises:
        ValueError: `most` is not in 0..1.
    """

    def __init__(
        self,
        source: MotionSource,
        watch: MotionWatch,
        most: float,
        counts: Callable[[], PacketCounts],
    ) -> None:
        if not 0.0 < most <= 1.0:
            raise ValueError(f"an override of {most!r} is not above 0 and at most 1")
        self.source, self._watch, self._most, self._counts = source, watch, most, counts
        duration = getattr(source, "duration", None)
        self._duration = float(duration) if isinstance(duration, int | float) else None
        self.fraction, self.held = most, False
        self._before = counts()
        self._messages: deque[str] = deque(maxlen=EVENTS_SHOWN)
        self._last: NDArray[np.void] | None = None
        self._due = -math.inf

    def begin(self, stop: Stop, meanwhile: Callable[[], object]) -> bool:
        """Set the requested speed and wait while a hold is requested; return False after a stop.

        Raises:
            ControllerFault: it is to be slower than planned and supports no override.
        """
        request = self._watch.request()
        while request.held and not stop.requested:
            meanwhile()
            time.sleep(REQUEST_PERIOD)
            request = self._watch.request()
        if stop.requested:
            return False
        self.fraction = min(self._most, request.override)
        change = getattr(self.source, "override", None)
        if callable(change):
            change(self.fraction)
        elif self.fraction < 1.0:
            raise ControllerFault(
                f"a {type(self.source).__name__} supports no override and cannot be run at "
                f"{100.0 * self.fraction:.0f} %; nothing was sent"
            )
        self._before = self._counts()
        return True

    def unchanged(self, stop: Stop) -> bool:
        """Return whether the motion may begin as `begin` left it: no stop, hold or lower speed."""
        request = self._watch.request()
        return not (stop.requested or request.held or request.override < self.fraction)

    def follow(self, motion: Session | ExchangeProcess) -> None:
        """Apply the present request. A motion held before it began begins at rest."""
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
                self._messages.append(str(error))

    @property
    def due(self) -> bool:
        """Whether the motion is to be shown again."""
        return time.monotonic() >= self._due

    def add_events(self, events: Iterable[ExchangeEvent]) -> None:
        """Add events to be shown."""
        self._messages.extend(map(describe, events))

    def add_records(self, records: NDArray[np.void]) -> None:
        """Add cycle records; the last one is shown."""
        if len(records):
            self._last = records[-1:].copy()

    def show(
        self, drives: DriveTrain, guard: Guard, state: State, motion_time: float, rate: float
    ) -> None:
        """Show the motion at `motion_time` s, at `rate` of the planned speed (NaN if unknown).

        Shares are of the active limits of `drives` and `guard`.
        """
        self._due = time.monotonic() + SHOW_PERIOD
        counts, before = self._counts(), self._before
        arrays: dict[str, NDArray[np.float64]] = {}
        if self._last is not None:
            last = self._last[0]
            error = last["target_position"] - last["position"]
            arrays = {
                "position": last["position"].copy(),
                "following_error": error,
                "following_share": np.abs(error @ drives.motor_from_joint.T)
                / TURN
                / guard.following_error,
                "current": last["target_current"].copy(),
                "current_share": np.abs(last["target_current"]) / guard.current,
            }
        self._watch.show(
            MotionProgress(
                motion_time=None if math.isnan(motion_time) else motion_time,
                duration=self._duration,
                cycles=counts.answered - before.answered,
                missed=counts.missed - before.missed,
                late=counts.late - before.late,
                not_accepted=counts.not_accepted - before.not_accepted,
                state=state,
                override=self.fraction,
                rate=None if math.isnan(rate) else rate,
                held=self.held,
                latency=_latency(counts, before),
                events=tuple(self._messages),
                **arrays,
            )
        )


def _latency(latest: PacketCounts, before: PacketCounts) -> Latency | None:
    counts = np.subtract(latest.latencies, before.latencies or 0).tolist()
    shares = [quantile(counts, share) for share in (0.5, 0.99, 1.0)]
    if None in shares:
        return None
    return Latency(*(min(value, latest.worst) for value in shares if value is not None))
