"""Whether the controller takes our set-points: its target held against those sent last.

While answers are lost the controller has to make do without; when it then hears the next one, the
arm is asked to leap by all that was lost. Unlike a packet that never arrived, a lost answer shows
nowhere but in the target that the controller reports.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.checks import require
from drivers.errors import MotionNotCarriedOn
from drivers.guard import FIRST_FRACTION, Guard

Array = NDArray[np.float64]


class TakenSetPoints:
    """The set-points sent last, in motor revolutions.

    Args:
        guard: whose following-error threshold and standstill apply.
        depth: how many of them the target received may be.
    """

    def __init__(self, guard: Guard, depth: int) -> None:
        n = guard.limits.n_joints
        self._guard = guard
        self._sent = np.zeros((depth, n))
        self._back = np.arange(depth)
        self._newest = 0
        self._lag = 0
        self._every = np.ones(n, dtype=np.bool_)

    def begin(self, target: Array) -> None:
        """The first set-point (n,) was sent, the target received."""
        self._sent[...] = target
        self._lag = 0

    def add(self, target: Array) -> None:
        """The next set-point (n,) was sent."""
        self._newest = newest = (self._newest + 1) % len(self._sent)
        self._sent[newest] = target

    def check(self, target: Array, cycle: int, where: NDArray[np.bool_] | None = None) -> int:
        """Each joint's target has to be one of the set-points sent last.

        Args:
            target: (n,) D1 received, motor revolutions.
            cycle: for the error.
            where: (n,) which joints; None for all.

        Returns:
            How many answers more than in the cycle before were not taken. What a joint at
            standstill moves in a cycle hides one.

        Raises:
            NotFinite, MotionNotCarriedOn: a target further than `FIRST_FRACTION` of the
                following-error threshold from all of them.
        """
        # As always: the set-point sent last. All else may take its time.
        if np.abs(target - self._sent[self._newest]).max() <= self._guard.limits.standstill:
            self._lag = 0
            return 0
        rows = self._sent[(self._newest - self._back) % len(self._sent)]
        off = np.abs(rows - target)
        where = self._every if where is None else where
        bound = FIRST_FRACTION * self._guard.following_error
        require(where, off.min(axis=0), bound, MotionNotCarriedOn, cycle)
        late = where & (off[0] > self._guard.limits.standstill)
        lag = int(off.argmin(axis=0)[late].max(initial=0))
        more, self._lag = max(0, lag - self._lag), lag
        return more
