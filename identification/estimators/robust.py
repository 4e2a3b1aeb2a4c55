"""Least squares that gross errors do not carry away: iteratively reweighted (Holland, Welsch 1977).

A collision, a slipped encoder count or a burst on the wire makes rows with errors of many
standard deviations, and least squares gives one of ten deviations the say of a hundred good
rows. A robust loss bounds it. The scale of each joint's noise is found alongside, from the
median absolute residual, which bad rows hardly move.

What it does not help against: rows whose *motion* is wrong (a torn time base), and what the
model leaves out everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.covariance import clustered_covariance
from identification.estimators.losses import Huber, Loss, Tukey
from identification.factor.factor import (
    Estimate,
    Factor,
    Solution,
    augmented_rows,
    nothing_usable,
    reduced,
    undetermined_names,
)
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

MOST_ITERATIONS: Final = 60
# Change of the parameters at which the iteration ends, in their standard deviations if noise were
# white; far below anything that means something.
TOLERANCE: Final = 1e-4
# Changes, likewise and of the scales (relative), at which the scales are held and another loss may
# go on. A scale that is a thousandth off changes the fit by far less than its own uncertainty does;
# to look for it further would double the passes.
_ROUGH: Final = 0.01
_SETTLED: Final = 1e-3
OUTLYING: Final = 4.0  # scales; one Gaussian row in 16 000
# Share of outlying rows beyond which they are no gross errors, but what the model leaves out.
MOST_OUTLYING: Final = 0.1
_MAD: Final = 0.6744897501960817  # median of |x| for a standard Gaussian x
_SMALLEST_SCALE: Final = 1e-6  # of the torque's RMS


@dataclass(frozen=True, eq=False)
class RobustEstimate:
    """A robust fit and what it made of the rows.

    Attributes:
        estimate: values and cluster-robust covariance; `noise_std` is the robust scale per joint.
        outlying: share of a joint's rows more than `OUTLYING` scales off (n,), NaN without rows.
        iterations: passes over the samples.
        converged: whether the last one changed nothing more.
    """

    estimate: Estimate
    outlying: Array
    iterations: int
    converged: bool

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """Joints of which so many rows are outlying that the model is to blame (n,).

        A robust loss then leaves out what the model cannot explain instead of what is wrong,
        and predicts worse than least squares.
        """
        return np.asarray(self.outlying > MOST_OUTLYING)


@dataclass(frozen=True, eq=False)
class _State:
    """Where the iteration stands.

    Attributes:
        factor: of the rows as weighted last.
        solution: from it.
        scale: standard deviation of each joint's good residuals (n,), NaN without rows.
        residuals: per recording (m, n), of the values before the solution's.
        passes: over the samples so far.
        held: whether the scale has settled and is not looked for again.
        converged: whether the last pass changed nothing.
    """

    factor: Factor
    solution: Solution
    scale: Array
    residuals: list[Array]
    passes: int
    held: bool = False
    converged: bool = False


def robust_estimate(
    model: RobotModel,
    recordings: Sequence[Samples],
    loss: Loss = Huber(),  # noqa: B008 - frozen
    *,
    gram: Factor | None = None,
    most_iterations: int = MOST_ITERATIONS,
    tolerance: float = TOLERANCE,
) -> RobustEstimate:
    """Fit recordings with a robust loss; every iteration reads the samples once, one at a time.

    Only the residuals, one number per row, are stored. Tukey's loss starts where Huber's ends, and
    with its scales (Yohai 1987): looked for anew they can shrink with the rows that count.
    QR takes the place of Gram matrices where the condition demands it.

    Args:
        model: the robot.
        recordings: can be gone through many times: a sequence, not a generator.
        loss: what a residual costs.
        gram: factor of the recordings, if it is known: saves a pass over the samples.
        most_iterations: for each loss. What has not converged by then is returned and says so.
        tolerance: change in standard deviations that ends the iteration.

    Raises:
        IdentificationError: no recordings, or not one usable row.
    """
    factor = reduced(model, recordings, gram)
    if not factor.samples.any():
        raise IdentificationError(nothing_usable(model))
    solution = factor.solve(np.ones(model.n_joints))
    residuals = [np.full(samples.torque.shape, np.nan) for samples in recordings]
    state = _State(factor, solution, np.full(model.n_joints, np.inf), residuals, 1)
    if isinstance(loss, Tukey):
        rough = max(tolerance, _ROUGH)
        state = _iterate(model, recordings, state, Huber(), most_iterations, rough)
    state = _iterate(model, recordings, state, loss, most_iterations, tolerance)
    return _result(model, recordings, state, loss)


def _iterate(
    model: RobotModel,
    recordings: Sequence[Samples],
    state: _State,
    loss: Loss,
    most: int,
    tolerance: float,
) -> _State:
    # The first pass finds the residuals of the start; only then there is a scale.
    if not np.isfinite(state.scale).any():
        state = _pass(model, recordings, state, Loss())
    for _ in range(most):
        new = _pass(model, recordings, state, loss)
        # In standard deviations, root mean square over the parameters.
        change = new.solution.values - state.solution.values
        squares = new.factor.products(change[:, None])[:, 0, 0]
        step = float(np.sqrt(max(float(_weights(new.scale) @ squares), 0.0) / len(change)))
        known = np.isfinite(new.scale)
        moved = np.abs(new.scale[known] / state.scale[known] - 1.0).max(initial=0.0)
        settled = bool(moved <= _SETTLED and step <= _ROUGH)
        state = replace(new, held=state.held or settled, converged=state.held and step <= tolerance)
        if state.converged:
            break
    return state


def _pass(model: RobotModel, recordings: Sequence[Samples], state: _State, loss: Loss) -> _State:
    """Weight all rows by their residuals, solve, and find the scale of those, unless held."""
    residuals = [np.full(samples.torque.shape, np.nan) for samples in recordings]
    rows = _weighted_rows(model, recordings, state.solution.values, state.scale, loss, residuals)
    factor = state.factor.from_blocks(model, rows, state.factor.samples)
    weights = _weights(state.scale)
    solution = factor.solve(weights if weights.any() else np.ones(len(weights)))
    scale = state.scale
    if not state.held:
        scale = _scales(recordings, residuals, state.solution)
    return _State(factor, solution, scale, residuals, state.passes + 1, state.held)


def _weighted_rows(
    model: RobotModel,
    recordings: Sequence[Samples],
    values: Array,
    scale: Array,
    loss: Loss,
    residuals: list[Array],
) -> Iterator[list[Array]]:
    """Yield rows times the roots of their weights; writes what they leave over to `residuals`."""
    for samples, left in zip(recordings, residuals, strict=True):
        for part, blocks in augmented_rows(model, samples):
            for joint, (block, used) in enumerate(zip(blocks, model.plan.columns, strict=True)):
                error = block[-1] - values[used] @ block[:-1]
                left[part, joint] = np.where(samples.usable[part, joint], error, np.nan)
                if np.isfinite(scale[joint]):
                    block *= np.sqrt(loss.weight(error / scale[joint]))
            yield blocks


def _scales(recordings: Sequence[Samples], residuals: list[Array], solution: Solution) -> Array:
    """Standard deviation per joint (n,) from the median of |residual|, NaN without rows.

    Corrected, all joints alike, for the degrees of freedom that the parameters take.
    """
    n = residuals[0].shape[1]
    scale = np.full(n, np.nan)
    rows = sum(int(np.count_nonzero(samples.usable)) for samples in recordings)
    freedom = max(rows - solution.root.shape[1], 1)
    for joint in range(n):
        left = np.concatenate([
            one[samples.usable[:, joint], joint]
            for samples, one in zip(recordings, residuals, strict=True)
        ])  # fmt: skip
        if len(left) == 0:
            continue
        power = [np.sum(s.torque[s.usable[:, joint], joint] ** 2) for s in recordings]
        floor = _SMALLEST_SCALE * np.sqrt(np.sum(power) / len(left))
        spread = np.median(np.abs(left)) / _MAD * np.sqrt(rows / freedom)
        scale[joint] = max(float(spread), float(floor), np.finfo(np.float64).tiny ** 0.5)
    return scale


def _weights(scale: Array) -> Array:
    """Inverse squares of scales (n,), zero where there is none yet."""
    known = np.isfinite(scale)
    return np.where(known, 1.0 / np.where(known, scale, 1.0) ** 2, 0.0)


def _result(
    model: RobotModel, recordings: Sequence[Samples], state: _State, loss: Loss
) -> RobustEstimate:
    clustered = clustered_covariance(model, recordings, state.solution, _weights(state.scale), loss)
    scaled = np.concatenate(state.residuals) / state.scale
    finite = np.isfinite(scaled)
    rows = np.where(np.isfinite(state.scale), np.count_nonzero(finite, axis=0), np.nan)
    ended = "" if state.converged else ", NOT converged"
    return RobustEstimate(
        estimate=Estimate(
            names=model.parameter_names,
            units=model.units,
            values=state.solution.values,
            covariance=clustered.covariance,
            noise_std=state.scale,
            samples=state.factor.samples,
            method=f"iteratively reweighted least squares{state.factor.words}, {loss.name},"
            f" {state.passes} passes{ended}, {clustered.words}",
            condition=state.solution.condition,
            undetermined=undetermined_names(model.parameter_names, clustered.determined),
            interval_factor=clustered.interval_factor,
        ),
        outlying=np.count_nonzero(finite & (np.abs(scaled) > OUTLYING), axis=0) / rows,
        iterations=state.passes,
        converged=state.converged,
    )
