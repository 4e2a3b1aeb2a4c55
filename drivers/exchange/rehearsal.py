"""A session that nobody hears, run before the link opens.

The first packet through a session costs tens of milliseconds where memory is locked: modules are
imported late, numerical libraries take their working memory, pages are touched for the first time.
None of that may happen while a controller waits. So a session of the same arm goes through init,
open mode and a motion at rest first.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.drive_train import DriveTrain
from drivers.guard import Guard, GuardLimits
from drivers.motion_source import BoundsName
from drivers.packets import DRIVE_ON, INIT_NUMBER, CyclicPacket, InitPacket, Mode, next_number
from drivers.record import CycleRing
from drivers.session import Session
from drivers.states import State

Array = NDArray[np.float64]

CYCLES: Final = 200
_HEADER: Final = struct.Struct("<i4B4x")


class _Rest:
    """A motion that stays where it begins."""

    finished = False
    bounds: BoundsName = "plan"

    def __init__(self, position: Array) -> None:
        self.start = position
        self._velocity = np.zeros_like(position)

    def begin(self, position: Array) -> None:
        self.start = position

    def advance(self) -> tuple[Array, Array]:
        return self.start, self._velocity

    def stop(self) -> None:
        self.finished = True


class Rehearsal:
    """A session of an arm and the controller it assumes; `cycle` runs one packet.

    Attributes:
        state: of the session; `State.OPEN` from the second cycle on.
    """

    def __init__(self, drive_train: DriveTrain, limits: GuardLimits, period: float) -> None:
        n = drive_train.n_joints
        position = 0.5 * (limits.lower + limits.upper)
        self._session = Session(drive_train, Guard(limits, period), CycleRing(n, 16))
        self._axes = CyclicPacket.zeros(1, n).axes
        self._axes["d"][:, 0] = self._axes["d"][:, 2] = drive_train.motor_revolutions(position)
        self._number = INIT_NUMBER
        init = InitPacket.build(n, round(1000.0 * period), _init_values(drive_train, limits))
        self._session.reply(init.encode(), 0.0)
        self._session.request(_Rest(position))

    @property
    def state(self) -> State:
        """Where the session stands."""
        return self._session.state

    def cycle(self) -> bytes | None:
        """The answer to one more packet."""
        first = self._number == INIT_NUMBER and self._session.state is State.INIT
        self._axes["mode"] = Mode.CLOSED if first else Mode.POSITION
        self._number = next_number(self._number)
        packet = _HEADER.pack(self._number, DRIVE_ON, 0, 0, 0) + self._axes.tobytes()
        return self._session.reply(packet, 0.0)


def _init_values(drives: DriveTrain, limits: GuardLimits) -> Mapping[str, ArrayLike]:
    """What the controller of this arm would say of it."""
    return {
        "gear_ratio": drives.gear_ratio,
        "calibration": drives.calibration,
        "kinematic_influence": [0.0, 0.0, 0.0, drives.k54, drives.k64, drives.k65],
        "current_limit": limits.current,
        "following_error": limits.following_error,
    }


def rehearse(drive_train: DriveTrain, limits: GuardLimits, period: float) -> State:
    """Run a motion at rest for some cycles; returns the state it came to, open if all is well."""
    rehearsal = Rehearsal(drive_train, limits, period)
    for _ in range(CYCLES):
        rehearsal.cycle()
    return rehearsal.state
