"""What the tables of excitations, parameters and ablations say, in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hil.report import numbers

from .reading_sines import beside_b
from .results import (
    AblationResult,
    ConditionResult,
    MethodResult,
    MotionRow,
    Paragraph,
    StudyResults,
)
from .wording import opening


def criteria_paragraph(results: StudyResults) -> Paragraph:
    """Table 1."""
    ours = {row.key: row for row in results.table1 if not row.printed}
    printed = {row.key: row for row in results.table1 if row.printed}
    if not {"a", "b"} <= ours.keys():
        return Paragraph(key="criteria", heading="The two excitations", sentences=[])
    a, b = ours["a"], ours["b"]
    sentences = [
        f"A reaches log det {numbers.fixed(a.log10_det, 1)} with I_c"
        f" {numbers.fixed(a.coupling_index, 1)}, B {numbers.fixed(b.log10_det, 1)} with"
        f" {numbers.fixed(b.coupling_index, 1)}.",
    ]
    if {"a", "b"} <= printed.keys():
        sentences += _beside_print(a, b, printed["a"], printed["b"])
    if a.duration is not None and b.duration is not None:
        sentences.append(
            f"A's motion lasts {numbers.fixed(a.duration, 1)} s and B's"
            f" {numbers.fixed(b.duration, 1)} s, so that as many repetitions give A"
            f" {numbers.fixed(a.duration / b.duration, 1)} times as many samples."
        )
    tried = [one for one in results.searches if one.key.startswith("a-")]
    chosen = next((one for one in tried if one.chosen), None)
    if chosen is not None and len(tried) > 1:
        sentences.append(
            f"A is the best of {len(tried)} searches by its own criterion, log det, over what the"
            f" paper leaves open: {chosen.words.removeprefix('method A, ')}."
        )
    return Paragraph(key="criteria", heading="The two excitations", sentences=sentences)


def _beside_print(a: MotionRow, b: MotionRow, paper_a: MotionRow, paper_b: MotionRow) -> list[str]:
    found = []
    for what, ours, theirs in (
        (
            "larger determinant",
            a.log10_det > b.log10_det,
            paper_a.log10_det > paper_b.log10_det,
        ),
        (
            "smaller coupling index",
            a.coupling_index < b.coupling_index,
            paper_a.coupling_index < paper_b.coupling_index,
        ),
    ):
        alike = "as in the paper" if ours == theirs else "unlike in the paper"
        found.append(f"The {what} is {'A' if ours else 'B'}'s, {alike}.")
    return found


def parameters_paragraph(results: StudyResults) -> Paragraph:
    """Table 2."""
    sentences: list[str] = []
    for condition in results.conditions:
        methods = {one.key: one for one in condition.methods}
        if {"a", "b"} <= methods.keys():
            told = [_scatter(condition, methods["a"], methods["b"])]
            told += _distance(results, methods["a"], methods["b"])
            sentences.append(" ".join(told))
        if condition.closeness:
            parts = [
                f"{one.second_closer} of {one.parameters} in {one.group}"
                + (
                    ""
                    if one.printed_second_closer is None
                    else f" (in print {one.printed_second_closer})"
                )
                for one in condition.closeness
            ]
            sentences.append(
                f"{opening(condition)}, B lies closer to pi_C than A in {'; '.join(parts)}."
            )
    return Paragraph(key="parameters", heading="The parameters", sentences=sentences)


def _scatter(condition: ConditionResult, a: MethodResult, b: MethodResult) -> str:
    usable = (np.array(a.std) > 0.0) & (np.array(b.std) > 0.0)
    logs = np.log(np.array(b.std)[usable] / np.array(a.std)[usable])
    smaller = int(np.count_nonzero(logs < 0.0))
    return (
        f"{opening(condition)}, B's estimates scatter over the repetitions"
        f" {numbers.fixed(math.exp(float(logs.mean())), 2)} times as much as A's (geometric mean"
        f" of {logs.size} parameters; less in {smaller} of them)."
    )


def _distance(results: StudyResults, a: MethodResult, b: MethodResult) -> list[str]:
    known = [
        (abs(x - one.truth), abs(y - one.truth))
        for one, x, y in zip(results.parameters, a.mean, b.mean, strict=True)
        if one.truth is not None
    ]
    pairs = [(x, y) for x, y in known if x > 0.0 and y > 0.0]
    if not pairs:
        return []
    ratio = math.exp(float(np.mean([math.log(y / x) for x, y in pairs])))
    closer = sum(y < x for x, y in pairs)
    return [
        f"Their distance from the planted values is {numbers.fixed(ratio, 2)} times that of A's in"
        f" the geometric mean; B is closer in {closer} of {len(pairs)}."
    ]


def ablation_paragraph(ablation: AblationResult) -> Paragraph:
    """Between which figures one thing moves the others."""
    sentences = [ablation.words]
    for method in dict.fromkeys(point.method for point in ablation.points):
        points = [point for point in ablation.points if point.method == method]
        if len(points) < 2:
            continue
        name = method.upper() if method in ("a", "b") else method
        spans = []
        if len({point.coupling_index for point in points}) > 1:
            spans.append(_span("I_c", [(p.name, p.coupling_index) for p in points], 1))
            spans.append(_span("log det", [(p.name, p.log10_det) for p in points], 1))
        spans.append(_span("parameter error", [(p.name, p.parameter_error) for p in points], 2))
        spans.append(
            _span(
                "fly-by error [%]",
                [(p.name, 100.0 * p.error["fly-by"]) for p in points if "fly-by" in p.error],
                3,
            )
        )
        spans.append(
            _span(
                "own fly-by error [%]",
                [(p.name, 100.0 * p.own["fly-by"]) for p in points if "fly-by" in p.own],
                4,
            )
        )
        told = "; ".join(span for span in spans if span)
        if told:
            sentences.append(f"{name}, {ablation.variable}: {told}.")
    sentences += _at_the_end(ablation)
    sentences += beside_b(ablation)
    sentences += ablation.missing
    if ablation.points and ablation.key in ("fly", "n_via", "weight"):
        count = ablation.points[0].repetitions
        sentences.append(
            f"Each setting is one motion, executed {'once' if count == 1 else f'{count} times'}: "
            "differences may be luck of the search."
            if ablation.key != "fly"
            else f"Each setting was executed {'once' if count == 1 else f'{count} times'}."
        )
    return Paragraph(key=f"ablation-{ablation.key}", heading=ablation.title, sentences=sentences)


def _at_the_end(ablation: AblationResult) -> list[str]:
    """The two methods beside each other at both ends of what is varied."""
    by_method = {
        method: {point.value: point.error for point in ablation.points if point.method == method}
        for method in dict.fromkeys(point.method for point in ablation.points)
    }
    if len(by_method) != 2:
        return []
    (first, before), (second, after) = by_method.items()
    both = sorted(before.keys() & after.keys())
    if len(both) < 2:
        return []
    told = []
    for value in (both[0], both[-1]):
        ratios = [
            f"{numbers.fixed(after[value][name] / error, 2)} on {name}"
            for name, error in before[value].items()
            if error > 0.0
        ]
        told.append(f"at {value:g} {', '.join(ratios)}")
    return [
        f"Median error with {second.upper()} over that with {first.upper()}: {'; '.join(told)}"
        " motions."
    ]


Setting = tuple[str, float | None]


def _span(what: str, points: Sequence[Setting], decimals: int) -> str:
    """Smallest and largest value, and at which settings."""
    known = [(value, at) for at, value in points if value is not None and math.isfinite(value)]
    if len(known) < 2:
        return ""
    (low, at_low), (high, at_high) = (pick(known, key=lambda one: one[0]) for pick in (min, max))
    return (
        f"{what} from {numbers.fixed(low, decimals)} (at {at_low}) to"
        f" {numbers.fixed(high, decimals)} (at {at_high})"
    )
