"""What became of an arm from campaign to campaign; the rules are in `docs/batch.md`.

A robust control chart of each figure of an axis: median and Qn (Rousseeuw and Croux 1993) with
limits by Student's t, for which Qn of n normal values has about 0.6 (n - 1) + 0.5 values, found by
simulation (n = 5 to 30, tail 1e-2 and 1e-3, on the safe side). Drift: Mann 1945, Sen 1968.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kendalltau, theilslopes
from scipy.stats import t as student

from hil.batch.types import BatchResult, LevelEstimate, Unused
from hil.reading import parse_time
from hil.terminal_text import plural
from identification import RobotModel

from .payload import Finding, Level, PayloadTrend, payload_findings, payload_trend

Array = NDArray[np.float64]

FEWEST: Final = 5
"""Earlier values without which nothing is judged, and values in a row that make a new level."""
FALSE_ALARMS: Final = 0.01
"""Share of campaigns of an unchanged arm in which any one of three rules finds a change: friction
of an axis, torque error of an axis, payload. Each has a third, shared equally among the axes.
The test for drift, which is made once for the whole history, has as much, shared likewise."""
LEAST_FRICTION: Final = 0.05
"""A change of friction by less than this share is not reported, however certain."""
LEAST_ERROR: Final = 0.10  #: The same of the torque error

_RULES: Final = 3
_DAY: Final = 86400.0
_QN_NORMAL: Final = 2.2219
# Speed [rad/s, m/s] where the data cannot say how fast an axis went: it has no viscous friction.
_ANY_SPEED: Final = 0.5
_SHIFTS: Final = 2  # of a figure that are described, the last ones
_NAMED: Final = 5


@dataclass(frozen=True, eq=False)
class Watched:
    """One figure over c campaigns, judged campaign by campaign."""

    values: Array  #: (c,); NaN where there is none
    stds: Array  #: (c,); zero where only the scatter of the history is known
    limits: Array  #: centre, low, high by the level that it belongs to, or was expected at (c, 3)
    #: which values belong to no level that was known then, by enough to matter
    departs: tuple[bool, ...]
    #: number of the level that a value belongs to, from 0; -1 for one that is not known, or
    #: departed and made no new level
    levels: tuple[int, ...]

    @property
    def at_last_level(self) -> NDArray[np.bool_]:
        """Campaigns at the level that was reached last (c,)."""
        known = [level for level in self.levels if level >= 0]
        return np.asarray(np.array(self.levels) == (known[-1] if known else 0))


class Drift(NamedTuple):
    """A slope per unit of time, and the ends of its 95 % interval."""

    slope: float
    low: float
    high: float
    p_value: float  #: of no drift, two-sided
    span: float  #: time from the first value to the last


@dataclass(frozen=True)
class Axis:
    """An axis, the unit of its friction, and the speed at which that is compared, NaN for any."""

    joint: str
    unit: str
    speed: float
    speed_unit: str

    @property
    def at(self) -> str:
        """The speed as the end of a phrase; "" if it does not matter."""
        return f" at {self.speed:.2g} {self.speed_unit}" if math.isfinite(self.speed) else ""


@dataclass(frozen=True, eq=False)
class AxisTrend(Axis):
    """An axis over the campaigns."""

    friction: Watched  #: mean of both directions
    error: Watched  #: standard deviation of what the model leaves of the torque
    #: of the friction at the level reached last [unit per day, or per campaign]; None if there are
    #: too few campaigns
    drift: Drift | None
    drifts: bool  #: whether that is more than chance, and enough to matter

    @property
    def relative_drift(self) -> Array:
        """Slope and the ends of its interval over the whole time, shares of the friction (3,)."""
        if self.drift is None:
            return np.full(3, np.nan)
        return np.array(self.drift[:3]) * self.drift.span / (_size(self.friction.values) or np.nan)


def _size(values: Array) -> float:
    """Median of what is known of values (c,), without its sign; 0 where nothing is."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.median(known)) if known.size else 0.0


@dataclass(frozen=True, eq=False)
class ArmTrend:
    """An arm over c campaigns."""

    name: str  #: of the arm
    campaigns: tuple[LevelEstimate, ...]  #: in order of time
    time: Array  #: (c,) [days since the first]; number of the campaign where no time is known
    dated: bool  #: whether times are known. If not, campaigns are in the order of their names.
    axes: tuple[AxisTrend, ...]
    payload: PayloadTrend
    names: tuple[str, ...]  #: of the campaigns, with their days if known
    #: folders of further campaigns, without a time, that are no part of the history
    undated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  #: what a reader must know of the archives


@dataclass(frozen=True, eq=False)
class Trends:
    """All arms of a batch by name, what was not used for it, and how many archives were fitted."""

    arms: tuple[ArmTrend, ...]
    broken: tuple[Unused, ...]
    estimator: str
    archives: int
    skipped: tuple[Unused, ...] = ()


def trends(result: BatchResult) -> Trends:
    """Find what changed on every arm of a batch."""
    found = []
    for digest, arm in sorted(result.arms.items(), key=lambda item: item[1].name):
        campaigns = [one for one in result.campaigns if one.arm == digest]
        if campaigns:
            own = [text for one in result.pooled if one.arm == digest for text in one.warnings]
            trend = arm_trend(arm.name, arm.cell.model, campaigns)
            found.append(replace(trend, warnings=tuple(dict.fromkeys(own))))
    return Trends(
        tuple(found), result.broken, result.estimator, len(result.repetitions), result.skipped
    )


def arm_trend(name: str, model: RobotModel, campaigns: Sequence[LevelEstimate]) -> ArmTrend:
    """Find what changed on one arm from campaign to campaign, in any order.

    Campaigns without a time of recording are left out if others have one, since nobody knows where
    they belong. If none has, all are used in the order of their folders' names.
    """
    known = [(at.timestamp(), one) for one in campaigns if (at := parse_time(one.when)) is not None]
    if known:
        known.sort(key=lambda pair: (pair[0], pair[1].campaign))
        ordered = [one for _, one in known]
        time = (np.array([at for at, _ in known]) - known[0][0]) / _DAY
    else:
        ordered = sorted(campaigns, key=lambda one: _natural(one.campaign))
        time = np.arange(1.0, len(ordered) + 1.0)
    within = {id(one) for one in ordered}
    return ArmTrend(
        name=name,
        campaigns=tuple(ordered),
        time=time,
        dated=bool(known),
        axes=_axes(model, ordered, time),
        payload=payload_trend(model, ordered, FALSE_ALARMS / _RULES),
        names=tuple(campaign_names(ordered, days=bool(known))),
        undated=tuple(one.campaign for one in campaigns if id(one) not in within),
    )


def _natural(name: str) -> list[tuple[int, str]]:
    """Names in the order that people count in: the ninth before the tenth."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)]


def campaign_names(campaigns: Sequence[LevelEstimate], *, days: bool = False) -> list[str]:
    """Campaigns as people call them: the last part of the folder, and if wanted the day.

    Where a folder holds several campaigns also what their cells state.
    """
    folders = [one.campaign for one in campaigns]
    names = []
    for k, name in enumerate(short_names(folders)):
        name = name or f"campaign {k + 1}"
        if folders.count(folders[k]) > 1:
            name += f", {campaigns[k].setup or 'nothing stated'}"
        names.append(f"{name} ({campaigns[k].when[:10]})" if days else name)
    return names


def short_names(folders: Sequence[str]) -> list[str]:
    """The end of each folder's path that no other one of them ends with: mostly its last part."""
    paths = [folder.rstrip("/") for folder in folders]

    def short(path: str) -> str:
        others, parts = [f"/{other}" for other in paths if other != path], path.split("/")
        ends = ("/".join(parts[-count:]) for count in range(1, len(parts)))
        return next((e for e in ends if not any(o.endswith(f"/{e}") for o in others)), path)

    return [short(path) for path in paths]


# Friction and torque error of the axes


def axes_of(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> list[Axis]:
    """All axes, each with one speed, the median of what the campaigns had."""
    speeds = [one.speed_rms for one in campaigns if one.speed_rms is not None]
    found = []
    for j, (joint, turns) in enumerate(zip(model.joint_names, model.chain.revolute, strict=True)):
        own = [row[j] for row in speeds if np.isfinite(row[j])]
        speed = float(np.median(own)) if own else math.nan
        found.append(Axis(joint, "N·m" if turns else "N", speed, "rad/s" if turns else "m/s"))
    return found


def friction_weights(model: RobotModel, axes: Sequence[Axis]) -> Array:
    """Weights G (n, p): ``G @ values`` is the friction of each axis at its speed [N·m, N].

    The mean of forwards and backwards, so that an offset and a difference by direction are no
    part of it. Where coupled motors have friction, that of the axis' own motor counts as well.
    """
    weights = np.zeros((model.n_joints, model.n_parameters))
    for k, term in enumerate(model.friction.terms):
        own = axes[term.owner].speed
        at = own if math.isfinite(own) and own > 0.0 else _ANY_SPEED
        forwards, backwards = term.term.column(np.array([at, -at]), np.array([1.0, -1.0]))
        weights[term.owner, model.base.rank + k] = 0.5 * (forwards - backwards)
    return weights


def friction_in(level: LevelEstimate, weights: Array) -> tuple[Array, Array]:
    """Friction of each axis by one estimate and its standard deviation, each (n,) [N·m, N].

    NaN for an axis without friction, or with a coefficient that the data do not determine.
    `weights` (n, p) are those of :func:`friction_weights`.
    """
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
        # At one level: a step is no drift.
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


def _error(values: Array, share: float) -> Watched:
    """A larger torque error is a fault, and a smaller one is none.

    In logarithms: residuals scatter by a share of their size.
    """
    with np.errstate(divide="ignore"):
        logarithm = np.where(values > 0.0, np.log(values), np.nan)
    least = float(np.log1p(LEAST_ERROR))
    judged = chart(logarithm, np.zeros(len(values)), share, least=least, rise_only=True)
    return replace(judged, values=values, limits=np.exp(judged.limits))


# The chart


def chart(
    values: Array, stds: Array, share: float, *, least: float = 0.0, rise_only: bool = False
) -> Watched:
    """Judge each value by those before it that did not depart themselves.

    Values that departed are no history for later ones, unless `FEWEST` of them in a row stay on one
    side: they are a new level, by which later ones are judged. A value that belongs to an earlier
    level has returned to it. Scatter is that about all levels.

    Values (n,) are in order of time, NaN where there is none, and came with standard deviations
    (n,). If nothing has changed `share` of them lie beyond the limits. A departure from the centre
    matters from `least` on; with `rise_only` only upwards.
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
        if len(away) == FEWEST:
            now = len(members)
            members.append(away)
            for one in away:
                levels[one] = now
            away = []
    if rise_only:
        found[:, 1] = np.where(np.isnan(found[:, 1]), np.nan, -np.inf)
    return Watched(values, stds, found, tuple(departs), tuple(levels))


def limits(
    values: Array, stds: Array, share: float, members: list[list[int]], level: int, std: float
) -> tuple[float, float, float]:
    """Centre, low and high of a value of this standard deviation if it belonged to a level.

    NaN with fewer than `FEWEST` values there. `values` (n,) have standard deviations `stds` (n,),
    zero where unknown, and scatter alike on all levels; `members` are the places of those of each.
    """
    own, every = members[level], np.concatenate(members).astype(np.intp)
    if len(own) < FEWEST:
        return math.nan, math.nan, math.nan
    centre = float(np.median(values[own]))
    residuals = np.concatenate([values[one] - np.median(values[one]) for one in members])
    # Each level has subtracted its own median from its residuals.
    spare = len(every) - len(members)
    scatter = qn_scale(residuals) * math.sqrt((len(every) - 1) / spare)
    typical = float(np.median(stds[every]))
    # Few values may lie close together by chance, but not closer than each is known.
    scale = max(scatter, typical)
    # A campaign of fewer repetitions than usual is known less well than the history scatters.
    one = scale**2 + max(0.0, std**2 - typical**2)
    spread = math.sqrt(one + scale**2 * math.pi / (2.0 * len(own)))
    reach = float(student.isf(share / 2.0, 0.6 * spare - 0.5)) * spread
    return centre, centre - reach, centre + reach


def qn_scale(values: Array) -> float:
    """Qn, a robust standard deviation: a low quantile of all distances between two values.

    Half of the values (n,) may be anything.
    """
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
    """Slope of values (n,) in time (n,), None for fewer than `FEWEST` or one instant."""
    known = np.isfinite(values)
    at, own = time[known], values[known]
    if len(own) < FEWEST or np.ptp(at) == 0.0 or np.ptp(own) == 0.0:
        return None
    slope, _, low, high = theilslopes(own, at, 0.95)
    p_value = float(kendalltau(at, own).pvalue)
    return Drift(float(slope), float(low), float(high), p_value, float(np.ptp(at)))


# What it means, in sentences


def findings(arm: ArmTrend) -> tuple[Finding, ...]:
    """What was found of an arm, what concerns its last campaign first; never empty."""
    found = payload_findings(arm.payload, arm.names)
    for axis in arm.axes:
        for what, watched in (("friction", axis.friction), ("torque error", axis.error)):
            found += [_shift(arm, axis, what, one) for one in shifts(watched)[-_SHIFTS:]]
        if axis.drifts:
            slope, low, high = 100.0 * axis.relative_drift
            since = arm.names[int(np.flatnonzero(axis.friction.at_last_level)[0])]
            words = (
                f"Friction of {axis.joint} {'rises' if slope > 0 else 'falls'} steadily:"
                f" {slope:+.0f} % since {since} (95 %: {low:+.0f} to {high:+.0f})."
            )
            step = "Wear, lubricant that ages, or campaigns run ever warmer."
            found.append(Finding("alarm", words, step))
    if all(one.level == "quiet" for one in found):
        found.insert(0, Finding("quiet", _nothing(arm)))
    order: list[Level] = ["alarm", "past", "quiet"]
    return (*sorted(found, key=lambda one: order.index(one.level)), *_order_findings(arm))


def summary(arm: ArmTrend) -> str:
    """One line: what the last campaign shows of the arm."""
    levels, count = [one.level for one in findings(arm)], len(arm.campaigns)
    alarms, past = levels.count("alarm"), levels.count("past")
    if alarms:
        return f"{plural(alarms, 'thing')} to look into"
    if count < 2:
        return "one campaign, nothing to compare it with"
    if past:
        return f"no new change; {plural(past, 'earlier change')}"
    few = "no change found, but too few campaigns to judge the axes"
    return "as before" if count > FEWEST else few


class Shift(NamedTuple):
    """Campaigns in a row, from number `first` to `last`, that are elsewhere than those before."""

    returns: bool  #: whether at a level that was left before
    first: int
    last: int
    #: medians of those before, and of these
    before: float
    value: float
    lasts: bool  #: whether no later campaign is elsewhere
    #: whether that is a thing to look into: what has risen, however long ago, stays one until it
    #: returns; what has fallen, until that is a level
    alarming: bool


def shifts(watched: Watched) -> list[Shift]:
    """All shifts of a figure, in order of time."""
    values, centres = watched.values, watched.limits[:, 0]

    def place(k: int) -> tuple[int, bool]:
        """The level of a campaign, and if it has none its side of the history."""
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
    ("friction", "above"): "Check this axis' gear, brake and lubrication; was it colder than"
    " before?",
    ("friction", "below"): "Was it warmer than before, or has gear or lubricant been changed?",
    ("friction", "returned"): "Repaired, greased, or equally warm again?",
    ("torque error", "above"): "Look at the residual of this axis in hil identify on that campaign:"
    " backlash, a rubbing hose or another motion make it.",
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
        f" {100.0 * change:.0f} % {side} what it was, {shift.value:.3g} against"
        f" {shift.before:.3g} {axis.unit}, {when}."
    )
    step = _STEPS.get((what, "returned" if shift.returns else side), "")
    return Finding("alarm" if shift.alarming else "past", words, step)


def _nothing(arm: ArmTrend) -> str:
    count, untested = len(arm.campaigns), arm.payload.untested
    if count < 2:
        return "There is one campaign, and nothing to compare it with."
    payload = f"Its payload was not tested: {untested}." if untested else "Its payload is the same."
    axes = "Friction and torque error of every axis are within the limits of those before"
    if count <= FEWEST:
        axes = f"Its axes are judged from the campaign on that has {FEWEST} before it"
    return f"No change was found in {count} campaigns. {payload} {axes}."


def _order_findings(arm: ArmTrend) -> list[Finding]:
    """What a reader must know of the order of campaigns."""
    if arm.undated:
        names = [one.rstrip("/").rsplit("/", 1)[-1] for one in arm.undated]
        names[_NAMED:] = [f"{len(names) - _NAMED} more"] if len(names) > _NAMED else []
        words = (
            f"{plural(len(arm.undated), 'further campaign')} ({', '.join(names)}) without a time of"
            " recording: left out here, since nobody knows where they belong."
        )
    elif arm.dated or len(arm.campaigns) < 2:
        return []
    else:
        words = (
            "No campaign has a time of recording: they are used in the order of their folders'"
            f" names, from {arm.names[0]} to {arm.names[-1]}."
            " If that is not the order of time, before and after mean nothing here."
        )
    return [Finding("quiet", words)]
