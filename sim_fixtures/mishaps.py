"""What befalls the mechanics from outside for some cycles: a jam, a load, a slipping encoder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Mishap = Literal["jam", "load", "slip"]

_JAM_FACTOR = 10.0
_ROWS: dict[Mishap, int] = {"jam": 0, "load": 1, "slip": 2}


class Mishaps:
    """Which axis is jammed, loaded or misread, and for how long.

    Attributes:
        changed: whether jams have changed since the last cycle.
    """

    def __init__(self, motor_torque: Sequence[float]) -> None:
        """Begin without any.

        Args:
            motor_torque: what each motor can muster on its joint, (n,) [N m].
        """
        self._torque: Array = np.array(motor_torque, dtype=np.float64)
        self._size: Array = np.zeros((3, self._torque.size))
        self._left = np.zeros((3, self._torque.size), np.int64)
        self.changed = False
        self._any = False

    def begin(self, kind: Mishap, axis: int, size: float, cycles: int) -> None:
        """Let one axis (0-based) suffer for some cycles.

        Args:
            kind: "jam": the axis is stuck; "load": a torque pushes on it; "slip": its encoder is
                read wrongly.
            axis: 0-based.
            size: load as a share of what the motor can muster; slip in motor revolutions; a jam
                has none.
            cycles: how long.
        """
        row = _ROWS[kind]
        self._size[row, axis] = size
        self._left[row, axis] = cycles
        self.changed = self._any = True

    @property
    def jam(self) -> Array | None:
        """Friction of jammed joints, (n,) [N m]; None if none is."""
        stuck = self._left[0] > 0
        return np.where(stuck, _JAM_FACTOR * self._torque, 0.0) if stuck.any() else None

    @property
    def load(self) -> Array | None:
        """Torques from outside, (n,) [N m]; None if there are none."""
        return self._of(1) * self._torque if self._any else None

    @property
    def slip(self) -> Array | None:
        """What is added to the encoder positions that are reported, (n,) [motor rev], or None."""
        return self._of(2) if self._any else None

    def _of(self, row: int) -> Array:
        values: Array = np.where(self._left[row] > 0, self._size[row], 0.0)
        return values

    def pass_cycle(self) -> None:
        """Let one cycle pass."""
        if self._any:
            before = self._left[0] > 0
            np.maximum(self._left - 1, 0, out=self._left)
            self.changed = bool((before != (self._left[0] > 0)).any())
            self._any = bool(self._left.any()) or self.changed
