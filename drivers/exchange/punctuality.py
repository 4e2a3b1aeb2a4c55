"""Whether answers leave while the controller still waits for them."""

from __future__ import annotations

import math
from typing import Final

from drivers.session import Session
from drivers.states import State

MAX_LATE: Final = 2
"""Answers in a row that may come too late in open mode."""


class Punctuality:
    """Counts the answers that leave more than a cycle after their packet arrived.

    Each is counted as "answered late", in every state. More than `max_late` in a row, each of them
    overtaken by the controller's next packet, bring a motion to rest on its path: the controller
    has been taking no answer, or each in a later cycle than it was meant for. A controller that
    was seen to wait for its answer is not overtaken by anything.
    """

    def __init__(self, session: Session, max_late: int) -> None:
        self._session = session
        self._max_late = max_late
        self._left = -math.inf  # when the last answer left, if it was late
        self._in_a_row = 0

    def heard(self, arrived: float) -> None:
        """A packet arrived at that time and is to be answered next.

        Infinite if the time is not known: a guess must not stop a motion.
        """
        if arrived > self._left:
            self._in_a_row = 0
            return
        self._left = -math.inf
        self._in_a_row += 1
        if self._in_a_row > self._max_late and self._session.state is State.OPEN:
            self._session.stop(f"{self._in_a_row} answers in a row left too late")

    def answered(self, arrived: float, left: float) -> None:
        """The answer to that packet left at that time."""
        if left - arrived > self._session.period:
            self._session.discarded("answered late", 1)
            self._left = left
        else:
            self._left = -math.inf
