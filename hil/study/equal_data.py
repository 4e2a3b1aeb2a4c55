"""The first two methods with as much motion of each: the longer one cut to fewer repetitions.

Equally many repetitions of motions that last differently are not equally much data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .records import FitRecord

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EqualData:
    """Which of two methods is cut, and to what.

    Attributes:
        cut: key of the method with more motion.
        repetitions: its first ones that are left.
        seconds: of motion that they are.
        other: key of the method that keeps all.
        other_seconds: of motion that it has.
    """

    cut: str
    repetitions: int
    seconds: float
    other: str
    other_seconds: float

    @property
    def name(self) -> str:
        """Name of the cut estimate."""
        return f"{self.cut}-equal"

    @classmethod
    def of(cls, fits: Mapping[str, FitRecord], keys: Sequence[str]) -> EqualData | None:
        """How to cut the longer of the first two; None where nothing is to be cut."""
        if len(keys) < 2:
            return None
        whole = {key: fits[key].duration * len(fits[key].values) for key in keys[:2]}
        other, cut = sorted(keys[:2], key=lambda key: whole[key])
        count = max(1, round(whole[other] / fits[cut].duration))
        if count >= len(fits[cut].values):
            return None
        return cls(cut, count, count * fits[cut].duration, other, whole[other])

    def estimate(self, fits: Mapping[str, FitRecord]) -> dict[str, Array]:
        """The cut estimate (p,) by its name: the mean over the repetitions that are left."""
        return {self.name: np.mean(fits[self.cut].values[: self.repetitions], axis=0)}
