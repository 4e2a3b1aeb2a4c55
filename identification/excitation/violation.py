"""Violated constraints of a motion: where and by how much."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from identification.arrays import Array
from identification.errors import IdentificationError

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
"""Kinds of constraints; "planning": the motion could not be planned."""


@dataclass(frozen=True)
class Violation:
    """A violated constraint of a motion at its worst instant."""

    kind: Kind  #: of the constraint
    subject: str  #: joint, motor ("motor of joint_3"), or pair of bodies
    value: float  #: reached value (a distance for a collision), SI
    bound: float  #: largest allowed value (smallest for a collision or a short motion), SI
    time: float | None  #: of the worst instant [s], if there is one
    posture: tuple[float, ...] = ()  #: joint positions there [rad]; empty if irrelevant
    scale: float | None = None  #: deviation from the bound that means an excess of 1; None: bound
    remedy: str = ""  #: empty if unknown

    @property
    def excess(self) -> float:
        """Deviation from the bound (> 0) relative to the scale, comparable between kinds.

        The scale is the limit of rates, torques, currents and durations, the joint's range for
        positions, the arm's length for collisions, 1 if zero. Infinite if not finite.
        """
        scale = abs(self.bound) if self.scale is None else self.scale
        excess = abs(self.value - self.bound) / (scale or 1.0)
        return excess if np.isfinite(excess) else np.inf

    def __str__(self) -> str:
        joints = ", ".join(f"{q:.3f}" for q in self.posture)
        return self.sentence(f"({joints}) rad" if joints else "")

    def sentence(self, joints: str, unit: str | None = None) -> str:
        """Return a message with the joint positions as given, unless empty.

        `unit` of value and bound starts with a space; None for SI.
        """
        unit = _UNITS[self.kind] if unit is None else unit
        text = f"{self.kind} of {self.subject}"
        if self.kind != "planning":
            side = "least" if self.value < self.bound else "most"
            text += f": {self.value:.4g}{unit}, must be at {side} {self.bound:.4g}{unit}"
        text += "" if self.time is None else f", at {self.time:.3f} s"
        text += f", joints at {joints}" if joints else ""
        return f"{text}; {self.remedy}" if self.remedy else text


def excess_by_kind(violations: Iterable[Violation]) -> Array:
    """Return the largest excess by kind of constraint, (len(KINDS),); 0 if satisfied."""
    excess = np.zeros(len(KINDS))
    for violation in violations:
        kind = KINDS.index(violation.kind)
        excess[kind] = max(excess[kind], violation.excess)
    return excess


class NoFeasibleMotionError(IdentificationError):
    """None of `tried` motions satisfies all constraints and excites all parameters.

    `rejected` has their number and `nearest` the smallest violation by kind of constraint;
    `unexciting` motions satisfy all constraints; `stopped`: the search was stopped before its end.
    """

    def __init__(
        self,
        rejected: Mapping[str, int],
        nearest: Mapping[str, Violation],
        *,
        tried: int | None = None,
        unexciting: int = 0,
        stopped: bool = False,
    ) -> None:
        self.rejected = dict(rejected)
        self.nearest = dict(nearest)
        self.tried = sum(self.rejected.values()) if tried is None else tried
        self.unexciting = unexciting
        self.stopped = stopped
        super().__init__(self.sentence())

    def sentence(self, text_of: Callable[[Violation], str] = str) -> str:
        """Return a message; `text_of` formats a violation."""
        reasons = [
            f"{kind} excludes {count}, smallest violation: {text_of(self.nearest[kind])}"
            for kind, count in sorted(self.rejected.items(), key=lambda item: -item[1])
        ]
        if self.unexciting:
            reasons.append(
                f"{self.unexciting} satisfy all constraints but leave a parameter without "
                "excitation"
            )
        if self.stopped:
            reasons.append("the search was stopped before its end")
        which = f"none of {self.tried} motions is feasible" if self.tried else "no motion was tried"
        return f"{which}: {'; '.join(reasons)}"
