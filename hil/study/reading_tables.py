"""What the tables of excitations and parameters say, in sentences."""

from __future__ import annotations

import math

import numpy as np

from hil.report import numbers

from .results import ConditionResult, MethodResult, MotionRow, Paragraph, StudyResults
from .wording import labels_of, opening


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
            told = [
                *_scatter(methods["a"], methods["b"]),
                *_distance(results, methods["a"], methods["b"]),
            ]
            if told:
                sentences.append(f"{opening(condition)}: {' '.join(told)}")
        if condition.closeness:
            sentences.append(_closeness(condition))
    return Paragraph(key="parameters", heading="The parameters", sentences=sentences)


def _closeness(condition: ConditionResult) -> str:
    """How often the second method comes closer to the manufacturer's column, as in section 4.2."""
    labels, first = labels_of(condition), condition.closeness[0]
    in_print = (first.first, first.second) == ("a", "b")  # what the paper has columns of
    parts = [
        f"{one.second_closer} of {one.parameters} in {one.group}"
        + (
            f" (in print {one.printed_second_closer})"
            if in_print and one.printed_second_closer is not None
            else ""
        )
        for one in condition.closeness
    ]
    return (
        f"{opening(condition)}, {labels[first.second]} lies closer to π_C than"
        f" {labels[first.first]} in {'; '.join(parts)}."
    )


def _scatter(a: MethodResult, b: MethodResult) -> list[str]:
    """How the estimates of single repetitions differ; nothing where there is one repetition."""
    usable = (np.array(a.std) > 0.0) & (np.array(b.std) > 0.0)
    if min(a.repetitions, b.repetitions) < 2 or not usable.any():
        return []
    logs = np.log(np.array(b.std)[usable] / np.array(a.std)[usable])
    smaller = int(np.count_nonzero(logs < 0.0))
    return [
        f"B's estimates scatter over the repetitions"
        f" {numbers.fixed(math.exp(float(logs.mean())), 2)} times as much as A's (geometric mean"
        f" of {logs.size} parameters; less in {smaller} of them)."
    ]


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
        f"B's distance from the planted values is {numbers.fixed(ratio, 2)} times that of A's in"
        f" the geometric mean; B is closer in {closer} of {len(pairs)}."
    ]
