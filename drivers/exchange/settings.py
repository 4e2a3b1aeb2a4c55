"""What an exchange process receives before it begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.drive_train import DriveTrain
from drivers.exchange.loop import MAX_LATE
from drivers.exchange.realtime import RealTimeSettings
from drivers.guard import GuardLimits
from drivers.transports.base import TransportSpec


@dataclass(frozen=True, eq=False)
class ExchangeSettings:
    """Everything the exchange needs; pickles.

    Attributes:
        transport: the link.
        drive_train: of the arm.
        guard_limits: bounds of every set-point.
        period: the controller's cycle, s.
        session: further keyword arguments of `Session`.
        realtime: what to ask the system for.
        ring_capacity: cycle records stored for whoever archives them.
        packets: raw packets stored for whoever archives them; 0: none, and the link is as it is.
        preload: modules imported before the link opens, so that programs made of their classes
            are read quickly.
        needs_archive: whether a motion is accepted and goes on only while the archive process
            lives and has an archive ready.
        max_late: answers in a row that may leave too late in open mode without stopping a motion;
            None takes the session's `max_gap`.
    """

    transport: TransportSpec
    drive_train: DriveTrain
    guard_limits: GuardLimits
    period: float
    session: Mapping[str, Any] = field(default_factory=dict)
    realtime: RealTimeSettings = field(default_factory=RealTimeSettings)
    ring_capacity: int = 20_000
    packets: int = 0
    preload: tuple[str, ...] = ()
    needs_archive: bool = True
    max_late: int | None = None

    @property
    def late_allowed(self) -> int:
        """`max_late`, or what stands for it."""
        if self.max_late is not None:
            return self.max_late
        allowed: int = self.session.get("max_gap", MAX_LATE)
        return allowed
