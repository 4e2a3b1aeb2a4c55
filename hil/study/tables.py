"""Tables of a study from estimates and predictions, with the paper's printed values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, URDF_PATH

from .campaigns import AP, LABELS, SINES, A, B, noise_key, variant_key
from .records import PLANTED, ClassForms, FitRecord, Fitted, ScoreRecord
from .results import (
    AblationPoint,
    AblationResult,
    ChanceRange,
    ClassResult,
    ClosenessResult,
    ComparisonResult,
    ConditionResult,
    EqualDataResult,
    MethodResult,
    MotionRow,
    StudyParameter,
)
from .settings import StudySettings
from .statistics import compared_on, corrected, parameter_error, ranges_of

Array = NDArray[np.float64]

GROUPS: Final = {
    "rows 1 to 22": range(1, 23),
    "rows 23 to 32, the aggregates": range(23, 33),
    "rows 33 to 40": range(33, 41),
    "rows 41 to 52, friction": range(41, 53),
}
"""Groups of rows of Table 2 by section 4.2 of the paper."""
TABLE1: Final = (
    ("a", 2000, 90.5, 127.9, "W = 3, own frequencies; 100 individuals"),
    ("b", 15996, 30.9, 101.2, "K = 6, λ1 = 0.7, λ2 = 0.3; 150 individuals"),
)
"""The paper's Table 1: method, N, log det (units not stated), I_c, notes."""


def is_printed(cell: Cell) -> bool:
    """Return whether a cell has the arm of the paper, the NS 16."""
    return cell.urdf == URDF_PATH.read_text(encoding="utf-8")


def printed_rows(cell: Cell) -> list[MotionRow]:
    """Return the printed rows of Table 1; none for another arm than the NS 16."""
    names = ("key", "n_samples", "log10_det", "coupling_index", "words")
    return [
        MotionRow.model_validate(dict(zip(names, row, strict=True)) | {"printed": True})
        for row in (TABLE1 if is_printed(cell) else ())
    ]


def parameters_of(cell: Cell, truth: Array) -> list[StudyParameter]:
    """Return the parameters with true values (p,) and the printed values of Table 2.

    Rows 41 to 52 are interleaved. Viscous and third friction terms are assumed to be per degree and
    per degree²: per radian the viscous friction would be negligible.
    """
    model, printed = cell.model, dict[str, dict[str, Any]]()
    for row in TABLE2 if is_printed(cell) else ():
        order = {"f1": 1, "f2": 2}.get(row.parameter[:2], 0) if row.id > N_ESSENTIAL else 0
        printed[row.pivot or row.parameter] = {
            "printed_id": row.id,
            "printed_symbol": row.parameter,
            "printed_factor": row.sign * (pi / 180.0) ** order,
            "printed_a": row.pi_a,
            "printed_b": row.pi_b,
            "printed_c": row.pi_c,
        }
    return [
        StudyParameter(name=name, unit=unit, truth=float(planted), **printed.get(name, {}))
        for name, unit, planted in zip(model.parameter_names, model.units, truth, strict=True)
    ]


def equal_data(fits: Mapping[str, FitRecord]) -> EqualDataResult | None:
    """Return how to shorten the longer of the first two to equal motion time; None if equal."""
    whole = {key: fits[key].duration * len(fits[key].values) for key in [*fits][:2]}
    other, cut = sorted(whole, key=lambda key: whole[key])
    count = max(1, round(whole[other] / fits[cut].duration))
    if count >= len(fits[cut].values):
        return None
    return EqualDataResult(
        cut=cut,
        name=f"{cut}-equal",
        repetitions=count,
        seconds=count * fits[cut].duration,
        other=other,
        other_seconds=whole[other],
        comparisons=[],
    )


def repetitions_of(fits: Mapping[str, FitRecord]) -> dict[str, Array]:
    """Return the estimates (r, p) of the repetitions of each method, with those of `equal_data`."""
    found, equal = {key: np.array(one.values) for key, one in fits.items()}, equal_data(fits)
    if equal is not None:
        found[equal.name] = found[equal.cut][: equal.repetitions]
    return found


def estimates_of(fits: Mapping[str, FitRecord]) -> dict[str, Array]:
    """Return the paper's estimate of each method: the mean over repetitions (p,)."""
    return {key: values.mean(axis=0) for key, values in repetitions_of(fits).items()}


@dataclass(frozen=True)
class Condition:
    """A simulated condition."""

    key: str
    words: str  #: description
    effects: tuple[str, ...]
    drifts: bool = True  #: whether successive repetitions may be correlated


def condition_result(
    condition: Condition,
    fits: Mapping[str, FitRecord],
    scores: Mapping[str, ScoreRecord],
    parameters: Sequence[StudyParameter],
) -> ConditionResult:
    """Return all tables of one condition from estimates by method and predictions by class."""
    keys, equal, repetitions = list(fits), equal_data(fits), repetitions_of(fits)
    forms = {name: ClassForms.of(one.forms) for name, one in scores.items()}
    truth = np.array([one.truth for one in parameters], dtype=np.float64)

    def pair(name: str, two: tuple[str, str], *, own: bool = False) -> ComparisonResult:
        """Compare two estimates by torque error, or by their deviation from the truth."""
        first, second = (
            forms[name].own_kernels(repetitions[key], truth)
            if own
            else forms[name].torque_kernels(repetitions[key])
            for key in two
        )
        return compared_on(name, two, (first, second), drifts=condition.drifts)

    compared = compared_pairs(keys)
    two = [] if condition.effects else compared[:1]
    if equal is not None:
        cut = [equal.name if key == equal.cut else key for key in keys[:2]]
        rows = corrected([pair(name, (cut[0], cut[1])) for name in forms])
        equal = equal.model_copy(update={"comparisons": rows})
    estimates = {key: values.mean(axis=0) for key, values in repetitions.items()}
    return ConditionResult(
        key=condition.key,
        words=condition.words,
        effects=list(condition.effects),
        methods=[_method(key, LABELS[key], fits[key]) for key in keys],
        classes=[
            _class_result(name, one, forms[name], estimates, truth, own=not condition.effects)
            for name, one in scores.items()
        ],
        comparisons=corrected([pair(name, some) for name in forms for some in compared]),
        own_comparisons=corrected([pair(name, some, own=True) for name in forms for some in two]),
        equal_data=equal,
        closeness=_closeness(fits, keys, parameters),
        examples=scores["fly-by"].examples,
    )


def _method(key: str, label: str, record: FitRecord) -> MethodResult:
    values = np.array(record.values)
    return MethodResult(
        key=key,
        label=label,
        repetitions=len(values),
        seconds=record.duration * len(values),
        mean=values.mean(axis=0).tolist(),
        std=(values.std(axis=0, ddof=1) if len(values) > 1 else 0.0 * values[0]).tolist(),
        **record.model_dump(include=set(Fitted.model_fields)),
    )


def _class_result(
    name: str,
    record: ScoreRecord,
    forms: ClassForms,
    estimates: Mapping[str, Array],
    truth: Array,
    *,
    own: bool,
) -> ClassResult:
    every = dict(estimates) | {PLANTED: truth}
    errors = {key: forms.own(one, truth).tolist() for key, one in estimates.items()}
    return ClassResult(
        motion_class=name,
        archives=[one.archive for one in record.forms],
        durations=record.durations,
        overall={key: forms.overall(one).tolist() for key, one in every.items()},
        own=errors if own else {},
        mean_abs=record.mean_abs,
        all_rows=record.all_rows,
        left_out=record.left_out,
    )


def compared_pairs(keys: Sequence[str]) -> list[tuple[str, str]]:
    """Return all pairs of methods; the printed sines are compared with B only."""
    pairs = list(combinations([key for key in keys if key != AP], 2))
    return [*pairs, (AP, B)] if AP in keys and B in keys else pairs


def _closeness(
    fits: Mapping[str, FitRecord], keys: Sequence[str], parameters: Sequence[StudyParameter]
) -> list[ClosenessResult]:
    """Count the parameters for which the second method is closer to the manufacturer's values."""
    if not any(one.printed_id for one in parameters):
        return []
    factor = np.array([one.printed_factor for one in parameters])
    columns = [factor * np.mean(fits[key].values, axis=0) for key in keys[:2]]
    prints = ([getattr(one, f"printed_{name}") for one in parameters] for name in ("a", "b", "c"))
    paper_a, paper_b, c = (np.array(values, dtype=np.float64) for values in prints)
    closer = np.abs(columns[1] - c) < np.abs(columns[0] - c)
    printed = np.abs(paper_b - c) < np.abs(paper_a - c)
    groups = {
        group: [one.printed_id in rows for one in parameters] & np.isfinite(c)
        for group, rows in GROUPS.items()
    }
    return [
        ClosenessResult(
            group=group,
            reference="pi_C",
            first=keys[0],
            second=keys[1],
            parameters=int(members.sum()),
            second_closer=int(closer[members].sum()),
            printed_second_closer=int(printed[members].sum()),
        )
        for group, members in groups.items()
    ]


_TEXTS: Final = {
    "sines": (
        "Variants of method A",
        "sines of method A",
        "Variants that the paper does not decide, with a search each: sines about the middle of the"
        " ranges or about the home posture, with the frequencies of Table 1 or up to the bound of"
        " the appendix; each compared with B.",
    ),
    "fly": (
        "Fly-by share",
        "fly-by share of B's via points",
        "The via points and speeds of B with another fly-by share, without a new search.",
    ),
    "n_via": (
        "Number of via points",
        "via points K",
        "A search of the same size for each number; more via points make a longer motion.",
    ),
    "weight": (
        "Weight of the coupling index",
        "λ2 of the coupling index in eq. 7",
        "A search of the same size for each weight; λ1 = 1 − λ2 is the weight of log det.",
    ),
    "repetitions": (
        "Number of repetitions",
        "fitted repetitions",
        "The first repetitions of the study.",
    ),
    "noise": (
        "Noise of the currents",
        "multiple of the cell's current noise",
        "A and B executed at each noise level; same held-out motions.",
    ),
}
"""Title, name of the setting and description, by key of the ablation."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Estimates and predictions of the ablations."""

    fits: Mapping[str, FitRecord]  #: of the ablations, by key
    main: Mapping[str, FitRecord]  #: of A and B with all repetitions
    scores: Mapping[str, ScoreRecord]  #: of the held-out motions, by class
    truth: Array  #: true parameters (p,)
    sines: str  #: key of the sines of method A

    @cached_property
    def forms(self) -> dict[str, ClassForms]:
        """Of the held-out motions, by class."""
        return {name: ClassForms.of(one.forms) for name, one in self.scores.items()}

    def point(
        self, value: float, record: FitRecord, values: Array, reference: Array, **named: Any
    ) -> AblationPoint:
        """Return the point of one setting from estimates (r, p) and a reference (p,)."""
        estimate, truth, forms = values.mean(axis=0), self.truth, self.forms.items()
        return AblationPoint(
            value=value,
            repetitions=len(values),
            log10_det=record.log10_det,
            coupling_index=record.coupling_index,
            duration=record.duration,
            parameter_error=parameter_error(estimate, reference, truth),
            error={name: float(np.median(one.overall(estimate))) for name, one in forms},
            own={name: float(np.median(one.own(estimate, truth))) for name, one in forms},
            **named,
        )


def ablations(
    settings: StudySettings, evidence: Evidence
) -> tuple[list[AblationResult], list[ChanceRange]]:
    """Return all ablations, and the ranges of A and B over repetitions."""
    fits, main = evidence.fits, {key: np.array(evidence.main[key].values) for key in (A, B)}
    values = {key: np.array(one.values) for key, one in fits.items()}
    reference = values[B].mean(axis=0)
    sines = [key for key in SINES if key in fits]
    inner = {key: evidence.forms["fly-by"].torque_kernels(values[key]) for key in (*sines, B)}
    beside_b = [
        compared_on("fly-by", (key, B), (inner[key], inner[B]), drifts=False) for key in sines
    ]
    # By ablation: value, method and key of the fit of each setting; and the study's own setting.
    wanted: dict[str, tuple[list[tuple[float, str, str]], object]] = {
        "sines": ([(float(k), A, key) for k, key in enumerate(sines)], evidence.sines),
        "fly": ([(one, B, variant_key("fly", one)) for one in settings.fly], B),
        "n_via": ([(float(one), B, variant_key("via", one)) for one in settings.n_via], B),
        "weight": ([(one, B, variant_key("weight", one)) for one in settings.coupling_weight], B),
        "noise": ([(f, m, noise_key(m, f)) for m in (A, B) for f in settings.noise], 1.0),
    }
    found = []
    for name, (rows, base) in wanted.items():
        points = [
            evidence.point(
                value,
                fits[key],
                values[key],
                reference,
                method=method,
                base=base in (value, key),
                label=SINES[key][0] if key in SINES else "",
            )
            for value, method, key in rows
            if key in fits
        ]
        found.append(_result(name, points, corrected(beside_b) if name == "sines" else ()))
    points = [
        evidence.point(
            float(size),
            evidence.main[method],
            main[method][:size],
            main[B][:size].mean(axis=0),
            method=method,
            base=size == len(main[method]),
        )
        for method in (A, B)
        for size in settings.subsets
        if size <= len(main[method])
    ]
    found.insert(-1, _result("repetitions", points))
    forms, truth, size = evidence.forms, evidence.truth, len(values[B])
    ranges = [
        one
        for method in (A, B)
        for one in ranges_of(method, main[method], size, forms, truth, reference)
    ]
    return found, ranges


def _result(
    key: str, points: list[AblationPoint], comparisons: Sequence[ComparisonResult] = ()
) -> AblationResult:
    title, variable, words = _TEXTS[key]
    return AblationResult(
        key=key,
        title=title,
        variable=variable,
        words=words,
        points=points,
        comparisons=list(comparisons),
    )
