"""The whole batch: archives found, settings decided, archives reduced, added up, estimated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar, cast

from hil.archive import Archive
from hil.cell import Cell
from hil.errors import HilError, InputError
from hil.identify.deciding import MOST_READ, carried_over, decide, with_noise
from hil.identify.options import Options
from hil.identify.settings import Settings
from hil.identify.sources import Source, all_fitted
from hil.io import json_digest
from hil.progress import Reporter, Silent, Task
from hil.terminal_text import plural
from identification import IdentificationError
from identification.factor.phases import PhaseFactor

from .cache import Where, code_digest, decision_digest, settings_digest
from .discovery import discover
from .estimates import Estimator, Group, repetition_level, sum_level
from .factors import bundles, cached, cell_from, cell_in, is_cached, opened, reduced, source_in
from .types import (
    ESTIMATORS,
    ArchiveRef,
    Arm,
    BatchEstimator,
    BatchResult,
    Broken,
    Bundle,
    GroupKey,
    LevelEstimate,
    NothingToFitError,
    Summary,
)
from .workers import FAN_IN, ArchiveTask, TreeSum, Workers

T = TypeVar("T")
Run = list[tuple[ArchiveRef, ...]]
"""Bundles that are reduced and added up together: one, or up to `FAN_IN` far away."""

_ROUNDS: Final = 3
"""How often archives are reduced again without those that end their process."""
_MANY: Final = 4
"""Runs per worker from which on whole runs are added up far away, so that less is sent."""


@dataclass(frozen=True)
class Plan:
    """How a batch is run.

    Attributes:
        options: as of `hil identify`, with an estimator that needs no sample; a single recording is
            never split.
        cache: folder of the cache; None: beside the archives.
        keep: whether anything is cached at all.
    """

    options: Options = Options()
    cache: Path | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        if self.options.estimator not in ESTIMATORS:
            raise InputError(
                None,
                f"the estimator {self.options.estimator!r} reads samples",
                field="--estimator",
                remedy=f"use {', '.join(ESTIMATORS)}",
            )

    @property
    def estimator(self) -> BatchEstimator:
        """By name."""
        return cast(BatchEstimator, self.options.estimator)


def reidentify(
    roots: Sequence[str],
    plan: Plan,
    workers: Workers,
    reporter: Reporter,
    *,
    check: Callable[[Sequence[ArchiveRef]], None] = lambda _: None,
) -> BatchResult:
    """Identify every arm from all its archives: repetition by repetition, campaign, and pooled.

    The numbers are those of `hil identify` on the archives of a campaign with the same held out.
    They do not depend on the order in which archives are found, nor on who computes what.

    Args:
        roots: folders, archives, or URLs of either.
        plan: how.
        workers: who does the work on archives.
        reporter: of progress.
        check: given the archives that were found, before their samples are read; may refuse them.

    Raises:
        NothingToFitError: there is not one archive that can be fitted.
        InputError: a place does not exist, or the estimator does not suit an arm.
        CacheError: the cache cannot be written.
    """
    where = Where(None if plan.cache is None else str(plan.cache.resolve()), plan.keep)
    found = discover(roots, where, workers, reporter)
    check(found.refs)
    batch = _Batch(plan, workers, where, reporter)
    batch.broken += found.broken
    return batch.result(found.refs, found.skipped)


# On a worker


class Decision(NamedTuple):
    """Settings of a campaign.

    Attributes:
        settings: None where there is not one archive to decide them from.
        broken: archives that could not be read for it.
    """

    settings: Settings | None
    broken: tuple[Broken, ...]


def decided(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, where: Where
) -> Decision:
    """Decide a campaign's settings from some of its archives, and cache them.

    Args:
        refs: see `Campaign.consulted`.
        options: what is open.
        arms: settings of the arm; None where this campaign decides on them.
        where: they are cached.

    Raises:
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was asked for and there is not one usable row.
    """
    known = _known_settings(refs, options, arms, where)
    if known is not None:
        return Decision(known, ())
    broken: list[Broken] = []
    rest: Source | None = None
    fitted: list[tuple[Archive, Source]] = []
    for ref in refs:
        try:
            if ref.use != "standstill":
                fitted.append(source_in(ref))
            elif rest is None:
                rest = source_in(ref, to_fit=False)[1]
        except (HilError, IdentificationError) as error:
            broken.append(Broken(ref.location, str(error)))
    if not fitted:
        return Decision(None, tuple(broken))
    sources, _ = with_noise(
        all_fitted(cell_in(fitted[0][0]), fitted, None if rest is None else rest.recording)
    )
    if arms is None:
        settings = decide(sources, options, Silent()).settings
    else:
        settings = carried_over(arms, sources, options)
    if not broken:
        where.store(refs[0].location).put(decision_digest(options, arms, refs), settings)
    return Decision(settings, tuple(broken))


def _known_settings(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, where: Where
) -> Settings | None:
    if not refs:
        return None
    return where.store(refs[0].location).get(decision_digest(options, arms, refs), Settings)


def opened_alone(ref: ArchiveRef) -> None:
    """Open an archive, to see whether that fails, or ends this process."""
    with opened(ref):
        pass


def added_up(
    run: Run, settings: Settings, where: Where
) -> tuple[PhaseFactor | None, tuple[Bundle, ...]]:
    """Reduce bundles: their sum, and the rest of each."""
    found = [reduced(refs, settings, where) for refs in run]
    total = TreeSum[PhaseFactor](bundle.phase for bundle in found).result()
    return total, tuple(replace(bundle, phase=None) for bundle in found)


# In the process that gives work out


@dataclass(eq=False)
class Campaign:
    """Archives of one group on their way.

    Attributes:
        key: of the group.
        refs: archives, without those found to be broken.
        arms: settings of its arm; None where it decides on them.
        settings: None until they are decided.
        runs: what is reduced and added up together, and whether it is in the cache.
    """

    key: GroupKey
    refs: tuple[ArchiveRef, ...]
    arms: Settings | None = None
    settings: Settings | None = None
    runs: list[tuple[Run, bool]] = field(default_factory=list)

    @property
    def consulted(self) -> tuple[ArchiveRef, ...]:
        """The archives that its settings depend on."""
        ordered = sorted(self.refs, key=lambda ref: ref.order)
        rest = [ref for ref in ordered if ref.use == "standstill"]
        fitted = [ref for ref in ordered if ref.use == "excitation"]
        return (*rest, *fitted[: 1 if self.arms is not None and rest else MOST_READ])

    @property
    def ready(self) -> Settings:
        """The settings, once they are decided."""
        assert self.settings is not None
        return self.settings

    @property
    def reduced(self) -> list[ArchiveRef]:
        """Archives that are reduced: all but those at standstill."""
        return [ref for ref in self.refs if ref.use != "standstill"]


class _Batch:
    """One run: gives out work, and estimates arm by arm with few bundles in memory at a time."""

    def __init__(self, plan: Plan, workers: Workers, where: Where, reporter: Reporter) -> None:
        self._plan, self._options, self._where = plan, plan.options, where
        self._workers, self._reporter = workers, reporter
        self._task: Task | None = None
        self._stream: Iterator[Any] = iter(())
        self.broken: list[Broken] = []
        self._read = self._cached = 0
        self._arms: dict[str, Arm] = {}
        self._repetitions: list[LevelEstimate] = []
        self._campaigns: list[LevelEstimate] = []
        self._pooled: list[LevelEstimate] = []

    def result(self, refs: Sequence[ArchiveRef], skipped: tuple[Broken, ...]) -> BatchResult:
        """Estimate everything."""
        found = [Campaign(key, tuple(own)) for key, own in groupby(refs, lambda ref: ref.key)]
        campaigns = self._with_settings(found)
        archives = sum(len(one.reduced) for one in campaigns)
        self._begin(campaigns)
        with self._reporter.task("reading archives and estimating", archives) as self._task:
            for digest, members in groupby(campaigns, lambda one: one.key.arm):
                self._arm(digest, list(members))
        self._task = None
        # The path stands in the reason of some as well.
        broken = tuple(
            dict.fromkeys(
                Broken(path, reason.removeprefix(f"{path}: ")) for path, reason in self.broken
            )
        )
        if not self._repetitions:
            raise _nothing_to_fit(broken)
        return BatchResult(
            estimator=self._plan.estimator,
            arms=self._arms,
            repetitions=tuple(self._repetitions),
            campaigns=tuple(self._campaigns),
            pooled=tuple(self._pooled),
            broken=broken,
            skipped=skipped,
            read=self._read,
            cached=self._cached,
            code=code_digest(),
        )

    # Settings

    def _with_settings(self, campaigns: Sequence[Campaign]) -> list[Campaign]:
        """Give each campaign its settings; returns those that have some.

        Those of an arm are decided on the first of its campaigns that can be read, and the others
        take them over with their own noise: comparisons in time need one law, and sums the same
        columns.
        """
        arms: dict[str, Settings] = {}
        waiting = list(campaigns)
        while waiting:
            first = {one.key.arm: one for one in reversed(waiting) if one.key.arm not in arms}
            asked = list(first.values()) or waiting
            waiting = [one for one in waiting if first and first.get(one.key.arm) is not one]
            while asked:
                asked = self._decide(asked, arms)
            arms |= {arm: one.settings for arm, one in first.items() if one.settings is not None}
        return [one for one in campaigns if one.settings is not None]

    def _decide(
        self, campaigns: Sequence[Campaign], arms: Mapping[str, Settings]
    ) -> list[Campaign]:
        """Decide settings; returns campaigns to be asked again, without what turned out broken."""
        for one in campaigns:
            one.arms = arms.get(one.key.arm)
            one.settings = _known_settings(one.consulted, self._options, one.arms, self._where)
        left = [one for one in campaigns if one.settings is None]
        tasks = [
            ArchiveTask(
                one.key.campaign, decided, (one.consulted, self._options, one.arms, self._where)
            )
            for one in left
        ]
        again = []
        for one, found in zip(left, self._results(tasks, "deciding settings"), strict=True):
            count = len(one.refs)
            if isinstance(found, Broken):
                broken = self._unusable(
                    one.consulted,
                    [ArchiveTask(ref.location, opened_alone, (ref,)) for ref in one.consulted],
                    "opening archives one by one",
                )
                reason = found.reason
            else:
                one.settings, broken = found.settings, [*found.broken]
                self.broken += broken
                reason = "none of its archives says how it is to be read"
                reason = reason if one.consulted else "it holds no excitation"
            paths = {each.path for each in broken}
            one.refs = tuple(ref for ref in one.refs if ref.location not in paths)
            if one.settings is not None:
                continue
            if 0 < len(one.refs) < count:
                again.append(one)
            elif one.refs or isinstance(found, Broken):
                self.broken.append(Broken(one.key.campaign, reason))
        return again

    def _unusable(
        self, refs: Sequence[ArchiveRef], tasks: Sequence[ArchiveTask[Any]], title: str
    ) -> list[Broken]:
        """Those of archives with which a task alone fails, or ends its process."""
        pairs = zip(refs, self._results(tasks, title), strict=True)
        broken = [Broken(ref.location, one.reason) for ref, one in pairs if _is_broken(one)]
        self.broken += broken
        return broken

    # Factors

    def _begin(self, campaigns: Sequence[Campaign]) -> None:
        """Give out the work on archives; what the cache has is read here where that can be seen."""
        every = [bundles(one.reduced) for one in campaigns]
        many = sum(map(len, every)) >= FAN_IN * _MANY * self._workers.count
        size = 1 if self._workers.near or not many else FAN_IN
        tasks = []
        for one, own in zip(campaigns, every, strict=True):
            for k in range(0, len(own), size):
                run = own[k : k + size]
                known = self._workers.near and is_cached(run[0], one.ready, self._where)
                one.runs.append((run, known))
                tasks += [] if known else [self._reducing(one, run)]
        archives = sum(len(refs) for task in tasks for refs in task.arguments[0])
        share = archives / max(1, len(tasks))
        self._stream = self._workers.results(tasks, lambda count: self._advance(share * count))

    def _reducing(self, one: Campaign, run: Run) -> ArchiveTask[Any]:
        arguments = run, one.ready, self._where
        return ArchiveTask(run[0][0].location, added_up, arguments, len(run))

    def _collected(self, one: Campaign, sums: TreeSum[PhaseFactor]) -> Iterator[Bundle]:
        """The bundles of a campaign in turn, added up."""
        for run, in_cache in one.runs:
            bundle = cached(run[0], one.ready, self._where) if in_cache else None
            found: tuple[Bundle, ...]
            if bundle is not None:
                total, found = bundle.phase, (bundle,)
            else:  # or damaged
                again = self._workers.results([self._reducing(one, run)])
                result = next(again if in_cache else self._stream)
                total, found = self._without_crashes(one, run, result)
            if in_cache:
                self._advance(len(run[0]), one.key.campaign)
            sums.add(total, 0 if len(run) == 1 else 1)
            yield from found

    def _without_crashes(
        self, one: Campaign, run: Run, result: Any
    ) -> tuple[PhaseFactor | None, tuple[Bundle, ...]]:
        """The sum of bundles; again without the archives that ended their process."""
        for _ in range(_ROUNDS):
            if not isinstance(result, Broken):
                break
            refs = [ref for own in run for ref in own]
            title = f"reading {refs[0].name} and others one by one"
            alone = [self._reducing(one, [(ref,)]) for ref in refs]
            paths = {each.path for each in self._unusable(refs, alone, title)}
            run = [tuple(ref for ref in own if ref.location not in paths) for own in run]
            run = [own for own in run if own]
            if not run:
                return None, ()
            (result,) = self._workers.results([self._reducing(one, run)])
        if isinstance(result, Broken):
            self.broken += [Broken(ref.location, result.reason) for own in run for ref in own]
            return None, ()
        total, found = result
        return total, found

    def _results(self, tasks: Sequence[ArchiveTask[T]], title: str) -> Iterator[T | Broken]:
        """What comes of tasks; at most one bar of progress is shown."""
        if not tasks or self._task is not None:
            self._advance(0, title)
            yield from self._workers.results(tasks)
            return
        with self._reporter.task(title, len(tasks)) as progress:
            found = list(self._workers.results(tasks, progress.advance))
        yield from found

    def _advance(self, units: float, note: str = "") -> None:
        if self._task is not None:
            self._task.advance(units, note)

    # Estimates

    def _arm(self, digest: str, members: Sequence[Campaign]) -> None:
        """Campaigns of one arm, and all of them together."""
        settings = members[0].ready
        arm = Arm(digest, settings.law(self._cell(members[0].refs[0])))
        self._arms[digest] = arm
        if self._plan.estimator == "prior":
            _require_one_belief(members)
        estimator = Estimator(self._plan.estimator, arm.cell, settings)
        everything, sums = Group(), TreeSum[PhaseFactor]()
        levels: list[LevelEstimate] = []
        for one in members:
            group, phase, found = self._campaign(one, estimator)
            levels += found
            if phase is not None:
                sums.add(phase)
                everything.add(group)
        self._campaigns += levels
        whole, keys = sums.result(), {ref.key for ref in everything.refs}
        if len(keys) == 1:
            self._pooled += [
                replace(one, level="pooled", campaign="", payload=None) for one in levels
            ]
        elif whole is not None:
            with self._failing(f"arm {digest[:8]}"):
                centre, apart = estimator.centre(whole), _setups(keys)
                self._pooled.append(
                    sum_level("pooled", estimator, everything, whole, centre, apart)
                )

    def _campaign(
        self, one: Campaign, estimator: Estimator
    ) -> tuple[Group, PhaseFactor | None, list[LevelEstimate]]:
        """Archives of one campaign, the sum of those that are fitted, and the estimate if any."""
        used = settings_digest(one.ready)
        group, sums = Group(settings={used}), TreeSum[PhaseFactor]()
        waiting: list[Summary] = []  # for the centre of all; of very many archives if need be only
        for bundle in self._collected(one, sums):
            self.broken += bundle.broken
            self._read += bundle.read
            self._cached += len(bundle.refs) - bundle.read
            for summary in bundle.summaries:
                group.add_archive(summary)
                if summary.ref.use == "excitation" and estimator.shrinks:
                    waiting.append(summary)
                elif summary.ref.use == "excitation":
                    group.repetitions.append(repetition_level(estimator, summary, used))
        phase = sums.result()
        levels: list[LevelEstimate] = []
        if phase is None:
            return group, None, levels
        with self._failing(one.key.campaign):
            centre = estimator.centre(phase)
            group.repetitions += [
                repetition_level(estimator, summary, used, centre) for summary in waiting
            ]
            payload = self._cell(group.refs[0]).model.payload
            stated = payload if payload is not None and payload.parameters.any() else None
            levels.append(sum_level("campaign", estimator, group, phase, centre, (), stated))
        self._repetitions += group.repetitions
        return group, phase, levels

    @contextmanager
    def _failing(self, name: str) -> Iterator[None]:
        """What cannot be estimated is reported with the reason, and costs nothing else."""
        try:
            yield
        except IdentificationError as error:
            self.broken.append(Broken(name, str(error)))

    def _cell(self, ref: ArchiveRef) -> Cell:
        """The cell of an archive."""
        texts = self._where.store(ref.location).get(ref.cell, list)
        if texts is not None and json_digest(texts) == ref.cell:
            return cell_from(*texts)
        with opened(ref) as archive:
            return cell_in(archive)


def _is_broken(found: object) -> bool:
    return isinstance(found, Broken)


def _nothing_to_fit(broken: Sequence[Broken]) -> NothingToFitError:
    problem = "there is no excitation and no imported recording that can be fitted"
    if broken:
        path, reason = broken[0]
        problem += (
            f"; {path} could not be used: {reason}"
            if len(broken) == 1
            else f"; {len(broken)} could not be used, the first of them {path}: {reason}"
        )
    return NothingToFitError(None, problem)


def _setups(keys: Collection[GroupKey]) -> list[str]:
    """What is to be known of campaigns whose cells state different things."""
    counts = Counter(key.setup for key in keys)
    if len(counts) < 2:
        return []
    stated = "; ".join(
        f"{setup or 'nothing'} ({plural(count, 'campaign')})"
        for setup, count in sorted(counts.items())
    )
    return [
        f"pooled over campaigns whose cells state different things, known and compensated: {stated}"
    ]


def _require_one_belief(members: Sequence[Campaign]) -> None:
    """One prior serves all campaigns of an arm, so their cells must state the same one."""
    first, *others = (ref for one in members for ref in one.refs)
    for ref in others:
        if ref.belief != first.belief:
            raise InputError(
                ref.location,
                f"its cell states another [nominal] than that of {first.location}, of the same arm",
                field="--estimator prior",
                remedy="name their folders apart, or use --estimator wls",
            )
