"""Stretches of a recording that is too long to be read whole.

Eight hours of a cell determine a model no better than the parts of them in which the arm moves most
ways, and would take memory for each row. What is read is spread over the whole recording, so that
the arm is cold and warm in it as it was.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.importers.stamps import PAUSE_NS

MAX_EXCERPT_ROWS: Final = 480_000
"""Rows that are read of one recording."""
MAX_EXCERPT_SECONDS: Final = 800.0
"""Time that is used of one recording [s]: memory follows blocks of time."""
STRETCH_ROWS: Final = 8_192
"""Rows that are read together."""
PROBE_STRIDE: Final = 64
"""Distance in rows at which a stretch is probed for motion."""
_MIN_ACTIVITY_SHARE: Final = 0.25  # of the activity of lively stretches
_LIVELY_QUANTILE: Final = 0.9  # quantile of the stretches
_GOLDEN_RATIO: Final = 0.5 * (5.0**0.5 - 1.0)


def activity(probes: Sequence[Array]) -> Array:
    """Return how much moves in each stretch (S,), 1 as in the whole recording.

    Args:
        probes: some rows of each stretch (k, c), NaN where there is no number.

    Returns:
        standard deviations over that of all rows, mean of the channels; NaN without a number.
    """
    whole = _deviations(np.concatenate(probes))
    usable = np.isfinite(whole) & (whole > 0.0)
    if not usable.any():
        return np.full(len(probes), np.nan)
    return np.array([_mean(_deviations(probe)[usable] / whole[usable]) for probe in probes])


def chosen_stretches(moved: Array, most: int) -> NDArray[np.intp]:
    """Return the stretches to read (k,), rising: all in which something moves, or `most`.

    These are spread over the recording, at uneven distances, as programs of robots repeat.

    Args:
        moved: activity of each stretch (S,); one of NaN may contain motion.
        most: stretches that are read.
    """
    known = moved[np.isfinite(moved)]
    least = _MIN_ACTIVITY_SHARE * float(np.quantile(known, _LIVELY_QUANTILE)) if known.size else 0.0
    moving = np.flatnonzero(~(moved < least))
    if len(moving) <= most:
        return moving
    edges = np.arange(most + 1) * len(moving) / most
    within = (np.arange(most) * _GOLDEN_RATIO) % 1.0
    return np.asarray(moving[(edges[:-1] + within * np.diff(edges)).astype(np.intp)])


def excerpt_of(stamp: NDArray[np.int64], position: Array, longest: int) -> Stretches | None:
    """Return the rows to use of a recording, None if all of them.

    Args:
        stamp: (m,) [ns].
        position: (m, n), any unit.
        longest: rows of a fast recording; of others `MAX_EXCERPT_SECONDS`.
    """
    steps = np.diff(stamp)
    usual = float(np.median(steps)) if steps.size else 0.0
    rate = 1e9 / usual if usual > 0.0 else np.inf
    most = int(min(longest, MAX_EXCERPT_SECONDS * rate))
    if len(stamp) <= most:
        return None
    parts = [0, *(np.flatnonzero(steps > PAUSE_NS) + 1).tolist(), len(stamp)]
    stretches = [
        slice(start, min(start + STRETCH_ROWS, b))
        for a, b in pairwise(parts)
        for start in range(a, b, STRETCH_ROWS)
    ]
    moved = activity([position[stretch][::PROBE_STRIDE] for stretch in stretches])
    chosen = chosen_stretches(moved, most // STRETCH_ROWS)
    rows = np.concatenate([np.arange(len(stamp))[stretches[k]] for k in chosen])
    return Stretches(rows, len(chosen))


class Stretches(NamedTuple):
    """Rows of a recording that are used."""

    rows: NDArray[np.intp]  #: rising
    stretches: int


def _deviations(rows: Array) -> Array:
    """Return the standard deviation of each channel (c,) of rows (k, c) over its numbers."""
    finite = np.isfinite(rows)
    count = finite.sum(axis=0)
    known = np.where(count > 0, count, np.nan)
    mean = np.where(finite, rows, 0.0).sum(axis=0) / known
    off = np.where(finite, rows - mean, 0.0)
    return np.asarray(np.sqrt((off**2).sum(axis=0) / known))


def _mean(values: Iterable[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else np.nan
