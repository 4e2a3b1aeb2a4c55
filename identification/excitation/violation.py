"""What a motion breaks, where, and by how much."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["planning", "joint limit", "duration", "collision", "torque", "current"]

KINDS: Final[tuple[Kind, ...]] = (
    "planning",
    "joint limit",
    "duration",
    "collision",
    "torque",
    "current",
)
"""Kinds of constraints; "planning" stands for a motion that there is not."""

_UNITS: dict[Kind, str] = {
    "planning": "",
    "joint limit": "",
    "duration": " s",
    "collision": " m",
    "torque": " N·m",
    "current": " A",
}


@dataclass(frozen=True)
class Violation:
    """One constraint that a motion breaks, at its worst instant.

    Attributes:
        kind: which constraint.
        subject: joint, motor ("motor of joint_3"), or the pair that comes too close.
        value: what it reaches (a distance for a collision), SI.
        bound: what it may reach at most (for a collision and a too short motion: at least), SI.
        time: when [s]; None where no instant is to blame.
        posture: joint positions there [rad]; empty where they play no part.
        scale: how far beyond the bound counts as an excess of 1, SI; None for the bound's own size.
        remedy: what to do about it, where that is known.
    """

    kind: Kind
    subject: str
    value: float
    bound: float
    time: float | None
    posture: tuple[float, ...] = ()
    scale: float | None = None
    remedy: str = ""

    @property
    def excess(self) -> float:
        """How far beyond the bound (> 0), in shares of the scale, comparable between kinds.

        A share of the limit for rates, torques, currents and durations, of the joint's range for
        positions, of the arm's length for collisions; infinite for what is no number. Absolute
        where there is no scale and the bound is zero.
        """
        scale = abs(self.bound) if self.scale is None else self.scale
        excess = abs(self.value - self.bound) / (scale or 1.0)
        return excess if np.isfinite(excess) else np.inf

    def __str__(self) -> str:
        joints = ", ".join(f"{q:.3f}" for q in self.posture)
        return self.sentence(f"({joints}) rad" if joints else "")

    def sentence(self, joints: str, unit: str | None = None) -> str:
        """In words.

        Args:
            joints: where the joints are, in words; empty to leave that out.
            unit: of value and bound, with a space before it, where they are not in SI.
        """
        unit = _UNITS[self.kind] if unit is None else unit
        text = f"{self.kind} of {self.subject}"
        if self.kind != "planning":  # where there is no motion, there are no numbers either
            text += f": {self.value:.4g}{unit}, {self._wanted(unit)}"
        if self.time is not None:
            text += f", at {self.time:.3f} s"
        if joints:
            text += f", joints at {joints}"
        return f"{text}; {self.remedy}" if self.remedy else text

    def _wanted(self, unit: str) -> str:
        side = "least" if self.value < self.bound else "most"
        return f"at {side} {self.bound:.4g}{unit} is wanted"


def excess_by_kind(violations: Iterable[Violation]) -> Array:
    """Return the largest excess of each kind of constraint, (len(KINDS),); 0 where satisfied."""
    excess = np.zeros(len(KINDS))
    for violation in violations:
        kind = KINDS.index(violation.kind)
        excess[kind] = max(excess[kind], violation.excess)
    return excess
