"""Where a motion stands while a person plays it, stops it and pulls at the time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Playback:
    """A clock that runs around from the end of a motion to its beginning.

    Attributes:
        duration: of the motion [s].
        time: where it stands [s].
        speed: seconds of the motion in a second.
        playing: whether the clock runs.
        pause: how long the end is shown before it begins again [s].
    """

    duration: float
    time: float = 0.0
    speed: float = 1.0
    playing: bool = True
    pause: float = 1.0
    _rested: float = 0.0

    def advance(self, seconds: float) -> None:
        """Let so much real time pass [s]."""
        if not self.playing:
            return
        if self.time >= self.duration:
            self._rested += seconds
            if self._rested >= self.pause:
                self.seek(0.0)
            return
        self.time = min(self.time + seconds * self.speed, self.duration)

    def seek(self, time: float) -> None:
        """Go to a time, the nearest there is [s]."""
        self.time = min(max(time, 0.0), self.duration)
        self._rested = 0.0
