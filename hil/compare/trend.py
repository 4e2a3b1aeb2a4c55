"""Trends of an arm over campaigns; see `docs/batch.md`.

Robust control charts: median and Qn (Rousseeuw and Croux 1993) with limits by Student's t. Qn of n
normal values has about 0.6 (n - 1) + 0.5 degrees of freedom, by simulation (n = 5 to 30, tails 1e-2
and 1e-3, conservative). Drift: Mann 1945, Sen 1968.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, takewhile
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kendalltau, theilslopes
from scipy.stats import t as student

from hil.batch.types import BatchResult, LevelEstimate
from hil.reading import parse_time
from hil.terminal_text import plural
from identification import RobotModel

from .payload import Finding, Level, PayloadTrend, payload_findings, payload_trend

Array = NDArray[np.float64]

MIN_CAMPAIGNS: Final = 5
"""Number of earlier values needed for a test, and of successive values that form a new level."""
FALSE_ALARMS: Final = 0.01
"""False alarms per campaign of an unchanged arm, shared equally by three rules (friction, torque
error, payload) and the axes; also of the test for drift over the whole history."""
LEAST_FRICTION: Final = 0.05
"""Smallest relevant relative change of friction."""
LEAST_ERROR: Final = 0.10  #: Smallest relevant relative change of the torque error

_RULES: Final = 3
_DAY: Final = 86400.0
_QN_NORMAL: Final = 2.2219
# rad/s or m/s, if the speed of an axis is unknown: any will do, as it has no viscous friction then.
_ANY_SPEED: Final = 0.5
_MAX_SHIFTS: Final = 2  # most recent shifts that are reported


@dataclass(frozen=True, eq=False)
class ControlChart:
    """Control chart of one quantity over c campaigns."""

    values: Array  #: (c,); NaN if unknown
    stds: Array  #: (c,); zero if unknown
    limits: Array  #: centre, lower and upper limit (c, 3)
    departs: tuple[bool, ...]  #: whether a value is outside the limits of all levels known then
    levels: tuple[int, ...]  #: number of its level, from 0; -1 for none

    @property
    def at_last_level(self) -> NDArray[np.bool_]:
        """Campaigns at the latest level (c,)."""
        known = [level for level in self.levels if level >= 0]
        return np.asarray(np.array(self.levels) == (known[-1] if known else 0))


class Drift(NamedTuple):
    """A slope per unit of time with its 95 % interval."""

    slope: float
    low: float
    high: float
    p_value: float  #: of no drift, two-sided
    span: float  #: time from the first value to the last


@dataclass(frozen=True)
class Axis:
    """An axis and the speed at which its friction is compared."""

    joint: str
    unit: str  #: of friction
    speed: float  #: NaN if irrelevant
    speed_unit: str

    @property
    def at(self) -> str:
        """Phrase " at <speed>", or an empty string."""
        return f" at {self.speed:.2g} {self.speed_unit}" if math.isfinite(self.speed) else ""


@dataclass(frozen=True, eq=False)
class AxisTrend(Axis):
    """Trend of an axis."""

    friction: ControlChart  #: mean of both directions
    error: ControlChart  #: standard deviation of the torque residual
    #: of the friction at its latest level [unit per day, or per campaign]; None with too few values
    drift: Drift | None
    drifts: bool  #: whether the drift is significant and relevant

    @property
    def relative_drift(self) -> Array:
        """Relative change over the whole time with its interval (3,)."""
        if self.drift is None:
            return np.full(3, np.nan)
        return np.array(self.drift[:3]) * self.drift.span / (_size(self.friction.values) or np.nan)


def _size(values: Array) -> float:
    """Return the median of the finite absolute values (c,), 0 if there are none."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.median(known)) if known.size else 0.0


@dataclass(frozen=True, eq=False)
class ArmTrend:
    """Trends of an arm over c campaigns."""

    name: str  #: of the arm
    campaigns: tuple[LevelEstimate, ...]  #: in chronological order
    time: Array  #: (c,) [days since the first]; number of the campaign if times are unknown
    dated: bool  #: whether times are known; otherwise campaigns are in the order of their names
    axes: tuple[AxisTrend, ...]
    payload: PayloadTrend
    names: tuple[str, ...]  #: of the campaigns, with their days if known
    undated: tuple[str, ...] = ()  #: folders without a time, not part of the trend
    warnings: tuple[str, ...] = ()  #: about the archives


def trends(result: BatchResult) -> list[ArmTrend]:
    """Compute the trends of every arm of a batch that has a campaign, by name."""
    found = []
    for digest, arm in sorted(result.arms.items(), key=lambda item: item[1].name):
        campaigns = [one for one in result.campaigns if one.arm == digest]
        warnings = [text for one in result.pooled if one.arm == digest for text in one.warnings]
        if campaigns:
            found.append(arm_trend(arm.name, arm.cell.model, campaigns, warnings))
    return found


def arm_trend(
    name: str,
    model: RobotModel,
    campaigns: Sequence[LevelEstimate],
    warnings: Sequence[str] = (),
) -> ArmTrend:
    """Compute the trends of one arm; campaigns without a recording time only if all lack it."""
    known = [(at.timestamp(), one) for one in campaigns if (at := parse_time(one.when)) is not None]
    if known:
        known.sort(key=lambda pair: (pair[0], pair[1].campaign))
        ordered = [one for _, one in known]
        time = (np.array([at for at, _ in known]) - known[0][0]) / _DAY
        undated = [one.campaign for one in campaigns if parse_time(one.when) is None]
    else:
        ordered, undated = sorted(campaigns, key=lambda one: _natural(one.campaign)), []
        time = np.arange(1.0, len(ordered) + 1.0)
    return ArmTrend(
        name=name,
        campaigns=tuple(ordered),
        time=time,
        dated=bool(known),
        axes=_axes(model, ordered, time),
        payload=payload_trend(model, ordered, FALSE_ALARMS / _RULES),
        names=tuple(campaign_names(ordered)),
        undated=tuple(undated),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that orders embedded numbers by value."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)]


def campaign_names(campaigns: Sequence[LevelEstimate]) -> list[str]:
    """Return names of campaigns: folder below the common one, setup if ambiguous, and day."""
    folders = [one.campaign for one in campaigns]
    names = []
    for one, name in zip(campaigns, short_names(folders), strict=True):
        setup = f", {one.setup or 'nothing stated'}" if folders.count(one.campaign) > 1 else ""
        day = f" ({one.when[:10]})" if one.when else ""
        names.append(f"{name}{setup}{day}")
    return names


def short_names(folders: Sequence[str]) -> list[str]:
    """Return each folder without the parents that all of them have in common."""
    parts = [folder.split("/") for folder in folders]
    parents = zip(*(one[:-1] for one in parts), strict=False)
    shared = len(list(takewhile(lambda names: len(set(names)) == 1, parents)))
    return ["/".join(one[shared:]) for one in parts]


# Friction and torque error of the axes


def axes_of(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> list[Axis]:
    """Return the axes with the median of their rms speeds."""
    speeds = [one.speed_rms for one in campaigns if one.speed_rms is not None]
    found = []
    for j, (joint, turns) in enumerate(zip(model.joint_names, model.chain.revolute, strict=True)):
        own = [row[j] for row in speeds if np.isfinite(row[j])]
        speed = float(np.median(own)) if own else math.nan
        found.append(Axis(joint, "N·m" if turns else "N", speed, "rad/s" if turns else "m/s"))
    return found


def friction_weights(model: RobotModel, axes: Sequence[Axis]) -> Array:
    """Return G (n, p): ``G @ values`` is the friction of each axis, mean of directions [N·m, N].

    Friction of the axis' own motor is included.
    """
    weights = np.zeros((model.n_joints, model.n_parameters))
    for k, term in enumerate(model.friction.terms):
        own = axes[term.owner].speed
        at = own if math.isfinite(own) and own > 0.0 else _ANY_SPEED
        forwards, backwards = term.term.column(np.array([at, -at]), np.array([1.0, -1.0]))
        weights[term.owner, model.base.rank + k] = 0.5 * (forwards - backwards)
    return weights


def friction_in(level: LevelEstimate, weights: Array) -> tuple[Array, Array]:
    """Return friction and its standard deviation of each axis, (n,) each [N·m, N]; may be NaN."""
    covariance = np.diag(level.std**2) if level.covariance is None else level.covariance
    known = np.isfinite(np.diag(covariance))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    variance = np.einsum("ji,ik,jk->j", weights, finite, weights)
    whole = weights.any(axis=1) & ~weights[:, ~known].any(axis=1)
    value = np.where(whole, weights @ level.values, np.nan)
    return value, np.where(whole, np.sqrt(np.maximum(variance, 0.0)), np.nan)


def _axes(
    model: RobotModel, campaigns: Sequence[LevelEstimate], time: Array
) -> tuple[AxisTrend, ...]:
    axes = axes_of(model, campaigns)
    weights = friction_weights(model, axes)
    friction, stds = np.array([friction_in(one, weights) for one in campaigns]).swapaxes(0, 1)
    error = np.array([one.noise_std for one in campaigns])
    share = FALSE_ALARMS / _RULES / model.n_joints
    found = []
    for j, axis in enumerate(axes):
        least = LEAST_FRICTION * _size(friction[:, j])
        watched = chart(friction[:, j], stds[:, j], share, least=least)
        # Only at the latest level: a step is not a drift.
        slope = drift(time, np.where(watched.at_last_level, watched.values, np.nan))
        certain = slope is not None and slope.p_value < FALSE_ALARMS / model.n_joints
        found.append(
            AxisTrend(
                **vars(axis),
                friction=watched,
                error=_error(error[:, j], share),
                drift=slope,
                drifts=slope is not None and certain and abs(slope.slope) * slope.span >= least,
            )
        )
    return tuple(found)


def _error(values: Array, share: float) -> ControlChart:
    """Return the one-sided chart of the logarithm, as residuals scatter in proportion to size."""
    with np.errstate(divide="ignore"):
        logarithm = np.where(values > 0.0, np.log(values), np.nan)
    least = float(np.log1p(LEAST_ERROR))
    judged = chart(logarithm, np.zeros(len(values)), share, least=least, rise_only=True)
    return replace(judged, values=values, limits=np.exp(judged.limits))


# The chart


def chart(
    values: Array, stds: Array, share: float, *, least: float = 0.0, rise_only: bool = False
) -> ControlChart:
    """Compute the control chart of a quantity.

    Each value is compared with the earlier values that did not depart. `MIN_CAMPAIGNS` successive
    departures to one side form a new level; a value may return to an earlier level. The scatter is
    that around all levels.

    Args:
        values: (n,) in chronological order, NaN if unknown.
        stds: (n,) standard deviations, zero if unknown.
        share: of values outside the limits if nothing changes.
        least: smallest relevant departure from the centre.
        rise_only: whether only a rise is a departure.
    """
    share = 2.0 * share if rise_only else share
    members, now, away = [list[int]()], 0, list[int]()
    found = np.full((len(values), 3), np.nan)
    departs, levels = [False] * len(values), [-1] * len(values)
    for k, value in enumerate(values):
        bands = [limits(values, stds, share, members, one, stds[k]) for one in range(len(members))]
        expected, home = bands[now], None
        found[k] = expected
        if not math.isfinite(value):
            continue
        for level in (now, *reversed(range(len(members)))):
            centre, low, high = bands[level]
            outside = value < low or value > high  # and of unknown limits never
            if not outside or abs(value - centre) < least:
                home = level
                break
        if home is None and rise_only and value < np.median(values[members[now]]):
            home = now
        if home is not None:
            now, levels[k], away, found[k] = home, home, [], bands[home]
            members[home].append(k)
            continue
        departs[k] = True
        if away and (value > expected[0]) != (values[away[-1]] > expected[0]):
            away = []
        away.append(k)
        if len(away) == MIN_CAMPAIGNS:
            now = len(members)
            members.append(away)
            for one in away:
                levels[one] = now
            away = []
    if rise_only:
        found[:, 1] = np.where(np.isnan(found[:, 1]), np.nan, -np.inf)
    return ControlChart(values, stds, found, tuple(departs), tuple(levels))


def limits(
    values: Array, stds: Array, share: float, members: list[list[int]], level: int, std: float
) -> tuple[float, float, float]:
    """Return centre, lower and upper limit of a level for a value of standard deviation `std`.

    NaN with fewer than `MIN_CAMPAIGNS` values; `members` are the indices of the values (n,) of each
    level, whose scatter is common.
    """
    own, every = members[level], np.concatenate(members).astype(np.intp)
    if len(own) < MIN_CAMPAIGNS:
        return math.nan, math.nan, math.nan
    centre = float(np.median(values[own]))
    residuals = np.concatenate([values[one] - np.median(values[one]) for one in members])
    # The median of each level takes one degree of freedom.
    spare = len(every) - len(members)
    scatter = qn_scale(residuals) * math.sqrt((len(every) - 1) / spare)
    typical = float(np.median(stds[every]))
    # The scatter of few values may be small by chance, but not below their own uncertainty.
    scale = max(scatter, typical)
    # A campaign with fewer repetitions has a larger uncertainty than the others.
    one = scale**2 + max(0.0, std**2 - typical**2)
    spread = math.sqrt(one + scale**2 * math.pi / (2.0 * len(own)))
    reach = float(student.isf(share / 2.0, 0.6 * spare - 0.5)) * spread
    return centre, centre - reach, centre + reach


def qn_scale(values: Array) -> float:
    """Return Qn of values (n,), a robust standard deviation with a breakdown point of 50 %."""
    n = len(values)
    if n < 2:
        return 0.0
    first, second = np.triu_indices(n, 1)
    half = n // 2 + 1
    place = half * (half - 1) // 2 - 1
    distance = np.partition(np.abs(values[first] - values[second]), place)[place]
    correction = n / (n + (1.4 if n % 2 else 3.8))
    return float(_QN_NORMAL * correction * distance)


def drift(time: Array, values: Array) -> Drift | None:
    """Return the drift of values (n,) over time (n,), None with fewer than `MIN_CAMPAIGNS`."""
    known = np.isfinite(values)
    at, own = time[known], values[known]
    if len(own) < MIN_CAMPAIGNS or np.ptp(at) == 0.0 or np.ptp(own) == 0.0:
        return None
    slope, _, low, high = theilslopes(own, at, 0.95)
    p_value = float(kendalltau(at, own).pvalue)
    return Drift(float(slope), float(low), float(high), p_value, float(np.ptp(at)))


# Findings


def findings(arm: ArmTrend) -> tuple[Finding, ...]:
    """Return the findings about an arm, those about its last campaign first; never empty."""
    found = payload_findings(arm.payload, arm.names)
    for axis in arm.axes:
        for what, watched in (("friction", axis.friction), ("torque error", axis.error)):
            found += [_shift(arm, axis, what, one) for one in shifts(watched)[-_MAX_SHIFTS:]]
        if axis.drifts:
            slope, low, high = 100.0 * axis.relative_drift
            since = arm.names[int(np.flatnonzero(axis.friction.at_last_level)[0])]
            words = (
                f"Friction of {axis.joint} {'rises' if slope > 0 else 'falls'} steadily:"
                f" {slope:+.0f} % since {since} (95 %: {low:+.0f} to {high:+.0f})."
            )
            step = "Check for wear, aged lubricant and rising temperature of the campaigns."
            found.append(Finding("alarm", words, step))
    if all(one.level == "quiet" for one in found):
        found.insert(0, Finding("quiet", _nothing(arm)))
    order: list[Level] = ["alarm", "past", "quiet"]
    return (*sorted(found, key=lambda one: order.index(one.level)), *_order_findings(arm))


def summary(arm: ArmTrend) -> str:
    """Return the state of the arm in one line."""
    levels = [one.level for one in findings(arm)]
    now, past = plural(levels.count("alarm"), "change"), levels.count("past")
    return f"{now}, {past} earlier, in {plural(len(arm.campaigns), 'campaign')}"


class Shift(NamedTuple):
    """Successive campaigns at another level than those before."""

    returns: bool  #: whether to an earlier level
    first: int  #: number of the first campaign
    last: int
    before: float  #: median of the earlier level
    value: float  #: median of these campaigns
    lasts: bool  #: whether it includes the last campaign
    alarming: bool  #: whether it lasts, and is a rise or not yet a level


def shifts(watched: ControlChart) -> list[Shift]:
    """Return all shifts in chronological order."""
    values, centres = watched.values, watched.limits[:, 0]

    def place(k: int) -> tuple[int, bool]:
        """Return the level of a campaign, and without one whether it is above the centre."""
        level = watched.levels[k]
        return level, level < 0 and bool(values[k] > centres[k])

    known = np.flatnonzero(np.isfinite(values)).tolist()
    runs = [(level, list(own)) for (level, _), own in groupby(known, place)]
    found = []
    for number, (level, own) in enumerate(runs[1:], start=1):
        returns = level >= 0 and level in {earlier for earlier, _ in runs[:number]}
        before, value = centres[own[0]], float(np.median(values[own]))
        if returns or not np.isfinite(before):
            before = np.median(values[runs[number - 1][1]])
        lasts = number == len(runs) - 1
        alarming = lasts and not returns and (value > before or level < 0)
        found.append(Shift(returns, own[0], own[-1], float(before), value, lasts, alarming))
    return found


_STEPS: Final = {
    ("friction", "above"): "Check gear, brake and lubrication of this axis, and whether it was"
    " colder.",
    ("friction", "below"): "Check whether it was warmer, or gear or lubricant were changed.",
    ("friction", "returned"): "Check whether it was repaired, greased or at the earlier"
    " temperature.",
    ("torque error", "above"): "See the residual of this axis in hil identify of that campaign:"
    " backlash, a hose or another motion.",
}


def _shift(arm: ArmTrend, axis: AxisTrend, what: str, shift: Shift) -> Finding:
    first, last = arm.names[shift.first], arm.names[shift.last]
    when = f"since {first}" if shift.lasts else f"from {first} to {last}"
    when = f"in {first}" if shift.first == shift.last else when
    change = abs(shift.value - shift.before) / (abs(shift.before) or math.inf)
    side = "above" if shift.value > shift.before else "below"
    how = "has returned to an earlier level" if shift.returns else "departs from its history"
    words = (
        f"{axis.joint} {how}: {what}{axis.at if what == 'friction' else ''} is"
        f" {100.0 * change:.0f} % {side} the earlier level, {shift.value:.3g} against"
        f" {shift.before:.3g} {axis.unit}, {when}."
    )
    step = _STEPS.get((what, "returned" if shift.returns else side), "")
    return Finding("alarm" if shift.alarming else "past", words, step)


def _nothing(arm: ArmTrend) -> str:
    untested = arm.payload.untested
    payload = f"Payload not tested: {untested}." if untested else "The payload has not changed."
    axes = "Friction and torque error of all axes are within the limits of the earlier campaigns"
    if len(arm.campaigns) <= MIN_CAMPAIGNS:
        axes = f"Axes are tested in campaigns with at least {MIN_CAMPAIGNS} earlier ones"
    return f"{payload} {axes}."


def _order_findings(arm: ArmTrend) -> list[Finding]:
    if arm.undated:
        words = f"Without recording time, not part of the trend: {', '.join(arm.undated)}."
    elif arm.dated or len(arm.campaigns) < 2:
        return []
    else:
        words = (
            "No campaign has a recording time: the order is that of their folders' names, from"
            f" {arm.names[0]} to {arm.names[-1]}. If that is not chronological, the trends are"
            " meaningless."
        )
    return [Finding("quiet", words)]
