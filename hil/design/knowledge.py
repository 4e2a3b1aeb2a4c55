"""What is known of the parameters before a motion is designed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Knowledge:
    """An earlier estimate, and the information that it came from.

    Attributes:
        names: of the model's parameters (p,).
        values: their estimates (p,).
        std: their standard deviations (p,), infinite for one that was not determined.
        joint_weights: 1 / variance of each joint's torque residual (n,).
        gram: information (p, p) of all that was moved, held out or not, weighted by these, as if
            sampled every `identification.excitation.SAMPLE_PERIOD`, as motions of a search are.
        samples: time samples in it, counted alike.
        repetitions: how often the new motion is going to be run.
        archives: name and SHA-256 of each file whose motion is in it.
    """

    names: tuple[str, ...]
    values: Array
    std: Array
    joint_weights: Array
    gram: Array
    samples: int
    repetitions: int
    archives: tuple[tuple[str, str], ...] = ()

    @property
    def relative_std(self) -> Array:
        """Standard deviation as a share of the value's size (p,), infinite for a value of 0."""
        size = np.abs(self.values)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(size > 0.0, self.std / size, np.inf)
