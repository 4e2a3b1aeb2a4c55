"""Series of the robots of a fleet: every recording is estimated separately."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

from hil.base.errors import InputError
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.batch.archive_discovery import ArchiveRef, LogImport, cell_in, discover, open_ref
from hil.batch.archive_reduction import Summary, has_summary, summarise
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive
from hil.batch.estimates import frequent_notes
from hil.batch.graph import archives_for_settings, cached_settings, decide_settings
from hil.fleet.conditions import Conditions
from hil.fleet.naming import RobotNaming
from hil.fleet.quantities import mean_parameters, tracked_quantities
from hil.fleet.series import (
    DatedRecording,
    QuantityFamily,
    TypeSeries,
    first_of,
    moment_of,
)
from hil.fleet.trend import FleetSources
from hil.pipeline.notes import Note
from hil.pipeline.options import Options
from identification import RobotModel
from identification.selection.settings import Settings

_RECORDINGS_PER_TASK: Final = 16  # recordings of one task


@one_thread()
def estimated_fleet(
    roots: Sequence[str],
    options: Options,
    cluster: Cluster,
    reporter: Reporter,
    *,
    cache: CacheLocation,
    naming: RobotNaming,
    importing: LogImport | None = None,
    conditions: Conditions = Conditions(),  # noqa: B008 - frozen
) -> tuple[tuple[TypeSeries, ...], FleetSources]:
    """Estimate every recording; return the series of each type, and facts about the recordings.

    Args:
        roots: folders, files, patterns or URLs.
        options: how recordings are identified; each by least squares without prior.
        cluster: whose workers read and estimate them.
        reporter: of progress.
        cache: of logs and estimates.
        naming: which robot a recording is of, and when it was made.
        importing: of logs and bags, which count only with it.
        conditions: of recordings, in addition to what their logs have.

    Raises:
        InputError: a place does not exist, nothing can be used, or no recording has a date.
        ClusterError: the cluster cannot be used, or ended.
        CacheError: the cache cannot be written.
    """
    found = discover(roots, cache, cluster, reporter, importing, naming.place)
    refs = [ref for ref in found.refs if ref.use == "excitation" and ref.when]
    undated = [
        SkippedArchive(ref.origin, "has no date", noun="undated recording")
        for ref in found.refs
        if ref.use == "excitation" and not ref.when
    ]
    broken = [*found.broken, *undated]
    if undated and not refs:
        raise _without_dates(found.refs, undated)
    if not refs:
        first = [f"{each.path}: {each.message}" for each in (*broken, *found.skipped)[:1]]
        raise InputError(None, "; ".join(["no recording can be used", *first]))
    types = _types(refs, options, cluster, reporter, cache, broken)
    used = [ref for each in types for ref in each.refs]
    sources = FleetSources(
        dated_by_file=sum(ref.dated_by == "file" for ref in used),
        twice=naming.in_several_places(used),
        simulated=all(ref.simulated for ref in used),
        broken=tuple(broken),
        skipped=found.skipped,
        warnings=frequent_notes([each for fits in types for each in fits.warned]),
    )
    return tuple(each.series(conditions) for each in types), sources


def _without_dates(refs: Sequence[ArchiveRef], undated: Sequence[SkippedArchive]) -> InputError:
    """Return the error of recordings of which none has a date."""
    others = f", like {len(undated) - 1} more" if len(undated) > 1 else ""
    remedy = "put the date into names and state where: --robot '{robot}/{date}.mcap'"
    if all(ref.simulated for ref in refs):
        others += ": an arm simulated in virtual time has none"
        remedy = f"compare such campaigns with `hil compare`, or {remedy}"
    return InputError(undated[0].path, f"has no date{others}", remedy=remedy)


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


@dataclass(frozen=True, eq=False)
class _TypeFits:
    """Estimates of all recordings of robots of one type, each estimated separately."""

    model: RobotModel
    by_robot: Mapping[str, Sequence[Summary]]  #: in order of time

    @property
    def refs(self) -> list[ArchiveRef]:
        """The recordings."""
        return [summary.ref for summaries in self.by_robot.values() for summary in summaries]

    @property
    def warned(self) -> list[tuple[ArchiveRef, Sequence[Note]]]:
        """The recordings with the warnings about each."""
        every = [summary for summaries in self.by_robot.values() for summary in summaries]
        return [(summary.ref, summary.warnings) for summary in every]

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
        """Return the estimates of recordings of one type; add the others to `broken`."""
        settings = _settings(refs, options, cluster, cache, broken)
        if settings is None:
            return None
        unusable = {each.path for each in broken}
        refs = [ref for ref in refs if ref.origin not in unusable]
        chunks = [
            refs[k : k + _RECORDINGS_PER_TASK] for k in range(0, len(refs), _RECORDINGS_PER_TASK)
        ]
        tasks = [
            ClusterTask(chunk[0].origin, summarise, (chunk, settings, cache)) for chunk in chunks
        ]
        new = sum(not has_summary(ref, settings, cache) for ref in refs)
        with reporter.task("estimating recordings", len(refs)) as progress:
            results = cluster.results(
                tasks, lambda _: progress.advance(_RECORDINGS_PER_TASK), archives=new
            )
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

    def series(self, conditions: Conditions) -> TypeSeries:
        """Return the series of every quantity of each robot."""
        recordings = {
            robot: tuple(_recording(robot, summary, conditions) for summary in summaries)
            for robot, summaries in self.by_robot.items()
        }
        every = [summary for summaries in self.by_robot.values() for summary in summaries]
        fits = [summary.fit for summary in every if summary.fit is not None]
        families = [
            QuantityFamily(
                tracked.followed,
                {
                    robot: tracked.of(summaries, first_of(recordings[robot]))
                    for robot, summaries in self.by_robot.items()
                },
            )
            for tracked in tracked_quantities(self.model, fits, mean_parameters(fits))
        ]
        digest = every[0].ref.type_key
        return TypeSeries(digest, self.model.joint_names, recordings, families)


def _recording(robot: str, summary: Summary, conditions: Conditions) -> DatedRecording:
    """Return a recording with all that may explain a change; what is stated goes first."""
    when = summary.ref.when
    return DatedRecording(when, {**summary.numbers, **conditions.of(robot, moment_of(when))})


def _settings(
    refs: Sequence[ArchiveRef],
    options: Options,
    cluster: Cluster,
    cache: CacheLocation,
    broken: list[SkippedArchive],
) -> Settings | None:
    """Return the settings of a type of robot; None if no recording can be read.

    The earliest recordings of one robot decide them, so that a later month changes no estimate.
    """
    for _, members in groupby(refs, lambda ref: ref.key):
        remaining = [*members]
        while remaining:
            chosen = archives_for_settings(remaining, None)
            settings = cached_settings(chosen, options, None, cache)
            if settings is not None:
                return settings
            task = ClusterTask(chosen[0].origin, decide_settings, (chosen, options, None, cache))
            (decision,) = cluster.results([task], archives=len(chosen))
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
