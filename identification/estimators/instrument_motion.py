"""Motion without measurement noise for instrumental variables: planned, or simulated.

An instrument need not be right, only close to the motion and independent of its noise. The
planned motion is what the controller was commanded, later by the lag with which each axis follows;
the lag is one number per axis from thousands of noisy samples, so no noise to speak of gets in.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.model.motion import Motion
from identification.signals.samples import RIGID_BANDWIDTH, Samples
from identification.signals.smoothing import ORDER, SmoothingSpline, fit_smoothing_spline

Array = NDArray[np.float64]

LONGEST_LAG: Final = 0.5  # s; position loops of industrial arms lag 5 to 100 ms
_LAG_STEP: Final = 0.01  # s
_ROWS: Final = 4000  # enough for a lag, however long the recording
# A command is followed as closely as a spline of this bandwidth can: it has no noise.
_COMMAND_TOLERANCE: Final = 1e-20  # rad² or m²
# Of a joint's own range: clocks of repetitions start within a cycle of each other.
_SAME_PLAN: Final = 0.01
_STILL: Final = 1e-4  # rad or m
_OVERLAP: Final = 0.9
_COMPARED: Final = 400  # instants


class Instruments(NamedTuple):
    """Motion to make instruments from, in the rows of some samples.

    Attributes:
        motion: m instants of n joints.
        usable: where it is known (m, n).
        lag: by which the measured motion follows the command (n,) [s]; NaN for a joint that
            does not move, or where nothing was shifted.
        source: where it comes from, in words.
    """

    motion: Motion
    usable: NDArray[np.bool_]
    lag: Array
    source: str


def planned_motion(
    samples: Samples,
    commanded: Array,
    *,
    bandwidth: float = RIGID_BANDWIDTH,
    lag: Array | None = None,
) -> Instruments:
    """Commanded motion, shifted by the lag of each axis.

    Args:
        samples: the measured motion.
        commanded: commanded positions in the rows of the samples (m, n) [rad or m], NaN where
            nothing was commanded.
        bandwidth: of the derivatives [Hz]; the same as that of the measured motion's.
        lag: of each axis where it is known from the same motion (n,) [s]; else it is sought.

    Raises:
        ShapeError: the commanded positions do not have the shape of the samples.
        IdentificationError: no row has a commanded position, or no joint is commanded to move.
    """
    measured, time = samples.motion.position, samples.motion.time
    if commanded.shape != measured.shape:
        raise ShapeError("commanded", commanded.shape, str(measured.shape))
    known = np.asarray(np.isfinite(commanded).all(axis=1))
    splines = []
    for segment in samples.segments:
        rows = np.flatnonzero(known[segment]) + segment.start
        if len(rows) < 2 * ORDER:
            continue
        tolerance = np.full(commanded.shape[1], _COMMAND_TOLERANCE)
        spline = fit_smoothing_spline(time[rows], commanded[rows], tolerance, widest=bandwidth)
        splines.append((rows, spline))
    if not splines:
        raise IdentificationError("nothing was commanded: there are no instruments to be had")
    if lag is None:
        longest_rows, longest = max(splines, key=lambda pair: len(pair[0]))
        lag = tracking_lag(time[longest_rows], measured[longest_rows], longest)
    if np.isnan(lag).all():
        raise IdentificationError("no joint is commanded to move: there are no instruments")
    shape = (3, *measured.shape)
    derivatives, usable = np.zeros(shape), np.zeros(measured.shape, dtype=np.bool_)
    for rows, spline in splines:
        for joint, own in enumerate(np.nan_to_num(lag)):
            at = time[rows] - own
            for order in range(3):
                derivatives[order, rows, joint] = spline(at, order)[:, joint]
            usable[rows, joint] = (at >= time[rows[0]]) & (at <= time[rows[-1]])
    return Instruments(
        Motion(time, *derivatives), usable, lag, "the commanded motion, later by each axis's lag"
    )


def same_plan(first: tuple[Array, Array], second: tuple[Array, Array]) -> bool:
    """Whether two recordings were commanded the same motion.

    Args:
        first: time since the motion's origin (m,) [s] and commanded positions (m, n), NaN where
            nothing was commanded.
        second: likewise; compared where both are known.
    """
    (time, one), (other_time, other) = first, second
    if one.shape[1] != other.shape[1]:
        return False
    rows, others = np.isfinite(one).all(axis=1), np.isfinite(other).all(axis=1)
    if not rows.any() or not others.any():
        return False
    time, one, other_time, other = time[rows], one[rows], other_time[others], other[others]
    start, stop = max(time[0], other_time[0]), min(time[-1], other_time[-1])
    longer = max(time[-1] - time[0], other_time[-1] - other_time[0])
    if stop - start < _OVERLAP * longer:
        return False
    at = np.linspace(start, stop, _COMPARED)
    # Not the largest: across a gap the two are not known.
    apart = [
        np.quantile(np.abs(np.interp(at, time, a) - np.interp(at, other_time, b)), _OVERLAP)
        for a, b in zip(one.T, other.T, strict=True)
    ]
    return bool(np.all(np.array(apart) <= _SAME_PLAN * np.maximum(np.ptp(one, axis=0), _STILL)))


def tracking_lag(time: Array, measured: Array, command: SmoothingSpline) -> Array:
    """Time by which each axis follows its command (n,) [s], NaN for one that is not moved.

    The shift that leaves the smallest variance of the difference: a constant one, as gravity
    makes it, does not count.

    Args:
        time: (m,) [s].
        measured: positions (m, n) [rad or m].
        command: spline through the commanded positions.
    """
    thin = slice(None, None, max(1, len(time) // _ROWS))
    time, measured = time[thin], measured[thin]
    inside = time >= time[0] + LONGEST_LAG
    if np.count_nonzero(inside) < 2 * ORDER:
        inside = np.ones(len(time), dtype=np.bool_)
    at, wanted = time[inside], measured[inside]

    def misfit(lag: float) -> Array:
        return np.asarray(np.var(wanted - command(at - lag), axis=0))

    grid = np.arange(-_LAG_STEP, LONGEST_LAG + _LAG_STEP, _LAG_STEP)
    table = np.array([misfit(float(lag)) for lag in grid])
    moves = np.ptp(command(at), axis=0) > 1e-6
    lags = np.full(measured.shape[1], np.nan)
    for joint in np.flatnonzero(moves):
        best = int(np.argmin(table[:, joint]))
        around = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        lags[joint] = scipy.optimize.minimize_scalar(
            lambda lag, j=joint: misfit(lag)[j],
            bounds=around,
            method="bounded",
            options={"xatol": 1e-6},
        ).x
    return lags
