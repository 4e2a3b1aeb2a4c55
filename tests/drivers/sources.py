"""Motions of every kind, good, at the edge of the bounds, and broken."""

from __future__ import annotations

import numpy as np

PERIOD = 0.002

WILD = (float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 5e-324, 3.0, -0.5, 1e-3, 1e-7)


class Breaks:
    """What is wrong with a source, and when."""

    def __init__(self, what: str = "", index: int = 0, joint: int = 0, value: float = 0.0):
        self.what = what
        self.index = index
        self.joint = joint
        self.value = value

    def __repr__(self) -> str:
        return f"{self.what} at {self.index} in joint {self.joint}: {self.value}"


class Scripted:
    """Plays a table (m, n) of motion and one of what goes with it, with one fault."""

    def __init__(self, motion: np.ndarray, beside: np.ndarray, breaks: Breaks):
        self.motion = motion
        self.beside = beside
        self.breaks = breaks
        self.index = 0
        self.begun = self.stopped = False
        self._buffers = np.zeros((2, motion.shape[1]))

    def _breaks(self, *what: str) -> bool:
        return self.breaks.what in what and self.index >= self.breaks.index

    @property
    def finished(self):
        if self._breaks("finished raises"):
            raise RuntimeError("finished")
        if self._breaks("finishes early"):
            return True
        if self._breaks("never ends"):
            return False
        return self.index + 1 >= len(self.motion)

    asked = 0

    def advance(self):
        self.asked += 1
        if self._breaks("raises"):
            raise ZeroDivisionError("advance")
        self.index = min(self.index + 1, len(self.motion) - 1)
        motion, beside = self._buffers
        # The same arrays every time, as a source without allocations would.
        motion[:] = self.motion[self.index]
        beside[:] = self.beside[self.index]
        at = self.index == self.breaks.index
        joint = self.breaks.joint
        if at and self.breaks.what == "motion":
            motion[joint] = self.breaks.value
        if at and self.breaks.what == "jumps":
            motion[joint] += self.breaks.value
        if at and self.breaks.what == "beside":
            beside[joint] = self.breaks.value
        if self._breaks("shape"):
            return motion[:-1], beside
        if self._breaks("columns"):
            return motion[:, None], beside
        if self._breaks("nothing"):
            return None
        if self._breaks("words"):
            return ["one"] * len(motion), beside
        return motion, beside

    def stop(self):
        self.stopped = True
        if self._breaks("stop raises"):
            raise KeyError("stop")
        if not self._breaks("ignores stop"):
            self._ramp_down()

    def _ramp_down(self):
        """Half a cosine in velocity: within the bounds of a stop where it was not accelerating."""
        k = self.index
        cycles = 400
        step = self.motion[k] - self.motion[max(k - 1, 0)]
        share = 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, cycles + 1))[1:, None]
        rows = self.motion[k] + np.cumsum(share * step, axis=0)
        self.motion = np.vstack([self.motion[: k + 1], rows])
        self.beside = np.vstack([self.beside[: k + 1], share * step / PERIOD])
        self.beside[-1] = 0.0


class ScriptedMotion(Scripted):
    """A `MotionSource`."""

    def __init__(
        self, motion: np.ndarray, beside: np.ndarray, breaks: Breaks, bounds: str = "plan"
    ):
        super().__init__(motion, beside, breaks)
        self._bounds = bounds

    @property
    def start(self):
        return self.motion[0]

    @property
    def bounds(self):
        if self._breaks("lies about bounds"):
            return ("stop", "override", "none", 7)[self.breaks.joint % 4]
        return "stop" if self.stopped and self._bounds == "stop" else "plan"

    def begin(self, position):
        if self.breaks.what == "begin raises":
            raise ValueError("begin")
        self.begun = True
        self.motion = self.motion - self.motion[0] + position

    def override(self, fraction):
        if self.breaks.what == "override raises":
            raise ValueError(fraction)


def smooth(cycles: int, distance: np.ndarray) -> np.ndarray:
    """(cycles + 1, n) from zero to `distance` along a polynomial with zero jerk at both ends."""
    s = np.linspace(0.0, 1.0, cycles + 1)[:, None]
    return s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3) * distance


FAULTS = (
    "motion",
    "jumps",
    "beside",
    "raises",
    "shape",
    "columns",
    "nothing",
    "words",
    "never ends",
    "lies about bounds",
    "finished raises",
    "finishes early",
    "begin raises",
    "stop raises",
    "ignores stop",
    "override raises",
    "current",
)
