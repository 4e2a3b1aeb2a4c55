"""What a motion breaks, where, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError

Array = NDArray[np.float64]
Kind = Literal["planning", "joint limit", "duration", "collision", "torque", "current"]

_UNITS: Final[dict[Kind, str]] = {
    "planning": "",
    "joint limit": "",
    "duration": " s",
    "collision": " m",
    "torque": " N·m",
    "current": " A",
}
KINDS: Final[tuple[Kind, ...]] = tuple(_UNITS)
"""Kinds of constraints; "planning" stands for a motion that there is not."""


@dataclass(frozen=True)
class Violation:
    """One constraint that a motion breaks, at its worst instant."""

    kind: Kind  #: which constraint
    subject: str  #: joint, motor ("motor of joint_3"), or the pair that comes too close
    value: float  #: what it reaches (a distance for a collision), SI
    #: what it may reach at most (for a collision and a too short motion: at least), SI
    bound: float
    time: float | None  #: when [s]; None where no instant is to blame
    posture: tuple[float, ...] = ()  #: joint positions there [rad]; empty where they play no part
    #: how far beyond the bound counts as an excess of 1, SI; None for the bound's own size
    scale: float | None = None
    remedy: str = ""  #: what to do about it, where that is known

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
            side = "least" if self.value < self.bound else "most"
            text += f": {self.value:.4g}{unit}, at {side} {self.bound:.4g}{unit} is wanted"
        text += "" if self.time is None else f", at {self.time:.3f} s"
        text += f", joints at {joints}" if joints else ""
        return f"{text}; {self.remedy}" if self.remedy else text


def excess_by_kind(violations: Iterable[Violation]) -> Array:
    """Return the largest excess of each kind of constraint, (len(KINDS),); 0 where satisfied."""
    excess = np.zeros(len(KINDS))
    for violation in violations:
        kind = KINDS.index(violation.kind)
        excess[kind] = max(excess[kind], violation.excess)
    return excess


class NoFeasibleMotionError(IdentificationError):
    """Every motion that was tried breaks a constraint.

    Attributes:
        rejected: how many break it, by kind of constraint; a motion may count for several.
        nearest: of each kind the violation that came closest to being none.
        closest: all violations of the motion that came closest to being feasible, by their sum.
        tried: how many motions there were.
        unexciting: how many satisfied every constraint, but left a parameter without excitation.
        stopped: whether the search was stopped before its end.
    """

    def __init__(
        self,
        rejected: Mapping[str, int],
        nearest: Mapping[str, Violation],
        *,
        closest: Sequence[Violation] = (),
        tried: int | None = None,
        unexciting: int = 0,
        stopped: bool = False,
    ) -> None:
        self.rejected = dict(rejected)
        self.nearest = dict(nearest)
        self.closest = tuple(closest)
        self.tried = sum(self.rejected.values()) if tried is None else tried
        self.unexciting = unexciting
        self.stopped = stopped
        super().__init__(self.sentence())

    def sentence(self, text_of: Callable[[Violation], str] = str) -> str:
        """In words; `text_of` puts a violation into the words and units of the reader."""
        reasons = [
            f"{kind} forbids {count}, the mildest: {text_of(self.nearest[kind])}"
            for kind, count in sorted(self.rejected.items(), key=lambda item: -item[1])
        ]
        worst: dict[str, Violation] = {}
        for violation in sorted(self.closest, key=lambda violation: -violation.excess):
            worst.setdefault(violation.kind, violation)
        if len(self.closest) > 1:
            breaks = " and ".join(map(text_of, worst.values()))
            reasons.append(f"the motion that comes closest breaks {breaks}")
        if self.unexciting:
            reasons.append(
                f"{self.unexciting} keep every constraint but leave a parameter without excitation"
            )
        if self.stopped:
            reasons.append("the search was stopped before its end")
        which = f"none of {self.tried} motions is feasible" if self.tried else "no motion was tried"
        return f"{which}: {'; '.join(reasons)}"
