"""Whether friction has changed while recordings were made, as the gears warmed up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.signals.samples import Samples

Array = NDArray[np.float64]

# A trend through fewer points is none.
FEWEST_PIECES: Final = 4
# Pieces in all: fewer leave the trend's own scatter too uncertain.
_PIECES: Final = 12
# Chance that a trend is seen where none is, per joint.
_CHANCE: Final = 0.001


@dataclass(frozen=True, eq=False)
class FrictionDrift:
    """By how much friction was higher than estimated, piece by piece in the order of recording.

    Attributes:
        share: (P, n), 0.05 for friction 5 % higher; NaN where a joint did not move.
        change: of a straight line through the pieces from the first to the last (n,).
        change_std: its standard error from the scatter about the line (n,).
        freedom: degrees of freedom of that scatter.
    """

    share: Array
    change: Array
    change_std: Array
    freedom: int

    @property
    def pieces(self) -> int:
        """Number P of pieces."""
        return len(self.share)

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Whether the trend stands out of the scatter (n,)."""
        limit = student_limit(0.5 * _CHANCE, self.freedom)
        known = np.isfinite(self.change)
        size = np.abs(np.where(known, self.change, 0.0))
        return np.asarray(size > limit * np.where(known, self.change_std, np.inf))


@dataclass(frozen=True, eq=False)
class DriftSums:
    """Of one recording, per piece and joint: friction times residual and squared, (P, n) each."""

    product: Array
    power: Array


def pieces_per_recording(recordings: int) -> int:
    """Into how many pieces a recording is cut so that a trend can be seen."""
    return max(1, -(-_PIECES // max(recordings, 1)))


def drift_sums(samples: Samples, residual: Array, friction: Array, pieces: int) -> DriftSums:
    """Sums over equal parts of a recording.

    Args:
        samples: the recording.
        residual: torque measured less predicted (m, n).
        friction: the part of the predicted torque that scales with temperature (m, n).
        pieces: number of parts.
    """
    edges = np.linspace(0, len(residual), pieces + 1).astype(np.intp)[:-1]
    rows = samples.usable
    return DriftSums(
        np.add.reduceat(np.where(rows, friction * residual, 0.0), edges, axis=0),
        np.add.reduceat(np.where(rows, friction**2, 0.0), edges, axis=0),
    )


def friction_drift(sums: Sequence[DriftSums]) -> FrictionDrift | None:
    """Trend over all pieces in order; None where they are too few.

    Of several recordings, equal parts are compared with each other: what the friction law gets
    wrong in one part of a motion is no change of friction.
    """
    product = np.concatenate([one.product for one in sums])
    power = np.concatenate([one.power for one in sums])
    if len(product) < FEWEST_PIECES:
        return None
    usual = np.median(power, axis=0)
    moved = power > 0.1 * np.where(usual > 0.0, usual, np.inf)
    share = np.where(moved, product / np.where(moved, power, 1.0), np.nan)
    parts = len(sums[0].power) if len(sums) >= FEWEST_PIECES else 1
    freedom = max(len(share) - parts - 1, 1)
    trends = [
        _trend(column, weight, parts, freedom)
        for column, weight in zip(share.T, power.T, strict=True)
    ]
    change, std = np.array(trends).T
    return FrictionDrift(share, change, std, freedom)


def _trend(share: Array, weight: Array, parts: int, freedom: int) -> tuple[float, float]:
    """Rise of a weighted straight line from the first to the last, and its standard error.

    The line is common to all parts of a motion, its level is each part's own.
    """
    known = np.isfinite(share)
    if np.count_nonzero(known) < FEWEST_PIECES + parts - 1:
        return np.nan, np.nan
    w = np.where(known, weight, 0.0)
    at = _about_means(np.linspace(-0.5, 0.5, len(share)), w, parts)
    y = _about_means(np.where(known, share, 0.0), w, parts)
    spread = float(w @ at**2)
    slope = float(w @ (at * y)) / spread
    left = np.where(known, y - slope * at, 0.0)
    lost = len(share) - int(np.count_nonzero(known))
    scale = np.count_nonzero(known) / max(freedom - lost, 1)
    variance = float(np.sum((w * at * left) ** 2)) / spread**2 * scale
    return slope, float(np.sqrt(variance))


def _about_means(values: Array, weight: Array, parts: int) -> Array:
    """Values (R parts,) less the weighted mean of their part over the R recordings."""
    table, w = values.reshape(-1, parts), weight.reshape(-1, parts)
    total = w.sum(axis=0)
    mean = (w * table).sum(axis=0) / np.where(total > 0.0, total, 1.0)
    return np.asarray((table - mean).ravel())
