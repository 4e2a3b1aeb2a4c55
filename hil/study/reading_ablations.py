"""What becomes of the figures when one thing is changed, in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from hil.report import numbers

from .reading_sines import beside_b
from .results import AblationBand, AblationPoint, AblationResult, Paragraph
from .wording import FLY_BY, listed, ratios_of, upper

_ENDS: Final = {
    "noise": lambda value: f"with {value:g} times the noise" if value else "without noise",
    "repetitions": lambda value: f"with {value:g} repetition{'' if value == 1.0 else 's'}",
}
_MANY: Final = 20
"""Subsets from which on the middle 95 % of them are just that."""
_SEARCHED: Final = ("n_via", "weight")
"""Where each setting is a motion of its own, found by a search."""


def ablation_paragraph(ablation: AblationResult, labels: Mapping[str, str]) -> Paragraph:
    """Between which figures one thing moves the others, and what of that may be chance."""
    sentences = [ablation.words]
    if any(one.setting for one in ablation.comparisons):
        sentences += _settings(ablation, labels)
    else:
        sentences += _spans(ablation, labels)
    if ablation.key in (*_SEARCHED, "fly"):
        sentences += _by_chance(ablation, labels)
    sentences += _at_the_ends(ablation, labels)
    sentences += beside_b(ablation)
    sentences += ablation.missing
    if ablation.points and ablation.key in _SEARCHED:
        count = ablation.points[0].repetitions
        sentences.append(
            f"Each setting is one motion, executed {'once' if count == 1 else f'{count} times'}: "
            "differences may be luck of the search."
        )
    return Paragraph(key=f"ablation-{ablation.key}", heading=ablation.title, sentences=sentences)


def _settings(ablation: AblationResult, labels: Mapping[str, str]) -> list[str]:
    """A pair of methods, setting by setting."""
    pairs = [(one.setting, one) for one in ablation.comparisons]
    first = ablation.comparisons[0]
    return [
        f"{upper(first.motion_class)} error with {labels[first.second]} over that with"
        f" {labels[first.first]}: {ratios_of(pairs)}"
    ]


def _spans(ablation: AblationResult, labels: Mapping[str, str]) -> list[str]:
    sentences = []
    for method in dict.fromkeys(point.method for point in ablation.points):
        points = [point for point in ablation.points if point.method == method]
        if len(points) < 2:
            continue
        spans = []
        if len({point.coupling_index for point in points}) > 1:
            spans.append(_span("I_c", [(p.name, p.coupling_index) for p in points], 1))
            spans.append(_span("log det", [(p.name, p.log10_det) for p in points], 1))
        spans.append(_span("distance", [(p.name, p.parameter_error) for p in points], 2))
        for words, decimals, values in (
            ("fly-by error [%]", 3, [(p.name, p.error.get(FLY_BY)) for p in points]),
            ("own fly-by error [%]", 4, [(p.name, p.own.get(FLY_BY)) for p in points]),
        ):
            shares = [(at, None if value is None else 100.0 * value) for at, value in values]
            spans.append(_span(words, shares, decimals))
        told = "; ".join(span for span in spans if span)
        if told:
            sentences.append(f"{labels[method]}, {ablation.variable}: {told}.")
    return sentences


def _by_chance(ablation: AblationResult, labels: Mapping[str, str]) -> list[str]:
    """Which settings lie beyond what as many repetitions of the method give without any change."""
    sentences = []
    for band in ablation.bands:
        if band.motion_class != FLY_BY or band.quantity == "parameter_error":
            continue
        own = band.quantity == "own"
        if not own and any(_alike(band, other) for other in ablation.bands):
            continue  # the noise that every estimate leaves hides what there is to see
        values = [
            (point.name, value)
            for point in ablation.points
            if not point.base
            and _beside(band, point)
            and (value := (point.own if own else point.error).get(FLY_BY)) is not None
        ]
        if not values:
            continue
        outside = [name for name, value in values if not band.low <= value <= band.high]
        many = "" if band.repetitions == 1 else "s"
        spread = (
            f"{numbers.significant(100.0 * band.low, 2)} to"
            f" {numbers.significant(100.0 * band.high, 2)} %"
        )
        few = ", too few to say much," if band.subsets < _MANY else ""
        sentences.append(
            f"{band.subsets} choices of {band.repetitions} repetition{many} of the study's own"
            f" {labels[band.method]}{few} give {'an own' if own else 'a'} fly-by error of"
            f" {spread}: "
            + (
                f"beyond that {'lies' if len(outside) == 1 else 'lie'} {listed(outside)}."
                if outside
                else "no other setting lies beyond that."
            )
        )
    return sentences


def _alike(band: AblationBand, other: AblationBand) -> bool:
    """Whether another band is of the same points in their own errors."""
    return other.quantity == "own" and (other.method, other.repetitions, other.motion_class) == (
        band.method,
        band.repetitions,
        band.motion_class,
    )


def _beside(band: AblationBand, point: AblationPoint) -> bool:
    """Whether a point is of as many repetitions of the same method."""
    return (point.method, point.repetitions) == (band.method, band.repetitions)


def _at_the_ends(ablation: AblationResult, labels: Mapping[str, str]) -> list[str]:
    """The two methods beside each other at both ends of what is varied."""
    words = _ENDS.get(ablation.key)
    by_method = {
        method: {point.value: point for point in ablation.points if point.method == method}
        for method in dict.fromkeys(point.method for point in ablation.points)
    }
    if words is None or len(by_method) != 2:
        return []
    (first, before), (second, after) = by_method.items()
    both = sorted(before.keys() & after.keys())
    if len(both) < 2:
        return []
    own = all(point.own for point in (*before.values(), *after.values()))
    told = []
    for value in (both[0], both[-1]):
        errors = [(point.own if own else point.error) for point in (before[value], after[value])]
        ratios = _ratios(*errors)
        if ratios:
            told.append(f"{words(value)} {ratios}")
    if not told:
        return []
    return [
        f"{'Own' if own else 'Median'} error with {labels[second]} over that with {labels[first]}:"
        f" {'; '.join(told)}."
    ]


def _ratios(before: Mapping[str, float], after: Mapping[str, float]) -> str:
    return ", ".join(
        f"{numbers.fixed(after[name] / error, 2)} on {name}"
        for name, error in before.items()
        if error > 0.0 and name in after
    )


Setting = tuple[str, float | None]


def _span(what: str, points: Sequence[Setting], decimals: int) -> str:
    """Smallest and largest value, and at which settings."""
    known = [(value, at) for at, value in points if value is not None and math.isfinite(value)]
    if len({numbers.fixed(value, decimals) for value, _ in known}) < 2:
        return ""
    (low, at_low), (high, at_high) = (pick(known, key=lambda one: one[0]) for pick in (min, max))
    return (
        f"{what} from {numbers.fixed(low, decimals)} (at {at_low}) to"
        f" {numbers.fixed(high, decimals)} (at {at_high})"
    )
