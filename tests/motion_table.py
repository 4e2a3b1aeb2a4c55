"""Reader of motions written as comma-separated values."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly


@dataclass(frozen=True)
class MotionTable:
    """The rows of a table (m, n), and between them the quintic that meets both."""

    joint_names: tuple[str, ...]
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    @classmethod
    def of(cls, text: str) -> MotionTable:
        heading, *rows = csv.reader(io.StringIO(text))
        time, *columns = np.array(rows, dtype=np.float64).T
        quantities = (np.column_stack(columns[k::3]) for k in range(3))
        return cls(tuple(h.rpartition(".")[0] for h in heading[1::3]), time, *quantities)

    @property
    def duration(self) -> float:
        return float(self.time[-1])

    def sample(self, t: np.ndarray) -> tuple[np.ndarray, ...]:
        """Position, velocity, acceleration (m, n), at rest before and after."""
        states = np.stack((self.position, self.velocity, self.acceleration), axis=1)
        motion = BPoly.from_derivatives(self.time, states)
        within = np.clip(t, 0.0, self.duration)
        moving = (within == t)[:, None]
        return motion(within), *(motion.derivative(k)(within) * moving for k in (1, 2))
