"""The angles that are shown: those of the robot description, or those of the teach pendant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .cell import Cell

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AngleFrame:
    """Angles as a cell's `[limits]` are written: shown = sign x URDF angle + offset.

    Attributes:
        name: "controller" or "urdf".
        sign: 1 or -1 per joint (n,).
        offset: (n,) [rad].
    """

    name: Literal["controller", "urdf"]
    sign: Array
    offset: Array

    @classmethod
    def of(cls, cell: Cell) -> AngleFrame:
        """The frame in which the cell's own limits and postures are written."""
        n = cell.joint_limits.n_joints
        if cell.file.limits is None or cell.file.limits.frame == "urdf":
            return cls("urdf", np.ones(n), np.zeros(n))
        table = cell.drive_table
        return cls(
            "controller",
            np.array(table.joint_sign, dtype=np.float64),
            np.radians(table.joint_offset_deg),
        )

    def shown(self, q: Array) -> Array:
        """Angles to show (..., n) [deg] from URDF angles [rad]."""
        return np.asarray(np.degrees(q * self.sign + self.offset), dtype=np.float64)

    def shown_rate(self, rate: Array) -> Array:
        """Rates to show (..., n) [deg/s, deg/s²] from those of URDF angles [rad]."""
        return np.asarray(np.degrees(rate * self.sign), dtype=np.float64)

    def text_of_angles(self, q: Array | Sequence[float]) -> str:
        """One posture (n,) [rad] of URDF angles in words, as a person would set it."""
        angles = ", ".join(
            f"J{joint} {angle:z.1f}" for joint, angle in enumerate(self.shown(np.asarray(q)), 1)
        )
        return f"{angles} deg, {self.whose}"

    @property
    def whose(self) -> str:
        """Whose angles are shown, in words."""
        return "teach pendant angles" if self.name == "controller" else "angles of the URDF"

    def urdf(self, shown: Array) -> Array:
        """URDF angles (..., n) [rad] from angles shown [deg]."""
        return np.asarray((np.radians(shown) - self.offset) * self.sign, dtype=np.float64)
