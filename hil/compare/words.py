"""What a comparison means, in sentences and as JSON: the first thing a reader sees."""

from __future__ import annotations

import math
from typing import Any, Final, Literal

import numpy as np

from .comparison import AxisChange, Comparison, ParameterChange
from .findings import Finding, payload_findings
from .trend import FEWEST, LEAST_FRICTION, campaign_names

_LEAST: Final = f"{100.0 * LEAST_FRICTION:g} %"
_PREDICTS_WORSE: Final = 1.1
"""Ratio of prediction errors from which a model is said to predict worse."""


def names(found: Comparison) -> list[str]:
    """What each campaign is called: the last part of its folder, and its day."""
    return campaign_names(found.campaigns, days=found.dated)


def verdict(found: Comparison) -> str:
    """One line."""
    axes = [axis.joint for axis in found.axes if any(axis.changed)]
    parts = []
    if axes:
        parts.append(f"friction of {_joined(axes)}")
    if any(found.payload.changed):
        parts.append("what the arm carries")
    if any(found.payload.other):
        parts.append("inertial parameters")
    if not parts and found.friction_slight:
        axes = [axis.joint for axis in found.axes if any(axis.slight)]
        return f"No change of {_LEAST} or more; friction of {_joined(axes)} differs by less"
    if not parts:
        return "No significant change"
    return f"Changed: {_joined(parts)}"


def findings(found: Comparison) -> list[Finding]:
    """Everything in sentences, what changed first; never empty."""
    called = names(found)
    every = [
        Finding("changed", _axis_words(axis, k, called), _axis_step(axis, k))
        for axis in found.axes
        for k in range(1, len(called))
        if axis.changed[k]
    ]
    for finding in payload_findings(found.payload, called):
        level: Literal["changed", "same"] = "same" if finding.level == "quiet" else "changed"
        every.append(Finding(level, finding.words, finding.next_step))
    every += _slight(found, called)
    every += _unchanged(found)
    every += _predictions(found, called)
    every.sort(key=lambda one: one.level)  # stable: "changed" comes first
    return every


def caveat(found: Comparison) -> str:
    """What few campaigns cannot show."""
    count = len(found.campaigns)
    text = (
        f"{count} campaigns do not show how much this arm differs from day to day without "
        "anything having happened to it: a cold arm has tens of per cent more friction. Compare "
        "campaigns of an arm that was equally warm."
    )
    if count > FEWEST:
        text += " `hil reidentify` on the same folders judges each by the scatter of those before."
    return text


def _axis_words(axis: AxisChange, k: int, called: list[str]) -> str:
    change, low, high = axis.relative(k)
    at = f" at {axis.speed:.2g} {axis.speed_unit}" if math.isfinite(axis.speed) else ""
    return (
        f"{axis.joint}: friction{at} is {100.0 * abs(change):.0f} % "
        f"{'higher' if change > 0.0 else 'lower'} in {called[k]} than in {called[0]}, "
        f"{axis.known[k].value:.3g} against {axis.known[0].value:.3g} {axis.unit} "
        f"(95 %: {100.0 * low:+.1f} to {100.0 * high:+.1f} %)."
    )


def _axis_step(axis: AxisChange, k: int) -> str:
    if axis.relative(k)[0] > 0.0:
        return "Check this axis' gear, brake and lubrication; was it colder?"
    return "Was it warmer, or has gear or lubricant been changed?"


def _slight(found: Comparison, called: list[str]) -> list[Finding]:
    """What differs by more than chance, and by less than counts as a change."""
    sentences = []
    for k in range(1, len(called)):
        axes = [axis for axis in found.axes if axis.slight[k]]
        if not axes:
            continue
        sizes = [100.0 * axis.relative(k)[0] for axis in axes]
        low, high = (f"{pick(sizes):+.1f}" for pick in (min, max))
        size = low if low == high else f"{low} to {high}"
        words = (
            f"Friction of {_joined([axis.joint for axis in axes])} has changed by {size} % from"
            f" {called[0]} to {called[k]}: more than chance, and less than the {_LEAST} that"
            " count as a change."
        )
        sentences.append(Finding("same", words))
    return sentences


def _unchanged(found: Comparison) -> list[Finding]:
    same = [axis for axis in found.axes if not any(axis.changed) and not any(axis.slight)]
    judged = [axis for axis in same if np.isfinite(axis.p_values).any()]
    silent = [axis.joint for axis in same if not np.isfinite(axis.p_values).any()]
    sentences = []
    if judged:
        worst = max(judged, key=lambda axis: float(np.nanmax(axis.smallest)))
        axes = _joined([axis.joint for axis in judged])
        sentences.append(
            Finding(
                "same",
                f"Friction of {axes} has not changed significantly; the detection limit is "
                f"{100.0 * float(np.nanmax(worst.smallest)):.0f} %"
                + (f" (of {worst.joint}, the least well known)." if len(judged) > 1 else "."),
            )
        )
    if silent:
        sentences.append(Finding("same", f"Friction of {_joined(silent)} is not determined."))
    if found.payload.untested:
        words = f"Whether it carries the same was not tested: {found.payload.untested}."
        sentences.append(Finding("same", words))
    elif not found.load_changed:
        sentences.append(Finding("same", "The payload has not changed significantly."))
    return sentences


def _predictions(found: Comparison, called: list[str]) -> list[Finding]:
    """How the first model does on the motions of the others, beside their own models."""
    sentences = []
    for k in range(1, len(called)):
        own, first = found.prediction.overall[k, k], found.prediction.overall[0, k]
        if not (np.isfinite(own) and np.isfinite(first) and own > 0.0):
            continue
        ratio = first / own
        how = (
            f"with {ratio:.2g} times the error of that campaign's own model"
            if ratio > _PREDICTS_WORSE
            else "as well as that campaign's own model"
        )
        sentences.append(
            Finding(
                "same",
                f"The model of {called[0]} predicts the validation motions of {called[k]} "
                f"{how}: {100.0 * first:.2g} % against {100.0 * own:.2g} % of the torque.",
            )
        )
    return sentences


def _joined(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def to_dict(found: Comparison) -> dict[str, Any]:
    """Everything in SI units; null for what is not known. Lists follow `campaigns`."""
    payload = found.payload
    return {
        "arm": found.arm,
        "simulated": found.simulated,
        "changed": found.changed,
        "friction_changed": found.friction_changed,
        "friction_slight": found.friction_slight,
        "load_changed": found.load_changed,
        "verdict": verdict(found),
        "findings": [vars(one) for one in findings(found)],
        "caveat": caveat(found),
        "warnings": list(found.warnings),
        "campaigns": [
            {
                "name": name,
                "folder": one.campaign,
                "when": one.when or None,
                "repetitions": one.repetitions,
                "stated": one.setup,
            }
            for name, one in zip(names(found), found.campaigns, strict=True)
        ],
        "axes": [_axis(axis) for axis in found.axes],
        "payload": {
            "untested": payload.untested or None,
            "changed": [bool(x) for x in payload.changed],
            "other_inertia": [bool(x) for x in payload.other],
            "mass": [_number(x) for x in payload.mass],
            "mass_std": [_number(x) for x in payload.mass_std],
            "p_value": [None if c is None else _number(c.p_value) for c in payload.changes],
        },
        "parameters": [_parameter(one) for one in found.parameters],
        "prediction": {
            "overall": [[_number(x) for x in row] for row in found.prediction.overall],
            "joints": [
                [[_number(x) for x in cell] for cell in row] for row in found.prediction.joints
            ],
        },
    }


def _axis(axis: AxisChange) -> dict[str, Any]:
    changes = [None, *(axis.relative(k) for k in range(1, len(axis.known)))]
    return {
        "joint": axis.joint,
        "unit": axis.unit,
        "speed": _number(axis.speed),
        "friction": [_number(one.value) for one in axis.known],
        "std": [_number(one.std) for one in axis.known],
        "repetitions": [[_number(x) for x in own] for own in axis.repetitions],
        "change": [None if one is None else _number(one[0]) for one in changes],
        "interval": [None if one is None else [_number(x) for x in one[1:]] for one in changes],
        "p_value": [_number(p) for p in axis.p_values],
        "changed": list(axis.changed),
        "slight": list(axis.slight),
        "smallest": [_number(x) for x in axis.smallest],
    }


def _parameter(one: ParameterChange) -> dict[str, Any]:
    return {
        "name": one.name,
        "unit": one.unit,
        "friction": one.is_friction,
        "value": [_number(each.value) for each in one.known],
        "std": [_number(each.std) for each in one.known],
        "p_value": [_number(p) for p in one.p_values],
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
