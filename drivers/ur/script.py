"""The program that runs on a Universal Robots controller while the PC moves the arm.

Each controller cycle it takes the set-point in the input registers, moves by servoj and confirms in
the output registers which one it used. It ends by itself, with a stop of its own, where

- the PC asks for it, or asks for anything but set-points;
- no new set-point came for `patience` cycles; until then the last step is repeated;
- a set-point is further away than the joint's velocity allows, or the arm from its set-point;
- the program was paused (a protective stop, the pendant) and resumed without new set-points.

servoj has no limits of its own: every set-point has passed the guard of the PC before, and these
checks are the second net. The watchdog of RTDE is the third: it stops the program if the program
itself does not notice that set-points ceased.

Functions of the maker's script manual: servoj, stopj, is_steady, read_input_*, write_output_*,
rtde_set_watchdog. Nothing of anybody's program is copied.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Final

from drivers.ur.registers import (
    ANGLE_REGISTERS,
    CHECK_REGISTER,
    DEMAND_REGISTER,
    ENDING_REGISTER,
    NUMBER_REGISTER,
    STAGE_REGISTER,
    TOKEN_REGISTER,
    UNUSED_REGISTER,
    Demand,
    Ending,
    Stage,
)

STARTING_CYCLES: Final = 500
"""Cycles for which the program waits for the first set-point."""
MIN_CONFIRMED_SET_POINTS: Final = 100
"""Set-points in a row that it must have received before it says that it streams."""
START_DISTANCE: Final = 1e-3
"""Largest distance of the first set-point from where the arm rests [rad]."""
_CHECKSUM_TOLERANCE: Final = 1e-7
"""Largest difference of a frame from its sum; single registers differ by more."""
_REST_TOLERANCE: Final = 1e-6
"""Step of a joint above which the arm is to move [rad]."""
_TEMPLATE: Final = Template(Path(__file__).with_name("stream.urscript").read_text("ascii"))
_REGISTERS: Final = {
    **{f"q{joint}": register for joint, register in enumerate(ANGLE_REGISTERS)},
    "number": NUMBER_REGISTER,
    "demand": DEMAND_REGISTER,
    "check": CHECK_REGISTER,
    "stage": STAGE_REGISTER,
    "unused": UNUSED_REGISTER,
    "token_register": TOKEN_REGISTER,
    "ending": ENDING_REGISTER,
}
_CODES: Final = {
    f"{prefix}_{code.name.lower()}": int(code)
    for prefix, codes in (("is", Stage), ("by", Ending), ("to", Demand))
    for code in codes
}


@dataclass(frozen=True)
class StreamProgram:
    """Constants of the program.

    Attributes:
        token: number that no other program has, above 0.
        period: of the controller [s].
        patience: cycles without a new set-point after which it stops the arm.
        velocity: largest velocity of each joint (6,) [rad/s].
        deviation: largest distance of each joint from its set-point (6,) [rad].
        deceleration: of its stop, of the joint that moves fastest [rad/s²].
        lookahead, gain: of servoj [s, none].
    """

    token: int
    period: float
    patience: int
    velocity: Sequence[float]
    deviation: Sequence[float]
    deceleration: float
    lookahead: float = 0.03
    gain: float = 2000.0

    def text(self) -> str:
        """Return the program, as it is sent to the controller."""
        constants = {
            "velocity": _list(self.velocity),
            "deviation": _list(self.deviation),
            "token": self.token,
            "patience": self.patience,
            "starting": STARTING_CYCLES,
            "confirmed": MIN_CONFIRMED_SET_POINTS,
            **{name: f"{value:.9g}" for name, value in self._numbers().items()},
        }
        return _TEMPLATE.substitute({**constants, **_REGISTERS, **_CODES})

    def _numbers(self) -> dict[str, float]:
        return {
            "period": self.period,
            "deceleration": self.deceleration,
            "lookahead": self.lookahead,
            "gain": self.gain,
            "start_distance": START_DISTANCE,
            "still": _REST_TOLERANCE,
            "whole": _CHECKSUM_TOLERANCE,
        }


def _list(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:.9g}" for value in values) + "]"
