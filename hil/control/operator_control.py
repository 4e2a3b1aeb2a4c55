"""Requests of the operator applied to a motion, and the motion shown to him."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.c4g_packets import DRIVE_ON
from drivers.drive_train import TURN, DriveTrain
from drivers.errors import RequestError
from drivers.guard import Guard
from drivers.motion_source import MotionSource
from hil.base.arrays import Array
from hil.base.errors import ControllerError
from hil.control.motion_watch import MotionProgress, MotionWatch, Stop

from .port import ControllerPort, PortStatus

REQUEST_PERIOD: Final = 0.02  # Period of reading the operator's request during a hold, s
SHOW_PERIOD: Final = 0.1  # Period of showing the motion, s


class OperatorControl:
    """Applies the requests of a motion's watch to the motion, and shows the motion to it.

    Args:
        port: of the controller that runs it.
        most: largest fraction of the planned speed, whatever is requested.

    Attributes:
        fraction: applied to the motion last.
        held: whether a hold was applied last.

    Raises:
        ValueError: `most` is not in 0..1.
    """

    def __init__(
        self, source: MotionSource, watch: MotionWatch, port: ControllerPort, most: float
    ) -> None:
        if not 0.0 < most <= 1.0:
            raise ValueError(f"an override of {most!r} is not above 0 and at most 1")
        self.source = source
        self._watch = watch
        self._port = port
        self._most = most
        duration = getattr(source, "duration", None)
        self._duration = float(duration) if isinstance(duration, int | float) else None
        self.fraction = most
        self.held = False
        self._before = port.status().counts
        self._last: NDArray[np.void] | None = None
        self._due = -math.inf

    def begin(self, stop: Stop, meanwhile: Callable[[], object]) -> bool:
        """Set the requested speed and wait while a hold is requested; return False after a stop.

        Raises:
            ControllerError: it is to be slower than planned and supports no override.
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
            raise ControllerError(
                f"a {type(self.source).__name__} supports no override and cannot be run at "
                f"{100.0 * self.fraction:.0f} %; nothing was sent"
            )
        self._before = self._port.status().counts
        return True

    def unchanged(self, stop: Stop) -> bool:
        """Return whether the motion may begin as `begin` left it: no stop, hold or lower speed."""
        request = self._watch.request()
        return not (stop.requested or request.held or request.override < self.fraction)

    def follow(self) -> None:
        """Apply the present request. A motion held before it began begins at rest."""
        request = self._watch.request()
        motion = self._port
        fraction = min(self._most, request.override)
        with suppress(RequestError):  # the motion has ended
            if fraction != self.fraction:
                self.fraction = fraction
                motion.override(fraction)
        with suppress(RequestError):
            if request.held is not self.held:
                self.held = request.held
                (motion.hold if request.held else motion.resume)()

    @property
    def due(self) -> bool:
        """Whether the motion is to be shown again."""
        return time.monotonic() >= self._due

    def show(self, drives: DriveTrain, guard: Guard, status: PortStatus) -> None:
        """Show the motion; shares are of the active limits of `drives` and `guard`."""
        self._due = time.monotonic() + SHOW_PERIOD
        if len(records := self._port.new_records()):
            self._last = records[-1:].copy()
        replied, missed, late_packets, late, not_accepted = np.subtract(
            status.counts, self._before
        ).tolist()
        arrays: dict[str, Array] = {}
        if self._last is not None:
            last = self._last[0]
            arrays = {"position": last["position"].copy()}
            if last["status"] == DRIVE_ON:  # else the controller has neither target nor current
                error = last["target_position"] - last["position"]
                turns = np.abs(error @ drives.motor_from_joint.T) / TURN
                arrays |= {
                    "following_error": error,
                    "following_share": turns / guard.following_error,
                    "current": last["target_current"].copy(),
                    "current_share": np.abs(last["target_current"]) / guard.current,
                }
        self._watch.show(
            MotionProgress(
                motion_time=None if math.isnan(status.motion_time) else status.motion_time,
                duration=self._duration,
                cycles=replied,
                missed=missed,
                late=late,
                not_accepted=not_accepted,
                late_packets=late_packets,
                state=status.state,
                override=self.fraction,
                rate=None if math.isnan(status.rate) else status.rate,
                held=self.held,
                **arrays,
            )
        )
