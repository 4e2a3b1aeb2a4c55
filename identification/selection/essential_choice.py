"""The essential parameters of a robot on all its held-out motion, and what the choice is worth.

The held-out motion decides which parameters stay, so its error flatters the model that is left.
What the choice is worth on motion that had no say is found beside it: parameters chosen inside the
fitted motion alone, on its last part, fitted to all of it and tried on the held-out motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.factor.factor import Factor, joint_weights, solve
from identification.factor.phases import PhaseFactor, joined
from identification.model.robot import RobotModel
from identification.selection.essential import CutRule, Elimination, EliminationStep, eliminate

Array = NDArray[np.float64]

# A rule that no held-out error can stop: the cut is that of Pham and Gautier alone.
_BY_SPREAD: Final = CutRule(overall=np.inf, axis=np.inf)
# Of the fitted motion, the share that parameters are fitted to when the rest chooses them.
_FITTED_SHARE: Final = 0.7
# Blocks below which an error is no evidence on anything.
_FEWEST_BLOCKS: Final = 10
_MOST_BLOCKS: Final = 150


@dataclass(frozen=True)
class BlindChoice:
    """Parameters that were chosen inside the fitted motion, tried on the held-out motion.

    Attributes:
        left: how many were chosen.
        essential: relative torque error of these on the held-out motion.
        full: that of all parameters.
    """

    left: int
    essential: float
    full: float


@dataclass(frozen=True, eq=False)
class EssentialChoice:
    """Which parameters a robot needs, and how far that can be relied on.

    Attributes:
        elimination: all steps and the cut, chosen on all held-out motion.
        by_spread: the last step by the rule of relative standard deviations alone (Pham and
            Gautier 1991), for comparison.
        by_spread_names: the parameters that this rule leaves.
        blind: what a choice without a look at the held-out motion is worth; None where the fitted
            motion is too short for one.
    """

    elimination: Elimination
    by_spread: EliminationStep
    by_spread_names: tuple[str, ...]
    blind: BlindChoice | None


def choose_essential(
    model: RobotModel,
    training: PhaseFactor,
    held_out: Sequence[PhaseFactor],
    *,
    weights: Array | None = None,
    rule: CutRule = CutRule(),
) -> EssentialChoice:
    """Choose the essential parameters, and say what the choice is worth.

    Args:
        model: the robot.
        training: the samples that are fitted.
        held_out: of each held-out recording.
        weights: per joint (n,); by default the inverse residual variances of an ordinary fit.
        rule: when to stop.

    Raises:
        IdentificationError: nothing was fitted or held out, or factors of another model.
    """
    if not held_out:
        raise IdentificationError("there is no held-out motion to choose parameters on")
    if weights is None:
        weights = joint_weights(training.total)
    elimination = eliminate(model, training, _joined(held_out), weights=weights, rule=rule)
    blind = eliminate(model, training, _joined(held_out), weights=weights, rule=_BY_SPREAD)
    return EssentialChoice(
        elimination=elimination,
        by_spread=blind.chosen,
        by_spread_names=blind.estimate.names,
        blind=_blind(model, training, held_out, weights, rule),
    )


def relative_error(factor: Factor, values: Array) -> float:
    """Relative torque error ||e|| / ||tau|| of parameters (p,) over all joints of a factor."""
    augmented = np.append(-values, 1.0)
    squares = float(np.einsum("i,jik,k->", augmented, factor.gram, augmented))
    power = float(factor.gram[:, -1, -1].sum())
    return float(np.sqrt(max(squares, 0.0) / power)) if power > 0.0 else np.nan


def _blind(
    model: RobotModel,
    training: PhaseFactor,
    held_out: Sequence[PhaseFactor],
    weights: Array,
    rule: CutRule,
) -> BlindChoice | None:
    used = training.occupied()
    cut = round(_FITTED_SHARE * len(used))
    if len(used) - cut < _FEWEST_BLOCKS:
        return None
    first, last = used.blocks(slice(0, cut)), used.blocks(slice(cut, None))
    chosen = eliminate(model, first, last, weights=weights, rule=rule).estimate.names
    columns = np.array([model.parameter_names.index(name) for name in chosen], dtype=np.intp)
    values = np.zeros(model.n_parameters)
    values[columns] = solve(training.restricted(columns).total.weighted(weights)).values
    unseen = _joined(held_out).total
    return BlindChoice(
        left=len(columns),
        essential=relative_error(unseen, values),
        full=relative_error(unseen, solve(training.total.weighted(weights)).values),
    )


def _joined(factors: Sequence[PhaseFactor]) -> PhaseFactor:
    """Blocks of several motions one after the other, without empty ones.

    Of many recordings neighbouring blocks are added up: what they are for, telling chance from a
    rise of the error, needs some hundred of them and costs time with each.
    """
    longer = max(1, sum(len(factor) for factor in factors) // _MOST_BLOCKS)
    return joined([factor.merged(longer) for factor in factors]).occupied()
