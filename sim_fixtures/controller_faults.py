"""Faults of the controller and its robot, as a script that says what happens in which cycle.

Cycles count the controller's packets from 0, as those of `drivers.transports.faults` do. Axes count
from 1, as they are printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from sim_fixtures.arm import Mishap

SLIP = 1.5
"""Size of an encoder's slip, as a multiple of the axis's following-error threshold."""
LOAD = 0.9
"""Size of a load, as a share of what the axis's motor can muster."""
PUSH = 0.15
"""Size of a push, likewise: nothing trips, and the repetition is another one than its fellows."""


class Faultable(Protocol):
    """What faults are inflicted on."""

    def lose_drive(self, reason: str) -> None:
        """The drive goes off and the brakes close."""

    def restart(self, *, warm: bool) -> None:
        """The controller begins anew."""

    def axis_leaves(self, axis: int) -> None:
        """One axis (from 1) leaves open mode by itself."""

    def pause(self, mode: int, cycles: int) -> None:
        """The controller reports a pause."""

    def suffer(self, kind: Mishap, axis: int, size: float, cycles: int) -> None:
        """Something befalls the mechanics of one axis (from 1)."""


@dataclass(frozen=True)
class Restart:
    """The controller is restarted: cold after a silence, warm (506) with the init packet next."""

    cycle: int
    warm: bool = False

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.restart(warm=self.warm)


@dataclass(frozen=True)
class DriveDrop:
    """The drive goes off by itself; somebody has to switch it on again."""

    cycle: int

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.lose_drive("the drive dropped out")


@dataclass(frozen=True)
class EmergencyStop:
    """Somebody presses the emergency stop."""

    cycle: int

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.lose_drive("emergency stop")


@dataclass(frozen=True)
class AxisLeaves:
    """One axis leaves open mode; the others stay."""

    cycle: int
    axis: int

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.axis_leaves(self.axis)


@dataclass(frozen=True)
class FollowingErrorFault:
    """An axis does not follow for `count` cycles.

    It is stuck ("jam"), which shows once it should move, or its encoder is read wrongly ("slip"),
    which shows at once.
    """

    cycle: int
    axis: int
    kind: Literal["jam", "slip"] = "jam"
    count: int = 500

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.suffer(self.kind, self.axis, SLIP, self.count)


@dataclass(frozen=True)
class CurrentSaturation:
    """A load drives the current of an axis near its limit for `count` cycles."""

    cycle: int
    axis: int
    count: int = 500

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.suffer("load", self.axis, LOAD, self.count)


@dataclass(frozen=True)
class Push:
    """Somebody leans against an axis for `count` cycles; no limit is reached."""

    cycle: int
    axis: int
    count: int = 50

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.suffer("load", self.axis, PUSH, self.count)


@dataclass(frozen=True)
class Pause:
    """The controller reports mode 500 or 502 for `count` cycles, then closed axes."""

    cycle: int
    count: int = 50
    mode: Literal[500, 502] = 502

    def inflict(self, on: Faultable) -> None:
        """Let it happen."""
        on.pause(self.mode, self.count)


ControllerFault = (
    Restart
    | DriveDrop
    | EmergencyStop
    | AxisLeaves
    | FollowingErrorFault
    | CurrentSaturation
    | Push
    | Pause
)
