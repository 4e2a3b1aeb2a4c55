r"""Current-to-torque gains of all drives, from a payload of known torque.

Weighted least squares of the measured currents on one
:func:`identification.factor.columns.gain_factor` for each recording k (after Gautier and Briot
2014, Wπ with the payload's moments of inertia if these are unknown),

.. math:: i_m = \kappa_m \bigl(W_m \pi + \varphi_{km} f_m + \delta_{km} + t_m\bigr) + e_m, \qquad
          \kappa_m = 1 / K_m, \quad f_m = W_{m,f} \pi_f

solved by Gauss-Newton; least squares of :math:`K_m i_m - W_m \pi = t_m` would bias gains towards
zero by current noise. Friction scale and offset of a motor may differ between recordings, with the
priors of :mod:`identification.estimators.payload_estimate`: without them a gear that warmed by
some percent between two recordings counts as torque of the payload. The covariance is
cluster-robust by time of the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.covariance import Clustered, cluster_covariance
from identification.estimators.payload_problem import (
    BLOCK_STRETCH,
    FRICTION_DRIFT_STD,
    OFFSET_STD_SHARE,
)
from identification.factor.blocks import FINE_BLOCK, merged
from identification.factor.factor import MIN_NOISE, Factor
from identification.factor.normal_equations import NormalEquations, Solution, solve
from identification.model.robot import RobotModel

MAX_RELATIVE_STD: Final = 0.05  # tolerance of a maker's torque constant
MAX_BLOCKS: Final = 400
"""Blocks of time that the longest recording is reduced to."""
_MIN_LOAD_RATIO: Final = 1e-9  # relative length of the payload's column that is rounding
_MAX_ITERATIONS: Final = 50
_MIN_MAGNITUDE: Final = 1e-100
_CONVERGENCE_TOLERANCE: Final = 1e-9
_MAX_MATRIX_VALUES: Final = 2e7  # of the information matrices of all blocks
_MIN_BLOCKS: Final = 60


class GainProblem(Enum):
    """Why the gain of a motor is not determined."""

    NO_ROW = "no usable row"
    NOT_LOADED = "not loaded by the payload"
    INSEPARABLE = "payload not separable from the robot"
    NOT_POSITIVE = "not positive"
    IMPRECISE = "imprecise"


@dataclass(frozen=True)
class UndeterminedGain:
    """A gain that is not determined, and why."""

    problem: GainProblem
    relative_std: float  #: standard deviation over the gain; infinite if that is zero


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of n motors."""

    motor_names: tuple[str, ...]  #: (n,)
    values: Array  #: torque per current (n,) [N·m/A or N/A], NaN if undetermined
    std: Array  #: standard deviations, cluster-robust (n,); infinite likewise
    reasons: tuple[UndeterminedGain | None, ...]  #: why the gain is undetermined, or None
    interval_factor: float  #: standard deviations in half a 95 % interval

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which gains the data determine (n,)."""
        return np.isfinite(self.values)

    @property
    def relative_std(self) -> Array:
        """Standard deviations relative to the gains (n,), NaN if undetermined."""
        return np.asarray(self.std / np.abs(self.values))


def identify_gains(
    model: RobotModel, factors: Sequence[Factor], inertia_std: float = np.inf
) -> Gains:
    """Estimate motor gains (n,) from recordings with a known payload, and with another or none.

    Args:
        model: of the arm.
        factors: their :func:`identification.factor.columns.gain_factor`, with equal blocks.
        inertia_std: prior standard deviation of moments of inertia that are unknown [kg·m²].

    Raises:
        IdentificationError: no usable row, or no recording with a payload.
    """
    runs = [np.stack(factor.matrices, axis=1) for factor in factors]
    totals = np.stack([run.sum(axis=0) for run in runs])
    rows = np.sum([factor.samples for factor in factors], axis=0)
    p = totals.shape[-1] - 3
    if not rows.any():
        raise IdentificationError("no usable sample to identify gains from")
    total = totals.sum(axis=0)
    if not total[:, p, p].any():
        raise IdentificationError(
            "no recording has a known payload, so gains and parameters have no scale"
        )
    moments = p - model.n_parameters
    friction = np.pad(model.friction_columns, (0, moments))
    layout = _Layout(p, model.n_joints, len(runs), friction, moments, inertia_std)
    noise, inverses = _motor_by_motor(total, rows)
    unknowns, _ = _gauss_newton(layout, totals, noise, inverses)
    level = _offset_variance(layout, totals, unknowns, rows)
    unknowns, solution, clustered = _with_covariance(layout, runs, totals, noise, unknowns, level)
    std = np.sqrt(np.diag(clustered.covariance)[layout.gains])
    inverse = unknowns[layout.gains]
    reasons = _reasons(total, rows, inverse, solution.determined[layout.gains], std)
    determined = np.array([reason is None for reason in reasons])
    gains = 1.0 / np.where(determined, inverse, 1.0)
    return Gains(
        motor_names=model.joint_names,
        values=np.where(determined, gains, np.nan),
        # From the inverses, to first order.
        std=np.where(determined, std * gains**2, np.inf),
        reasons=reasons,
        interval_factor=clustered.interval_factor,
    )


class _Layout(NamedTuple):
    """Places of the unknowns: parameters, inverse gains, and by run offsets and friction scales."""

    p: int
    n: int
    runs: int
    friction: NDArray[np.bool_]  # which parameters are friction (p,)
    moments: int  # unknown moments of inertia of the payload, the last parameters
    inertia_std: float  # their prior standard deviation [kg·m²]

    @property
    def size(self) -> int:
        return self.p + self.n + 2 * self.runs * self.n

    @property
    def gains(self) -> slice:
        return slice(self.p, self.p + self.n)

    @property
    def drifts(self) -> NDArray[np.intp]:
        """Offsets and friction scales (2, runs, n)."""
        first = self.p + self.n
        return np.arange(first, self.size, dtype=np.intp).reshape(2, self.runs, self.n)

    def prior(self, offset_variance: Array) -> Array:
        """Return the information on each unknown, by the variance of offsets (n,)."""
        prior = np.zeros(self.size)
        prior[self.p - self.moments : self.p] = 1.0 / self.inertia_std**2
        prior[self.drifts[0]] = np.divide(
            1.0, offset_variance, out=np.zeros(self.n), where=offset_variance > 0.0
        )
        prior[self.drifts[1]] = 1.0 / FRICTION_DRIFT_STD**2
        return prior


def _reasons(
    total: Array, rows: NDArray[np.intp], inverse: Array, determined: NDArray[np.bool_], std: Array
) -> tuple[UndeterminedGain | None, ...]:
    """Return why each motor's gain is undetermined or None, from inverse and std (n,)."""
    p = total.shape[1] - 3
    magnitude = np.abs(inverse)
    relative = np.divide(
        std, magnitude, out=np.full_like(magnitude, np.inf), where=magnitude > _MIN_MAGNITUDE
    )
    # Whether the payload's torque on a motor exceeds rounding.
    powers = np.diagonal(total, axis1=1, axis2=2)
    loaded = powers[:, p] > _MIN_LOAD_RATIO**2 * powers[:, :p].max(axis=1, initial=0.0)
    checks = (  # first match
        (rows == 0, GainProblem.NO_ROW),
        (determined & (inverse > 0.0) & (relative <= MAX_RELATIVE_STD), None),
        (~loaded, GainProblem.NOT_LOADED),
        (~determined, GainProblem.INSEPARABLE),
        (~(inverse > 0.0), GainProblem.NOT_POSITIVE),
    )
    found = [
        next((problem for holds, problem in checks if holds[m]), GainProblem.IMPRECISE)
        for m in range(len(total))
    ]
    return tuple(
        None if problem is None else UndeterminedGain(problem, share)
        for problem, share in zip(found, relative.tolist(), strict=True)
    )


def _motor_by_motor(total: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return current noise (n,) and inverse gain (n,), estimated separately per motor."""
    n = len(total)
    p = total.shape[1] - 3
    noise, inverses = np.full((2, n), np.nan)
    unknown = np.arange(p + 1)
    for m in np.flatnonzero(rows):
        gram = total[m][np.ix_(unknown, unknown)]
        current = total[m][unknown, -1]
        solution = solve(NormalEquations(gram, current))
        squares = total[m][-1, -1] - solution.values @ current
        freedom = max(rows[m] - len(unknown), 1)
        noise[m] = np.sqrt(max(squares, MIN_NOISE**2 * total[m][-1, -1]) / freedom)
        if solution.determined[p] and solution.values[p] > 0.0:
            inverses[m] = solution.values[p]
    estimated = np.isfinite(inverses)
    return noise, np.where(
        estimated, inverses, np.median(inverses[estimated]) if estimated.any() else 1.0
    )


def _offset_variance(
    layout: _Layout, totals: Array, unknowns: Array, rows: NDArray[np.intp]
) -> Array:
    """Return the prior variance of offsets (n,), by the mean square of each motor's friction."""
    friction = np.where(layout.friction, unknowns[: layout.p], 0.0)
    gram = totals.sum(axis=0)[:, : layout.p, : layout.p]
    squares = np.einsum("i,mij,j->m", friction, gram, friction)
    return np.asarray(OFFSET_STD_SHARE**2 * squares / np.maximum(rows, 1))


def _gauss_newton(
    layout: _Layout, totals: Array, noise: Array, start: Array, prior: Array | None = None
) -> tuple[Array, Solution]:
    """Return the unknowns and the last problem, from inverse gains (n,) or all unknowns.

    Without a prior all recordings have one friction and no further offset.
    """
    if prior is None:
        free = np.arange(layout.p + layout.n)
        prior = np.zeros(layout.size)
    else:
        free = np.arange(layout.size)
    unknowns = np.zeros(layout.size)
    if len(start) == layout.size:
        unknowns[:] = start
    else:
        unknowns[layout.gains] = start

    def problem(unknowns: Array) -> tuple[NormalEquations, float]:
        information = 0.0
        scores = 0.0
        squares = 0.0
        for k, total in enumerate(totals):
            terms = _linearised(layout, k, total[None], unknowns, noise)
            information = information + terms[0][0]
            scores = scores + terms[1][0]
            squares += float(terms[2][0])
        equations = NormalEquations(
            np.asarray(information + np.diag(prior)), np.asarray(scores - prior * unknowns)
        )
        return equations, squares + float(unknowns @ (prior * unknowns))

    if len(start) != layout.size:
        unknowns[: layout.p] = solve(problem(unknowns)[0].part(np.arange(layout.p))).values
    # Steps are halved if the sum of squares increases.
    damping = 1.0
    cost = np.inf
    best = unknowns
    step = np.zeros_like(unknowns)
    for _ in range(_MAX_ITERATIONS):
        equations, squares = problem(unknowns)
        if squares > cost * (1.0 + 1e-12):
            damping *= 0.5
            unknowns = best + damping * step
            if damping < 1e-3:
                break
            continue
        part = equations.part(free)
        step = np.zeros_like(unknowns)
        step[free] = solve(part).values
        best = unknowns
        cost = squares
        damping = 1.0
        unknowns = best + step
        if step[free] @ part.A @ step[free] < _CONVERGENCE_TOLERANCE:
            break
    return best, solve(problem(best)[0])


def _with_covariance(
    layout: _Layout,
    runs: Sequence[Array],
    totals: Array,
    noise: Array,
    unknowns: Array,
    offset_variance: Array,
) -> tuple[Array, Solution, Clustered]:
    """Return unknowns with drifts, the last problem, and the covariance."""
    length = -(-max(map(len, runs)) // max(_MIN_BLOCKS, int(_MAX_MATRIX_VALUES / layout.size**2)))
    blocks = [merged(run, length) for run in runs]
    prior = layout.prior(offset_variance)
    # The prior is not scaled; the data are, by the design effect of coloured noise.
    effect = 1.0
    for _ in range(2):
        spread = noise * np.sqrt(effect)
        unknowns, solution = _gauss_newton(layout, totals, spread, unknowns, prior)
        count = max(map(len, blocks))
        information = np.zeros((count, layout.size, layout.size))
        scores = np.zeros((count, layout.size))
        for k, run in enumerate(blocks):
            terms = _linearised(layout, k, run, unknowns, spread)
            information[: len(run)] += terms[0]
            scores[: len(run)] += terms[1]
        duration = length * FINE_BLOCK  # for the description only
        clustered = cluster_covariance(
            information, scores, solution, np.diag(prior), duration, BLOCK_STRETCH
        )
        effect *= max(1.0, clustered.design_effect)
    return unknowns, solution, clustered


def _linearised(
    layout: _Layout, run: int, gram: Array, unknowns: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Return information (B, k, k), scores (B, k) and weighted squares (B,) of the currents."""
    blocks, _, width, _ = gram.shape
    p = layout.p
    (offsets, scales) = layout.drifts[:, run]
    information = np.zeros((blocks, layout.size, layout.size))
    scores = np.zeros((blocks, layout.size))
    squares = np.zeros(blocks)
    friction = np.where(layout.friction, unknowns[:p], 0.0)
    for m in np.flatnonzero(noise > 0.0):
        inverse = unknowns[p + m]
        scale = unknowns[scales[m]]
        # Of the columns [W | t | 1 | i].
        torque = np.concatenate([unknowns[:p] + scale * friction, [1.0, unknowns[offsets[m]], 0.0]])
        slope = np.zeros((width, p + 3))
        slope[:p, :p] = inverse * np.diag(1.0 + scale * layout.friction)
        slope[:, p] = torque
        slope[p + 1, p + 1] = inverse
        slope[:p, p + 2] = inverse * friction
        residual = -inverse * torque
        residual[-1] = 1.0
        place = np.append(np.arange(p), [p + m, offsets[m], scales[m]])
        weighted_gram = gram[:, m] / noise[m] ** 2
        information[:, place[:, None], place] += slope.T @ weighted_gram @ slope
        scores[:, place] += weighted_gram @ residual @ slope
        squares += np.einsum("i,bij,j->b", residual, weighted_gram, residual)
    return information, scores, squares
