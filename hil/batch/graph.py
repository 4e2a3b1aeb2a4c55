"""The batch: find archives, decide settings, and estimate by one graph of Dask tasks.

archive -> factor (cached) -> sum -> estimate (cached): a task reduces up to `ARCHIVES_PER_TASK`
archives of a campaign, each of which is cached, and adds their factors; one task adds these sums,
which it reads itself if all of them are cached, and estimates the campaign; others pool the
campaigns of an arm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import Any, Final, cast, get_args

from hil.archive import Archive
from hil.base.errors import InputError
from hil.base.files import json_digest
from hil.base.progress import Reporter, Silent
from hil.base.threads import one_thread
from hil.pipeline.estimating import with_loading
from hil.pipeline.options import Options
from hil.pipeline.prepared import MAX_RECORDINGS, carried_over, decide
from hil.pipeline.sources import Source, all_fitted
from identification.estimators.siblings import with_siblings
from identification.selection.settings import Settings

from .archive_discovery import (
    ArchiveRef,
    CellTexts,
    Discovery,
    GroupKey,
    LogImport,
    cell_from,
    cell_in,
    discover,
    open_only,
    open_ref,
)
from .archive_reduction import (
    ToReduce,
    ensure_reduced,
    load_source,
    reduce_archives,
    reduction_key,
    to_reduce,
)
from .cache import CacheLocation, code_digest
from .cluster import AnyFuture, Cluster, ClusterTask, Death, SkippedArchive, error_of, reason_of
from .estimates import (
    ArmModel,
    BatchArm,
    BatchEstimate,
    BatchEstimator,
    CampaignResult,
    estimate_arm,
    estimate_cached,
    estimate_campaign,
    group_of,
    result_of,
)

ARCHIVES_PER_TASK: Final = 16
"""Archives of one task, and campaigns of one sum: Dask takes 2.5 ms for a task, and sums of factors
are fifty times as large as what else is known of an archive."""


LOGS_FOR_SETTINGS: Final = 8
"""Logs, the earliest, by which the settings of a robot are decided."""

# Settings


def decision_digest(options: Options, arms: Settings | None, refs: Sequence[ArchiveRef]) -> str:
    """Return the digest of the inputs of a decision: options or the arm's settings, archives, code.

    Of the estimators only the automatic one influences the settings.
    """
    requested = asdict(options) | {"estimator": options.estimator == "auto"}
    stated = None if arms is None else asdict(arms)
    return json_digest([requested, stated, [ref.sha256 for ref in refs], code_digest()])


def archives_for_settings(
    refs: Sequence[ArchiveRef], arms: Settings | None
) -> tuple[ArchiveRef, ...]:
    """Return the archives that determine a campaign's settings, standstill first.

    Where the arm has settings only noise and cell are the campaign's own: one excitation is read.
    """
    ordered = sorted(refs, key=lambda ref: ref.order)
    if all(ref.source for ref in refs):  # Recordings of a later month change no setting.
        ordered = sorted(refs, key=lambda ref: (ref.when, ref.order))[:LOGS_FOR_SETTINGS]
    standstill = [ref for ref in ordered if ref.use == "standstill"]
    fitted = [ref for ref in ordered if ref.use == "excitation"]
    return (*standstill, *fitted[: MAX_RECORDINGS if arms is None else 1])


def cached_settings(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, cache: CacheLocation
) -> Settings | None:
    """Return the settings that were decided from these archives before.

    Args:
        refs: the archives.
        options: of the identification.
        arms: settings of the arm, if it has any.
        cache: that they are in.
    """
    if not refs:
        return None
    return cache.get(refs[0].origin, decision_digest(options, arms, refs), Settings)


def decide_settings(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, cache: CacheLocation
) -> tuple[Settings | None, list[SkippedArchive]]:
    """Decide a campaign's settings from `archives_for_settings` and cache them.

    Args:
        refs: archives of the campaign.
        options: of the identification.
        arms: settings of the arm; if it has any, the campaign has these, with its own noise.
        cache: of the settings.

    Returns:
        The settings, None if no excitation is left; archives that could not be read.

    Raises:
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was requested and there is no usable row.
    """
    broken: list[SkippedArchive] = []
    standstill: Source | None = None
    fitted: list[tuple[Archive, Source]] = []
    for ref in refs:
        try:
            if ref.use != "standstill":
                fitted.append(load_source(ref))
            elif standstill is None:
                standstill = load_source(ref, to_fit=False)[1]
        except Exception as error:
            broken.append(SkippedArchive(ref.origin, reason_of(error, ref.origin)))
    if not fitted:
        return None, broken
    noise = None if standstill is None else standstill.recording
    sources = all_fitted(cell_in(fitted[0][0]), fitted, noise)
    if arms is None:
        settings = with_loading(decide(sources, options, Silent()).settings, sources)
    else:
        settings = carried_over(arms, sources, options)
    if not broken:
        cache.put(refs[0].origin, decision_digest(options, arms, refs), settings)
    return settings, broken


# The batch


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Result of a batch."""

    estimator: str
    arms: Mapping[str, BatchArm]  #: by digest
    repetitions: tuple[BatchEstimate, ...]  #: of all campaigns, in the order of `ArchiveRef.order`
    campaigns: tuple[BatchEstimate, ...]  #: in the same order
    pooled: tuple[BatchEstimate, ...]  #: one per arm
    #: likewise of robots with two siblings or more: with the common prior of their type
    siblings: tuple[BatchEstimate, ...]
    broken: tuple[SkippedArchive, ...]  #: archives and campaigns (by folder) that could not be used
    skipped: tuple[SkippedArchive, ...]  #: archives that are not intended for fitting
    read: int  #: archives whose factor was computed
    cached: int  #: archives whose factor was cached
    code: str  #: digest of the programs


@one_thread()
def reidentify(
    roots: Sequence[str],
    options: Options,
    cluster: Cluster,
    reporter: Reporter,
    *,
    cache: CacheLocation = CacheLocation(),  # noqa: B008 - frozen
    importing: LogImport | None = None,
    place: Callable[[ArchiveRef], ArchiveRef] = lambda ref: ref,
    check: Callable[[Discovery], None] = lambda _: None,
) -> BatchResult:
    """Identify every arm from all its archives: by repetition, by campaign, and pooled.

    Equals `hil identify` on the archives of a campaign, with the same motions held out.
    They depend neither on the order in which archives are found nor on the workers. A single
    recording is never split.

    Args:
        roots: folders, files, patterns or URLs.
        options: of the identification.
        cluster: of workers.
        reporter: of progress.
        cache: of reduced archives.
        importing: of logs and bags, which count only with it.
        place: adds what is known of the robot and the date of a recording.
        check: receives the archives found, before samples are read, and may raise.

    Raises:
        InputError: a place does not exist, no archive can be fitted, or the estimator is not one of
            a batch.
        ClusterError: the cluster cannot be used, or ended.
        CacheError: the cache cannot be written.
    """
    if options.estimator not in (estimators := get_args(BatchEstimator)):
        problem = f"{options.estimator!r} reads samples"
        remedy = f"use {', '.join(estimators)}"
        raise InputError(None, problem, field="estimator", remedy=remedy)
    discovery = discover(roots, cache, cluster, reporter, importing, place)
    check(discovery)
    batch = _Batch(options, cluster, cache, reporter, [*discovery.broken])
    campaigns = batch.with_settings(
        [_Campaign(key, list(refs)) for key, refs in groupby(discovery.refs, lambda ref: ref.key)]
    )
    return batch.result(campaigns, discovery.skipped)


@dataclass(eq=False)
class _Campaign:
    """Archives of one group in progress."""

    key: GroupKey
    refs: list[ArchiveRef]
    settings: Settings | None = None  #: None until decided

    @property
    def arm_type(self) -> str:
        """Digest that robots of one type share."""
        return self.refs[0].type_key

    @property
    def ready(self) -> Settings:
        """The decided settings."""
        assert self.settings is not None
        return self.settings

    @property
    def partitions(self) -> list[list[ToReduce]]:
        """Its archives by task, in the order of sums."""
        refs = sorted(self.refs, key=lambda ref: ref.order)
        return list(_chunks(to_reduce([ref for ref in refs if ref.use != "standstill"])))


@dataclass(eq=False)
class _ArmWork:
    """An arm in progress."""

    model: ArmModel
    campaigns: list[_Campaign]
    results: dict[GroupKey, CampaignResult]
    pooled: BatchEstimate | SkippedArchive | None = None

    @property
    def has_pooled(self) -> bool:
        """Whether the pooled estimate differs from the estimate of its only campaign."""
        return len(self.campaigns) > 1


def _chunks(things: Sequence[Any]) -> Iterator[list[Any]]:
    for begin in range(0, len(things), ARCHIVES_PER_TASK):
        yield list(things[begin : begin + ARCHIVES_PER_TASK])


@dataclass(eq=False)
class _Batch:
    """State of a batch."""

    options: Options
    cluster: Cluster
    cache: CacheLocation
    reporter: Reporter
    broken: list[SkippedArchive]

    # Settings

    def with_settings(self, campaigns: Sequence[_Campaign]) -> list[_Campaign]:
        """Decide the settings of campaigns; return the campaigns that have settings.

        The settings of a type of arm are decided on its first readable campaign; the others use
        them with their own noise: comparisons need one friction law, and sums the same columns.
        """
        arms: dict[str, Settings] = {}
        types = {campaign.key: campaign.arm_type for campaign in campaigns}
        waiting = list(campaigns)
        while waiting:
            first = {
                types[campaign.key]: campaign
                for campaign in reversed(waiting)
                if types[campaign.key] not in arms
            }
            undecided = list(first.values()) or waiting
            waiting = [campaign for campaign in waiting if campaign not in undecided]
            while undecided:
                undecided = self._decide(undecided, arms)
            arms |= {
                arm: campaign.settings
                for arm, campaign in first.items()
                if campaign.settings is not None
            }
        return [campaign for campaign in campaigns if campaign.settings is not None]

    def _decide(self, campaigns: Sequence[_Campaign], arms: dict[str, Settings]) -> list[_Campaign]:
        """Decide settings; return the campaigns to repeat without archives that are unusable."""
        undecided = []
        for campaign in campaigns:
            arm_settings = arms.get(campaign.arm_type)
            refs = archives_for_settings(campaign.refs, arm_settings)
            campaign.settings = cached_settings(refs, self.options, arm_settings, self.cache)
            if campaign.settings is None:
                undecided.append((campaign, (refs, self.options, arm_settings, self.cache)))
        tasks = [
            ClusterTask(c.key.campaign, decide_settings, arguments) for c, arguments in undecided
        ]
        again = []
        archives = sum(len(refs) for _, (refs, *_) in undecided)
        results = self._results(tasks, "deciding settings", archives)
        for (campaign, (refs, *_)), decision in zip(undecided, results, strict=True):
            if isinstance(decision, SkippedArchive):  # perhaps an archive ends its process
                alone = [ClusterTask(ref.origin, open_only, (ref,)) for ref in refs]
                opened = self._results(alone, "opening archives one by one", len(alone))
                broken = [other for other in opened if other is not None]
                reason = decision.reason
            else:
                campaign.settings, broken = decision
                some = any(ref.use == "excitation" for ref in refs)
                reason = "" if some else "it holds no excitation"
            self.broken += broken
            paths = {other.path for other in broken}
            campaign.refs = [ref for ref in campaign.refs if ref.origin not in paths]
            if campaign.settings is None and broken and campaign.refs:
                again.append(campaign)
            elif campaign.settings is None and reason:
                self.broken.append(SkippedArchive(campaign.key.campaign, reason))
        return again

    def _results(self, tasks: Sequence[ClusterTask[Any]], title: str, archives: int) -> list[Any]:
        if not tasks:
            return []
        with self.reporter.task(title, len(tasks)) as progress:
            return self.cluster.results(tasks, progress.advance, archives=archives)

    # Estimates

    def result(
        self, campaigns: Sequence[_Campaign], skipped: tuple[SkippedArchive, ...]
    ) -> BatchResult:
        """Reduce and estimate everything."""
        arms = [
            _ArmWork(self._model(digest, members), members, {})
            for digest, members in _by_arm(campaigns)
        ]
        archives = sum(len(part) for campaign in campaigns for part in campaign.partitions)
        with self.reporter.task("reading archives and estimating", archives) as progress:
            waiting = arms
            while waiting:
                waiting = self._estimate(waiting, progress.advance)
        results = [arm.results[campaign.key] for arm in arms for campaign in arm.campaigns]
        estimates = [estimate for result in results for estimate in result.estimates]
        pooled = [estimate for arm in arms for estimate in self._pooled(arm)]
        lost = [unused for result in results for unused in result.broken]
        broken = tuple(dict.fromkeys([*self.broken, *lost]))
        repetitions = tuple(estimate for estimate in estimates if estimate.level == "repetition")
        if not repetitions:
            problem = "there is no excitation and no imported recording that can be fitted"
            first = [f"{each.path} could not be used: {each.message}" for each in broken[:1]]
            raise InputError(None, "; ".join([problem, *first]))
        return BatchResult(
            estimator=self.options.estimator,
            arms={arm.model.digest: _arm_of(arm.model) for arm in arms},
            repetitions=repetitions,
            campaigns=tuple(estimate for estimate in estimates if estimate.level == "campaign"),
            pooled=tuple(pooled),
            siblings=tuple(_siblings(pooled, {arm.model.digest: arm.model for arm in arms})),
            broken=broken,
            skipped=skipped,
            read=sum(result.read for result in results),
            cached=sum(result.cached for result in results),
            code=code_digest(),
        )

    def _estimate(
        self, arms: Sequence[_ArmWork], advance: Callable[[float, str], None]
    ) -> list[_ArmWork]:
        """Execute the graphs of some arms; return the arms of which a task ended its process.

        The archives that did are removed from these, and reported.
        """
        archives = sum(self._uncached(campaign) for arm in arms for campaign in arm.campaigns)
        #: who receives a future that is done, by its identity. No reference to one is held, so that
        #: the workers release results that nothing else needs, and only results of campaigns and
        #: arms are fetched: sums are fifty times as large
        receivers: dict[int, Callable[[AnyFuture], None]] = {}
        damaged: list[_ArmWork] = []

        def submitted() -> Iterator[AnyFuture]:
            for arm in arms:
                yield from self._submit(arm, receivers, archives, advance)

        for future in self.cluster.completed(submitted()):
            receivers[id(future)](future)
        for arm in arms:
            if any(campaign.key not in arm.results for campaign in arm.campaigns):
                damaged.append(arm)
                for campaign in arm.campaigns:
                    if campaign.key not in arm.results:
                        self._remove_deadly(campaign)
        return damaged

    def _submit(
        self,
        arm: _ArmWork,
        receivers: dict[int, Callable[[AnyFuture], None]],
        archives: int,
        advance: Callable[[float, str], None],
    ) -> Iterator[AnyFuture]:
        """Submit the graph of an arm; yield the futures to wait for, with their receivers."""

        def submit(path: str, function: Callable[..., Any], *arguments: Any) -> AnyFuture:
            return self.cluster.submit(ClusterTask(path, function, arguments), archives=archives)

        arm.results.clear()
        campaigns: list[AnyFuture] = []
        for campaign in arm.campaigns:
            place = campaign.key.campaign
            partitions = campaign.partitions
            keys = [reduction_key(partition, campaign.ready) for partition in partitions]
            estimated = (json_digest(keys), self.cache, arm.model, campaign.ready, place)
            if all(self._has(partition, campaign) for partition in partitions):
                pair = submit(place, estimate_cached, partitions, *estimated)
                receivers[id(pair)] = _advance(advance, sum(map(len, partitions)), place)
                yield pair
            else:
                parts = []
                for partition in partitions:
                    reduced = submit(place, reduce_archives, partition, campaign.ready, self.cache)
                    receivers[id(reduced)] = _advance(advance, len(partition), place)
                    parts.append(reduced)
                pair = submit(place, estimate_campaign, parts, *estimated)
                yield from parts
            result = submit(place, result_of, pair)
            receivers[id(result)] = self._receive_campaign(arm, campaign.key)
            campaigns.append(pair)
            yield result
        if arm.has_pooled:
            sums = [submit("", group_of, chunk) for chunk in _chunks(campaigns)]
            pooled = submit(
                f"arm {arm.model.digest[:8]}", estimate_arm, sums, self.cache, arm.model
            )
            receivers[id(pooled)] = self._receive_pooled(arm)
            yield pooled

    def _receive_campaign(self, arm: _ArmWork, key: GroupKey) -> Callable[[AnyFuture], None]:
        def receive(future: AnyFuture) -> None:
            result = self.cluster.outcome_of(future)
            if isinstance(result, SkippedArchive):
                result = CampaignResult((), (result,), 0, 0)
            if not isinstance(result, Death):
                arm.results[key] = result

        return receive

    def _receive_pooled(self, arm: _ArmWork) -> Callable[[AnyFuture], None]:
        def receive(future: AnyFuture) -> None:
            result = self.cluster.outcome_of(future)
            if not isinstance(result, Death):
                arm.pooled = result

        return receive

    def _uncached(self, campaign: _Campaign) -> int:
        """Return how many archives of a campaign must be read."""
        count = 0
        for partition in campaign.partitions:
            if not self._has(partition, campaign):
                count += sum(not self._has([one], campaign) for one in partition)
        return count

    def _has(self, partition: Sequence[ToReduce], campaign: _Campaign) -> bool:
        return self.cache.has(partition[0].ref.origin, reduction_key(partition, campaign.ready))

    def _remove_deadly(self, campaign: _Campaign) -> None:
        """Remove the archives of a campaign that end the process that reduces them."""
        tasks = [
            ClusterTask(one.ref.origin, ensure_reduced, (one, campaign.ready, self.cache))
            for partition in campaign.partitions
            for one in partition
        ]
        results = self._results(tasks, "reducing archives one by one", len(tasks))
        deadly = [result for result in results if result is not None]
        self.broken += deadly
        paths = {unused.path for unused in deadly}
        campaign.refs = [ref for ref in campaign.refs if ref.origin not in paths]

    def _model(self, digest: str, members: Sequence[_Campaign]) -> ArmModel:
        """Return what the estimates of an arm need in addition to factors."""
        ref = members[0].refs[0]
        texts = self.cache.get(ref.origin, ref.cell, CellTexts)
        if texts is None:
            cell = cell_in(open_ref(ref))
            texts = CellTexts(cell.text, cell.urdf)
        estimator = cast(BatchEstimator, self.options.estimator)
        settings = members[0].ready
        return ArmModel(
            digest, texts.cell, texts.urdf, settings, estimator, ref.robot, ref.type_key
        )

    def _pooled(self, arm: _ArmWork) -> list[BatchEstimate]:
        """Return the pooled estimate of an arm; with one campaign, its estimate."""
        if arm.has_pooled:
            if isinstance(arm.pooled, SkippedArchive):
                self.broken.append(arm.pooled)
            return [arm.pooled] if isinstance(arm.pooled, BatchEstimate) else []
        return [
            replace(estimate, level="pooled", campaign="")
            for result in arm.results.values()
            for estimate in result.estimates
            if estimate.level == "campaign"
        ]


def _siblings(
    pooled: Sequence[BatchEstimate], models: Mapping[str, ArmModel]
) -> Iterator[BatchEstimate]:
    """Yield the estimates of robots with the common prior of their type."""
    named = [each for each in pooled if models[each.arm].robot]
    for _, members in groupby(named, lambda each: models[each.arm].arm_type):
        robots = list(members)
        found = with_siblings([each.estimate for each in robots])
        if found is not None:
            for each, estimate in zip(robots, found.estimates, strict=True):
                yield replace(each, level="siblings", estimate=estimate)


def _by_arm(campaigns: Sequence[_Campaign]) -> list[tuple[str, list[_Campaign]]]:
    groups = groupby(campaigns, lambda campaign: campaign.key.arm)
    return [(digest, list(members)) for digest, members in groups]


def _arm_of(model: ArmModel) -> BatchArm:
    """Return an arm with its cell."""
    cell = cell_from(model.cell, model.urdf, model.settings.friction)
    return BatchArm(model.digest, cell, model.robot, model.arm_type)


def _advance(
    advance: Callable[[float, str], None], count: int, note: str
) -> Callable[[AnyFuture], None]:
    """Return what is done when `count` archives are reduced."""

    def receive(future: AnyFuture) -> None:
        if error_of(future) is None:
            advance(count, note)

    return receive
