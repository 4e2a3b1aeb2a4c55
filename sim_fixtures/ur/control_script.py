"""The control script of ur-rtde (SDU), as a state machine of the commands that move joints.

Its text is recognised by its name and not interpreted: a command number in the input register 0
has the script move and answer in the output register 0 that it is ready, or done. Of its commands
movej, servoj and the ends of both are known; others are answered as done, and do nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from sim_fixtures.arrays import Array
from sim_fixtures.ur.program import ENDED, STOPPING, STREAMING, ProgramConstants, Registers

FIRST_LINE: Final = "def rtde_control():"
_READY_STATE: Final = 1
_DONE_STATE: Final = 2
_MOVE_J_COMMAND: Final = 1
_SERVO_J_COMMAND: Final = 11
_END_COMMAND: Final = 255
_IMMEDIATE_COMMANDS: Final = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
"""Commands that a PC sends again and again, after which the script is ready at once."""
_SPEED, _ACCELERATION = 6, 7
_DEFAULT_DECELERATION: Final = 10.0  # rad/s²
_LOOKAHEAD_SECONDS: Final = 0.03  # s; the PC's own is not used


class ControlScript:
    """A running script, with the attributes of `RegisterProgram`."""

    watched = False

    def __init__(self, inputs: Registers, outputs: Registers, position: Array, period: float):
        nothing = np.full(6, np.inf)
        self.constants = ProgramConstants(
            token=0, velocity=nothing, deviation=nothing, period=period, patience=0, starting=0,
            confirmed=0, start_distance=np.inf, deceleration=_DEFAULT_DECELERATION,
            lookahead=_LOOKAHEAD_SECONDS, watchdog=np.inf,
        )  # fmt: skip
        self.command = position.copy()
        self.stage = STREAMING
        self._inputs = inputs
        self._outputs = outputs
        self._period = period
        self._executed = False
        self._path: list[Array] = []
        outputs.ints[0] = _READY_STATE

    def step(self, actual: Array, is_steady: Callable[[], bool]) -> None:
        """Run one cycle."""
        del actual, is_steady
        if self._path:
            self.command = self._path.pop(0)
            self._outputs.ints[0] = _DONE_STATE if not self._path else 0
            return
        number = self._inputs.ints.get(0, 0)
        if number == _END_COMMAND:
            self.stage = STOPPING
        elif number in _IMMEDIATE_COMMANDS:
            if number == _SERVO_J_COMMAND:
                self.command = self._inputs.vector(0)
            self._outputs.ints[0] = _READY_STATE
        elif number == 0:
            self._executed = False
            self._outputs.ints[0] = _READY_STATE
        elif not self._executed:
            self._executed = True
            self._outputs.ints[0] = _DONE_STATE
            if number == _MOVE_J_COMMAND:
                self._outputs.ints[0] = 0
                floats = self._inputs.floats
                self._path = self._ramp(
                    self._inputs.vector(0), floats.get(_SPEED, 1.0), floats.get(_ACCELERATION, 1.0)
                )

    def _ramp(self, target: Array, speed: float, acceleration: float) -> list[Array]:
        """Return set-points (6,) of a motion of all joints together, by trapezoids of speed."""
        way = target - self.command
        length = float(np.abs(way).max())
        if length == 0.0:
            return [target]
        speed = min(speed, float(np.sqrt(length * acceleration)))
        rise = speed / acceleration
        duration = length / speed + rise
        count = int(np.ceil(duration / self._period))
        time = np.minimum(np.arange(1, count + 1) * self._period, duration)
        begin = 0.5 * acceleration * np.minimum(time, rise) ** 2
        middle = speed * np.clip(time - rise, 0.0, duration - 2.0 * rise)
        late = np.maximum(time - (duration - rise), 0.0)
        end = speed * late - 0.5 * acceleration * late**2
        share = (begin + middle + end) / length
        return [self.command + s * way for s in share[:-1]] + [target]

    def end(self) -> None:
        """Its stop is over."""
        self.stage = ENDED
