"""Registers by which PC and program exchange set-points, and the codes in them.

Registers 24 to 47 are those for external clients, 0 to 23 for field buses and PLCs; inputs keep
their value until they are written again, also after their writer has gone.

Source: the maker's RTDE guide, "input registers", "output registers".
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from drivers.ur.outputs import N_JOINTS

FIRST_REGISTER: Final = 24
ANGLE_REGISTERS: Final = tuple(range(FIRST_REGISTER, FIRST_REGISTER + N_JOINTS))
"""Float registers of the set-point, controller angles [rad]; in the output the one used."""
CHECK_REGISTER: Final = FIRST_REGISTER + N_JOINTS
"""Float register of the sum of set-point and number, so that no half of a frame is used."""
NUMBER_REGISTER: Final = FIRST_REGISTER
"""Integer register: number of the set-point; as an output, of the set-point used last."""
DEMAND_REGISTER: Final = FIRST_REGISTER + 1
"""Input: integer register of a `Demand`."""
STAGE_REGISTER: Final = FIRST_REGISTER + 1
"""Output: integer register of a `Stage`."""
UNUSED_REGISTER: Final = FIRST_REGISTER + 2
"""Output: cycles without a new set-point since the program began."""
TOKEN_REGISTER: Final = FIRST_REGISTER + 3
"""Output: number of the program, different from any other program's."""
ENDING_REGISTER: Final = FIRST_REGISTER + 4
"""Output: an `Ending`."""

INPUTS: Final = (
    f"input_int_register_{NUMBER_REGISTER}",
    f"input_int_register_{DEMAND_REGISTER}",
    *(f"input_double_register_{register}" for register in (*ANGLE_REGISTERS, CHECK_REGISTER)),
)
"""Inputs of one frame, in its order."""
OUTPUTS: Final = (
    *(
        f"output_int_register_{register}"
        for register in (
            NUMBER_REGISTER,
            STAGE_REGISTER,
            UNUSED_REGISTER,
            TOKEN_REGISTER,
            ENDING_REGISTER,
        )
    ),
    *(f"output_double_register_{register}" for register in ANGLE_REGISTERS),
)


class Demand(IntEnum):
    """What the PC asks of the program in a cycle; anything but `STREAM` ends it."""

    NOTHING = 0
    STREAM = 1
    END = 2
    STOP = 3


class Stage(IntEnum):
    """Stage of the program."""

    NONE = 0
    WAITING = 1
    STREAMING = 2
    STOPPING = 3
    ENDED = 4


class Ending(IntEnum):
    """Why the program ended."""

    NONE = 0
    ASKED = 1
    REFUSED = 2
    SILENCE = 3
    STEP = 4
    DEVIATION = 5
    PAUSED = 6
    NO_START = 7


ENDINGS: Final = {
    Ending.NONE: "the program on the controller was stopped there",
    Ending.ASKED: "the program on the controller ended as asked",
    Ending.REFUSED: "the program on the controller was asked to stop",
    Ending.SILENCE: "no new set-point reached the controller in time: its program stopped the arm",
    Ending.STEP: "a set-point was further than the arm can move in its time: the program on the "
    "controller stopped it",
    Ending.DEVIATION: "the arm was too far from its set-point: the program on the controller "
    "stopped it",
    Ending.PAUSED: "the program on the controller was paused and resumed: it ended",
    Ending.NO_START: "no set-point reached the controller: its program ended without moving",
}
"""Why a motion ended, by the program's own word."""
