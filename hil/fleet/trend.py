"""Which robot of a fleet changes: in which joint, how fast, since when, and whether by heat.

Each recording is estimated by itself; each quantity of each joint is a series over time, and the
series of robots of one type are modelled together (:mod:`hil.fleet.series_changes`). p values are
adjusted for all robots, joints and quantities (Holm 1979).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import groupby
from typing import Final, Literal, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.batch.archive_discovery import ArchiveRef, LogImport, cell_in, discover, open_ref
from hil.batch.archive_reduction import Summary, summarise
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive
from hil.batch.graph import archives_for_settings, cached_settings, decide_settings
from hil.compare.comparison import LEAST, holm
from hil.fleet.naming import RobotNaming
from hil.fleet.quantities import (
    CAUSES,
    QuantityName,
    TrackedQuantity,
    tracked_quantities,
)
from hil.fleet.series_changes import FEWEST, SIBLINGS, Course, Series, courses
from hil.fleet.trend_limits import TrendLimit
from hil.pipeline.options import Options
from identification import RobotModel
from identification.factor.estimate import Estimate
from identification.selection.settings import Settings

FALSE_ALARMS: Final = 0.01
"""Probability of any change in a fleet that has none, at one time of asking."""
REFERENCE: Final = 3.0
"""First months of a robot, against which it has changed."""
_FIRST: Final = 3  # recordings that these have at least
_CHUNK: Final = 16  # recordings of one task
_MONTH: Final = timedelta(days=365.25 / 12.0)
_DETERMINED: Final = 4.0  # standard deviations that a value exceeds
_MOST_COMMON: Final = 2  # covariates that concern all joints
_LONGEST: Final = 240.0  # months within which a limit is foreseen


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
        effects: share of change by one unit of each covariate, by name.
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
    """All quantities of a robot, the greatest concern first."""

    robot: str
    recordings: int
    first: str  #: date of the first recording, ISO 8601
    last: str
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
class FleetTrend:
    """The robots of a fleet, the greatest concern first, and what could not be used."""

    robots: tuple[RobotTrend, ...]
    covariates: tuple[str, ...]  #: names of temperatures and other columns that were used
    seasonal: bool  #: whether the robots are enough to show what moves all of them at once
    dated_by_file: int  #: recordings that have only the date of their file
    simulated: bool
    recordings: int
    broken: tuple[SkippedArchive, ...]
    skipped: tuple[SkippedArchive, ...]

    @property
    def changed(self) -> tuple[RobotTrend, ...]:
        """Robots that have changed."""
        return tuple(robot for robot in self.robots if robot.changed)


@one_thread()
def fleet_trend(
    roots: Sequence[str],
    options: Options,
    cluster: Cluster,
    reporter: Reporter,
    *,
    cache: CacheLocation,
    naming: RobotNaming,
    importing: LogImport | None = None,
    limits: Sequence[TrendLimit] = (),
    covariates: Sequence[str] = (),
) -> FleetTrend:
    """Estimate every recording, and find what changes over time.

    Args:
        roots: folders, files, patterns or URLs.
        options: how recordings are identified; each by least squares without prior.
        cluster: whose workers read and estimate them.
        reporter: of progress.
        cache: of logs and estimates.
        naming: which robot a recording is of, and when it was made.
        importing: of logs and bags, which count only with it.
        limits: of which the dates are foreseen.
        covariates: columns of logs that may explain a change, beside temperatures.

    Raises:
        InputError: a place does not exist, nothing can be used, or no recording has a date.
        ClusterError: the cluster cannot be used, or ended.
        CacheError: the cache cannot be written.
    """
    found = discover(roots, cache, cluster, reporter, importing, naming.place)
    refs = [ref for ref in found.refs if ref.use == "excitation" and ref.when]
    undated = [
        SkippedArchive(ref.origin, "has no date")
        for ref in found.refs
        if ref.use == "excitation" and not ref.when
    ]
    broken = [*found.broken, *undated]
    if not refs:
        first = [f"{each.path} could not be used: {each.message}" for each in broken[:1]]
        raise InputError(None, "; ".join(["there is no recording with a date", *first]))
    types = _types(refs, options, cluster, reporter, cache, broken)
    found_trends = [each for fits in types for each in fits.trends(limits, covariates)]
    return FleetTrend(
        robots=_by_robot(_judged(found_trends), types),
        covariates=tuple(sorted({name for each in types for name in each.covariates(covariates)})),
        seasonal=any(len(each.by_robot) > SIBLINGS for each in types),
        dated_by_file=sum(ref.dated_by == "file" for each in types for ref in each.refs),
        simulated=all(ref.simulated for each in types for ref in each.refs),
        recordings=sum(len(each.refs) for each in types),
        broken=tuple(broken),
        skipped=found.skipped,
    )


def _types(
    refs: Sequence[ArchiveRef],
    options: Options,
    cluster: Cluster,
    reporter: Reporter,
    cache: CacheLocation,
    broken: list[SkippedArchive],
) -> list[_TypeFits]:
    """Return the estimates of each type; InputError without any."""
    types: list[_TypeFits] = []
    for _, members in groupby(sorted(refs, key=lambda ref: ref.order), lambda ref: ref.type_key):
        fits = _TypeFits.of([*members], options, cluster, reporter, cache, broken)
        types += [] if fits is None else [fits]
    if not types:
        first = [f"{each.path} could not be used: {each.message}" for each in broken[:1]]
        raise InputError(None, "; ".join(["no recording can be estimated", *first]))
    return types


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
        changed = p_value < FALSE_ALARMS and largest >= LEAST
        would_be = raw_p < FALSE_ALARMS and each.raw_change >= LEAST
        trend = replace(trend, p_value=p_value, changed=changed, explained=would_be and not changed)
        judged.append(trend if changed else replace(trend, changes=(), limits=()))
    return judged


def _by_robot(
    trends: Sequence[QuantityTrend], types: Sequence[_TypeFits]
) -> tuple[RobotTrend, ...]:
    robots = []
    for fits in types:
        for name, summaries in fits.by_robot.items():
            of_robot = [trend for trend in trends if trend.robot == name]
            dates = sorted(summary.ref.when for summary in summaries)
            ordered = tuple(sorted(of_robot, key=lambda trend: trend.concern))
            robots.append(RobotTrend(name, len(summaries), dates[0], dates[-1], ordered))
    quiet = (True, True, 0.0, 1.0)
    return tuple(
        sorted(robots, key=lambda robot: (robot.main.concern if robot.main else quiet, robot.robot))
    )


def _time_of(ref: ArchiveRef) -> datetime:
    moment = datetime.fromisoformat(ref.when)
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


@dataclass(frozen=True, eq=False)
class _TypeFits:
    """Estimates of all recordings of robots of one type, each by itself."""

    model: RobotModel
    by_robot: Mapping[str, Sequence[Summary]]  #: in order of time

    @property
    def refs(self) -> list[ArchiveRef]:
        """The recordings."""
        return [summary.ref for summaries in self.by_robot.values() for summary in summaries]

    @classmethod
    def of(
        cls,
        refs: Sequence[ArchiveRef],
        options: Options,
        cluster: Cluster,
        reporter: Reporter,
        cache: CacheLocation,
        broken: list[SkippedArchive],
    ) -> _TypeFits | None:
        """Return the estimates of recordings of one type; add to `broken` those without one."""
        settings = _settings(refs, options, cluster, cache, broken)
        if settings is None:
            return None
        unusable = {each.path for each in broken}
        refs = [ref for ref in refs if ref.origin not in unusable]
        chunks = [refs[k : k + _CHUNK] for k in range(0, len(refs), _CHUNK)]
        tasks = [
            ClusterTask(chunk[0].origin, summarise, (chunk, settings, cache)) for chunk in chunks
        ]
        with reporter.task("estimating recordings", len(refs)) as progress:
            results = cluster.results(tasks, lambda _: progress.advance(_CHUNK), archives=len(refs))
        summaries: list[Summary] = []
        for result in results:
            for each in [result] if isinstance(result, SkippedArchive) else result:
                if isinstance(each, SkippedArchive):
                    broken.append(each)
                else:
                    summaries.append(replace(each, scatter=None))
        if not summaries:
            return None
        by_robot: dict[str, list[Summary]] = {}
        for summary in sorted(summaries, key=lambda each: (each.ref.when, each.ref.order)):
            by_robot.setdefault(summary.ref.robot or cls._name_of(summary.ref), []).append(summary)
        model = cell_in(open_ref(summaries[0].ref), settings).model
        return cls(model, dict(sorted(by_robot.items())))

    @staticmethod
    def _name_of(ref: ArchiveRef) -> str:
        return f"arm {ref.arm[:8]}"

    def covariates(self, more: Sequence[str]) -> list[str]:
        """Return the names of temperatures, and of the columns that were asked for."""
        counts: dict[str, int] = {}
        for ref in self.refs:
            for name, value in ref.facts.items():
                if isinstance(value, float):
                    counts[name] = counts.get(name, 0) + 1
        every = len(self.refs)
        return [name for name, count in counts.items() if count == every or name in more]

    def trends(self, limits: Sequence[TrendLimit], more: Sequence[str]) -> Iterator[_FoundTrend]:
        """Yield the trend of each quantity of each robot."""
        reference = self._reference()
        names = self.covariates(more)
        for tracked in tracked_quantities(self.model, self._fits(), reference):
            yield from self._family(
                tracked, names_of_joint(names, tracked.number, self.model), limits
            )

    def _fits(self) -> list[Estimate]:
        summaries = (each for group in self.by_robot.values() for each in group)
        return [summary.fit for summary in summaries if summary.fit is not None]

    def _reference(self) -> Array:
        """Return the mean of the parameters of all recordings (p,), where they are determined."""
        values = np.array([fit.values for fit in self._fits()])
        stds = np.array([fit.std for fit in self._fits()])
        weights = np.where(
            np.isfinite(stds) & (stds > 0.0), 1.0 / np.maximum(stds, 1e-300) ** 2, 0.0
        )
        total = weights.sum(axis=0)
        return np.asarray((weights * values).sum(axis=0) / np.where(total > 0.0, total, 1.0))

    def _family(
        self, tracked: TrackedQuantity, names: Sequence[str], limits: Sequence[TrendLimit]
    ) -> Iterator[_FoundTrend]:
        """Yield one quantity of one joint of all robots, modelled together."""
        starts = {robot: _time_of(group[0].ref) for robot, group in self.by_robot.items()}
        origin = min(starts.values())
        measured = {
            robot: tracked.of(group, _first_of(group)) for robot, group in self.by_robot.items()
        }
        series: dict[str, _RelativeSeries] = {}
        for robot, group in self.by_robot.items():
            relative = _RelativeSeries.of(group, *measured[robot], names, origin)
            if relative is not None:
                series[robot] = relative
        family = [each.series for each in series.values()]
        for (robot, each), course in zip(series.items(), courses(family), strict=True):
            if course is not None:
                trend = _trend(robot, tracked, each, course, origin, names, limits)
                yield _FoundTrend(trend, course.unadjusted_p, course.unadjusted_largest)


def _settings(
    refs: Sequence[ArchiveRef],
    options: Options,
    cluster: Cluster,
    cache: CacheLocation,
    broken: list[SkippedArchive],
) -> Settings | None:
    """Return the settings of a type: those of its robot whose first recording is readable.

    Decided by the earliest recordings of one robot, so that a later month changes no estimate.
    """
    for _, members in groupby(refs, lambda ref: ref.key):
        remaining = [*members]
        while remaining:
            chosen = archives_for_settings(remaining, None)
            settings = cached_settings(chosen, options, None, cache)
            if settings is not None:
                return settings
            task = ClusterTask(chosen[0].origin, decide_settings, (chosen, options, None, cache))
            (decision,) = cluster.results([task], archives=len(refs))
            if isinstance(decision, SkippedArchive):
                broken.append(decision)
                unusable = {chosen[0].origin}
            else:
                settings, lost = decision
                if settings is not None:
                    broken += lost
                    return settings
                broken += lost
                unusable = {each.path for each in lost} or {ref.origin for ref in chosen}
            remaining = [ref for ref in remaining if ref.origin not in unusable]
    return None


def _first_of(group: Sequence[Summary]) -> int:
    """Return how many recordings are of the first months."""
    start = _time_of(group[0].ref)
    within = sum(_time_of(each.ref) - start < REFERENCE * _MONTH for each in group)
    return max(min(_FIRST, len(group)), within)


class _RelativeSeries(NamedTuple):
    """A series as shares of its first months."""

    series: Series
    dates: tuple[str, ...]
    values: Array
    stds: Array
    reference: float

    @classmethod
    def of(
        cls,
        group: Sequence[Summary],
        values: Array,
        variances: Array,
        names: Sequence[str],
        origin: datetime,
    ) -> _RelativeSeries | None:
        """Return a series of values (m,); None if it is too short, or zero within its errors."""
        known = np.flatnonzero(np.isfinite(values) & np.isfinite(variances))
        if len(known) < FEWEST:
            return None
        group = [group[k] for k in known.tolist()]
        values = values[known]
        variances = variances[known]
        first = _first_of(group)
        reference = float(np.mean(values[:first]))
        error = float(np.sqrt(np.mean(variances[:first]) / first))
        if not abs(reference) > _DETERMINED * error:
            return None
        times = np.array([(_time_of(each.ref) - origin) / _MONTH for each in group])
        columns = np.array(
            [[_number(each.ref.facts.get(name)) for name in names] for each in group]
        ).reshape(len(group), len(names))
        series = Series(times, values / reference - 1.0, variances / reference**2, _filled(columns))
        dates = tuple(each.ref.when for each in group)
        return cls(series, dates, values, np.sqrt(variances), reference)


def _number(value: float | str | None) -> float:
    return value if isinstance(value, float) else np.nan


def _filled(columns: Array) -> Array:
    """Return covariates with the mean of the others where one is missing, 0 where all are."""
    counts = np.isfinite(columns).sum(axis=0)
    means = np.nansum(columns, axis=0) / np.maximum(counts, 1)
    return np.where(np.isfinite(columns), columns, means)


def names_of_joint(names: Sequence[str], joint: int, model: RobotModel) -> list[str]:
    """Return those of some covariates that concern a joint: its own, and those of no joint.

    Covariates of joints end with their numbers, from 0 or 1; the first two of no joint are taken.
    """
    numbered: dict[str, dict[int, str]] = {}
    for name in names:
        if (match := re.fullmatch(r"(.*?)_?(\d+)", name)) is not None:
            numbered.setdefault(match[1], {})[int(match[2])] = name
    of_joints = {
        stem: numbers
        for stem, numbers in numbered.items()
        if sorted(numbers) in ([*range(model.n_joints)], [*range(1, model.n_joints + 1)])
    }
    own = [numbers[joint + min(numbers)] for numbers in of_joints.values()]
    of_any = {name for numbers in of_joints.values() for name in numbers.values()}
    return [*own[:1], *[name for name in names if name not in of_any][:_MOST_COMMON]]


def _trend(
    robot: str,
    tracked: TrackedQuantity,
    each: _RelativeSeries,
    course: Course,
    origin: datetime,
    names: Sequence[str],
    limits: Sequence[TrendLimit],
) -> QuantityTrend:
    """Return the model of a series with dates, as shares of the level before all changes."""
    level = 1.0 + course.level
    scale = 1.0 / level if level > 0.1 else 1.0

    def date(month: float) -> str:
        return (origin + month * _MONTH).isoformat(timespec="seconds")

    last = float(each.series.time[-1])
    reached = [
        _reached(limit, course, scale, last, date)
        for limit in limits
        if limit.quantity == tracked.quantity
    ]
    return QuantityTrend(
        robot=robot,
        joint=tracked.joint,
        quantity=tracked.quantity,
        unit=tracked.unit,
        speed=tracked.speed,
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
        effects=dict(zip(names, (course.effects * scale).tolist(), strict=True)),
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
    months = np.arange(0.0, _LONGEST, 0.05)

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
