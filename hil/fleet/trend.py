"""Which robot of a fleet changes: in which joint, how fast, since when, and whether by heat.

The series of robots of one type are modelled together (:mod:`hil.fleet.series_changes`). p values
are adjusted for all robots, joints and quantities (Holm 1979).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Final, Literal, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.batch.cluster import SkippedArchive
from hil.compare.comparison import FALSE_ALARM_RATE, MIN_RELATIVE_CHANGE, holm
from hil.fleet.covariates import warmed
from hil.fleet.quantities import CAUSES, FollowedQuantity, QuantityName
from hil.fleet.series import (
    MONTH,
    DatedRecording,
    QuantityFamily,
    RelativeSeries,
    TypeSeries,
)
from hil.fleet.series_changes import MIN_SIBLINGS, Course, common_course, courses, scattered
from hil.fleet.trend_limits import TrendLimit
from hil.pipeline.notes import Note

_FORECAST_MONTHS: Final = 240.0  # months within which a limit is foreseen
_SEASON: Final = ("cosine of a year", "sine of a year")


@dataclass(frozen=True)
class LimitReached:
    """When a limit is reached: dates in ISO 8601, None for none within twenty years."""

    limit: TrendLimit
    date: str | None
    earliest: str | None
    latest: str | None


@dataclass(frozen=True)
class DatedChange:
    """One change of a quantity: a step, or a slope that begins.

    Attributes:
        kind: which of the two.
        begin, earliest, latest: dates, ISO 8601, of the begin and the ends of its 95 % interval.
        size: of the step, or of the slope a month, as a share of the first months.
    """

    kind: Literal["step", "slope"]
    begin: str
    earliest: str
    latest: str
    size: float


@dataclass(frozen=True, eq=False)
class QuantityTrend:
    """One quantity of a joint of a robot over time; shares are of its first months.

    Attributes:
        robot: its name.
        joint: its name.
        quantity: what it is.
        unit: of the values.
        speed: of friction [rad/s or m/s], None of others.
        reference: mean of the first months.
        dates: of the recordings, ISO 8601.
        values: of the recordings, in the unit (m,).
        stds: of the values, by the recordings alone (m,).
        adjusted: values without what temperature and season explain, as a share of change (m,).
        fitted: by the model, likewise (m,).
        changes: significant ones in order of time.
        change, half: at the end from before all changes, and half of its 95 % interval.
        rate, rate_half: a month, at the end, likewise.
        p_value: of no change, adjusted for all robots, joints and quantities.
        changed: whether the change is significant and at least 5 %.
        explained: whether it would be without temperature and season, and is not with them.
        effects: share of change by one unit of each covariate, by name; of a time since the start
            by the whole warm-up, of the reference error by a unit away from the first months.
        limits: when those that were stated are reached.
    """

    robot: str
    joint: str
    quantity: QuantityName
    unit: str
    speed: float | None
    reference: float
    dates: tuple[str, ...]
    values: Array
    stds: Array
    adjusted: Array
    fitted: Array
    changes: tuple[DatedChange, ...]
    change: float
    half: float
    rate: float
    rate_half: float
    p_value: float
    changed: bool
    explained: bool
    effects: Mapping[str, float]
    limits: tuple[LimitReached, ...]

    @property
    def concern(self) -> tuple[bool, bool, float, float]:
        """Sort key, the greatest concern first."""
        largest = float(np.max(np.abs(self.fitted), initial=0.0))
        return (not self.changed, not self.explained, -largest, self.p_value)


@dataclass(frozen=True, eq=False)
class RobotTrend:
    """All quantities of a robot, the greatest concern first; or of all robots of a type together.

    Attributes:
        robot: its name.
        kind: digest of its type, "" if unknown.
        recordings: in order of time.
        trends: of its quantities.
    """

    robot: str
    kind: str
    recordings: tuple[DatedRecording, ...]
    trends: tuple[QuantityTrend, ...]

    @property
    def main(self) -> QuantityTrend | None:
        """The quantity of greatest concern; None if no series is long enough.

        Of several that have changed one that says the cause, before its parts and the error.
        """
        if not self.trends:
            return None
        first = self.trends[0].concern[:2]
        alike = [trend for trend in self.trends if trend.concern[:2] == first]
        return min(
            alike, key=lambda trend: (CAUSES.get(trend.quantity, len(CAUSES)), trend.concern)
        )

    @property
    def changed(self) -> bool:
        """Whether any quantity has changed."""
        return any(trend.changed for trend in self.trends)


@dataclass(frozen=True, eq=False)
class FleetSources:
    """What is known about the recordings of a fleet, apart from their numbers.

    Attributes:
        dated_by_file: recordings that have only the date of their file.
        twice: places of names that are in several at the same time, maybe of several robots.
        simulated: whether no robot moved.
        broken, skipped: what could not be used, and what is not for it.
        warnings: about recordings that were used.
    """

    dated_by_file: int = 0
    twice: Mapping[str, Sequence[str]] = field(default_factory=dict)
    simulated: bool = False
    broken: tuple[SkippedArchive, ...] = ()
    skipped: tuple[SkippedArchive, ...] = ()
    warnings: tuple[Note, ...] = ()


@dataclass(frozen=True, eq=False)
class FleetTrend:
    """The robots of a fleet, the greatest concern first.

    Attributes:
        robots: each by itself.
        together: all robots of a type, of each type that has enough of them for a year.
        covariates: names of temperatures and other columns that were used.
        seasonal: whether the robots are enough to show what moves all of them at once.
        unknown: requested covariates that no recording has.
        sources: the recordings.
    """

    robots: tuple[RobotTrend, ...]
    together: tuple[RobotTrend, ...]
    covariates: tuple[str, ...]
    seasonal: bool
    unknown: tuple[str, ...]
    sources: FleetSources

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return sum(len(robot.recordings) for robot in self.robots)

    @property
    def changed(self) -> tuple[RobotTrend, ...]:
        """Robots that have changed, after all robots of a type if these have together."""
        return tuple(robot for robot in (*self.together, *self.robots) if robot.changed)


def fleet_trend(
    types: Sequence[TypeSeries],
    sources: FleetSources = FleetSources(),
    *,
    limits: Sequence[TrendLimit] = (),
    covariates: Sequence[str] = (),
) -> FleetTrend:
    """Find what changes over time in the series of robots, each type separately.

    Args:
        types: their series.
        sources: of the series.
        limits: of which the dates are foreseen.
        covariates: names of numbers that may explain a change, in addition to those that most
            recordings have.
    """
    found = [
        (number, each)
        for number, series in enumerate(types)
        for family in series.families
        for each in _family_trends(series, family, limits, covariates)
    ]
    judged = _judged([each for _, each in found])
    by_type: list[list[QuantityTrend]] = [[] for _ in types]
    for (number, _), trend in zip(found, judged, strict=True):
        by_type[number].append(trend)
    robots = [
        _robot_trend(robot, series.digest, recordings, trends)
        for series, trends in zip(types, by_type, strict=True)
        for robot, recordings in series.recordings.items()
    ]
    together = [
        _robot_trend("", series.digest, (), trends)
        for series, trends in zip(types, by_type, strict=True)
    ]
    names = {name for trend in judged if trend.robot for name in trend.effects}
    known = {name for series in types for name in series.known}
    return FleetTrend(
        robots=_ranked(robots),
        together=_ranked([each for each in together if each.trends]),
        covariates=tuple(sorted(names)),
        seasonal=any(len(series.recordings) > MIN_SIBLINGS for series in types),
        unknown=tuple(name for name in covariates if name not in known),
        sources=sources,
    )


def _robot_trend(
    robot: str,
    kind: str,
    recordings: Sequence[DatedRecording],
    trends: Sequence[QuantityTrend],
) -> RobotTrend:
    own = sorted((each for each in trends if each.robot == robot), key=lambda each: each.concern)
    return RobotTrend(robot, kind, tuple(recordings), tuple(own))


def _ranked(robots: Sequence[RobotTrend]) -> tuple[RobotTrend, ...]:
    quiet = (True, True, 0.0, 1.0)
    return tuple(
        sorted(robots, key=lambda robot: (robot.main.concern if robot.main else quiet, robot.robot))
    )


class _FoundTrend(NamedTuple):
    """A trend that is not judged yet, and what its series says without temperature and season."""

    trend: QuantityTrend
    raw_p: float
    raw_change: float


def _judged(found: Sequence[_FoundTrend]) -> list[QuantityTrend]:
    """Adjust p values for all robots, joints and quantities, and judge each trend by them."""
    if not found:
        return []
    adjusted = holm(np.array([each.trend.p_value for each in found]))
    raw = holm(np.array([each.raw_p for each in found]))
    judged = []
    for each, p_value, raw_p in zip(found, adjusted.tolist(), raw.tolist(), strict=True):
        trend = each.trend
        largest = float(np.max(np.abs(trend.fitted)))
        changed = p_value < FALSE_ALARM_RATE and largest >= MIN_RELATIVE_CHANGE
        would_be = raw_p < FALSE_ALARM_RATE and each.raw_change >= MIN_RELATIVE_CHANGE
        trend = replace(trend, p_value=p_value, changed=changed, explained=would_be and not changed)
        judged.append(trend if changed else replace(trend, changes=(), limits=()))
    return judged


def _family_trends(
    types: TypeSeries,
    family: QuantityFamily,
    limits: Sequence[TrendLimit],
    covariates: Sequence[str],
) -> Iterator[_FoundTrend]:
    """Yield one quantity of one joint of all robots, modelled together, then of all together."""
    followed = family.followed
    names = types.covariates_of(followed.joint, covariates)
    origin = min(recordings[0].moment for recordings in types.recordings.values())
    series: dict[str, RelativeSeries] = {}
    for robot, (values, variances) in family.values.items():
        recordings = types.recordings[robot]
        relative = RelativeSeries.of(recordings, values, variances, names, origin)
        if relative is not None:
            series[robot] = relative
    members = warmed([each.series for each in series.values()], names)
    if followed.quantity == "reference error":
        pairs = zip(series.values(), members, strict=True)
        members = scattered([each.of_an_error(member) for each, member in pairs])
    for (robot, each), course in zip(series.items(), courses(members), strict=True):
        if course is not None:
            trend = _trend(robot, followed, each, course, origin, names, limits)
            yield _FoundTrend(trend, course.unadjusted_p, course.unadjusted_largest)
    if (common := common_course(members)) is not None:
        reference = float(np.mean([each.reference for each in series.values()]))
        whole = RelativeSeries(
            common.series,
            tuple(_date(origin, time) for time in common.series.time.tolist()),
            (1.0 + common.series.value) * reference,
            np.sqrt(common.series.variance) * abs(reference),
            reference,
            len(common.series.time),
        )
        course = common.course
        trend = _trend("", followed, whole, course, origin, _SEASON, limits)
        yield _FoundTrend(trend, course.unadjusted_p, course.unadjusted_largest)


def _date(origin: datetime, month: float) -> str:
    return (origin + month * MONTH).isoformat(timespec="seconds")


def _trend(
    robot: str,
    followed: FollowedQuantity,
    each: RelativeSeries,
    course: Course,
    origin: datetime,
    names: Sequence[str],
    limits: Sequence[TrendLimit],
) -> QuantityTrend:
    """Return the model of a series with dates, as shares of the level before all changes."""
    level = 1.0 + course.level
    scale = 1.0 / level if level > 0.1 else 1.0

    def date(month: float) -> str:
        return _date(origin, month)

    last = float(each.series.time[-1])
    reached = [
        _reached(limit, course, scale, last, date)
        for limit in limits
        if limit.quantity == followed.quantity
    ]
    return QuantityTrend(
        robot=robot,
        joint=followed.joint,
        quantity=followed.quantity,
        unit=followed.unit,
        speed=followed.speed,
        reference=each.reference,
        dates=each.dates,
        values=each.values,
        stds=each.stds,
        adjusted=(course.adjusted - course.level) * scale,
        fitted=(course.fitted - course.level) * scale,
        changes=tuple(
            DatedChange(
                change.shape.kind,
                date(change.shape.begin),
                date(change.earliest),
                date(change.latest),
                change.size * scale,
            )
            for change in course.changes
        ),
        change=course.change * scale,
        half=course.half * scale,
        rate=course.rate * scale,
        rate_half=course.rate_half * scale,
        p_value=course.p_value,
        changed=False,
        explained=False,
        effects={
            name: effect * scale
            for name, effect, column in zip(
                names, course.effects.tolist(), each.series.covariates.T, strict=True
            )
            if np.isfinite(column).any()
        },
        limits=tuple(reached),
    )


def _reached(
    limit: TrendLimit,
    course: Course,
    scale: float,
    last: float,
    date: Callable[[float], str],
) -> LimitReached:
    """Return when the line of the present rate reaches a limit, and when its band does."""
    sign = 1.0 if limit.share > 0.0 else -1.0
    size = abs(limit.share)
    now = sign * course.change * scale
    half = course.half * scale
    months = np.arange(0.0, _FORECAST_MONTHS, 0.05)

    def when(level: float, rate: float) -> str | None:
        ahead = level + rate * months
        passed = np.flatnonzero(ahead >= size)
        return date(last + float(months[passed[0]])) if len(passed) else None

    rate = sign * course.rate * scale
    rate_half = course.rate_half * scale
    return LimitReached(
        limit,
        when(now, rate),
        when(now + half, rate + rate_half),
        when(now - half, rate - rate_half),
    )
