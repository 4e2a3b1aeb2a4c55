"""What the trends of an arm mean, in plain words: the first thing a reader sees."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final, Literal, get_args

import numpy as np

from hil.batch.chart import FEWEST
from hil.batch.payload_change import Change
from hil.batch.payload_trend import Statement
from hil.batch.trend import ArmTrend, AxisTrend, Watched
from identification.model.payload import Payload


@dataclass(frozen=True)
class Shift:
    """Campaigns in a row that are elsewhere than those before them.

    Attributes:
        kind: "departs": at no level known before; "returns": at one that was left before.
        first: number of the first of these campaigns.
        last: of the last.
        before: median of those before.
        value: median of these.
        settled: whether they made a level by which later ones are judged.
        lasts: whether no later campaign is elsewhere.
    """

    kind: Literal["departs", "returns"]
    first: int
    last: int
    before: float
    value: float
    settled: bool
    lasts: bool


def shifts(watched: Watched) -> list[Shift]:
    """All shifts of a figure, in order of time."""
    runs = _runs(watched)
    seen = {level for level, _ in runs[:1]}
    found = []
    for number, (level, own) in enumerate(runs[1:], start=1):
        fresh = level < 0 or level not in seen
        seen.add(level)
        band = watched.limits[own[0]]
        left = float(np.median(watched.values[runs[number - 1][1]]))
        found.append(
            Shift(
                kind="departs" if fresh else "returns",
                first=own[0],
                last=own[-1],
                before=band.centre if fresh and band is not None else left,
                value=float(np.median(watched.values[own])),
                settled=level >= 0,
                lasts=number == len(runs) - 1,
            )
        )
    return found


def _runs(watched: Watched) -> list[tuple[int, list[int]]]:
    """Known campaigns in a row at one level, or outside on one side, and the number of it."""

    def place(k: int) -> tuple[int, bool]:
        level, band = watched.levels[k], watched.limits[k]
        above = level < 0 and band is not None and watched.values[k] > band.centre
        return level, bool(above)

    known = [k for k, value in enumerate(watched.values) if np.isfinite(value)]
    return [(level, list(own)) for (level, _), own in groupby(known, place)]


Level = Literal["alarm", "past", "quiet"]
_ORDER: Final[tuple[Level, ...]] = get_args(Level)

_MONTH = 365.25 / 12.0
_YEAR = 365.25
_CERTAIN = 2.0
_MILLIMETRE = 1e-3
# Told one by one; what is more is counted.
_SHIFTS = 2
_NAMED = 5


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
    found = [*payload_findings(arm)]
    for axis in arm.axes:
        found += _axis_findings(arm, axis)
    if all(one.level == "quiet" for one in found):
        found.insert(0, _nothing(arm))
    found.sort(key=lambda one: _ORDER.index(one.level))
    return (*found, *_order_findings(arm))


def summary(arm: ArmTrend) -> str:
    """One line: what the last campaign says of the arm."""
    levels = [one.level for one in findings(arm)]
    alarms, past = levels.count("alarm"), levels.count("past")
    if alarms:
        return f"{alarms} {'thing' if alarms == 1 else 'things'} to look into"
    if len(arm.campaigns) < 2:
        return "one campaign, nothing to compare it with"
    if past:
        return f"no new change; {past} earlier {'one' if past == 1 else 'ones'}"
    if len(arm.campaigns) <= FEWEST:
        return "no change found, but too few campaigns to judge the axes"
    return "as before"


def campaign_name(arm: ArmTrend, k: int) -> str:
    """A campaign as the page calls it: the last part of its folder, and its day."""
    name = campaign_folder(arm, k)
    return f"{name} ({arm.when[k][:10]})" if arm.dated else name


def campaign_folder(arm: ArmTrend, k: int) -> str:
    """The last part of its folder, and what its cell states where a folder holds several."""
    name = short_names(arm.campaigns)[k] or f"campaign {k + 1}"
    if arm.campaigns.count(arm.campaigns[k]) == 1:
        return name
    return f"{name}, {arm.setups[k] or 'nothing stated'}"


def short_names(folders: Sequence[str]) -> list[str]:
    """The end of each folder's path that no other one of them ends with: mostly its last part."""
    paths = [folder.rstrip("/") for folder in folders]
    return [_short(path, [f"/{other}" for other in paths if other != path]) for path in paths]


def _short(path: str, others: Sequence[str]) -> str:
    parts = path.split("/")
    ends = ("/".join(parts[-count:]) for count in range(1, len(parts)))
    return next((end for end in ends if not any(o.endswith(f"/{end}") for o in others)), path)


def _last_part(folder: str) -> str:
    return folder.rstrip("/").rsplit("/", 1)[-1]


def _order_findings(arm: ArmTrend) -> list[Finding]:
    """What a reader must know of the order of campaigns."""
    if arm.undated:
        names = ", ".join(_last_part(one) for one in arm.undated[:_NAMED])
        more = len(arm.undated) - _NAMED
        return [
            Finding(
                "quiet",
                f"{len(arm.undated)} further {_campaigns(len(arm.undated))} ({names}"
                f"{f' and {more} more' if more > 0 else ''}) without a time of recording:"
                " left out here, since nobody knows where they belong.",
            )
        ]
    if arm.dated or len(arm.campaigns) < 2:
        return []
    return [
        Finding(
            "quiet",
            "No campaign has a time of recording: they are taken in the order of their folders'"
            f" names, from {campaign_name(arm, 0)} to {campaign_name(arm, len(arm.campaigns) - 1)}."
            " If that is not the order of time, before and after mean nothing here.",
        )
    ]


def _campaigns(count: int) -> str:
    return "campaign" if count == 1 else "campaigns"


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
    found = _shift_findings(arm, axis, axis.friction, _friction_words)
    found += _shift_findings(arm, axis, axis.error, _error_words)
    if axis.drifts:
        found.append(_drifts(arm, axis))
    return found


def _shift_findings(
    arm: ArmTrend,
    axis: AxisTrend,
    watched: Watched,
    words: Callable[[ArmTrend, AxisTrend, Shift], tuple[str, str]],
) -> list[Finding]:
    """The last shifts of a figure: each with its own sentence, and how many there were before."""
    every = shifts(watched)
    found = []
    for shift in every[-_SHIFTS:]:
        # What has risen stays a thing to look into until it returns, however long ago it was.
        alarming = shift.kind == "departs" and (shift.value > shift.before or not shift.settled)
        level: Level = "alarm" if shift.lasts and alarming else "past"
        found.append(Finding(level, *words(arm, axis, shift)))
    if len(every) > _SHIFTS:
        count = len(every) - _SHIFTS
        text = f"{axis.joint} had {count} earlier {'change' if count == 1 else 'changes'} of this"
        found.append(Finding("past", f"{text} kind: see the figures."))
    return found


def _friction_words(arm: ArmTrend, axis: AxisTrend, shift: Shift) -> tuple[str, str]:
    value, unit = shift.value, axis.unit
    change = _relative_change(value, shift.before)
    at = f" at {axis.speed:.2g} {axis.speed_unit}" if math.isfinite(axis.speed) else ""
    if shift.kind == "returns":
        return (
            f"{axis.joint} has returned to an earlier level of friction{at}: {value:.3g} after"
            f" {shift.before:.3g} {unit}{_when(arm, shift)}.",
            "Repaired, greased, or equally warm again?",
        )
    words = (
        f"{axis.joint} departs from its history: friction{at} is {100.0 * abs(change):.0f} %"
        f" {'above' if change > 0 else 'below'} what it was, {value:.3g} against"
        f" {shift.before:.3g} {unit}{_when(arm, shift)}.{_settled(shift)}"
    )
    if change > 0:
        step = "Check this axis' gear, brake and lubrication; was it colder than before?"
    else:
        step = "Was it warmer than before, or has gear or lubricant been changed?"
    return words, step


def _error_words(arm: ArmTrend, axis: AxisTrend, shift: Shift) -> tuple[str, str]:
    value, unit = shift.value, axis.unit
    if shift.kind == "returns":
        return (
            f"{axis.joint} has returned to an earlier level of torque error: {value:.3g} after"
            f" {shift.before:.3g} {unit}{_when(arm, shift)}.",
            "",
        )
    return (
        f"{axis.joint} departs from its history: the model leaves {value:.3g} {unit} of its"
        f" torque unexplained, {100.0 * _relative_change(value, shift.before):.0f} % more than"
        f" before ({shift.before:.3g} {unit}){_when(arm, shift)}.{_settled(shift)}",
        "Look at the residual of this axis in hil identify on that campaign: backlash, a rubbing"
        " hose or another motion make it.",
    )


def _settled(shift: Shift) -> str:
    if shift.settled and shift.lasts:
        return " It has stayed there: later campaigns are judged by this level."
    return ""


def _when(arm: ArmTrend, shift: Shift) -> str:
    """In which campaigns."""
    if shift.first == shift.last:
        return f" in {campaign_name(arm, shift.first)}"
    if shift.lasts:
        return f", since {campaign_name(arm, shift.first)}"
    return f", from {campaign_name(arm, shift.first)} to {campaign_name(arm, shift.last)}"


def _drifts(arm: ArmTrend, axis: AxisTrend) -> Finding:
    slope = axis.drift
    assert slope is not None
    size = abs(float(np.nanmedian(axis.friction.values))) or math.inf
    unit, scale = _per(arm, slope.span)
    per, low, high = (100.0 * one * scale / size for one in (slope.slope, slope.low, slope.high))
    total = 100.0 * slope.slope * slope.span / size
    first = int(np.flatnonzero(axis.friction.settled)[0])
    over = f"since {campaign_name(arm, first)}" if first else "over all campaigns"
    words = (
        f"Friction of {axis.joint} {'rises' if per > 0 else 'falls'} steadily: {per:+.2g} %"
        f" {unit} (95 %: {low:+.2g} to {high:+.2g}), {total:+.0f} % {over}."
    )
    return Finding("alarm", words, "Wear, lubricant that ages, or campaigns run ever warmer.")


def _per(arm: ArmTrend, span: float) -> tuple[str, float]:
    """A unit of time in which the slope is a number that people can judge."""
    if not arm.dated:
        return "per campaign", 1.0
    if span < 14.0:
        return "per day", 1.0
    return ("per month", _MONTH) if span < 2.0 * _YEAR else ("per year", _YEAR)


def payload_findings(arm: ArmTrend) -> list[Finding]:
    """What was found of what an arm carries, campaign by campaign."""
    payload = arm.payload
    found = []
    for k, change in enumerate(payload.changes):
        statement = payload.statements[k]
        if statement is not None:
            found.append(_statement_finding(arm, k, statement))
        if change is None or not (payload.changed[k] or payload.other[k]):
            continue
        level: Level = "alarm" if k == len(payload.changes) - 1 else "past"
        where = f"between {campaign_name(arm, k - 1)} and {campaign_name(arm, k)}"
        if payload.changed[k]:
            beside = "" if statement is None else ", beside what is stated,"
            words = f"What the arm carries{beside} has changed {where}: {_what(change)}."
            step = "State the payload in the cell file, or check the tool and its fastening."
        else:
            words = (
                f"Inertial parameters have changed {where}, but not as by something put on the"
                f" last link: that explains {100.0 * change.share:.0f} % of the change."
            )
            step = "Check the torque constants and the calibration, and what links before it carry."
        found.append(Finding(level, words, step))
    return found


def _statement_finding(arm: ArmTrend, k: int, statement: Statement) -> Finding:
    """A payload that a cell states is no discovery; whether the torques agree is."""
    told = (
        f"From {campaign_name(arm, k)} on the cell states {_load(statement.after)} instead of"
        f" {_load(statement.before)}"
    )
    match statement.verdict:
        case "agrees":
            return Finding("quiet", f"{told}; the torques agree.")
        case "statement only":
            return Finding(
                "quiet", f"{told}; by its torques it carries the same as before: only that is new."
            )
        case "either":
            return Finding(
                "quiet", f"{told}; whether it was carried before as well, the torques do not say."
            )
        case "differs":
            return Finding(
                "alarm" if k == len(arm.campaigns) - 1 else "past",
                f"{told}; the torques do not agree.",
                "Weigh the payload and measure its centre, then correct the cell file.",
            )
        case "untested":
            return Finding("quiet", f"{told}; whether the torques agree was not tested.")


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
