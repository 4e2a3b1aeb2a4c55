r"""Sizes of changes, estimated by least squares together with all parameters of the arm.

The torque of joint j in block b, where a change multiplies a part of it by 1 + s, is

.. math:: \tau_{jb} = (1 + u_j \sigma_j)\, W_j \, ((1 + m_{jb} s)\circ\pi) + C_{jb}\, c + e

with m = 1 where the change is, for parameters that it concerns (all, or friction); C are columns of
changes that add a torque (payload, delay, friction by the load), their size among the c. Gauss-
Newton on s, parameters, c and the scales of the other torques, with what is believed of the arm and
of scales (standard deviations u). So s is the number by which one has to divide the torque to make
it consistent with the others: where the parameters were fitted to it, their torque is no reference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.estimators.covariance import cluster_covariance, solve_with_prior
from identification.estimators.prior import GaussianPrior
from identification.factor.normal_equations import NormalEquations
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.torque_columns import ColumnSums, columns_of
from identification.model.link_wrenches import MASS_INDEX
from identification.model.robot import RobotModel

_SCALING: Final = ("scale", "friction")
_SIZED: Final = (*_SCALING, "delay", "drift", "load friction", "payload")
_MAX_ITERATIONS: Final = 30
_STEP_TOLERANCE: Final = 1e-3  # of an unknown and its deviation
_MIN_STEP_FACTOR: Final = 0.1  # factor of a factor, in one step
_MIN_NOISE_SHARE: Final = 1e-6  # of the torque


class ScorePrior(NamedTuple):
    """What is believed of an arm in addition to fitted rows."""

    gaussian: GaussianPrior
    design_effect: float  # rows that count as one


class ChangeSize(NamedTuple):
    """Size of a change: delay [s], drift [rad], factor less one, mass [kg] or share of the load."""

    size: float
    std: float  # cluster-robust, with that of the prior
    interval_factor: float  # standard deviations in half a 95 % interval

    def or_as(self, other: ChangeSize) -> ChangeSize:
        """Return it with a deviation that includes its distance from another estimate of it."""
        return self._replace(std=math.hypot(self.std, self.size - other.size))

    def differs_from(self, other: ChangeSize) -> bool:
        """Whether it differs significantly from another size, by its own deviation."""
        return abs(self.size - other.size) > SIGNIFICANT_SIGMAS * self.std


def estimated_size(
    change: Change,
    tables: ColumnSums,
    model: RobotModel,
    values: Array,
    *,
    known: Sequence[Change] = (),
    prior: ScorePrior | None = None,
    scale_std: Array | None = None,
) -> ChangeSize | None:
    """Return the size of a change, None of one without size or that the motion does not determine.

    Args:
        change: to be sized.
        tables: of the recordings, with the rate and the load of `values`.
        model: of the arm.
        values: parameters (p,) near those of the arm, where the estimate begins.
        known: changes that are there as well.
        prior: what is believed of the arm.
        scale_std: relative standard deviations (n,) of the torques' scales, by default exact.
    """
    if change.meaning not in _SIZED:
        return None
    problem = _Problem.of(change, tables, model, values, known, prior, scale_std)
    return problem.size(values)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Sums over [W | C | torque] by block and joint, and what the unknowns do to them.

    The unknowns are p parameters, s, n scales and r coefficients.
    """

    gram: Array  # (B, n, p + r + 1, p + r + 1)
    rows: NDArray[np.intp]  # (n,)
    concerned: Array  # m as parts of the parameters (B, n, p), zero of changes that add a torque
    scale_std: Array  # (n,), zero of the torques whose scale is s
    information: Array  # of the prior of all unknowns (k, k)
    mean: Array  # of it (k,)
    sizes: NDArray[np.intp]  # unknowns whose median is the size

    @classmethod
    def of(
        cls,
        change: Change,
        tables: ColumnSums,
        model: RobotModel,
        values: Array,
        known: Sequence[Change],
        prior: ScorePrior | None,
        scale_std: Array | None,
    ) -> _Problem:
        """Reduce the tables."""
        blocks, n, width, _ = tables.gram.shape
        p = tables.n_parameters
        scaling = change.meaning in _SCALING
        added = [columns_of(tables, model, values, each) for each in known]
        if not scaling:
            added.insert(0, columns_of(tables, model, values, change))
        parameters = np.broadcast_to(np.eye(width, p), (blocks, n, width, p))
        torque = np.broadcast_to(tables.torques[:, :, None], (blocks, n, width, 1))
        wide = np.concatenate([parameters, *added, torque], axis=3)
        r = wide.shape[3] - p - 1
        concerned = np.zeros((blocks, n, p))
        if scaling:
            friction_only = change.meaning == "friction"
            mask = tables.mask_of(change)
            concerned[:, [*change.joints]] = mask[:, None, None] * (
                model.friction_columns if friction_only else np.ones(p)
            )
        std = np.zeros(n) if scale_std is None else scale_std.copy()
        if change.meaning == "scale" and change.part is None:
            std[[*change.joints]] = 0.0
        tempering = 1.0 if prior is None else max(1.0, prior.design_effect / tables.step)
        information = np.zeros((p + 1 + n + r,) * 2)
        mean = np.zeros(len(information))
        scales = np.arange(p + 1, p + 1 + n)
        information[scales, scales] = tempering
        if prior is not None:
            information[:p, :p] = tempering * prior.gaussian.information
            mean[:p] = prior.gaussian.mean
        first = p + 1 + n
        coefficients = {
            "payload": np.array([first + MASS_INDEX]),
            "delay": np.array([first]),
            "drift": np.array([first]),
            "load friction": first + np.arange(n),
        }
        return cls(
            gram=np.swapaxes(wide, 2, 3) @ tables.gram @ wide,
            rows=tables.rows.sum(axis=0),
            concerned=concerned,
            scale_std=std,
            information=information,
            mean=mean,
            sizes=coefficients.get(change.meaning, np.array([p])),
        )

    def size(self, values: Array) -> ChangeSize | None:
        """Estimate the size from parameters (p,) on."""
        p = self.concerned.shape[2]
        unknowns = np.zeros(len(self.mean))
        unknowns[:p] = values
        torque = self.gram[..., -1, -1].sum(axis=0)
        rows = np.maximum(self.rows, 1)
        floor = _MIN_NOISE_SHARE**2 * torque + np.finfo(np.float64).tiny
        for _ in range(_MAX_ITERATIONS):
            moves, residual = self._linearised(unknowns)
            pulled = (self.gram @ residual[..., None])[..., 0]
            squares = np.einsum("bji,bji->j", pulled, residual)
            weights = rows / np.maximum(squares, floor)
            scores = np.einsum("bjik,bji,j->bk", moves, pulled, weights, optimize=True)
            weighted = weights[:, None, None] * (np.swapaxes(moves, 2, 3) @ self.gram @ moves)
            of_blocks = weighted.sum(axis=1)
            pull = self.information @ (self.mean - unknowns)
            equations = NormalEquations(of_blocks.sum(axis=0), scores.sum(axis=0) + pull)
            solution = solve_with_prior(equations, self.information)
            step = solution.values
            # A factor stays above zero.
            least = float((_MIN_STEP_FACTOR - 1.0) * (1.0 + unknowns[p]))
            step = step * min(1.0, least / min(float(step[p]), least))
            unknowns = unknowns + step
            deviations = np.sqrt(solution.inverse.diagonal())
            if np.all(np.abs(step) <= _STEP_TOLERANCE * (np.abs(unknowns) + deviations)):
                break
        order = self.sizes[np.argsort(unknowns[self.sizes])]
        row = np.zeros_like(unknowns)
        for k in (len(order) - 1) // 2, len(order) // 2:
            row[order[k]] += 0.5
        if not np.all(solution.determined[row > 0.0]):
            return None
        clustered = cluster_covariance(of_blocks, scores, solution, self.information)
        used = np.flatnonzero(row)
        variance = float(row[used] @ clustered.covariance[np.ix_(used, used)] @ row[used])
        half = float(clustered.interval_factors(row[None])[0])
        return ChangeSize(float(row @ unknowns), math.sqrt(max(variance, 0.0)), half)

    def _linearised(self, unknowns: Array) -> tuple[Array, Array]:
        """Return the columns of the unknowns (B, n, q, k) and the residual (B, n, q)."""
        blocks, n, p = self.concerned.shape
        width = self.gram.shape[-1]
        parameters, s, scales, added = np.split(unknowns, [p, p + 1, p + 1 + n])
        scale = 1.0 + self.scale_std * scales
        parts = (1.0 + s * self.concerned) * parameters
        moves = np.zeros((blocks, n, width, len(unknowns)))
        diagonal = np.arange(p)
        moves[:, :, diagonal, diagonal] = scale[:, None] * (1.0 + s * self.concerned)
        moves[:, :, :p, p] = scale[:, None] * self.concerned * parameters
        for joint in range(n):
            moves[:, joint, :p, p + 1 + joint] = self.scale_std[joint] * parts[:, joint]
        columns = np.arange(len(added))
        moves[:, :, p + columns, p + 1 + n + columns] = 1.0
        residual = np.zeros((blocks, n, width))
        residual[..., :p] = -scale[:, None] * parts
        residual[..., p:-1] = -added
        residual[..., -1] = 1.0
        return moves, residual
