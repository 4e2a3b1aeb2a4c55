"""Whether the controller takes our set-points: its target held against those sent last.

While answers are lost the controller has to make do without; when it then hears the next one, the
arm is asked to leap by all that was lost. Unlike a packet that never arrived, a lost answer shows
nowhere but in the target that the controller reports. A packet that never arrived is no answer
either: a controller that carries its target on meanwhile reports one ahead of those sent.

A controller may report each target a cycle late, which looks like one answer lost for ever. One
that was seen to report the target sent last, while that moved, does not.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.checks import require
from drivers.errors import MotionNotCarriedOn
from drivers.guard import FIRST_FRACTION, Guard

Array = NDArray[np.float64]

LEAP_FRACTION: Final = 0.25
"""Share of the following-error threshold allowed between target and set-point sent last."""
LONGEST_CARRY: Final = 10
"""Packets missed in a row for which a target may have been carried on: a path is no straight line
for longer, and what the controller passed has to be computed within one cycle."""
REPEATS: Final = 10
"""Times in a row that a set-point may be sent again."""


class SentSetPoints:
    """The set-points sent last, in motor revolutions.

    Args:
        guard: whose following-error threshold and standstill apply.
        depth: how many of them, not counting what was sent again, the target received may be.

    Attributes:
        ahead: set-points that the controller passed by itself after more packets were missed than
            `depth` allows for, so that a motion has to go on from there.
    """

    def __init__(self, guard: Guard, depth: int) -> None:
        n = guard.limits.n_joints
        self._guard = guard
        self._depth = depth
        # One more than allowed, so that one too many can be counted.
        self._sent = np.zeros((depth + 1 + REPEATS, n))
        self._back = np.arange(len(self._sent))
        self._ahead = np.arange(1.0, max(depth, LONGEST_CARRY + 1))[:, None]
        self._newest = 0
        self._lag = 0
        self._repeats = 0
        self._punctual = False
        self.ahead = 0
        self._every = np.ones(n, dtype=np.bool_)

    def begin(self, target: Array) -> None:
        """The first set-point (n,) was sent, the target received."""
        self._sent[...] = target
        self._lag = self._repeats = self.ahead = 0
        self._punctual = False

    def add(self, target: Array) -> None:
        """The next set-point (n,) was sent."""
        self._repeats = 0
        self._put(target)

    def repeat(self) -> int:
        """The one sent last was sent again; returns for which time in a row."""
        self._repeats += 1
        self._put(self._sent[self._newest])
        return self._repeats

    def _put(self, target: Array) -> None:
        self._newest = newest = (self._newest + 1) % len(self._sent)
        self._sent[newest] = target

    def check(
        self, target: Array, missed: int, cycle: int, where: NDArray[np.bool_] | None = None
    ) -> int:
        """Each joint's target has to be one of the set-points sent last, or the last carried on.

        Args:
            target: (n,) D1 received, motor revolutions.
            missed: packets before this one that were not answered: for so many steps, but no more
                than `LONGEST_CARRY`, the controller may have carried on.
            cycle: for the error.
            where: (n,) which joints; None for all.

        Returns:
            How many answers more than in the cycle before were not taken. What a joint at
            standstill moves in a cycle hides one.

        Raises:
            NotFinite, MotionNotCarriedOn: a target further than `FIRST_FRACTION` of the
                following-error threshold from all of them, or than `LEAP_FRACTION` from the last,
                unless it was carried on for so long that the motion goes on from there.
        """
        sent, standstill = self._sent, self._guard.limits.standstill
        newest = sent[self._newest]
        self.ahead = 0
        # As always: the set-point sent last. All else may take its time.
        if np.abs(target - newest).max() <= standstill:
            # Where hardly anything moves, a target reported late looks the same.
            if not self._punctual:
                self._punctual = bool(np.abs(newest - sent[self._newest - 1]).max() > standstill)
            if self._punctual:
                self._lag = 0
            return 0
        rows = sent[(self._newest - self._back) % len(sent)]
        carried = self._carried(missed)
        late, ahead = np.abs(rows - target), np.abs(carried - target)
        where = self._every if where is None else where
        oldest = self._depth + self._repeats
        nearest = np.minimum(late[:oldest].min(axis=0), ahead.min(axis=0, initial=np.inf))
        threshold = self._guard.following_error
        require(where, nearest, FIRST_FRACTION * threshold, MotionNotCarriedOn, cycle)
        if missed >= self._depth and len(carried):
            off = np.vstack((late[0], *ahead))[:, where].max(axis=1)
            self.ahead = int(off.argmin())
        if not self.ahead:
            require(where, late[0], LEAP_FRACTION * threshold, MotionNotCarriedOn, cycle)
        behind = where & (late[0] > standstill)
        behind &= late.min(axis=0) <= ahead.min(axis=0, initial=np.inf)
        lag = int(late[: self._depth + 1 + self._repeats].argmin(axis=0)[behind].max(initial=0))
        more, self._lag = max(0, lag - self._lag), lag
        return more

    def carried_on(self, target: Array, missed: int) -> Array:
        """(n,) the set-point sent last, carried on by the steps that lead nearest to a target."""
        candidates = np.vstack((self._sent[self._newest], self._carried(missed)))
        nearest = np.abs(candidates - target).argmin(axis=0)
        chosen: Array = np.take_along_axis(candidates, nearest[None], axis=0)[0]
        return chosen

    def _carried(self, missed: int) -> Array:
        """(k, n) the set-point sent last, carried on by one step, two, and so on."""
        newest = self._sent[self._newest]
        step = newest - self._sent[self._newest - 1 - self._repeats]
        carried: Array = newest + self._ahead[:missed] * step
        return carried
