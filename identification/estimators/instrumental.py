r"""Instrumental variables: estimates without bias from noise in the measured positions.

With instruments Z that correlate with the motion and not with its noise, here the regressor of the
planned motion, and one weight per joint in Omega,

.. math:: \hat\pi = (Z^T \Omega W)^{-1} Z^T \Omega y

is consistent for any such noise (IDIM-IV: Janot, Vandanjon and Gautier 2014); the standard
deviation grows by 1/sqrt(R²) of Shea (1997). Not covered: motion removed by a narrow smoother, and
noise that changes the sign of a slow speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.estimators.covariance import block_length, spread
from identification.factor.blocks import FINE_BLOCK, merged
from identification.factor.columns import measured_part
from identification.factor.estimate import (
    Estimate,
    estimate_of,
    inverse_variance,
    joint_weights,
    residual_variance,
)
from identification.factor.estimation_method import EstimationMethod, Instrumental, TimeBlocks
from identification.factor.factor import Factor
from identification.factor.normal_equations import MAX_CONDITION, MAX_UNDETERMINED_SHARE
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import RIGID_BANDWIDTH, Samples
from identification.signals.smoothing import SPLINE_ORDER, SmoothingSpline, fit_smoothing_spline

MAX_COMMAND_LAG: Final = 0.5  # s; position loops of industrial arms lag 5 to 100 ms
_LAG_STEP: Final = 0.01  # s
_LAG_ROWS: Final = 4000  # enough for a lag
# Commands have no noise.
_COMMAND_TOLERANCE: Final = 1e-20  # rad² or m²
# Tolerance as a share of a joint's range: clocks of repetitions differ by up to a cycle.
_PLAN_TOLERANCE: Final = 0.01
_MIN_COMMAND_RANGE: Final = 1e-4  # rad or m
_MIN_OVERLAP_SHARE: Final = 0.9
_COMPARED_INSTANTS: Final = 400  # instants


class Instruments(NamedTuple):
    """Motion for instruments, in the rows of some samples."""

    motion: Motion  # m instants of n joints
    usable: NDArray[np.bool_]  # rows with a command (m, n)
    lag: Array  # of the measured motion behind the command (n,) [s]; NaN without motion


def planned_motion(samples: Samples, commanded: Array, *, lag: Array | None = None) -> Instruments:
    """Return the motion commanded by positions (m, n) [rad or m] (NaN: none), shifted by lag.

    The lag (n,) [s] is estimated unless given.

    Raises:
        IdentificationError: no commanded position, or no joint is commanded to move.
    """
    measured = samples.motion.position
    time = samples.motion.time
    with_command = np.asarray(np.isfinite(commanded).all(axis=1))
    tolerance = np.full(commanded.shape[1], _COMMAND_TOLERANCE)
    splines = []
    for segment in samples.segments:
        rows = np.flatnonzero(with_command[segment]) + segment.start
        if len(rows) >= 2 * SPLINE_ORDER:
            segment_spline = fit_smoothing_spline(
                time[rows], commanded[rows], tolerance, widest=RIGID_BANDWIDTH
            )
            splines.append((rows, segment_spline))
    if not splines:
        raise IdentificationError("no commanded positions: no instruments")
    if lag is None:
        longest, spline = max(splines, key=lambda pair: len(pair[0]))
        lag = tracking_lag(time[longest], measured[longest], spline)
    if np.isnan(lag).all():
        raise IdentificationError("no joint is commanded to move: no instruments")
    derivatives = np.zeros((3, *measured.shape))
    usable = np.zeros(measured.shape, dtype=np.bool_)
    for rows, spline in splines:
        for joint, shift in enumerate(np.nan_to_num(lag)):
            at = time[rows] - shift
            for order in range(3):
                derivatives[order, rows, joint] = spline(at, order)[:, joint]
            usable[rows, joint] = (at >= time[rows[0]]) & (at <= time[rows[-1]])
    return Instruments(Motion(time, *derivatives), usable, lag)


def same_plan(first: tuple[Array, Array], second: tuple[Array, Array]) -> bool:
    """Return whether two pairs of times (m,) and commanded positions (m, n) are one motion."""
    (time, commanded) = first
    (other_time, other) = second
    if commanded.shape[1] != other.shape[1]:
        return False
    rows = np.isfinite(commanded).all(axis=1)
    others = np.isfinite(other).all(axis=1)
    if not rows.any() or not others.any():
        return False
    time = time[rows]
    commanded = commanded[rows]
    other_time = other_time[others]
    other = other[others]
    start = max(time[0], other_time[0])
    stop = min(time[-1], other_time[-1])
    longer = max(time[-1] - time[0], other_time[-1] - other_time[0])
    if stop - start < _MIN_OVERLAP_SHARE * longer:
        return False
    at = np.linspace(start, stop, _COMPARED_INSTANTS)
    # A quantile, since gaps are interpolated.
    apart = [
        np.quantile(
            np.abs(np.interp(at, time, a) - np.interp(at, other_time, b)), _MIN_OVERLAP_SHARE
        )
        for a, b in zip(commanded.T, other.T, strict=True)
    ]
    return bool(
        np.all(
            np.array(apart)
            <= _PLAN_TOLERANCE * np.maximum(np.ptp(commanded, axis=0), _MIN_COMMAND_RANGE)
        )
    )


def tracking_lag(time: Array, measured: Array, command: SmoothingSpline) -> Array:
    """Return the lag of axes (m, n) behind their command (n,) [s], NaN if not commanded."""
    thin = slice(None, None, max(1, len(time) // _LAG_ROWS))
    time = time[thin]
    measured = measured[thin]
    inside = time >= time[0] + MAX_COMMAND_LAG
    if np.count_nonzero(inside) >= 2 * SPLINE_ORDER:
        time = time[inside]
        measured = measured[inside]

    def misfit(lag: float) -> Array:
        return np.asarray(np.var(measured - command(time - lag), axis=0))

    grid = np.arange(-_LAG_STEP, MAX_COMMAND_LAG + _LAG_STEP, _LAG_STEP)
    table = np.array([misfit(float(lag)) for lag in grid])
    lags = np.full(measured.shape[1], np.nan)
    for joint in np.flatnonzero(np.ptp(command(time), axis=0) > 1e-6):
        best = int(np.argmin(table[:, joint]))
        lags[joint] = scipy.optimize.minimize_scalar(
            lambda lag, j=joint: misfit(lag)[j],
            bounds=(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]),
            method="bounded",
            options={"xatol": 1e-6},
        ).x
    return lags


# Below, instruments leave more than a tenth of the bias of least squares (Staiger and Stock 1997);
# each block counts as one sample.
MIN_FIRST_STAGE_F: Final = 10.0


@dataclass(frozen=True, eq=False)
class InstrumentalEstimate:
    """Estimate by instrumental variables."""

    estimate: Estimate  #: with cluster-robust covariance
    weak: tuple[str, ...]  #: parameters with weak instruments


class CrossSolution(NamedTuple):
    """Solution of ``Z^T W pi = Z^T y``."""

    values: Array  # (p,), of least (scaled) norm where undetermined
    right: Array  # R (p, k)
    left: Array  # L (p, k): R L^T is the inverse of Z^T W on the k directions determined
    condition: float  # square root of the scaled condition of Z^T W
    determined: NDArray[np.bool_]  # (p,)


def solve_cross(total: Array) -> CrossSolution:
    """Solve a Gram matrix of [Z | W | y] (2 p + 1, 2 p + 1) for pi."""
    p = len(total) // 2
    length = np.sqrt(np.diag(total)[:-1])
    scale = np.where(length > 0.0, length, 1.0)
    left = scale[:p]
    right = scale[p:]
    u, singular, vt = np.linalg.svd(total[:p, p : 2 * p] / np.outer(left, right))
    large = singular > singular[0] / MAX_CONDITION**2
    lost = np.abs(vt[~large]).max(axis=0, initial=0.0)
    root = np.sqrt(singular[large])
    own_right = vt[large].T / root / right[:, None]
    own_left = u[:, large] / root / left[:, None]
    return CrossSolution(
        values=own_right @ (own_left.T @ total[:p, -1]),
        right=own_right,
        left=own_left,
        condition=float(np.sqrt(singular[0] / singular[-1])) if singular[-1] > 0.0 else np.inf,
        determined=np.asarray(lost < MAX_UNDETERMINED_SHARE),
    )


def estimate_instrumental(
    model: RobotModel, factor: Factor, weights: Array | None = None
) -> InstrumentalEstimate:
    """Estimate with instrumental variables, from a factor of :func:`instrument_factor`.

    The covariance is the sandwich over blocks, with Z'W for W'W. Weights (n,) are by default the
    inverse residual variances of an instrumental fit weighted by least squares.

    Raises:
        IdentificationError: the factor has no rows.
    """
    p = model.n_parameters
    names = model.parameter_names
    if not factor.samples.any():
        raise IdentificationError("no row in which samples and instruments move")
    rows = measured_part(factor)
    if weights is None:
        first = joint_weights(rows)
        values = solve_cross(factor.by_block(first).sum(axis=0)).values
        root = rows.solve(first).root
        weights = inverse_variance(residual_variance(rows, values, root, first))
    blocks = factor.occupied().by_block(weights)
    total = blocks.sum(axis=0)
    solution = solve_cross(total)
    strength = np.where(solution.determined, partial_r2(total), 0.0)
    first_stage = strength / np.maximum(1.0 - strength, 1e-12) * len(blocks)
    cross = blocks[:, :p, p : 2 * p]
    moments = blocks[:, :p, -1]
    length = block_length(moments - cross @ solution.values)
    cross = merged(cross, length)
    scores = merged(moments, length) - cross @ solution.values
    moved = spread(cross, scores, solution.right, solution.left)
    estimate = estimate_of(
        model.units,
        rows,
        rows.solve(weights)._replace(
            values=solution.values, condition=solution.condition, determined=solution.determined
        ),
        weights,
        EstimationMethod(Instrumental(), TimeBlocks(len(scores), length * FINE_BLOCK)),
        moved.T @ moved,
        float(student_limit(0.025, max(1, len(scores) - 1))),
    )
    return InstrumentalEstimate(
        estimate=estimate,
        weak=tuple(
            name for name, f in zip(names, first_stage, strict=True) if f < MIN_FIRST_STAGE_F
        ),
    )


def partial_r2(total: Array) -> Array:
    """Return Shea's partial R² (p,) of a Gram matrix of [Z | W | y] (2 p + 1, 2 p + 1).

    The share of each column of W, apart from the other columns, that the instruments explain:
    (W'W)^-1_kk over (W'Z (Z'Z)^-1 Z'W)^-1_kk (Shea 1997).
    """
    p = len(total) // 2
    scale = np.sqrt(np.maximum(np.diag(total)[:-1], 1e-300))
    scaled = total[:-1, :-1] / np.outer(scale, scale)
    zz = scaled[:p, :p]
    zw = scaled[:p, p:]
    ww = scaled[p:, p:]
    inverse = partial(np.linalg.pinv, rcond=1.0 / MAX_CONDITION**2, hermitian=True)
    own_inverse = np.diag(inverse(ww))
    by_instruments = np.diag(inverse(zw.T @ inverse(zz) @ zw))
    positive = (own_inverse > 0.0) & (by_instruments > 0.0)
    share = np.where(positive, own_inverse / np.where(positive, by_instruments, 1.0), 0.0)
    return np.clip(share, 0.0, 1.0)
