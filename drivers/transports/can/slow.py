"""Values that go up one per cycle, in turn, and how old the last known ones are."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.packets import LAST_NUMBER
from drivers.transports.can.layout import FUNCTIONALITY, MAX_AXES

Words = NDArray[np.int32]
Ages = NDArray[np.uint16]

WORDS_PER_AXIS: Final = 9
N_QUANTITIES: Final = 8
NEVER: Final = 0xFFFF
"""Age of a value that was never received, and of one older than can be said."""
_COLUMNS: Final = (2, 6, 7, 8)
"""Columns of D2, extra1..3 in an axis block of nine words (mode first)."""
UNKNOWN: Final = int(np.float32(np.nan).view(np.int32))


def rotation(n_axes: int) -> list[int]:
    """Indices of the slow values of `n_axes` axes, in the order they are sent."""
    fields = range(len(_COLUMNS))
    values = [MAX_AXES * field + axis for field in fields for axis in range(n_axes)]
    return [*values, FUNCTIONALITY]


class SlowSender:
    """The controller's end: whose turn it is."""

    def __init__(self, n_axes: int) -> None:
        self._rotation = rotation(n_axes)
        self._turn = 0

    def next(self, words: Words, functionality: bytes) -> tuple[int, bytes]:
        """Index and four bytes of the value of this cycle; words are (n, 9)."""
        index = self._rotation[self._turn]
        self._turn = (self._turn + 1) % len(self._rotation)
        if index == FUNCTIONALITY:
            return index, functionality
        field, axis = divmod(index, MAX_AXES)
        return index, words[axis, _COLUMNS[field]].tobytes()


class SlowStore:
    """The PC's end: the last value of each, and its age.

    Attributes:
        ages: (n, 8) cycles since each of D1..D5, extra1..3 was sent, `NEVER` before the first.
        functionality: four bytes, zero before the first.
    """

    def __init__(self, n_axes: int) -> None:
        self._n_axes = n_axes
        self.forget()

    def forget(self) -> None:
        """Nothing is known."""
        self.ages: Ages = np.zeros((self._n_axes, N_QUANTITIES), np.uint16)
        self.ages[:, [column - 1 for column in _COLUMNS]] = NEVER
        self.functionality = bytes(4)
        self._values: Words = np.full((self._n_axes, len(_COLUMNS)), UNKNOWN, np.int32)
        self._elapsed = np.full((self._n_axes, len(_COLUMNS)), NEVER, np.int64)
        self._last: int | None = None

    def update(self, number: int, index: int, value: bytes, words: Words) -> int:
        """Take the slow value of a cycle and fill all of them into its words, (n, 9).

        Returns:
            Cycles since the last one taken, 0 for the first; negative where this cycle is older
            than that one. Of such a cycle nothing slow is known.
        """
        ahead = 0 if self._last is None else (number - self._last) % LAST_NUMBER
        if ahead > LAST_NUMBER // 2 or (ahead == 0 and self._last is not None):
            words[:, _COLUMNS] = UNKNOWN
            self.ages = self._as_ages(np.full_like(self._elapsed, NEVER))
            return -1
        self._last = number
        np.minimum(self._elapsed + ahead, NEVER, out=self._elapsed)
        field, axis = divmod(index, MAX_AXES)
        if index == FUNCTIONALITY:
            self.functionality = value
        elif field < len(_COLUMNS) and axis < self._n_axes:
            self._values[axis, field] = np.frombuffer(value, np.int32)[0]
            self._elapsed[axis, field] = 0
        self._values[self._elapsed == NEVER] = UNKNOWN
        words[:, _COLUMNS] = self._values
        self.ages = self._as_ages(self._elapsed)
        return ahead

    def _as_ages(self, elapsed: NDArray[np.int64]) -> Ages:
        ages: Ages = np.zeros((self._n_axes, N_QUANTITIES), np.uint16)
        ages[:, 1] = elapsed[:, 0]
        ages[:, 5:] = elapsed[:, 1:]
        return ages
