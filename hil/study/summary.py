"""From fits and scores to the tables of a study."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .comparing import Estimated, compared_on, corrected, own_kernels, torque_kernels
from .designs import AP, B
from .equal_data import EqualData
from .forms import ClassForms
from .records import FitRecord, ScoreRecord
from .results import (
    ClassResult,
    ClosenessResult,
    ComparisonResult,
    ConditionResult,
    CrossCell,
    EqualDataResult,
    MethodResult,
    StudyParameter,
)

Array = NDArray[np.float64]

# Groups of rows of Table 2 as section 4.2 of the paper reads them.
GROUPS: Final = {
    "rows 1 to 22": range(1, 23),
    "rows 23 to 32, the aggregates": range(23, 33),
    "rows 33 to 40": range(33, 41),
    "rows 41 to 52, friction": range(41, 53),
}


@dataclass(frozen=True)
class Named:
    """What a condition is called, and whether its repetitions may be like their neighbours."""

    key: str
    words: str
    effects: tuple[str, ...]
    drifts: bool = True


@dataclass(frozen=True, eq=False)
class ClassSight:
    """All that estimates are compared with on one class of motion.

    Attributes:
        motion_class: its name.
        forms: of its motions.
        estimates: by key, with their repetitions.
        drifts: whether repetitions may be like their neighbours.
    """

    motion_class: str
    forms: ClassForms
    estimates: Mapping[str, Estimated]
    drifts: bool

    def compared(
        self,
        first: str,
        second: str,
        kernels: Callable[[Array], Array],
        *,
        joint: str | None = None,
    ) -> ComparisonResult:
        """Two of its estimates; a table of one."""
        before, after = self.estimates[first], self.estimates[second]
        return compared_on(
            self.motion_class, before, after, kernels, joint=joint, drifts=self.drifts
        )


def estimates_of(fits: Mapping[str, FitRecord]) -> dict[str, Array]:
    """The paper's estimate of each: the mean over the repetitions' own estimates (p,)."""
    return {key: np.mean(one.values, axis=0) for key, one in fits.items()}


def truth_of(parameters: Sequence[StudyParameter]) -> Array | None:
    """Planted parameters (p,), where all are known."""
    known = [one.truth for one in parameters if one.truth is not None]
    return np.array(known) if len(known) == len(parameters) else None


def condition_result(
    named: Named,
    labels: Mapping[str, str],
    fits: Mapping[str, FitRecord],
    scores: Mapping[str, ScoreRecord],
    parameters: Sequence[StudyParameter],
    joint_names: Sequence[str],
    others: Sequence[str] = (),
) -> ConditionResult:
    """All tables of one condition.

    Args:
        named: the condition.
        labels: of the methods, by key, in the order of the tables.
        fits: of the methods.
        scores: by class of motion.
        parameters: of the model, with the print.
        joint_names: of the arm.
        others: further estimates in the cross table, such as the planted parameters.
    """
    keys, equal = list(labels), EqualData.of(fits, list(labels))
    others = others if equal is None else [equal.name, *others]
    wanted = [*keys, *others]
    classes = [_class_result(name, one, wanted, named.effects) for name, one in scores.items()]
    repeated = {key: np.array(fits[key].values) for key in keys}
    if equal is not None:
        repeated[equal.name] = repeated[equal.cut][: equal.repetitions]
    estimates = {key: Estimated(key, values) for key, values in repeated.items()}
    sight = {
        name: ClassSight(name, ClassForms.of(one.forms), estimates, named.drifts)
        for name, one in scores.items()
    }
    truth = truth_of(parameters)
    return ConditionResult(
        key=named.key,
        words=named.words,
        effects=list(named.effects),
        methods=[_method(key, labels[key], fits[key]) for key in keys],
        classes=classes,
        cross=[
            _cell(one, key) for one in classes for key in (*keys, *others) if key in one.overall
        ],
        comparisons=_comparisons(sight, keys),
        own_comparisons=[] if truth is None or named.effects else _own(sight, keys, truth),
        joint_comparisons=_by_joint(sight["fly-by"], keys, joint_names)
        if "fly-by" in sight
        else [],
        equal_data=None if equal is None else _equal_data(sight, keys, equal),
        closeness=_closeness(fits, keys, parameters),
        examples=list(shown.examples) if (shown := _shown(scores)) is not None else [],
    )


def _shown(scores: Mapping[str, ScoreRecord]) -> ScoreRecord | None:
    """The class that an example is shown of: the robot's own motions, where there are any."""
    return scores.get("fly-by") or next(iter(scores.values()), None)


def _method(key: str, label: str, record: FitRecord) -> MethodResult:
    values = np.array(record.values)
    return MethodResult(
        key=key,
        label=label,
        repetitions=len(record.repetitions),
        seconds=record.duration * len(record.repetitions),
        mean=values.mean(axis=0).tolist(),
        std=(values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])).tolist(),
        pooled=record.pooled,
        pooled_std=record.pooled_std,
        undetermined=record.undetermined,
        noise_std=record.noise_std,
        log10_det=record.log10_det,
        coupling_index=record.coupling_index,
        correlation=record.correlation,
        time=record.time,
        position=record.position,
        velocity=record.velocity,
    )


def _class_result(
    name: str, record: ScoreRecord, wanted: Sequence[str], effects: Sequence[str]
) -> ClassResult:
    known = [key for key in wanted if key in record.scores]
    own = {key: [one.own for one in record.scores[key] if one.own] for key in known}
    left_out, samples = np.sum(record.left_out, axis=0), sum(record.samples)
    return ClassResult(
        motion_class=name,
        archives=[one.archive for one in record.scores[known[0]]],
        durations=record.durations,
        overall={key: [one.overall for one in record.scores[key]] for key in known},
        unfiltered={key: [one.unfiltered for one in record.scores[key]] for key in known},
        own={} if effects else {key: values for key, values in own.items() if values},
        mean_abs={key: [one.mean_abs for one in record.scores[key]] for key in known},
        all_rows={key: [one.all_rows for one in record.scores[key]] for key in known},
        left_out=(left_out / samples).tolist(),
        left_out_share=float(left_out.sum() / (samples * left_out.size)),
    )


def _cell(result: ClassResult, key: str) -> CrossCell:
    lower, middle, upper = np.percentile(result.overall[key], (25.0, 50.0, 75.0)).tolist()
    return CrossCell(
        method=key,
        motion_class=result.motion_class,
        median=middle,
        lower=lower,
        upper=upper,
        unfiltered_median=float(np.median(result.unfiltered[key])),
        all_rows_median=float(np.median(result.all_rows[key])),
        own_median=float(np.median(own)) if (own := result.own.get(key)) else None,
    )


def compared_pairs(keys: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs of methods: all, but for the printed sines, which the paper sets beside B alone."""
    pairs = list(combinations([key for key in keys if key != AP], 2))
    return [*pairs, (AP, B)] if AP in keys and B in keys else pairs


def _comparisons(sight: Mapping[str, ClassSight], keys: Sequence[str]) -> list[ComparisonResult]:
    return corrected(
        [
            one.compared(first, second, torque_kernels(one.forms))
            for one in sight.values()
            for first, second in compared_pairs(keys)
        ]
    )


def _by_joint(
    one: ClassSight, keys: Sequence[str], joint_names: Sequence[str]
) -> list[ComparisonResult]:
    """The first two methods, axis by axis, in the length of the error."""
    if len(keys) < 2:
        return []
    return corrected(
        [
            one.compared(keys[0], keys[1], torque_kernels(one.forms, j), joint=joint)
            for j, joint in enumerate(joint_names)
        ]
    )


def _own(
    sight: Mapping[str, ClassSight], keys: Sequence[str], truth: Array
) -> list[ComparisonResult]:
    """The first two methods in what their estimates themselves are off by, class by class."""
    return corrected(
        [
            one.compared(keys[0], keys[1], own_kernels(one.forms, truth))
            for one in sight.values()
            if len(keys) > 1
        ]
    )


def _equal_data(
    sight: Mapping[str, ClassSight], keys: Sequence[str], equal: EqualData
) -> EqualDataResult:
    """The first two with as much motion of each, on every class."""
    first, second = (equal.name if key == equal.cut else key for key in keys[:2])
    return EqualDataResult(
        cut=equal.cut,
        name=equal.name,
        repetitions=equal.repetitions,
        seconds=equal.seconds,
        other=equal.other,
        other_seconds=equal.other_seconds,
        comparisons=corrected(
            [one.compared(first, second, torque_kernels(one.forms)) for one in sight.values()]
        ),
    )


def _closeness(
    fits: Mapping[str, FitRecord], keys: Sequence[str], parameters: Sequence[StudyParameter]
) -> list[ClosenessResult]:
    """How often the second of the first two methods comes closer to the manufacturer's column."""
    if len(keys) < 2 or not any(one.printed_id for one in parameters):
        return []
    first, second = keys[:2]
    means = {key: np.mean(fits[key].values, axis=0) for key in (first, second)}
    found = []
    for group, rows in GROUPS.items():
        members = [
            (k, one)
            for k, one in enumerate(parameters)
            if one.printed_id in rows and one.printed_c is not None
        ]
        closer = printed = 0
        for k, one in members:
            assert one.printed_c is not None
            assert one.printed_a is not None and one.printed_b is not None
            distance = {
                key: abs(one.printed_factor * means[key][k] - one.printed_c) for key in means
            }
            closer += distance[second] < distance[first]
            printed += abs(one.printed_b - one.printed_c) < abs(one.printed_a - one.printed_c)
        found.append(
            ClosenessResult(
                group=group,
                reference="pi_C",
                first=first,
                second=second,
                parameters=len(members),
                second_closer=closer,
                printed_second_closer=printed,
            )
        )
    return found


def parameter_error(estimate: Array, base: Array, truth: Array) -> float | None:
    """Geometric mean over the parameters of distance to the truth, that of `base` being 1 (p,)."""
    own, reference = np.abs(estimate - truth), np.abs(base - truth)
    usable = (own > 0.0) & (reference > 0.0)
    if not usable.any():
        return None
    return float(np.exp(np.mean(np.log(own[usable] / reference[usable]))))
