"""What a model is good for, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from identification.text import enumerated, number, percentage
from identification.validation.purpose import NoFigure, Purpose, PurposeName, good_for

TITLES: Final[dict[PurposeName, str]] = {
    "feed-forward": "feed-forward",
    "gravity": "gravity compensation",
    "simulation": "simulation",
    "contact": "contact detection",
    "payload": "payload detection",
    "parameters": "single parameters",
}

MISSING: Final[dict[NoFigure, str]] = {
    "nothing held out": "no motion was held out",
    "too short": "the unseen motion is too short",
    "undetermined": "not determined",
    "no gravity": "the torque does not contain gravity",
    "no dry friction": "no dry friction to hold the arm was identified",
    "not possible": "no physically consistent parameters",
}


_NO_FRICTION: Final = 1e-3
"""Dry friction over the error of gravity, below which none is shown: a bound of the estimate."""


def purposes_in_a_sentence(
    purposes: Sequence[Purpose],
    joints: Sequence[str],
    asked: Sequence[PurposeName] = (),
    *,
    only: bool = False,
) -> str:
    """Return what a model is good for, what it is not good for, and what it would notice.

    What it is not good for comes first if that was requested; requested purposes that could not
    be judged are named with the reason.

    Args:
        purposes: all of them, judged.
        joints: names of the joints.
        asked: requested purposes.
        only: whether it is good for nothing else.
    """
    good = [_with_figure(p, joints) for p in purposes if p.good]
    bad = [_with_figure(p, joints) for p in purposes if p.good is False]
    seen = [
        f"{what} from {noticed(p)}"
        for p in purposes
        for what in [{"contact": "a force at the flange", "payload": "a payload"}.get(p.name)]
        if what and p.good is None and p.figure is not None and math.isfinite(p.figure)
    ]
    unknown = [_with_figure(p, joints) for p in purposes if p.name in asked and p.good is None]
    sentences = [
        f"Good {'only ' if only else ''}for {enumerated(good)}." if good else "",
        f"Not for {enumerated(bad)}." if bad else "",
        f"Not judged: {enumerated(unknown)}." if unknown else "",
        f"It notices {enumerated(seen)}." if seen else "",
    ]
    if not good_for(purposes, asked):
        sentences[:3] = [*sentences[1:3], sentences[0]]
    return " ".join(filter(None, sentences))


def _with_figure(purpose: Purpose, joints: Sequence[str]) -> str:
    """Return a purpose with its figure in brackets."""
    title = TITLES[purpose.name]
    if purpose.name == "gravity" and purpose.good:
        return title
    return f"{title} ({figure(purpose, joints)})"


def figure(purpose: Purpose, joints: Sequence[str]) -> str:
    """Return the figure of a purpose, with what it is compared to."""
    if purpose.figure is None:
        return MISSING.get(purpose.missing, "")
    match purpose.name:
        case "feed-forward":
            left = percentage(purpose.figure, _decimals(purpose.figure))
            return f"{left} of the torque left{_nominal(purpose)}"
        case "gravity":
            return _gravity(purpose, joints)
        case "simulation":
            horizon = purpose.references["horizon"]
            return f"flange {number(1e3 * purpose.figure, 2)} mm off after {horizon:g} s"
        case "parameters":
            roughly, unknown = (int(purpose.references[name]) for name in ("roughly", "not"))
            return f"{int(purpose.figure)} known to 10 %, {roughly} to 50 %, {unknown} not"
        case _:
            period = purpose.references.get("period")
            rate = f", one false alarm in {period:g} s" if period else ""
            return f"from {noticed(purpose)}{rate}"


def _nominal(purpose: Purpose) -> str:
    nominal = purpose.references.get("nominal with friction")
    if nominal is None:
        return ""
    return f", nominal model with friction {percentage(nominal, _decimals(nominal))}"


def noticed(purpose: Purpose) -> str:
    """Return the force or mass that is noticed."""
    assert purpose.figure is not None
    if not math.isfinite(purpose.figure):
        return "no force" if purpose.name == "contact" else "no mass"
    return f"{rounded(purpose.figure)} {purpose.unit}"


def _gravity(purpose: Purpose, joints: Sequence[str]) -> str:
    """Return the joint whose gravity torque is off most, against its dry friction."""
    rows = zip(joints, purpose.joints, purpose.joint_limits, strict=True)
    held = [(error / limit, joint, error, limit) for joint, error, limit in rows if limit > 0.0]
    if not held:
        return MISSING["no dry friction"]
    _, joint, error, limit = max(held)
    if not math.isfinite(error):
        return f"{joint} not determined"
    held_by = (
        f"dry friction {rounded(limit)} N·m" if limit > _NO_FRICTION * error else "no dry friction"
    )
    return f"{joint} off by {rounded(error)} N·m, {held_by}"


def requirement(purpose: Purpose) -> str:
    """Return the requirement on the figure; empty if there is none."""
    if purpose.limit is None:
        return ""
    match purpose.name:
        case "feed-forward":
            return f"at most {percentage(purpose.limit)}, and less than the nominal model"
        case "gravity":
            return "off by less than dry friction"
        case "simulation":
            return f"at most {number(1e3 * purpose.limit)} mm{_tested_up_to(purpose)}"
        case _:
            return f"at most {number(purpose.limit)} {purpose.unit}"


def _tested_up_to(purpose: Purpose) -> str:
    """Return how fast the joints were, beyond which the figure says nothing."""
    if "speed" not in purpose.references:
        return ""
    speed, acceleration = (purpose.references[name] for name in ("speed", "acceleration"))
    return f"; tested up to {rounded(speed)} rad/s and {rounded(acceleration)} rad/s²"


def _decimals(share: float) -> int:
    return 1 if abs(share) < 0.1 else 0


def rounded(value: float) -> str:
    """Return a number with two significant digits, without an exponent."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 1 - math.floor(math.log10(abs(value))))
    return f"{round(value, digits) if digits else float(f'{value:.2g}'):.{digits}f}"
