"""What trends and comparisons of an arm mean, in sentences: the first thing a reader sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final, Literal, get_args

import numpy as np

from hil.terminal_text import plural
from identification.model.payload import Payload

from .payload import Change, PayloadTrend, Statement, Verdict
from .trend import FEWEST, ArmTrend, AxisTrend, Watched

Level = Literal["alarm", "past", "quiet", "changed", "same"]
_ORDER: Final[tuple[Level, ...]] = get_args(Level)

_MONTH: Final = 365.25 / 12.0
_YEAR: Final = 365.25
_CERTAIN: Final = 2.0
_MILLIMETRE: Final = 1e-3
_SHIFTS: Final = 2
"""Shifts of a figure that are described one by one."""
_NAMED: Final = 5

_STEPS: Final = {
    "friction above": "Check this axis' gear, brake and lubrication; was it colder than before?",
    "friction below": "Was it warmer than before, or has gear or lubricant been changed?",
    "friction returns": "Repaired, greased, or equally warm again?",
    "torque error above": "Look at the residual of this axis in hil identify on that campaign: "
    "backlash, a rubbing hose or another motion make it.",
}
_VERDICTS: Final[dict[Verdict, str]] = {
    "agrees": "the torques agree",
    "statement only": "by its torques it carries the same as before: only the statement is new",
    "either": "the torques do not show whether it was carried before as well",
    "differs": "the torques do not agree",
    "untested": "whether the torques agree was not tested",
}


@dataclass(frozen=True)
class Finding:
    """One thing to know about an arm.

    Attributes:
        level: "alarm" concerns the last campaign, "past" earlier ones, "quiet" nothing; in a
            comparison "changed", or "same" for what did not, or by little, or is not known.
        words: a sentence.
        next_step: what to do about it; "" for nothing.
    """

    level: Level
    words: str
    next_step: str = ""


def findings(arm: ArmTrend) -> tuple[Finding, ...]:
    """What was found of an arm, what concerns its last campaign first; never empty."""
    found = payload_findings(arm.payload, arm.names)
    for axis in arm.axes:
        found += _shift_findings(arm, axis, axis.friction, "friction")
        found += _shift_findings(arm, axis, axis.error, "torque error")
        found += _drift_findings(arm, axis)
    if all(one.level == "quiet" for one in found):
        found.insert(0, _nothing(arm))
    found.sort(key=lambda one: _ORDER.index(one.level))
    return (*found, *_order_findings(arm))


def summary(arm: ArmTrend) -> str:
    """One line: what the last campaign shows of the arm."""
    levels = [one.level for one in findings(arm)]
    alarms, past = levels.count("alarm"), levels.count("past")
    if alarms:
        return f"{plural(alarms, 'thing')} to look into"
    if len(arm.campaigns) < 2:
        return "one campaign, nothing to compare it with"
    if past:
        return f"no new change; {past} earlier {'one' if past == 1 else 'ones'}"
    if len(arm.campaigns) <= FEWEST:
        return "no change found, but too few campaigns to judge the axes"
    return "as before"


# Friction and torque error


@dataclass(frozen=True)
class Shift:
    """Campaigns in a row that are elsewhere than those before them.

    Attributes:
        kind: "departs": at no level known before; "returns": at one that was left before.
        first: number of the first of these campaigns.
        last: of the last.
        before: median of those before.
        value: median of these.
        is_level: whether they made a level by which later ones are judged.
        lasts: whether no later campaign is elsewhere.
    """

    kind: Literal["departs", "returns"]
    first: int
    last: int
    before: float
    value: float
    is_level: bool
    lasts: bool


def shifts(watched: Watched) -> list[Shift]:
    """All shifts of a figure, in order of time."""

    def place(k: int) -> tuple[int, bool]:
        """The level of a campaign, and if it has none its side of the history."""
        level, band = watched.levels[k], watched.limits[k]
        return level, level < 0 and band is not None and bool(watched.values[k] > band.centre)

    known = [k for k, value in enumerate(watched.values) if np.isfinite(value)]
    runs = [(level, list(own)) for (level, _), own in groupby(known, place)]
    found = []
    for number, (level, own) in enumerate(runs[1:], start=1):
        fresh = level < 0 or level not in {earlier for earlier, _ in runs[:number]}
        band = watched.limits[own[0]]
        left = float(np.median(watched.values[runs[number - 1][1]]))
        found.append(
            Shift(
                kind="departs" if fresh else "returns",
                first=own[0],
                last=own[-1],
                before=band.centre if fresh and band is not None else left,
                value=float(np.median(watched.values[own])),
                is_level=level >= 0,
                lasts=number == len(runs) - 1,
            )
        )
    return found


def _shift_findings(arm: ArmTrend, axis: AxisTrend, watched: Watched, what: str) -> list[Finding]:
    """The last shifts of a figure, and how many there were before."""
    every = shifts(watched)
    found = []
    for shift in every[-_SHIFTS:]:
        # What has risen stays a thing to look into until it returns, however long ago it was.
        alarming = shift.kind == "departs" and (shift.value > shift.before or not shift.is_level)
        words, step = _shift_words(arm, axis, shift, what)
        found.append(Finding("alarm" if shift.lasts and alarming else "past", words, step))
    if len(every) > _SHIFTS:
        earlier = plural(len(every) - _SHIFTS, "earlier change")
        words = f"{axis.joint} had {earlier} of its {what}: see the figures."
        found.append(Finding("past", words))
    return found


def _shift_words(arm: ArmTrend, axis: AxisTrend, shift: Shift, what: str) -> tuple[str, str]:
    at = ""
    if what == "friction" and math.isfinite(axis.speed):
        at = f" at {axis.speed:.2g} {axis.speed_unit}"
    if shift.first == shift.last:
        when = f" in {arm.names[shift.first]}"
    elif shift.lasts:
        when = f", since {arm.names[shift.first]}"
    else:
        when = f", from {arm.names[shift.first]} to {arm.names[shift.last]}"
    value, before = f"{shift.value:.3g}", f"{shift.before:.3g} {axis.unit}"
    if shift.kind == "returns":
        words = f"has returned to an earlier level of {what}{at}: {value} after {before}{when}."
        return f"{axis.joint} {words}", _STEPS.get(f"{what} returns", "")
    change = (shift.value - shift.before) / (abs(shift.before) or math.inf)
    side = "above" if change > 0 else "below"
    words = (
        f"{axis.joint} departs from its history: {what}{at} is {100.0 * abs(change):.0f} % {side}"
        f" what it was, {value} against {before}{when}."
    )
    if shift.is_level and shift.lasts:
        words += " It has stayed there: later campaigns are judged by this level."
    return words, _STEPS.get(f"{what} {side}", "")


def _drift_findings(arm: ArmTrend, axis: AxisTrend) -> list[Finding]:
    slope = axis.drift
    if slope is None or not axis.drifts:
        return []
    size = abs(float(np.nanmedian(axis.friction.values))) or math.inf
    unit, scale = _per(arm, slope.span)
    per, low, high = (100.0 * one * scale / size for one in (slope.slope, slope.low, slope.high))
    total = 100.0 * slope.slope * slope.span / size
    first = int(np.flatnonzero(axis.friction.at_last_level)[0])
    over = f"since {arm.names[first]}" if first else "over all campaigns"
    words = (
        f"Friction of {axis.joint} {'rises' if per > 0 else 'falls'} steadily: {per:+.2g} %"
        f" {unit} (95 %: {low:+.2g} to {high:+.2g}), {total:+.0f} % {over}."
    )
    return [Finding("alarm", words, "Wear, lubricant that ages, or campaigns run ever warmer.")]


def _per(arm: ArmTrend, span: float) -> tuple[str, float]:
    """A unit of time in which the slope is a number that people can judge."""
    if not arm.dated:
        return "per campaign", 1.0
    if span < 14.0:
        return "per day", 1.0
    return ("per month", _MONTH) if span < 2.0 * _YEAR else ("per year", _YEAR)


# Payload


def payload_findings(payload: PayloadTrend, names: Sequence[str]) -> list[Finding]:
    """What was found of what an arm carries, campaign by campaign."""
    last = len(payload.changes) - 1
    found = []
    for k, change in enumerate(payload.changes):
        statement = payload.statements[k]
        level: Level = "alarm" if k == last else "past"
        if statement is not None:
            found.append(_statement_finding(names[k], statement, level))
        if change is None or not (payload.changed[k] or payload.other[k]):
            continue
        where = f"between {names[k - 1]} and {names[k]}"
        if payload.changed[k]:
            beside = "" if statement is None else ", beside what is stated,"
            words = f"The payload{beside} has changed {where}: {_what(change)}."
            step = "State the payload in the cell file, or check the tool and its fastening."
        else:
            words = (
                f"Inertial parameters have changed {where}, but not as by something put on the"
                f" last link: that explains {100.0 * change.share:.0f} % of the change."
            )
            step = "Check the torque constants and the calibration, and what links before it carry."
        found.append(Finding(level, words, step))
    return found


def _statement_finding(name: str, statement: Statement, level: Level) -> Finding:
    """A payload that a cell states is no discovery; whether the torques agree is."""
    words = (
        f"From {name} on the cell states {_load(statement.after)} instead of"
        f" {_load(statement.before)}; {_VERDICTS[statement.verdict]}."
    )
    if statement.verdict != "differs":
        return Finding("quiet", words)
    step = "Weigh the payload and measure its centre, then correct the cell file."
    return Finding(level, words, step)


def _load(payload: Payload | None) -> str:
    if payload is None or payload.mass == 0.0:
        return "nothing"
    return f"a payload of {payload.mass:g} kg"


def _what(change: Change) -> str:
    """Mass if it can be seen, and how far from the last joint it sits if that is known."""
    if not math.isfinite(change.mass):
        moment = float(np.linalg.norm(np.nan_to_num(change.moment)))
        return f"first moment by {moment:.2g} kg·m, while its mass cannot be seen by this arm"
    if abs(change.mass) < _CERTAIN * change.mass_std:
        return (
            f"its mass not significantly ({change.mass:+.2g} ± {change.mass_std:.1g} kg),"
            " but its centre or inertia"
        )
    verb = "put on" if change.mass > 0 else "removed"
    text = f"{abs(change.mass):.2f} ± {change.mass_std:.2g} kg {verb}"
    if np.isfinite(change.moment).all():
        centre = (round(float(c)) for c in change.moment / change.mass / _MILLIMETRE)
        text += f", centred at ({', '.join(map(str, centre))}) mm of the last joint"
    return text


# Nothing, and the order


def _nothing(arm: ArmTrend) -> Finding:
    count = len(arm.campaigns)
    if count < 2:
        return Finding("quiet", "There is one campaign, and nothing to compare it with.")
    carried = "No change of its payload was found."
    if arm.payload.untested:
        carried = f"Whether its payload is the same was not tested: {arm.payload.untested}."
    if count <= FEWEST:
        judged = f"Its axes are judged from the campaign on that has {FEWEST} before it"
        return Finding("quiet", f"{carried} {judged}; there are {count}.")
    words = "friction and torque error of every axis are within the limits of those before"
    return Finding("quiet", f"Nothing has departed in {count} campaigns: {words}. {carried}")


def _order_findings(arm: ArmTrend) -> list[Finding]:
    """What a reader must know of the order of campaigns."""
    if arm.undated:
        names = ", ".join(one.rstrip("/").rsplit("/", 1)[-1] for one in arm.undated[:_NAMED])
        more = len(arm.undated) - _NAMED
        words = (
            f"{plural(len(arm.undated), 'further campaign')} ({names}"
            f"{f' and {more} more' if more > 0 else ''}) without a time of recording:"
            " left out here, since nobody knows where they belong."
        )
        return [Finding("quiet", words)]
    if arm.dated or len(arm.campaigns) < 2:
        return []
    words = (
        "No campaign has a time of recording: they are used in the order of their folders'"
        f" names, from {arm.names[0]} to {arm.names[len(arm.campaigns) - 1]}."
        " If that is not the order of time, before and after mean nothing here."
    )
    return [Finding("quiet", words)]
