"""Whether the controller accepts our set-points: its target compared with those sent last.

While answers are lost the controller holds its target. Were the motion to go on meanwhile, the next
set-point that it hears would be as many steps away. So the last one is sent again until the target
shows that it was accepted: the motion waits, as it does for packets. Unlike a packet that never
arrived, a lost answer shows nowhere but in that target. A packet that never arrived is no answer
either: a controller that carries its target on meanwhile reports one ahead of those sent.

A controller that reports its target a cycle late looks the same in its first cycle, and to a
repetition of the last set-point in every second one. It is known by the first steps of a motion,
which are small (`SLOW`): there nothing is sent again, and what the target is behind by then is no
loss from then on. A link that becomes so late at speed is a loss in every second cycle, which soon
brings the motion to rest; on that way it counts as late.
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
SLOW: Final = 4.0
"""Times what counts as standstill: some 2 % of full speed. Of such steps several may be made up in
one cycle."""
REPETITIONS: Final = 100
"""Times that a set-point is sent again, at most, to a controller that does not accept it."""


class SentSetPoints:
    """The set-points sent last, in motor revolutions.

    Args:
        guard: whose following-error threshold and standstill apply.
        depth: how many of them the target received may be.

    Attributes:
        again: the controller did not accept the last one: it is to be sent once more.
        lag: cycles that the controller is known to report its target late.
    """

    def __init__(self, guard: Guard, depth: int) -> None:
        n = guard.limits.n_joints
        self._guard = guard
        self._depth = depth
        # One more than allowed, so that one too many can be counted.
        self._sent = np.zeros((depth + 1, n))
        self._back = np.arange(depth + 1)
        self._ahead = np.arange(1.0, depth)[:, None]
        self._newest = 0
        self.lag = 0
        self._repeated = 0
        self._unsure = False
        self.again = False
        self._every = np.ones(n, dtype=np.bool_)

    def begin(self, target: Array) -> None:
        """The first set-point (n,) was sent, the target received."""
        self._sent[...] = target
        self.lag = self._repeated = 0
        self._unsure = self.again = False

    def go_on_from(self, target: Array, step: Array) -> None:
        """The controller carried on to this target (n,) by this step (n,); as late as before."""
        self._sent[(self._newest - self._back) % len(self._sent)] = (
            target - self._back[:, None] * step
        )
        self._repeated, self._unsure, self.again = 0, False, False

    def repeat(self) -> None:
        """The last set-point was sent once more."""
        self._repeated += 1

    def add(self, target: Array) -> None:
        """The next set-point (n,) was sent."""
        self._unsure, self._repeated = self._repeated > 0, 0
        self._newest = newest = (self._newest + 1) % len(self._sent)
        self._sent[newest] = target

    def check(
        self,
        target: Array,
        missed: int,
        cycle: int,
        where: NDArray[np.bool_] | None = None,
        *,
        stopping: bool = False,
    ) -> int:
        """Each joint's target has to be one of the set-points sent last, or the last carried on.

        Args:
            target: (n,) D1 received, motor revolutions.
            missed: packets before this one that were not answered: for so many steps, but less
                than `depth`, the controller may have carried on.
            cycle: for the error.
            where: (n,) which joints; None for all.
            stopping: the motion is being brought to rest.

        Returns:
            How many answers more than in the cycle before were not accepted. What a joint at
            standstill moves in a cycle hides one.

        Raises:
            NotFinite, MotionNotCarriedOn: a target further than `FIRST_FRACTION` of the
                following-error threshold from all of them, or than `LEAP_FRACTION` from the last,
                or that is not the last one though this was sent `REPETITIONS` times.
        """
        sent, standstill = self._sent, self._guard.limits.standstill
        newest = sent[self._newest]
        self.again = False
        # As always: the set-point sent last. All else may take its time.
        if np.abs(target - newest).max() <= standstill:
            # Where hardly anything moves, a target reported late looks the same.
            step = np.abs(newest - sent[self._newest - 1]).max()
            if self.lag and not self._repeated and step > standstill:
                self.lag = 0
            return 0
        rows = sent[(self._newest - self._back) % len(sent)]
        carried = newest + self._ahead[:missed] * (newest - rows[1])
        late, ahead = np.abs(rows - target), np.abs(carried - target)
        where = self._every if where is None else where
        nearest = np.minimum(late[: self._depth].min(axis=0), ahead.min(axis=0, initial=np.inf))
        threshold = self._guard.following_error
        require(where, nearest, FIRST_FRACTION * threshold, MotionNotCarriedOn, cycle)
        require(where, late[0], LEAP_FRACTION * threshold, MotionNotCarriedOn, cycle)
        behind = where & (late[0] > standstill)
        behind &= late.min(axis=0) <= ahead.min(axis=0, initial=np.inf)
        lag = int(late.argmin(axis=0)[behind].max(initial=0))
        more = max(0, lag - self.lag)
        known_late = stopping and self._unsure
        if not more or known_late or np.abs(newest - rows[1]).max() <= SLOW * standstill:
            self.lag = lag
            return 0 if known_late else more
        self.again = True
        if self._repeated >= REPETITIONS:
            require(where, late[0], np.full_like(newest, standstill), MotionNotCarriedOn, cycle)
        return 1 if self._repeated else more
