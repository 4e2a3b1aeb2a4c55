"""A motion that still grows at its end, read at times that never fall back."""

from __future__ import annotations

from typing import NamedTuple

from planner.arrays import Array, read_only
from planner.path_reader import PathReader
from planner.piecewise_cubic import PiecewiseCubic


class _Stretch(NamedTuple):
    """A part of the motion: its motion times [s] and how it is read."""

    begin: float
    end: float
    path: PathReader


class Timeline:
    """Parts of a motion in a row, of which the last may still be cut short.

    Args:
        position: Where the motion begins (n,) [rad]; the arm rests there until a part is added.
    """

    def __init__(self, position: Array) -> None:
        self._stretches: list[_Stretch] = []
        self._reading = 0
        self._rest = read_only(position)

    @property
    def end(self) -> float:
        """Motion time at which the last part ends [s]."""
        return self._stretches[-1].end if self._stretches else 0.0

    def append(self, part: PiecewiseCubic, rest: Array) -> None:
        """Add a part at the end; `rest` (n,) [rad] is where the arm then comes to rest."""
        if part.duration > 0.0:
            begin = self.end
            self._stretches.append(_Stretch(begin, begin + part.duration, PathReader(part)))
        self._rest = read_only(rest)

    def cut(self, time: float) -> None:
        """End the last part at a motion time [s] within it that was not read past yet.

        The arm does not rest there; whatever is appended next goes on from its state.
        """
        last = self._stretches[-1]
        self._stretches[-1] = last._replace(end=time)

    def forget_read(self) -> None:
        """Drop the parts before the one read last."""
        del self._stretches[: self._reading]
        self._reading = 0

    def position(self, time: float) -> Array:
        """Return the position (n,) [rad] at a motion time [s], not before the one read last."""
        stretches = self._stretches
        if not stretches or time >= stretches[-1].end:
            return self._rest
        while time >= stretches[self._reading].end:
            self._reading += 1
        begin, _, path = stretches[self._reading]
        return path.read(time - begin)[0]
