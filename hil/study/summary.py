"""From fits and scores to the tables of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .equal_data import EqualData
from .paired import compare, holm
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
_SEED: Final = 20140901


@dataclass(frozen=True)
class Named:
    """What a condition is called."""

    key: str
    words: str
    effects: tuple[str, ...]


def estimates_of(fits: Mapping[str, FitRecord]) -> dict[str, Array]:
    """The paper's estimate of each: the mean over the repetitions' own estimates (p,)."""
    return {key: np.mean(one.values, axis=0) for key, one in fits.items()}


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
    first = next((one for one in classes if one.motion_class == "fly-by"), None)
    return ConditionResult(
        key=named.key,
        words=named.words,
        effects=list(named.effects),
        methods=[_method(key, labels[key], fits[key]) for key in keys],
        classes=classes,
        cross=[
            _cell(one, key) for one in classes for key in (*keys, *others) if key in one.overall
        ],
        comparisons=_comparisons(classes, keys),
        own_comparisons=_own(classes, keys),
        joint_comparisons=[] if first is None else _by_joint(first, keys, joint_names),
        equal_data=None if equal is None else _equal_data(classes, keys, equal),
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
    return ClassResult(
        motion_class=name,
        archives=[one.archive for one in record.scores[known[0]]],
        durations=record.durations,
        overall={key: [one.overall for one in record.scores[key]] for key in known},
        unfiltered={key: [one.unfiltered for one in record.scores[key]] for key in known},
        own={} if effects else {key: values for key, values in own.items() if values},
        mean_abs={key: [one.mean_abs for one in record.scores[key]] for key in known},
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
        own_median=float(np.median(own)) if (own := result.own.get(key)) else None,
    )


def _comparisons(classes: Sequence[ClassResult], keys: Sequence[str]) -> list[ComparisonResult]:
    return corrected(
        [
            compared_on(
                one.motion_class, None, first, second, one.overall[first], one.overall[second]
            )
            for one in classes
            for first, second in combinations(keys, 2)
        ]
    )


def _by_joint(
    result: ClassResult, keys: Sequence[str], joint_names: Sequence[str]
) -> list[ComparisonResult]:
    """The first two methods, axis by axis, in the mean |e| of the paper's Fig. 3."""
    if len(keys) < 2:
        return []
    first, second = keys[:2]
    return corrected(
        [
            compared_on(
                result.motion_class,
                joint,
                first,
                second,
                [row[j] for row in result.mean_abs[first]],
                [row[j] for row in result.mean_abs[second]],
            )
            for j, joint in enumerate(joint_names)
        ]
    )


def _own(classes: Sequence[ClassResult], keys: Sequence[str]) -> list[ComparisonResult]:
    """The first two methods in what their estimates themselves are off by, class by class."""
    return corrected(
        [
            compared_on(
                one.motion_class, None, keys[0], keys[1], one.own[keys[0]], one.own[keys[1]]
            )
            for one in classes
            if len(keys) > 1 and set(keys[:2]) <= one.own.keys()
        ]
    )


def _equal_data(
    classes: Sequence[ClassResult], keys: Sequence[str], equal: EqualData
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
            [
                compared_on(
                    one.motion_class,
                    None,
                    first,
                    second,
                    one.overall[first],
                    one.overall[second],
                )
                for one in classes
            ]
        ),
    )


def compared_on(
    motion_class: str,
    joint: str | None,
    first: str,
    second: str,
    before: Sequence[float],
    after: Sequence[float],
) -> ComparisonResult:
    """Errors with `second` over errors with `first`, motion by motion; p not yet corrected."""
    found = compare(np.array(before), np.array(after), seed=_SEED)
    return ComparisonResult(
        motion_class=motion_class,
        joint=joint,
        first=first,
        second=second,
        motions=found.motions,
        ratio=found.ratio,
        low=found.low,
        high=found.high,
        wins=found.wins,
        p_value=found.p_value,
        p_corrected=found.p_value,
    )


def corrected(comparisons: list[ComparisonResult]) -> list[ComparisonResult]:
    """The comparisons of one table with p values corrected for their number."""
    after = holm([one.p_value for one in comparisons])
    return [
        one.model_copy(update={"p_corrected": p}) for one, p in zip(comparisons, after, strict=True)
    ]


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
