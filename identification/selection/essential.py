"""Essential parameters: those that a motion needs, chosen by backward elimination.

The parameter of the largest relative standard deviation is removed (Pham and Gautier 1991) unless
motion that was held out is predicted worse without it, by more than :class:`CutRule` gives away;
what was refused is tried once more when nothing else can go. What the choice is worth on motion
that had no say is found beside it (:class:`BlindChoice`). All of it works on factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.estimators.covariance import block_length, with_block_covariance
from identification.factor.factor import (
    Estimate,
    Factor,
    Solution,
    estimate_of,
    joint_weights,
    solve,
)
from identification.factor.phases import PhaseFactor, joined, merged
from identification.model.robot import RobotModel

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_CHANCE: Final = 0.05
_TINY: Final = 1e-300
# Of the fitted motion, the share that parameters are fitted to when the rest chooses them.
_FITTED_SHARE: Final = 0.7
# Blocks below which an error is no evidence on anything.
_FEWEST_BLOCKS: Final = 10
_MOST_BLOCKS: Final = 150


@dataclass(frozen=True)
class CutRule:
    """When to stop taking parameters out."""

    # largest over smallest relative standard deviation of those left; below it the data know all
    # of them comparably well (Pham and Gautier 1991: 10 to 30)
    spread: float = 30.0
    # rise of the relative torque error on held-out motion, over all joints, that is given away for
    # a smaller model: 0.001 is 0.1 points of per cent
    overall: float = 0.001
    axis: float = 0.005  # the same for one joint, as a share of that joint's torque
    noticeable: float = 0.1  # share of both that a rise beyond chance must reach to count


# A rule that no held-out error can stop: the cut is that of Pham and Gautier alone.
_BY_SPREAD: Final = CutRule(overall=np.inf, axis=np.inf)


class EliminationStep(NamedTuple):
    """The model after one more parameter was removed."""

    removed: str | None  # the parameter, None for the model it all begins with
    left: int  # number of parameters left
    spread: float  # largest over smallest relative standard deviation of those left
    # of those left, classical; infinite with one that is not determined
    largest_relative_std: float
    in_sample: float  # relative torque error ||e|| / ||tau|| over all joints on the fitted motion
    held_out: float  # the same on the motion that was held out


@dataclass(frozen=True, eq=False)
class Elimination:
    """All steps down to one parameter, and where to stop."""

    #: the path: step k has k removals. Behind the cut parameters go on being removed by relative
    #: standard deviation alone, to show what that costs
    steps: tuple[EliminationStep, ...]
    cut: int  #: the step chosen
    #: parameters that the held-out motion did not let go before the cut, in order
    refused: tuple[str, ...]
    reason: str  #: why the cut is there, in words
    #: of the parameters left at the cut, with their names and the cluster-robust covariance,
    #: which is that of a model with exactly these parameters: it takes no account of their having
    #: been chosen
    estimate: Estimate
    values: Array  #: the same for the full model (p,), zero for what was removed

    @property
    def removed(self) -> tuple[str, ...]:
        """Names of the parameters removed up to the cut, in order."""
        return tuple(str(step.removed) for step in self.steps[1 : self.cut + 1])

    @property
    def chosen(self) -> EliminationStep:
        """The step at the cut."""
        return self.steps[self.cut]


class BlindChoice(NamedTuple):
    """Parameters that were chosen inside the fitted motion, tried on the held-out motion."""

    left: int  # how many were chosen
    essential: float  # relative torque error of these on the held-out motion
    full: float  # that of all parameters


class EssentialChoice(NamedTuple):
    """Which parameters a robot needs, and how far that can be relied on."""

    elimination: Elimination  # all steps and the cut, chosen on all held-out motion
    # last step by relative standard deviations alone (Pham and Gautier 1991), for comparison
    by_spread: EliminationStep
    # a choice without a look at the held-out motion; None where the fitted motion is too short
    blind: BlindChoice | None


def choose_essential(
    model: RobotModel, training: PhaseFactor, held_out: Sequence[PhaseFactor]
) -> EssentialChoice:
    """Choose the essential parameters of fitted samples, and say what the choice is worth.

    Raises:
        IdentificationError: nothing was fitted or held out.
    """
    if not held_out:
        raise IdentificationError("there is no held-out motion to choose parameters on")
    weights = joint_weights(training.total)
    # Of many recordings neighbouring blocks are added up: what they are for, telling chance from a
    # rise of the error, needs some hundred of them and costs time with each.
    longer = max(1, sum(len(factor) for factor in held_out) // _MOST_BLOCKS)
    unseen = joined([factor.merged(longer) for factor in held_out]).occupied()
    return EssentialChoice(
        elimination=eliminate(model, training, unseen, weights=weights),
        by_spread=eliminate(model, training, unseen, weights=weights, rule=_BY_SPREAD).chosen,
        blind=_blind(model, training, unseen.total, weights),
    )


def _blind(
    model: RobotModel, training: PhaseFactor, unseen: Factor, weights: Array
) -> BlindChoice | None:
    used = training.occupied()
    cut = round(_FITTED_SHARE * len(used))
    if len(used) - cut < _FEWEST_BLOCKS:
        return None
    first, last = used.blocks(slice(0, cut)), used.blocks(slice(cut, None))
    chosen = np.flatnonzero(eliminate(model, first, last, weights=weights).values)
    equations, values = training.total.weighted(weights), np.zeros(model.n_parameters)
    values[chosen] = solve(equations.part(chosen)).values
    full = solve(equations).values
    return BlindChoice(len(chosen), unseen.relative_error(values), unseen.relative_error(full))


def eliminate(
    model: RobotModel,
    training: PhaseFactor,
    held_out: PhaseFactor,
    *,
    weights: Array | None = None,
    rule: CutRule = CutRule(),
) -> Elimination:
    """Take parameters out one by one and choose how many can go.

    The held-out samples, better of another motion, choose the cut, so their error there is a little
    flattered. Weights (n,) are by default the inverse residual variances of an ordinary fit.

    Raises:
        IdentificationError: one of the factors has no rows.
    """
    for factor, what in ((training, "fitted"), (held_out, "held-out")):
        if not factor.samples.any():
            raise IdentificationError(f"there is not one usable {what} sample")
    total, names = training.total, training.parameter_names
    if weights is None:
        weights = joint_weights(total)
    path = _Path(total, held_out, weights, rule)
    path.guarded()
    cut, refused, chosen = len(path.steps) - 1, tuple(names[k] for k in path.refused), path.current
    path.to_the_end()
    part, units = training.restricted(chosen.left), [model.units[k] for k in chosen.left]
    classical = estimate_of(units, part.total, chosen.solution, weights, "")
    name = "essential parameters by weighted least squares"
    return Elimination(
        steps=tuple(path.steps),
        cut=cut,
        refused=refused,
        reason=_reason(path.steps, cut, refused, rule),
        estimate=with_block_covariance(classical, part, weights, name),
        values=chosen.values,
    )


class _Subset(NamedTuple):
    """The fit with some of the parameters, and its errors."""

    left: Indices  # (k,)
    solution: Solution  # of the normal equations in these
    relative: Array  # standard deviations (k,), infinite where undetermined
    values: Array  # for the full model (p,), zero elsewhere
    blocks: Array  # weighted squared held-out error by blocks of time (B,)
    held_out: float  # relative error over all joints
    held_out_joint: Array  # (n,), zero for one without rows

    def spread(self, free: NDArray[np.bool_] | bool = True) -> float:
        """Largest relative standard deviation of those that are free over the smallest of all."""
        largest = np.where(free, self.relative, 0.0).max()
        return float(largest / max(self.relative.min(), _TINY))


class _Path:
    """Elimination in progress."""

    def __init__(self, total: Factor, held_out: PhaseFactor, weights: Array, rule: CutRule) -> None:
        self._total, self._unseen, self._rule = total, held_out.total, rule
        self._equations = total.weighted(weights)
        self._blocks = held_out.weighted(weights)[held_out.samples.any(axis=1)]
        self.refused: list[int] = []
        self.steps: list[EliminationStep] = []
        self.best = self.current = self._subset(np.arange(total.n_parameters))
        self._go_on(self.current, None)

    def guarded(self) -> None:
        """Remove until those that may go are known comparably well, or nothing may go."""
        before: list[int] | None = None
        # What another parameter stood in for may have become superfluous without it.
        while before != self.refused:
            before, self.refused = self.refused, []
            while self.current.spread(self._free) >= self._rule.spread:
                if len(self.current.left) == 1:
                    break
                index, relative_std = self._worst()
                smaller = self._without(index)
                if np.isfinite(relative_std) and self._is_worse(smaller):
                    self.refused.append(index)
                else:
                    self._go_on(smaller, index)

    def to_the_end(self) -> None:
        """Remove by relative standard deviation alone until one parameter is left."""
        self.refused = []
        while len(self.current.left) > 1:
            index, _ = self._worst()
            self._go_on(self._without(index), index)

    @property
    def _free(self) -> NDArray[np.bool_]:
        """Which of those left may go."""
        return ~np.isin(self.current.left, self.refused)

    def _worst(self) -> tuple[int, float]:
        """Index and relative standard deviation of what to take out next."""
        solution, left = self.current.solution, self.current.left
        if not solution.determined.all():
            own = self._equations.part(left).A
            lost = 1.0 - np.einsum("ij,ji->i", solution.inverse, own)
            return int(left[np.flatnonzero(lost > 0.99 * lost.max())[-1]]), np.inf
        worst = int(np.argmax(np.where(self._free, self.current.relative, -1.0)))
        return int(left[worst]), float(self.current.relative[worst])

    def _without(self, index: int) -> _Subset:
        return self._subset(self.current.left[self.current.left != index])

    def _subset(self, left: Indices) -> _Subset:
        solution, values = solve(self._equations.part(left)), np.zeros(len(self._equations.b))
        values[left] = solution.values
        variance = np.maximum(np.diag(solution.inverse), 0.0)
        relative = np.sqrt(variance) / np.maximum(np.abs(solution.values), _TINY)
        relative[~solution.determined] = np.inf
        augmented = np.append(-values, 1.0)
        return _Subset(
            left,
            solution,
            relative,
            values,
            np.maximum((self._blocks @ augmented) @ augmented, 0.0),
            self._unseen.relative_error(values),
            np.nan_to_num(self._unseen.relative_errors(values)),
        )

    def _is_worse(self, smaller: _Subset) -> bool:
        """Whether a removal raises the held-out error, by more than the rule gives away."""
        if smaller.blocks.sum() <= self.current.blocks.sum():
            return False
        overall = (smaller.held_out - self.best.held_out) / self._rule.overall
        axis = (smaller.held_out_joint - self.best.held_out_joint) / self._rule.axis
        certain = _is_certain(smaller.blocks - self.best.blocks)
        return max(overall, float(axis.max())) > (self._rule.noticeable if certain else 1.0)

    def _go_on(self, subset: _Subset, index: int | None) -> None:
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
        if subset.blocks.sum() < self.best.blocks.sum():
            self.best = subset


def _is_certain(difference: Array) -> bool:
    """Whether a sum of differences of squared errors, by blocks (B,), is above zero beyond chance.

    Student's t with as many blocks as are left when they are merged until neighbours hardly
    correlate.
    """
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
    return float(student_limit(_CHANCE, freedom))


def _reason(steps: list[EliminationStep], cut: int, refused: tuple[str, ...], rule: CutRule) -> str:
    """Say why the cut is where it is."""
    full, chosen = steps[0], steps[cut]
    text = (
        f"{chosen.left} of {full.left} parameters are essential: their relative standard deviations"
        f" differ by a factor of {chosen.spread:.3g}"
    )
    if refused:
        text += (
            f"; those of more than {rule.spread:g} times the smallest stay because the error on"
            f" held-out motion rises without them: {', '.join(refused)}"
        )
    elif chosen.spread < rule.spread:
        text += f", less than {rule.spread:g}"
    return (
        f"{text}. Error on the motion they were chosen on: {full.held_out:.2%} with all"
        f" parameters, {chosen.held_out:.2%} with these"
    )
