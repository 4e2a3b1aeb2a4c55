"""Two estimates beside each other on the motions of one class, and tables of such comparisons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .drawn import Spread, spread
from .forms import ClassForms
from .paired import compare, holm
from .results import ComparisonResult
from .verdict import ALPHA, verdict_of

Array = NDArray[np.float64]

_SEED: Final = 20140901


@dataclass(frozen=True, eq=False)
class Estimated:
    """An estimate with the repetitions that it is the mean of.

    Attributes:
        key: its name.
        values: of each repetition by itself (r, p).
    """

    key: str
    values: Array


def torque_kernels(forms: ClassForms, joint: int | None = None) -> Callable[[Array], Array]:
    """What :func:`compared_on` asks for, of the low-passed torque errors."""
    return lambda values: forms.torque_kernels(values, joint)


def own_kernels(forms: ClassForms, truth: Array) -> Callable[[Array], Array]:
    """The same of what the estimates themselves are off by."""
    return lambda values: forms.own_kernels(values, truth)


def compared_on(
    motion_class: str,
    first: Estimated,
    second: Estimated,
    kernels: Callable[[Array], Array],
    *,
    joint: str | None = None,
    drifts: bool,
) -> ComparisonResult:
    """Errors with `second` over errors with `first`, motion by motion; a table of one.

    Args:
        motion_class: of the motions.
        first: estimate.
        second: estimate.
        kernels: inner products (m, r, r) of the errors that r estimates leave.
        joint: that the errors are of; None for all together.
        drifts: whether repetitions may be like their neighbours.
    """
    inner = [kernels(one.values) for one in (first, second)]
    # The sum of a mean's squared errors: weights 1 / r on either side.
    before, after = (np.sqrt(one.mean(axis=(1, 2))) for one in inner)
    found = compare(before, after)
    known = spread(inner[0], inner[1], drifts=drifts, seed=_SEED)
    return _judged(
        ComparisonResult(
            motion_class=motion_class,
            joint=joint,
            first=first.key,
            second=second.key,
            motions=found.motions,
            repetitions=[len(first.values), len(second.values)],
            ratio=found.ratio,
            error=None if known is None else known.error,
            freedom=None if known is None else known.freedom,
            level=1.0 - ALPHA,
            low=None,
            high=None,
            verdict="too few",
            wins=found.wins,
            p_value=found.p_value,
            p_corrected=found.p_value,
        ),
        1,
    )


def corrected(comparisons: Sequence[ComparisonResult]) -> list[ComparisonResult]:
    """The comparisons of one table, corrected for their number.

    Intervals and verdicts after Bonferroni, so that all intervals of the table hold together and
    a difference is told exactly where an interval leaves out 1; signed ranks after Holm.
    """
    after = holm([one.p_value for one in comparisons])
    return [
        _judged(one, len(comparisons)).model_copy(update={"p_corrected": p})
        for one, p in zip(comparisons, after, strict=True)
    ]


def _judged(one: ComparisonResult, count: int) -> ComparisonResult:
    """With interval and verdict as one of so many."""
    level, low, high = 1.0 - ALPHA / count, None, None
    if one.error is not None and one.freedom is not None:
        width = Spread(one.error, one.freedom).half_width(level)
        low, high = (float(bound) for bound in one.ratio * np.exp([-width, width]))
    verdict = verdict_of(one.ratio, low, high)
    return one.model_copy(update={"level": level, "low": low, "high": high, "verdict": verdict})
