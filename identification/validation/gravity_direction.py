"""Whether recordings make more sense with gravity pulling another way than declared.

An arm on a wall, on a ceiling or on a tilted base, described as upright, spoils every
axis that gravity loads, and looks like many wrong torque constants at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.factor.standard_gram import StandardGram, solve, squared_errors
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

_STANDARD: Final = 9.81  # m/s²
_PASSES: Final = 2


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """The direction of gravity that fits the recordings best.

    Attributes:
        declared: gravity of the model (3,) [m/s²].
        best: gravity that fits the training motion best, of the same size (3,) [m/s²].
        ratio: squared error on unseen motion under `best` over that under `declared`: the
            geometric mean over the joints that moved.
    """

    declared: Array
    best: Array
    ratio: float

    def off(self, ratio: float, degrees: float) -> bool:
        """Whether the declared direction is wrong: less error elsewhere, and not just beside it."""
        return self.ratio < ratio and float(np.degrees(self.angle)) > degrees

    @property
    def angle(self) -> float:
        """Between the two [rad]; zero where none is declared."""
        size = float(np.linalg.norm(self.declared) * np.linalg.norm(self.best))
        if size == 0.0:
            return 0.0
        return float(np.arccos(np.clip(self.declared @ self.best / size, -1.0, 1.0)))


def find_gravity(
    model: RobotModel, training: StandardGram, held_out: StandardGram
) -> GravityDirection:
    """Fit the training motion under all directions of gravity, and predict the held-out one.

    The best of six directions along the base's axes and the declared one is refined.
    """
    size = float(np.linalg.norm(model.gravity)) or _STANDARD
    starts = [model.gravity, *(size * sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))]
    first = min(starts, key=lambda gravity: _misfit(training, gravity))
    if not np.any(first):
        return GravityDirection(model.gravity, model.gravity, 1.0)
    across = np.linalg.svd(first[None, :])[2][1:]

    def pulled(tilt: Array) -> Array:
        direction = first / size + tilt @ across
        return np.asarray(size * direction / np.linalg.norm(direction))

    found = scipy.optimize.minimize(
        lambda tilt: _misfit(training, pulled(tilt)),
        np.zeros(2),
        method="Nelder-Mead",
        options={
            "initial_simplex": [[0.0, 0.0], [0.2, 0.0], [0.0, 0.2]],
            "xatol": 1e-3,
            "fatol": 1e-3,
            "maxfev": 80,
        },
    )
    best = pulled(found.x)
    as_is, other = (_unseen(training, held_out, gravity) for gravity in (model.gravity, best))
    counts = held_out.rows > 0
    change = np.log(np.maximum(other, 1e-300)) - np.log(np.maximum(as_is, 1e-300))
    ratio = float(np.exp(change[counts].mean())) if counts.any() else 1.0
    return GravityDirection(model.gravity, best, ratio)


def _fitted(gram: Array, rows: Array) -> Array:
    """Parameters under one gravity, each joint weighted by its own residual."""
    errors = gram[:, -1, -1]
    values = np.zeros(gram.shape[1] - 1)
    for _ in range(_PASSES):
        weights = np.where(rows > 0, rows / np.maximum(errors, 1e-12 * gram[:, -1, -1] + 1e-300), 0)
        values = solve(gram, weights)
        errors = squared_errors(gram, values)
    return values


def _misfit(training: StandardGram, gravity: Array) -> float:
    """Twice the negative logarithm of the likelihood, noise variances concentrated out."""
    gram = training.under(gravity)
    errors = squared_errors(gram, _fitted(gram, training.rows))
    floor = 1e-12 * gram[:, -1, -1] + 1e-300
    return float(training.rows @ np.log(np.maximum(errors, floor)))


def _unseen(training: StandardGram, held_out: StandardGram, gravity: Array) -> Array:
    values = _fitted(training.under(gravity), training.rows)
    gram = held_out.under(gravity)
    return np.maximum(squared_errors(gram, values), 1e-12 * gram[:, -1, -1])
