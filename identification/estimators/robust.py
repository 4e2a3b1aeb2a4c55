"""Robust estimation by iteratively reweighted least squares (Holland and Welsch 1977)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimators.covariance import clustered_covariance
from identification.estimators.loss_functions import Huber, Loss, Tukey
from identification.factor.estimate import Estimate, estimate_of, inverse_variance
from identification.factor.estimation_method import EstimationMethod, Reweighted
from identification.factor.factor import Factor, reduced, total_factor
from identification.factor.normal_equations import Solution
from identification.factor.rows import augmented_rows
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

MAX_ITERATIONS: Final = 60
# final change of the parameters, in standard deviations of white noise
FINAL_STEP_TOLERANCE: Final = 1e-4
# Changes of parameters (likewise) and scales (relative) at which the scales are fixed and the next
# loss starts.
_STEP_TOLERANCE: Final = 0.01
_SCALE_TOLERANCE: Final = 1e-3
OUTLIER_SCALES: Final = 4.0  # scales; one Gaussian row in 16 000
MAX_OUTLIER_SHARE: Final = 0.1  # share of outlying rows above which the model is wrong
_NORMAL_MAD: Final = 0.6744897501960817  # median of |x| for a standard Gaussian x
_MIN_SCALE_SHARE: Final = 1e-6  # of the torque's RMS


@dataclass(frozen=True, eq=False)
class RobustEstimate:
    """Robust fit with its outliers."""

    estimate: Estimate  #: with cluster-robust covariance; `noise_std` is the robust scale per joint
    outlying: Array  #: share of rows beyond `OUTLIER_SCALES` scales (n,), NaN without rows
    iterations: int  #: passes over the samples
    converged: bool

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """Joints (n,) whose many outlying rows show a wrong model, not wrong data."""
        return np.asarray(self.outlying > MAX_OUTLIER_SHARE)


class _State(NamedTuple):
    """State of the iteration."""

    factor: Factor  # of the weighted rows
    solution: Solution
    scale: Array  # standard deviation of each joint's inliers (n,), NaN without rows
    residuals: tuple[Array, ...] = ()  # per recording (m, n), before the last solution
    passes: int = 1
    scale_fixed: bool = False
    converged: bool = False


def robust_estimate(
    model: RobotModel,
    recordings: Sequence[Samples],
    loss: Loss = Huber(),  # noqa: B008 - frozen
    *,
    total: Factor | None = None,
    most_iterations: int = MAX_ITERATIONS,
) -> RobustEstimate:
    """Fit recordings with a robust loss; every iteration reads the samples once.

    The noise scale of each joint is estimated from the median absolute residual; Tukey's loss
    starts from the solution and scales of Huber's (Yohai 1987).

    Args:
        model: of the arm.
        recordings: prepared.
        loss: of the residuals.
        total: factor of the recordings, which saves a pass.
        most_iterations: of the fit.

    Raises:
        IdentificationError: no recordings, or no usable row.
    """
    total = total_factor(model, recordings) if total is None else total
    factor = reduced(model, recordings, total)
    n = model.n_joints
    state = _State(factor, factor.solve(np.ones(n)), np.full(n, np.inf))
    stages = [(Huber(), _STEP_TOLERANCE)] if isinstance(loss, Tukey) else []
    for stage_loss, tolerance in [*stages, (loss, FINAL_STEP_TOLERANCE)]:
        state = state._replace(converged=False)
        for _ in range(most_iterations):
            state = _iterate(model, recordings, state, stage_loss, tolerance)
            if state.converged:
                break
    weights = inverse_variance(state.scale**2)
    clustered = clustered_covariance(model, recordings, state.solution, weights, loss)
    scaled = np.concatenate(state.residuals) / state.scale
    rows = np.where(np.isfinite(state.scale), np.count_nonzero(np.isfinite(scaled), axis=0), np.nan)
    fit = Reweighted(
        loss.name, loss.tuning, state.passes, state.converged, by_qr=factor.storage == "qr"
    )
    estimate = estimate_of(
        model.units,
        state.factor,
        state.solution._replace(determined=clustered.determined),
        weights,
        EstimationMethod(fit, clustered.blocks),
        clustered.covariance,
        clustered.interval_factor,
    )
    return RobustEstimate(
        estimate=replace(estimate, noise_std=state.scale),
        outlying=np.count_nonzero(np.abs(scaled) > OUTLIER_SCALES, axis=0) / rows,
        iterations=state.passes,
        converged=state.converged,
    )


def _iterate(
    model: RobotModel, recordings: Sequence[Samples], state: _State, loss: Loss, tolerance: float
) -> _State:
    """Weight all rows by their residuals, solve, and update the scale unless fixed."""
    residuals = tuple(np.full(samples.torque.shape, np.nan) for samples in recordings)
    rows = _weighted_rows(model, recordings, state.solution.values, state.scale, loss, residuals)
    previous = state.factor
    factor = Factor.of_rows(
        rows, previous.samples[None], model.plan.columns, previous.parameter_names, previous.storage
    )
    weights = inverse_variance(state.scale**2)
    solution = factor.solve(weights if weights.any() else np.ones(len(weights)))
    scale = state.scale if state.scale_fixed else _scales(recordings, residuals, state.solution)
    # RMS over the parameters, in standard deviations.
    change = solution.values - state.solution.values
    squares = float(inverse_variance(scale**2) @ factor.products(change[:, None])[:, 0, 0])
    step = np.sqrt(max(squares, 0.0) / len(change))
    finite = np.isfinite(scale)
    moved = np.abs(scale[finite] / state.scale[finite] - 1.0).max(initial=0.0)
    return _State(
        factor,
        solution,
        scale,
        residuals,
        state.passes + 1,
        scale_fixed=bool(
            state.scale_fixed or (moved <= _SCALE_TOLERANCE and step <= _STEP_TOLERANCE)
        ),
        converged=bool(state.scale_fixed and step <= tolerance),
    )


def _weighted_rows(
    model: RobotModel,
    recordings: Sequence[Samples],
    values: Array,
    scale: Array,
    loss: Loss,
    residuals: Sequence[Array],
) -> Iterator[tuple[NDArray[np.intp], list[Array]]]:
    """Yield rows of one block times the roots of their weights; writes to `residuals`."""
    for samples, residual in zip(recordings, residuals, strict=True):
        for rows, blocks in augmented_rows(model, samples):
            for joint, (block, used) in enumerate(zip(blocks, model.plan.columns, strict=True)):
                error = block[-1] - values[used] @ block[:-1]
                residual[rows, joint] = np.where(samples.usable[rows, joint], error, np.nan)
                if np.isfinite(scale[joint]):
                    block *= np.sqrt(loss.weight(error / scale[joint]))
            yield np.zeros(rows.stop - rows.start, dtype=np.intp), blocks


def _scales(recordings: Sequence[Samples], residuals: Sequence[Array], solution: Solution) -> Array:
    """Return the standard deviation per joint (n,) from the median of |residual|."""
    usable = np.concatenate([samples.usable for samples in recordings])
    torque = np.concatenate([samples.torque for samples in recordings])
    residual = np.concatenate(residuals)
    rows = np.count_nonzero(usable)
    wider = np.sqrt(rows / max(rows - solution.root.shape[1], 1))
    scale = np.full(residual.shape[1], np.nan)
    for joint, joint_rows in enumerate(usable.T):
        if joint_rows.any():
            floor = _MIN_SCALE_SHARE * np.sqrt(np.mean(torque[joint_rows, joint] ** 2))
            spread = np.median(np.abs(residual[joint_rows, joint])) / _NORMAL_MAD * wider
            scale[joint] = max(spread, floor, np.finfo(np.float64).tiny ** 0.5)
    return scale
