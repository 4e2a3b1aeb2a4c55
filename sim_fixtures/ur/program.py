"""The one program that the simulated controller runs, as a state machine by its constants.

It does what the text of the program says, cycle by cycle, without interpreting it; another text is
refused, as a controller refuses one with an error. A test compares it with the text itself.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sim_fixtures.arrays import Array

_FIRST_REGISTER: Final = 24
WAITING: Final = 1
STREAMING: Final = 2
STOPPING: Final = 3
ENDED: Final = 4
_STREAM_DEMAND: Final = 1
_END_DEMAND: Final = 2
_STOP_DEMAND: Final = 3
_ASKED, _REFUSED, _SILENCE, _STEP, _DEVIATION, _PAUSED, _NO_START = range(1, 8)
_NUMBER_PATTERN: Final = r"([-+0-9.e]+)"
_LIST_PATTERN: Final = r"\[([-+0-9.e, ]+)\]"
_CHECKSUM_TOLERANCE: Final = 1e-7
_MIN_MOVEMENT: Final = 1e-6
_REACH_MARGIN: Final = 1.01
_REACH_OFFSET: Final = 1e-6


class ProgramError(ValueError):
    """A text that this controller does not run; its message is what the controller says."""


@dataclass(frozen=True, eq=False)
class ProgramConstants:
    """Numbers in the text of the program.

    Attributes:
        token: its number, which no other program has.
        velocity, deviation: largest ones of each joint (6,) [rad/s, rad].
        period: of a cycle, by servoj [s].
        patience, starting, confirmed: cycles without a set-point, before the first, and set-points
            until it streams.
        start_distance: largest distance of the first set-point [rad].
        deceleration: of its stop [rad/s²].
        lookahead: of servoj [s].
        watchdog: longest time between two set-points [s].
    """

    token: int
    velocity: Array
    deviation: Array
    period: float
    patience: int
    starting: int
    confirmed: int
    start_distance: float
    deceleration: float
    lookahead: float
    watchdog: float

    @classmethod
    def of(cls, text: str) -> ProgramConstants:
        """Return the constants of a program, or raise ProgramError."""
        lines = text.strip().splitlines()
        if not lines or lines[0].strip() != "def hil_stream():" or lines[-1].strip() != "end":
            raise ProgramError("syntax error on line 1")

        def number(pattern: str) -> float:
            found = re.search(pattern.replace("#", _NUMBER_PATTERN), text)
            if found is None:
                raise ProgramError(f"compile error: {pattern}")
            return float(found[1])

        def numbers(name: str) -> Array:
            found = re.search(rf"^  {name} = {_LIST_PATTERN}$", text, re.MULTILINE)
            if found is None:
                raise ProgramError(f"compile error: {name}")
            return np.array([float(part) for part in found[1].split(",")])

        return cls(
            token=int(number(r"write_output_integer_register\(27, #\)")),
            velocity=numbers("velocity"),
            deviation=numbers("deviation"),
            period=number(r"servoj\(q, t=#,"),
            patience=int(number(r"if silent >= #:")),
            starting=int(number(r"if silent > #:")),
            confirmed=int(number(r"if confirmed > #:")),
            start_distance=number(r"reach = #\n"),
            deceleration=number(r"stopj\(#\)"),
            lookahead=number(r"lookahead_time=#,"),
            watchdog=1.0 / number(r'rtde_set_watchdog\("input_int_register_24", #, "stop"\)'),
        )


@dataclass(eq=False)
class Registers:
    """Integer and float registers of one direction; zero until they are written."""

    ints: dict[int, int] = field(default_factory=dict)
    floats: dict[int, float] = field(default_factory=dict)

    def write(self, values: Mapping[str, float]) -> None:
        """Write registers by the names of RTDE."""
        for name, value in values.items():
            kind, _, number = name.removeprefix("input_").partition("_register_")
            if kind == "int":
                self.ints[int(number)] = int(value)
            elif kind == "double":
                self.floats[int(number)] = float(value)

    def vector(self, first: int) -> Array:
        """Return six float registers."""
        return np.array([self.floats.get(first + k, 0.0) for k in range(6)])


class RegisterProgram:
    """A running program.

    Attributes:
        command: set-point of servoj in this cycle (6,) [rad].
        stage: one of `WAITING`, `STREAMING`, `STOPPING` and `ENDED`.
        watched: whether it has set the watchdog.
    """

    def __init__(
        self, constants: ProgramConstants, inputs: Registers, outputs: Registers, position: Array
    ) -> None:
        self.constants = constants
        self._inputs = inputs
        self._outputs = outputs
        self.command = position.copy()
        self.stage = WAITING
        self.watched = False
        self._received = position.copy()
        self._change: Array = np.zeros(6)
        self._number = inputs.ints.get(_FIRST_REGISTER, 0)
        self._silent = self._unused = self._confirmed = 0
        self._moves = False
        outputs.ints.update({_FIRST_REGISTER: 0, 25: WAITING, 26: 0, 28: 0, 27: constants.token})
        self._show(position)

    def _show(self, q: Array) -> None:
        self._outputs.floats.update({_FIRST_REGISTER + k: float(q[k]) for k in range(6)})

    def step(self, actual: Array, is_steady: Callable[[], bool]) -> None:
        """Run one cycle with the measured position (6,); `is_steady` is whether the arm rests."""
        ending = self._take(is_steady)
        if ending == 0 and (np.abs(actual - self.command) > self.constants.deviation).any():
            ending = _DEVIATION
        outputs = self._outputs.ints
        if ending == 0:
            outputs.update({_FIRST_REGISTER: self._number, 25: self.stage, 26: self._unused})
            self._show(self.command)
        else:
            self.stage = STOPPING
            outputs.update({28: ending, 25: STOPPING})

    def _take(self, is_steady: Callable[[], bool]) -> int:
        """Take the set-point of the registers; return why the program ends, 0 if it does not."""
        inputs = self._inputs
        number = inputs.ints.get(_FIRST_REGISTER, 0)
        demand = inputs.ints.get(_FIRST_REGISTER + 1, 0)
        q = inputs.vector(_FIRST_REGISTER)
        total = 0.0
        for value in q.tolist():
            total += value
        whole = (
            abs(total + number - inputs.floats.get(_FIRST_REGISTER + 6, 0.0)) < _CHECKSUM_TOLERANCE
        )
        if whole and demand == _END_DEMAND:
            return _ASKED
        if whole and (demand == _STOP_DEMAND or (demand == 0 and self.stage == STREAMING)):
            return _REFUSED
        if whole and demand == _STREAM_DEMAND and number not in (self._number, 0) and number > 0:
            return self._follow(q, number)
        return self._continue(is_steady)

    def _follow(self, q: Array, number: int) -> int:
        constants = self.constants
        first = self._confirmed == 0
        ahead = 1 if first or number < self._number else number - self._number
        ahead = min(ahead, constants.patience)
        reach = constants.velocity * constants.period * ahead * _REACH_MARGIN + _REACH_OFFSET
        if first:
            reach = np.full(6, constants.start_distance)
        change = q - self._received
        if not (np.abs(change) <= reach).all():
            return _STEP
        self._change = np.zeros(6) if first else change / ahead
        self._moves = bool((np.abs(self._change) > _MIN_MOVEMENT).any())
        self.watched = True
        self.command, self._received = q.copy(), q.copy()
        self._number = number
        self._silent = 0
        self._confirmed += 1
        if self._confirmed > constants.confirmed:
            self.stage = STREAMING
        return 0

    def _continue(self, is_steady: Callable[[], bool]) -> int:
        """Go on without a new set-point."""
        self._silent += 1
        if self._confirmed == 0:
            return _NO_START if self._silent > self.constants.starting else 0
        self._unused += 1
        if self._silent >= self.constants.patience:
            return _SILENCE
        if self._moves and is_steady():
            return _PAUSED
        self.command = self.command + self._change
        return 0

    def end(self) -> None:
        """Its stop is over."""
        self.stage = ENDED
        self._outputs.ints[25] = ENDED
