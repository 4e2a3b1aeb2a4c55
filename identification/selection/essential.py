"""Essential parameters, chosen by backward elimination.

The parameter of the largest relative standard deviation is removed (Pham and Gautier 1991) unless
that raises the error on held-out motion by more than :class:`CutRule` allows; refused removals are
tried once more at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.estimators.covariance import block_length, with_block_covariance
from identification.factor.blocks import merged
from identification.factor.estimate import Estimate, estimate_of, joint_weights
from identification.factor.estimation_method import EstimationMethod, LeastSquares
from identification.factor.factor import Factor, joined
from identification.factor.normal_equations import Solution, solve
from identification.model.robot import RobotModel

_SIGNIFICANCE_LEVEL: Final = 0.05
_TINY: Final = 1e-300
_MAX_BLOCKS: Final = 150


@dataclass(frozen=True)
class CutRule:
    """Termination of the elimination."""

    # largest over smallest relative standard deviation at which to stop (Pham and Gautier 1991: 10
    # to 30)
    spread: float = 30.0
    # allowed rise of the relative held-out torque error over all joints (0.001 is 0.1 %)
    overall: float = 0.001
    axis: float = 0.005  # the same for one joint
    noticeable: float = 0.1  # share of both allowed for a significant rise


@dataclass(frozen=True)
class EliminationStep:
    """Model after the removal of one more parameter."""

    removed: str | None  # None for the full model
    left: int  # parameters left
    spread: float  # largest over smallest relative standard deviation of those left
    largest_relative_std: float  # classical; infinite if undetermined
    in_sample: float  # relative torque error ||e|| / ||tau|| on the fitted motion
    held_out: float  # on the held-out motion


@dataclass(frozen=True, eq=False)
class Elimination:
    """All steps down to one parameter, and the cut."""

    #: step k has k removals; after the cut by relative standard deviation alone
    steps: tuple[EliminationStep, ...]
    cut: int  #: index of the chosen step
    refused: tuple[str, ...]  #: parameters whose removal was refused, in order
    rule: CutRule  #: of the cut
    #: of the remaining parameters, with cluster-robust covariance that ignores their selection
    estimate: Estimate
    values: Array  #: for the full model (p,), zero if removed

    @property
    def removed(self) -> tuple[str, ...]:
        """Names of the parameters removed up to the cut, in order."""
        return tuple(str(step.removed) for step in self.steps[1 : self.cut + 1])

    @property
    def chosen(self) -> EliminationStep:
        """Step at the cut."""
        return self.steps[self.cut]


def choose_essential(
    model: RobotModel, training: Factor, held_out: Sequence[Factor]
) -> Elimination:
    """Choose the essential parameters of fitted samples.

    Raises:
        IdentificationError: nothing was fitted, or no row was held out.
    """
    # Blocks are merged to some hundred, enough for significance.
    longer = max(1, sum(len(factor) for factor in held_out) // _MAX_BLOCKS)
    unseen = joined([factor.merged(longer) for factor in held_out]).occupied()
    return eliminate(model, training, unseen, weights=joint_weights(training))


def eliminate(
    model: RobotModel,
    training: Factor,
    held_out: Factor,
    *,
    weights: Array | None = None,
    rule: CutRule = CutRule(),
) -> Elimination:
    """Remove parameters one by one and choose the cut by the error on held-out samples.

    Args:
        model: of the arm.
        training: factor of the fitted samples.
        held_out: factor of the others.
        weights: of the joints (n,); by default the inverse residual variances of an ordinary fit.
        rule: of the cut.

    Raises:
        IdentificationError: one of the factors has no rows.
    """
    for factor, what in ((training, "fitted"), (held_out, "held-out")):
        if not factor.samples.any():
            raise IdentificationError(f"no usable {what} sample")
    names = training.parameter_names
    if weights is None:
        weights = joint_weights(training)
    path = _Path(training, held_out, weights, rule)
    path.remove_guarded()
    cut = len(path.steps) - 1
    refused = tuple(names[k] for k in path.refused)
    chosen = path.current
    path.remove_all()
    part = training.restricted(chosen.left)
    units = [model.units[k] for k in chosen.left]
    method = EstimationMethod(LeastSquares(essential_only=True))
    classical = estimate_of(units, part, chosen.solution, weights, method)
    return Elimination(
        steps=tuple(path.steps),
        cut=cut,
        refused=refused,
        rule=rule,
        estimate=with_block_covariance(classical, part, weights),
        values=chosen.values,
    )


class _Subset(NamedTuple):
    """Fit of some parameters, and its errors."""

    left: Indices  # (k,)
    solution: Solution  # of the normal equations in these
    relative: Array  # standard deviations (k,), infinite where undetermined
    values: Array  # for the full model (p,), zero elsewhere
    square: float  # weighted squared held-out error
    held_out: float  # relative error over all joints
    held_out_joint: Array  # (n,), zero for one without rows

    def spread(self, free: NDArray[np.bool_] | bool = True) -> float:
        """Return the largest relative deviation of `free` parameters over the smallest."""
        largest = np.where(free, self.relative, 0.0).max()
        return float(largest / max(self.relative.min(), _TINY))


class _Path:
    """Elimination in progress."""

    def __init__(self, total: Factor, held_out: Factor, weights: Array, rule: CutRule) -> None:
        self._total = total
        self._unseen = held_out
        self._rule = rule
        self._equations = total.weighted(weights)
        self._blocks = held_out.occupied().by_block(weights)
        self._whole = np.asarray(self._blocks.sum(axis=0))
        self.refused: list[int] = []
        self.steps: list[EliminationStep] = []
        self.best = self.current = self._subset(np.arange(total.n_parameters))
        self._append_step(self.current, None)

    def remove_guarded(self) -> None:
        """Remove until the spread is below the rule, or no removal is allowed."""
        previous: list[int] | None = None
        # Refused removals may be possible after others.
        while previous != self.refused:
            previous = self.refused
            self.refused = []
            while self.current.spread(self._free) >= self._rule.spread:
                if len(self.current.left) == 1:
                    break
                index, relative_std = self._worst()
                smaller = self._without(index)
                if np.isfinite(relative_std) and self._is_worse(smaller):
                    self.refused.append(index)
                else:
                    self._append_step(smaller, index)

    def remove_all(self) -> None:
        """Remove by relative standard deviation until one parameter is left."""
        self.refused = []
        while len(self.current.left) > 1:
            index, _ = self._worst()
            self._append_step(self._without(index), index)

    @property
    def _free(self) -> NDArray[np.bool_]:
        """Mask of the remaining parameters whose removal was not refused."""
        return ~np.isin(self.current.left, self.refused)

    def _worst(self) -> tuple[int, float]:
        """Return index and relative standard deviation of the next parameter to remove."""
        solution = self.current.solution
        remaining = self.current.left
        if not solution.determined.all():
            information = self._equations.part(remaining).A
            lost = 1.0 - np.einsum("ij,ji->i", solution.inverse, information)
            return int(remaining[np.flatnonzero(lost > 0.99 * lost.max())[-1]]), np.inf
        worst = int(np.argmax(np.where(self._free, self.current.relative, -1.0)))
        return int(remaining[worst]), float(self.current.relative[worst])

    def _without(self, index: int) -> _Subset:
        return self._subset(self.current.left[self.current.left != index])

    def _subset(self, remaining: Indices) -> _Subset:
        solution = solve(self._equations.part(remaining))
        values = np.zeros(len(self._equations.b))
        values[remaining] = solution.values
        variance = np.maximum(np.diag(solution.inverse), 0.0)
        relative = np.sqrt(variance) / np.maximum(np.abs(solution.values), _TINY)
        relative[~solution.determined] = np.inf
        augmented = np.append(-values, 1.0)
        return _Subset(
            remaining,
            solution,
            relative,
            values,
            float(max(augmented @ self._whole @ augmented, 0.0)),
            self._unseen.relative_error(values),
            np.nan_to_num(self._unseen.relative_errors(values)),
        )

    def _is_worse(self, smaller: _Subset) -> bool:
        """Return whether a removal raises the held-out error by more than the rule allows."""
        if smaller.square <= self.current.square:
            return False
        overall = (smaller.held_out - self.best.held_out) / self._rule.overall
        axis = (smaller.held_out_joint - self.best.held_out_joint) / self._rule.axis
        increase = max(overall, float(axis.max()))
        if increase <= self._rule.noticeable:
            return False
        change = self._squares(smaller) - self._squares(self.best)
        return increase > 1.0 or _is_significant(change)

    def _squares(self, subset: _Subset) -> Array:
        """Return the weighted squared held-out error by blocks of time (B,)."""
        augmented = np.append(-subset.values, 1.0)
        return np.asarray(np.maximum((self._blocks @ augmented) @ augmented, 0.0))

    def _append_step(self, subset: _Subset, index: int | None) -> None:
        self.steps.append(
            EliminationStep(
                removed=None if index is None else self._total.parameter_names[index],
                left=len(subset.left),
                spread=subset.spread(),
                largest_relative_std=float(subset.relative.max()),
                in_sample=self._total.relative_error(subset.values),
                held_out=subset.held_out,
            )
        )
        self.current = subset
        if subset.square < self.best.square:
            self.best = subset


def _is_significant(difference: Array) -> bool:
    """Return whether a sum of differences by blocks (B,) is significantly above zero."""
    if not difference.any():
        return False
    blocks = merged(difference, block_length(difference[:, None]))
    count = len(blocks)
    if count < 2:
        return False
    deviation = max(np.sqrt(count * blocks.var(ddof=1)), _TINY)
    return bool(blocks.sum() / deviation > _limit(count - 1))


@lru_cache
def _limit(freedom: int) -> float:
    return float(student_limit(_SIGNIFICANCE_LEVEL, freedom))
