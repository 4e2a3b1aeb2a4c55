r"""Current-to-torque gains of all drives, from a payload of known torque.

Weighted least squares of the measured currents on one
:func:`identification.factor.columns.gain_factor` (after Gautier and Briot 2014),

.. math:: i_m = \kappa_m \bigl(W_m \pi + t_m\bigr) + e_m, \qquad \kappa_m = 1 / K_m

bilinear and solved by Gauss-Newton; least squares of :math:`K_m i_m - W_m \pi = t_m` would bias
gains towards zero by current noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.covariance import cluster_covariance
from identification.factor.factor import Factor, NormalEquations, Solution, solve

Array = NDArray[np.float64]

WORST_RELATIVE_STD: Final = 0.05  # tolerance of a maker's torque constant
_NO_LOAD: Final = 1e-9  # relative length of the payload's column that is rounding
_ITERATIONS: Final = 50
_VANISHING: Final = 1e-100
_LEAST_NOISE: Final = 1e-6  # rounding of the Gram matrix, as a share of the current
_CONVERGED: Final = 1e-9


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of n motors."""

    motor_names: tuple[str, ...]  #: (n,)
    values: Array  #: torque per current (n,) [N·m/A or N/A], NaN if undetermined
    std: Array  #: standard deviations, cluster-robust (n,); infinite likewise
    reasons: tuple[str | None, ...]  #: why the gain is undetermined, or None
    interval_factor: float  #: standard deviations in half a 95 % interval

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which gains the data determine (n,)."""
        return np.isfinite(self.values)


def identify_gains(factor: Factor, motor_names: Sequence[str]) -> Gains:
    """Estimate gains of motors (n,), from blocks with a known payload and with another or none.

    Raises:
        IdentificationError: no usable row, or no recording with a payload.
    """
    grams = np.stack(factor.matrices, axis=1)
    total, rows = grams.sum(axis=0), factor.samples
    p = factor.n_parameters - 1
    if not rows.any():
        raise IdentificationError("no usable sample to identify gains from")
    if not total[:, p, p].any():
        raise IdentificationError(
            "no recording has a known payload, so gains and parameters have no scale"
        )
    noise, inverses = _motor_by_motor(total, rows)
    unknowns, solution = _gauss_newton(total, noise, inverses)
    clustered = cluster_covariance(*_linearised(grams, unknowns, noise)[:2], solution)
    std = np.sqrt(np.diag(clustered.covariance)[p:])
    reasons = _reasons(total, rows, unknowns[p:], solution.determined[p:], std)
    known = np.array([reason is None for reason in reasons])
    gains = 1.0 / np.where(known, unknowns[p:], 1.0)
    return Gains(
        motor_names=tuple(motor_names),
        values=np.where(known, gains, np.nan),
        # From the inverses, to first order.
        std=np.where(known, std * gains**2, np.inf),
        reasons=reasons,
        interval_factor=clustered.interval_factor,
    )


def _reasons(
    total: Array, rows: NDArray[np.intp], found: Array, determined: NDArray[np.bool_], std: Array
) -> tuple[str | None, ...]:
    """Return why each motor's gain is undetermined or None, from inverse and std (n,)."""
    p = total.shape[1] - 2
    size = np.abs(found)
    relative = np.divide(std, size, out=np.full_like(size, np.inf), where=size > _VANISHING)
    # Whether the payload's torque on a motor exceeds rounding.
    powers = np.diagonal(total, axis1=1, axis2=2)
    loaded = powers[:, p] > _NO_LOAD**2 * powers[:, :p].max(axis=1, initial=0.0)
    good = determined & (found > 0.0) & (relative <= WORST_RELATIVE_STD)
    checks = (  # first match
        (rows == 0, "the motor has no usable row"),
        (good, None),
        (~loaded, "the payload does not load it"),
        (~determined, "the payload's torque is not separable from the robot's own"),
        (~(found > 0.0), "its estimate is not positive: the payload's torque is below the noise"),
    )
    return tuple(
        next(
            (words for holds, words in checks if holds[m]),
            f"its relative standard deviation is {relative[m]:.0%}, limit {WORST_RELATIVE_STD:.0%}",
        )
        for m in range(len(total))
    )


def _motor_by_motor(total: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return current noise (n,) and inverse gain (n,), estimated separately per motor."""
    n, p = len(total), total.shape[1] - 2
    noise, inverses = np.full((2, n), np.nan)
    for m in np.flatnonzero(rows):
        gram = total[m]
        own = solve(NormalEquations(gram[:-1, :-1], gram[:-1, -1], gram[-1, -1], int(rows[m])))
        squares = gram[-1, -1] - own.values @ gram[:-1, -1]
        freedom = max(rows[m] - len(gram) + 1, 1)
        noise[m] = np.sqrt(max(squares, _LEAST_NOISE**2 * gram[-1, -1]) / freedom)
        if own.determined[p] and own.values[p] > 0.0:
            inverses[m] = own.values[p]
    known = np.isfinite(inverses)
    return noise, np.where(known, inverses, np.median(inverses[known]) if known.any() else 1.0)


def _gauss_newton(total: Array, noise: Array, inverses: Array) -> tuple[Array, Solution]:
    """Return parameters and inverse gains (p + n,) from a start (n,), and the last problem."""
    p = total.shape[1] - 2

    def problem(unknowns: Array) -> tuple[NormalEquations, float]:
        information, scores, squares = _linearised(total[None], unknowns, noise)
        return NormalEquations(information[0], scores[0]), float(squares[0])

    unknowns = np.concatenate([np.zeros(p), inverses])
    unknowns[:p] = solve(problem(unknowns)[0].part(np.arange(p))).values
    # Steps are halved if the sum of squares increases.
    damping, cost = 1.0, np.inf
    best, step = unknowns, np.zeros_like(unknowns)
    for _ in range(_ITERATIONS):
        equations, squares = problem(unknowns)
        if squares > cost * (1.0 + 1e-12):
            damping *= 0.5
            unknowns = best + damping * step
            if damping < 1e-3:
                break
            continue
        step = solve(equations).values
        best, cost, damping = unknowns, squares, 1.0
        unknowns = best + step
        if step @ equations.A @ step < _CONVERGED:
            break
    return best, solve(problem(best)[0])


def _linearised(gram: Array, unknowns: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Return information (B, k, k), scores (B, k) and weighted squares (B,) of the currents."""
    blocks, n, width, _ = gram.shape
    p = width - 2
    information, scores = np.zeros((blocks, p + n, p + n)), np.zeros((blocks, p + n))
    squares = np.zeros(blocks)
    for m in np.flatnonzero(noise > 0.0):
        inverse = unknowns[p + m]
        torque = np.concatenate([unknowns[:p], [1.0, 0.0]])  # of [W | t | i]
        slope = np.zeros((width, p + 1))
        slope[:p, :p] = inverse * np.eye(p)
        slope[:, p] = torque
        residual = -inverse * torque
        residual[-1] = 1.0
        place = np.append(np.arange(p), p + m)
        own = gram[:, m] / noise[m] ** 2
        information[:, place[:, None], place] += slope.T @ own @ slope
        scores[:, place] += own @ residual @ slope
        squares += np.einsum("i,bij,j->b", residual, own, residual)
    return information, scores, squares
