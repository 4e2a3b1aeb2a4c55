"""The batch: find archives, decide settings, reduce archives to factors, add and estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, TypeVar, cast, get_args

from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import Options
from hil.identify.settings import Settings
from hil.progress import Reporter
from identification import IdentificationError

from . import factors
from .cache import CacheLocation, code_digest, settings_digest
from .discovery import discover
from .estimates import Estimator, Group, repetition_level, sum_level
from .types import (
    ArchiveRef,
    Arm,
    BatchEstimator,
    BatchResult,
    Bundle,
    GroupKey,
    LevelEstimate,
    Summary,
    Unused,
)
from .workers import ArchiveTask, Workers

T = TypeVar("T")
Advance = Callable[[float, str], None]


def reidentify(
    roots: Sequence[str],
    options: Options,
    workers: Workers,
    reporter: Reporter,
    *,
    cache: CacheLocation = CacheLocation(),  # noqa: B008 - frozen
    check: Callable[[Sequence[ArchiveRef]], None] = lambda _: None,
) -> BatchResult:
    """Identify every arm from all its archives: by repetition, by campaign, and pooled.

    The numbers are those of `hil identify` on the archives of a campaign with the same held out.
    They depend neither on the order in which archives are found nor on the workers.

    The roots are folders or archives. A single recording is never split. `check` receives the
    archives found, before samples are read, and may raise.

    Raises:
        InputError: a place does not exist, no archive can be fitted, or the estimator is not one of
            a batch.
        CacheError: the cache cannot be written.
    """
    if options.estimator not in (known := get_args(BatchEstimator)):
        problem, remedy = f"{options.estimator!r} reads samples", f"use {', '.join(known)}"
        raise InputError(None, problem, field="estimator", remedy=remedy)
    found = discover(roots, cache, workers, reporter)
    check(found.refs)
    batch = _Batch(options, workers, cache, reporter, [*found.broken])
    campaigns = batch.with_settings(
        [_Campaign(key, list(own)) for key, own in groupby(found.refs, lambda ref: ref.key)]
    )
    return batch.result(campaigns, found.skipped)


@dataclass(eq=False)
class _Campaign:
    """Archives of one group in progress."""

    key: GroupKey
    refs: list[ArchiveRef]
    settings: Settings | None = None  #: None until decided
    #: archives of each bundle, and whether it is in the cache
    bundles: list[tuple[tuple[ArchiveRef, ...], bool]] = field(default_factory=list)

    @property
    def ready(self) -> Settings:
        """The decided settings."""
        assert self.settings is not None
        return self.settings


@dataclass(eq=False)
class _Batch:
    """State of a batch; estimates arm by arm with few bundles in memory at a time."""

    options: Options
    workers: Workers
    cache: CacheLocation
    reporter: Reporter
    broken: list[Unused]
    read: int = 0
    cached: int = 0
    stream: Iterator[Any] = field(default_factory=lambda: iter(()))

    # Settings

    def with_settings(self, campaigns: Sequence[_Campaign]) -> list[_Campaign]:
        """Decide the settings of campaigns; return those that have some.

        Those of an arm are decided on its first readable campaign; the others use them with their
        own noise: comparisons need one friction law, and sums the same columns.
        """
        arms: dict[str, Settings] = {}
        waiting = list(campaigns)
        while waiting:
            first = {one.key.arm: one for one in reversed(waiting) if one.key.arm not in arms}
            asked = list(first.values()) or waiting
            waiting = [one for one in waiting if one not in asked]
            while asked:
                asked = self._decide(asked, arms)
            arms |= {arm: one.settings for arm, one in first.items() if one.settings is not None}
        return [one for one in campaigns if one.settings is not None]

    def _decide(self, campaigns: Sequence[_Campaign], arms: dict[str, Settings]) -> list[_Campaign]:
        """Decide settings; return the campaigns to repeat without archives that are unusable."""
        asked = []
        for one in campaigns:
            own = arms.get(one.key.arm)
            refs = factors.archives_for_settings(one.refs, own)
            one.settings = factors.cached_settings(refs, self.options, own, self.cache)
            if one.settings is None:
                asked.append((one, (refs, self.options, own, self.cache)))
        tasks = [ArchiveTask(c.key.campaign, factors.decide_settings, own) for c, own in asked]
        again = []
        results = self._results(tasks, "deciding settings")
        for (one, (refs, *_)), found in zip(asked, results, strict=True):
            if isinstance(found, Unused):  # perhaps an archive ends its process
                alone = [ArchiveTask(ref.location, factors.open_only, (ref,)) for ref in refs]
                opened = self._results(alone, "opening archives one by one")
                broken, reason = [other for other in opened if other is not None], found.reason
            else:
                one.settings, broken = found
                some = any(ref.use == "excitation" for ref in refs)
                reason = "" if some else "it holds no excitation"
            self.broken += broken
            paths = {other.path for other in broken}
            one.refs = [ref for ref in one.refs if ref.location not in paths]
            if one.settings is None and broken and one.refs:
                again.append(one)
            elif one.settings is None and reason:
                self.broken.append(Unused(one.key.campaign, reason))
        return again

    def _results(self, tasks: Sequence[ArchiveTask[T]], title: str) -> list[T | Unused]:
        if not tasks:
            return []
        with self.reporter.task(title, len(tasks)) as progress:
            return list(self.workers.results(tasks, progress.advance))

    # Factors

    def _reducing(self, one: _Campaign, refs: tuple[ArchiveRef, ...]) -> ArchiveTask[Bundle]:
        return ArchiveTask(refs[0].location, factors.reduce_bundle, (refs, one.ready, self.cache))

    def _reduced(self, one: _Campaign) -> Iterator[Bundle]:
        """Yield the bundles of a campaign; one that ends its process is repeated by archive."""
        for refs, known in one.bundles:
            found: Any = (
                factors.cached_bundle(refs, one.ready, self.cache) if known else next(self.stream)
            )
            if found is None:  # damaged
                (found,) = self.workers.results([self._reducing(one, refs)])
            if isinstance(found, Bundle):
                yield found
                continue
            alone = [self._reducing(one, (ref,)) for ref in refs]
            for own in self.workers.results(alone):
                yield Bundle(broken=(own,), read=1) if isinstance(own, Unused) else own

    # Estimates

    def result(self, campaigns: Sequence[_Campaign], skipped: tuple[Unused, ...]) -> BatchResult:
        """Reduce and estimate everything; local cache entries are read in this process."""
        tasks = []
        for one in campaigns:
            for refs in factors.split_bundles([ref for ref in one.refs if ref.use != "standstill"]):
                known = self.workers.local and factors.is_cached(refs, one.ready, self.cache)
                one.bundles.append((refs, known))
                tasks += [] if known else [self._reducing(one, refs)]
        self.stream = self.workers.results(tasks)
        arms: dict[str, Arm] = {}
        levels: list[LevelEstimate] = []
        archives = sum(len(refs) for one in campaigns for refs, _ in one.bundles)
        with self.reporter.task("reading archives and estimating", archives) as progress:
            for digest, own in groupby(campaigns, lambda one: one.key.arm):
                members = list(own)
                cell = members[0].ready.with_friction_law(self._cell(members[0].refs[0]))
                arms[digest] = Arm(digest, cell)
                levels += self._arm(arms[digest], members, progress.advance)
        # Some reasons begin with the path.
        reasons = (Unused(path, text.removeprefix(f"{path}: ")) for path, text in self.broken)
        broken = tuple(dict.fromkeys(reasons))
        found = {
            level: tuple(one for one in levels if one.level == level)
            for level in ("repetition", "campaign", "pooled")
        }
        if not found["repetition"]:
            problem = "there is no excitation and no imported recording that can be fitted"
            first = [f"{path} could not be used: {reason}" for path, reason in broken[:1]]
            raise InputError(None, "; ".join([problem, *first]))
        return BatchResult(
            estimator=self.options.estimator,
            arms=arms,
            repetitions=found["repetition"],
            campaigns=found["campaign"],
            pooled=found["pooled"],
            broken=broken,
            skipped=skipped,
            read=self.read,
            cached=self.cached,
            code=code_digest(),
        )

    def _arm(self, arm: Arm, members: Sequence[_Campaign], advance: Advance) -> list[LevelEstimate]:
        """Return the estimates of an arm: repetitions, campaigns, and the pooled one."""
        name = cast(BatchEstimator, self.options.estimator)
        estimator = Estimator(name, arm.cell.model, members[0].ready)
        everything, campaigns = Group(), list[LevelEstimate]()
        for one in members:
            group, found = self._campaign(one, estimator, advance)
            campaigns += found
            if group.total is not None:
                everything.add(group)
        levels = [*everything.repetitions, *campaigns]
        keys = {ref.key for ref in everything.refs}
        if len(keys) == 1:
            levels += [replace(one, level="pooled", campaign="") for one in campaigns]
        elif everything.total is not None:
            setups = sorted({key.setup or "nothing" for key in keys})
            text = "pooled over campaigns whose cells state different payloads or delays, which are"
            apart = [f"{text} compensated: {'; '.join(setups)}"] if len(setups) > 1 else []
            with self._failing(f"arm {arm.digest[:8]}"):
                centre = estimator.centre(everything.total)
                levels.append(sum_level("pooled", estimator, everything, centre, apart))
        return levels

    def _campaign(
        self, one: _Campaign, estimator: Estimator, advance: Advance
    ) -> tuple[Group, list[LevelEstimate]]:
        """Return the group of a campaign with its repetitions, and its estimate if any."""
        used = settings_digest(one.ready)
        group, summaries = Group(settings={used}), list[Summary]()
        for bundle in self._reduced(one):
            self.broken += bundle.broken
            self.read += bundle.read
            self.cached += bundle.cached
            group.add_bundle(bundle)
            summaries += [each for each in bundle.summaries if each.ref.use == "excitation"]
            advance(bundle.read + bundle.cached, one.key.campaign)
        levels: list[LevelEstimate] = []
        if group.total is not None:
            with self._failing(one.key.campaign):
                centre = estimator.centre(group.total)
                group.repetitions = [
                    repetition_level(estimator, each, used, centre) for each in summaries
                ]
                levels.append(sum_level("campaign", estimator, group, centre))
        return group, levels

    @contextmanager
    def _failing(self, name: str) -> Iterator[None]:
        """Report a failed estimate with its reason, and continue."""
        try:
            yield
        except IdentificationError as error:
            self.broken.append(Unused(name, str(error)))

    def _cell(self, ref: ArchiveRef) -> Cell:
        """Return the cell of an archive."""
        texts = self.cache.store(ref.location).get(ref.cell, list)
        if texts is None:
            return factors.cell_in(factors.open_ref(ref))
        return factors.cell_from(*texts)
