"""What the cell of a recording compensates: a delay of the torque, and a payload."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self

from hil.cell import Cell
from hil.pipeline.prepared import stated_delay


@dataclass(frozen=True, order=True)
class Setup:
    """Delay of the torque and payload that a cell states; campaigns with others are not one.

    Figures are rounded to twelve digits, so that rounding makes no other setup.
    """

    delay: float = 0.0  #: [s]
    mass: float = 0.0  #: of the payload [kg]
    centre: tuple[float, ...] = ()  #: of its mass in the frame (3,) [m]; empty without a payload
    inertia: tuple[float, ...] = ()  #: about the centre (6,) [kg·m²]; empty if zero
    frame: str = ""  #: link of the description; "": the link of the last joint

    def __bool__(self) -> bool:
        return bool(self.delay or self.centre)

    @classmethod
    def of(cls, cell: Cell) -> Self:
        """Return the setup that a cell states."""
        delay = _rounded(stated_delay(cell))
        payload = cell.file.robot.payload
        if payload is None or not (payload.mass or any(payload.inertia)):
            return cls(delay)
        return cls(
            delay,
            _rounded(payload.mass),
            _all_rounded(payload.centre),
            _all_rounded(payload.inertia) if any(payload.inertia) else (),
            payload.frame or "",
        )


NO_SETUP: Final = Setup()
"""That of a cell without delay and payload."""


def _rounded(figure: float) -> float:
    return float(f"{figure:.12g}")


def _all_rounded(figures: Iterable[float]) -> tuple[float, ...]:
    return tuple(map(_rounded, figures))
