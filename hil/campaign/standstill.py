"""Whether an arm that the controller moves has come to rest, seen in the records."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TARGET_MOVED = 1e-5
"""rad; a target at rest does not change at all, but its rounding may."""
ARM_MOVED = 5e-4
"""rad; more than an encoder's noise, less than any motion makes in a second."""
REST = 1.0
"""s of the controller's time without motion after which the arm is at rest."""


class Standstill:
    """Looks at records for the last motion of target or arm. A joint not known counts as moving.

    Args:
        period: cycle of the controller, s.
    """

    def __init__(self, period: float) -> None:
        self._cycles = round(REST / period)
        self._target: NDArray[np.float64] | None = None
        self._position: NDArray[np.float64] | None = None
        self._since = 0

    def take(self, records: NDArray[np.void]) -> bool:
        """Whether the arm has been at rest for `REST` at the end of the next records (k,)."""
        if not len(records):
            return False
        for record in records:
            target, position, cycle = record["target_position"], record["position"], record["cycle"]
            still = (
                self._target is not None
                and self._position is not None
                and cycle > self._since
                and bool(np.all(np.abs(target - self._target) <= TARGET_MOVED))
                and bool(np.all(np.abs(position - self._position) <= ARM_MOVED))
            )
            if not still:
                self._target, self._position = target.copy(), position.copy()
                self._since = int(cycle)
        return int(records["cycle"][-1]) - self._since >= self._cycles
