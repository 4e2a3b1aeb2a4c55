"""What the trends of an arm mean, in plain words: the first thing a reader sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.batch.chart import FEWEST
from hil.batch.payload_change import Change
from hil.batch.trend import ArmTrend, AxisTrend, Watched

Level = Literal["alarm", "past", "quiet"]

_MONTH = 365.25 / 12.0
_YEAR = 365.25
_CERTAIN = 2.0
_MILLIMETRE = 1e-3


@dataclass(frozen=True)
class Finding:
    """One thing to know about an arm.

    Attributes:
        level: "alarm" concerns the last campaign, "past" earlier ones, "quiet" nothing.
        words: a sentence.
        next_step: what to do about it; "" for nothing.
    """

    level: Level
    words: str
    next_step: str = ""


def findings(arm: ArmTrend) -> tuple[Finding, ...]:
    """What was found of an arm, what concerns its last campaign first; never empty."""
    found = [*_payload_findings(arm)]
    for axis in arm.axes:
        found += _axis_findings(arm, axis)
    found.sort(key=lambda one: one.level != "alarm")
    return tuple(found) if found else (_nothing(arm),)


def summary(arm: ArmTrend) -> str:
    """One line: what the last campaign says of the arm."""
    alarms = sum(one.level == "alarm" for one in findings(arm))
    if alarms:
        return f"{alarms} {'thing' if alarms == 1 else 'things'} to look into"
    if len(arm.campaigns) < 2:
        return "one campaign, nothing to compare it with"
    if len(arm.campaigns) <= FEWEST:
        return "no change found, but too few campaigns to judge the axes"
    return "as before"


def campaign_name(arm: ArmTrend, k: int) -> str:
    """A campaign as the page calls it: the last part of its folder, and its day."""
    name = arm.campaigns[k].rstrip("/").rsplit("/", 1)[-1] or f"campaign {k + 1}"
    return f"{name} ({arm.when[k][:10]})" if arm.dated else name


def _nothing(arm: ArmTrend) -> Finding:
    count = len(arm.campaigns)
    if count < 2:
        return Finding("quiet", "There is one campaign, and nothing to compare it with.")
    carried = (
        f"Whether it carries what it carried was not tested: {arm.payload.untested}."
        if arm.payload.untested
        else "What it carries has not changed, as far as can be told."
    )
    if count <= FEWEST:
        return Finding(
            "quiet",
            f"{carried} Its axes are judged from the campaign on that has {FEWEST} before it;"
            f" there are {count}.",
        )
    return Finding(
        "quiet",
        f"Nothing has departed in {count} campaigns: friction and torque error of every axis are"
        f" where the campaigns before let expect them. {carried}",
    )


def _axis_findings(arm: ArmTrend, axis: AxisTrend) -> list[Finding]:
    found = []
    if any(axis.friction.departs):
        found.append(_friction_departs(arm, axis))
    if any(axis.error.departs):
        found.append(_error_departs(arm, axis))
    if axis.drifts:
        found.append(_drifts(arm, axis))
    return found


def _friction_departs(arm: ArmTrend, axis: AxisTrend) -> Finding:
    k, centre = _latest(axis.friction)
    value = float(axis.friction.values[k])
    change = _relative_change(value, centre)
    at = f" at {axis.speed:.2g} {axis.speed_unit}" if math.isfinite(axis.speed) else ""
    words = (
        f"{axis.joint} departs from its history: friction{at} is {100.0 * abs(change):.0f} %"
        f" {'above' if change > 0 else 'below'} what it was, {value:.3g} against"
        f" {centre:.3g} {axis.unit}{_since(arm, axis.friction)}."
    )
    step = (
        "Check this axis' gear, brake and lubrication; was it colder than in the other campaigns?"
        if change > 0
        else "Was it warmer than in the other campaigns, or has gear or lubricant been changed?"
    )
    return _finding(arm, axis.friction, words, step)


def _error_departs(arm: ArmTrend, axis: AxisTrend) -> Finding:
    k, centre = _latest(axis.error)
    value = float(axis.error.values[k])
    words = (
        f"{axis.joint} departs from its history: the model leaves {value:.3g} {axis.unit} of its"
        f" torque unexplained, {100.0 * _relative_change(value, centre):.0f} % more than before"
        f" ({centre:.3g} {axis.unit}){_since(arm, axis.error)}."
    )
    step = "Look at the residual of this axis in hil identify on that campaign: backlash, a"
    return _finding(arm, axis.error, words, f"{step} rubbing hose or another motion make it.")


def _drifts(arm: ArmTrend, axis: AxisTrend) -> Finding:
    assert axis.drift is not None
    size = abs(float(np.nanmedian(axis.friction.values))) or math.inf
    span = float(np.ptp(arm.time))
    unit, scale = _per(arm, span)
    slope, low, high = (
        100.0 * one * scale / size for one in (axis.drift.slope, axis.drift.low, axis.drift.high)
    )
    total = axis.drift.slope * span / size
    words = (
        f"Friction of {axis.joint} {'rises' if slope > 0 else 'falls'} steadily: {slope:+.2g} %"
        f" {unit} (95 %: {low:+.2g} to {high:+.2g}), {100.0 * total:+.0f} % over all campaigns."
    )
    return Finding("alarm", words, "Wear, lubricant that ages, or campaigns run ever warmer.")


def _per(arm: ArmTrend, span: float) -> tuple[str, float]:
    """A unit of time in which the slope is a number that people can judge."""
    if not arm.dated:
        return "per campaign", 1.0
    if span < 14.0:
        return "per day", 1.0
    return ("per month", _MONTH) if span < 2.0 * _YEAR else ("per year", _YEAR)


def _payload_findings(arm: ArmTrend) -> list[Finding]:
    payload = arm.payload
    found = []
    for k, change in enumerate(payload.changes):
        if change is None or not (payload.changed[k] or payload.other[k]):
            continue
        level: Level = "alarm" if k == len(payload.changes) - 1 else "past"
        where = f"between {campaign_name(arm, k - 1)} and {campaign_name(arm, k)}"
        if payload.changed[k]:
            words = f"What the arm carries has changed {where}: {_what(change)}."
            step = "State the payload in the cell file, or check the tool and its fastening."
        else:
            words = (
                f"Inertial parameters have changed {where}, but not as by something put on the"
                f" last link: that explains {100.0 * change.share:.0f} % of the change."
            )
            step = "Check the torque constants and the calibration, and what links before it carry."
        found.append(Finding(level, words, step))
    return found


def _what(change: Change) -> str:
    """Mass if it can be seen, and how far from the last joint it sits if that is known."""
    if not math.isfinite(change.mass):
        moment = float(np.linalg.norm(np.nan_to_num(change.moment)))
        return f"first moment by {moment:.2g} kg·m, while its mass cannot be seen by this arm"
    if abs(change.mass) < _CERTAIN * change.mass_std:
        return (
            f"its mass by less than can be told ({change.mass:+.2g} ± {change.mass_std:.1g} kg),"
            " but its centre or inertia"
        )
    verb = "put on" if change.mass > 0 else "taken off"
    text = f"{abs(change.mass):.2f} ± {change.mass_std:.2g} kg {verb}"
    if np.isfinite(change.moment).all():
        centre = change.moment / change.mass / _MILLIMETRE
        text += (
            f", centred at ({', '.join(f'{round(float(c))}' for c in centre)}) mm of the last joint"
        )
    return text


def _relative_change(value: float, centre: float) -> float:
    return (value - centre) / (abs(centre) or math.inf)


def _latest(watched: Watched) -> tuple[int, float]:
    """The last campaign that departs, and the centre of those before it."""
    k = max(k for k, departs in enumerate(watched.departs) if departs)
    limits = watched.limits[k]
    assert limits is not None
    return k, limits.centre


def _since(arm: ArmTrend, watched: Watched) -> str:
    """In which campaigns."""
    which = [k for k, departs in enumerate(watched.departs) if departs]
    first, last = which[0], which[-1]
    if first == last:
        return f" in {campaign_name(arm, last)}"
    if len(which) == last - first + 1 and last == len(watched.departs) - 1:
        return f", since {campaign_name(arm, first)}"
    return f", in {len(which)} campaigns, last in {campaign_name(arm, last)}"


def _finding(arm: ArmTrend, watched: Watched, words: str, step: str) -> Finding:
    return Finding("alarm" if watched.departs[len(arm.campaigns) - 1] else "past", words, step)
