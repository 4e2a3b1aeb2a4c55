"""Quantities that were recorded at times of their own, brought onto one time base.

Two topics in one table leave holes in every row, and files of one recording have a clock each. The
stamps of the measured quantity with the fewest samples are kept, and the others are interpolated to
them: its own numbers stay as they were recorded, and nothing seems more often measured than it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.conclusions import OneTimeBase
from identification.signals.recording import GAP_STEPS

Stamps = NDArray[np.int64]

_MEASURED: Final = ("position", "torque", "motor_current")
"""Quantities of which one gives the stamps; the others may be fewer."""
_SMOOTH: Final = ("position", "velocity")
_MIN_CUBIC_SAMPLES: Final = 4  # samples of a cubic


class Timed(NamedTuple):
    """Values (k, n) at stamps (k,) [ns], NaN where one was not recorded."""

    stamp: Stamps
    values: Array


class OnOneBase(NamedTuple):
    """Quantities (m, n) by name at common stamps (m,) [ns]."""

    stamp: Stamps
    values: dict[str, Array]
    conclusion: OneTimeBase


def at_stamps(
    stamp: Stamps, known: Stamps, values: Array, *, across_gaps: bool = False, smooth: bool = False
) -> Array:
    """Return values (k, n) known at stamps (k,), at others (m,); exact where both are equal.

    Args:
        stamp: where they are wanted [ns].
        known: where they are known [ns], in any order.
        values: known values, one row each.
        across_gaps: also between stamps that are more than `GAP_STEPS` usual steps apart.
        smooth: by a cubic spline, else linear.

    Returns:
        the values, NaN outside the known ones and in gaps.
    """
    known, first = np.unique(known, return_index=True)
    values = values[first]
    if len(known) < 2:
        return np.full((len(stamp), values.shape[1]), np.nan)
    time = 1e-9 * (known - known[0])
    at = 1e-9 * (stamp - known[0])
    if smooth and len(known) >= _MIN_CUBIC_SAMPLES:
        from scipy.interpolate import CubicSpline  # only for quantities at times of their own

        result = CubicSpline(time, values)(at)
    else:
        result = np.column_stack([np.interp(at, time, column) for column in values.T])
    after = np.clip(np.searchsorted(known, stamp), 1, len(known) - 1)
    gap = np.diff(time)[after - 1] > GAP_STEPS * np.median(np.diff(time))
    outside = (stamp < known[0]) | (stamp > known[-1]) | (gap & (not across_gaps))
    result[outside & ~np.isin(stamp, known)] = np.nan
    return np.asarray(result)


def on_one_base(parts: Mapping[str, Timed], source: Path) -> OnOneBase:
    """Return quantities at the stamps of the measured one with the fewest samples.

    Stamps at which another measured quantity has no sample nearby are left out; a command is NaN
    there.

    Raises:
        SourceError: the quantities were not recorded at the same time.
    """
    columns = {name: _columns(part) for name, part in parts.items()}
    measured = [name for name in _MEASURED if name in columns]
    rarest = min(measured, key=lambda name: min(len(stamp) for stamp, _ in columns[name]))
    stamp = min((stamp for stamp, _ in columns[rarest]), key=len)
    values = {}
    for name, of_joints in columns.items():
        smooth = name in _SMOOTH
        values[name] = np.column_stack(
            [at_stamps(stamp, known, column, smooth=smooth) for known, column in of_joints]
        )
    required = [values[name] for name in values if name != "commanded_position"]
    whole = np.all([np.isfinite(array).all(axis=1) for array in required], axis=0)
    if np.count_nonzero(whole) < 2:
        spans = "; ".join(_span(name, of_joints) for name, of_joints in columns.items())
        problem = f"its quantities were not recorded at the same time ({spans})"
        remedy = "give columns of one recording, or record all of them on one clock"
        raise SourceError(source, problem, field="time", remedy=remedy)
    counts = {name: min(len(stamp) for stamp, _ in each) for name, each in columns.items()}
    conclusion = OneTimeBase(counts, rarest, int(np.count_nonzero(~whole)))
    return OnOneBase(stamp[whole], {k: array[whole] for k, array in values.items()}, conclusion)


def are_interleaved(finite: Sequence[NDArray[np.bool_]]) -> bool:
    """Return whether rows have one quantity or another, and hardly any has all.

    `finite` tells of each quantity which rows (m,) have all its numbers.
    """
    together = np.count_nonzero(np.all(finite, axis=0))
    fewest = min(np.count_nonzero(each) for each in finite)
    return bool(fewest >= _MIN_CUBIC_SAMPLES and together < 0.5 * fewest)


def _columns(part: Timed) -> list[tuple[Stamps, Array]]:
    """Return the stamps and values (k, 1) of each column, in order of time."""
    order = np.argsort(part.stamp, kind="stable")
    stamp = part.stamp[order]
    columns = []
    for column in part.values[order].T:
        has = np.isfinite(column)
        columns.append((stamp[has], column[has, None]))
    return columns


def _span(name: str, of_joints: Sequence[tuple[Stamps, Array]]) -> str:
    stamp = of_joints[0][0]
    if not len(stamp):
        return f"{name}: no number"
    return f"{name}: {1e-9 * stamp.min():.6g} to {1e-9 * stamp.max():.6g} s"
