"""The work on archives: settling campaigns, reducing bundles, and whatever goes wrong in that."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from hil.errors import HilError
from hil.identify.options import Options
from hil.identify.settings import Settings
from hil.progress import Reporter, Task
from identification import IdentificationError
from identification.factor.phases import PhaseFactor

from .cache import Where
from .errors import CacheError
from .factors import opened, without_sum
from .keeping import bundle_with_cache, bundles, is_kept, kept_bundle
from .on_workers import ArchiveTask, Part, Summed
from .settings import Settled, consulted, known_settings, settle
from .tree_sum import TreeSum
from .types import ArchiveRef, Broken, Bundle, GroupKey
from .workers import Workers


class Done(NamedTuple):
    """What came of a bundle.

    Attributes:
        read: archives that had to be read.
        bundle: itself, where it was not kept; None where it was.
    """

    read: int
    bundle: Bundle | None


def bundle_kept(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Part[None, Done]:
    """Reduce a bundle where what is kept can be seen by whoever asks."""
    found = bundle_with_cache(refs, settings, where)
    return Part(None, Done(found.read, None if found.bundle.lasting else found.bundle))


def bundle_sent(
    refs: Sequence[ArchiveRef], settings: Settings, where: Where
) -> Part[PhaseFactor, Done]:
    """Reduce a bundle where whoever asks sees nothing of what is kept; the sum is added up."""
    found = bundle_with_cache(refs, settings, where)
    return Part(found.bundle.phase, Done(found.read, without_sum(found.bundle)))


def campaign_settled(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, where: Where
) -> Part[None, Settled]:
    """Settle a campaign."""
    return Part(None, settle(refs, options, arms, where))


def opened_once(ref: ArchiveRef) -> Part[None, Broken | None]:
    """Open an archive, to see whether that ends this process."""
    try:
        with opened(ref):
            return Part(None, None)
    except (HilError, IdentificationError) as error:
        return Part(None, Broken(ref.location, str(error)))


_ROUNDS: Final = 3
"""How often a campaign is added up far away before what still ends its process is left out."""


@dataclass(eq=False)
class Campaign:
    """Archives of one group on their way.

    Attributes:
        key: of the group.
        refs: archives, without those found to be broken.
        arms: settings of its arm; None where it decides on them.
        settings: None until they are settled.
        bundles: archives that are reduced together.
    """

    key: GroupKey
    refs: tuple[ArchiveRef, ...]
    arms: Settings | None = None
    settings: Settings | None = None
    bundles: list[tuple[ArchiveRef, ...]] = field(default_factory=list)

    @property
    def consulted(self) -> tuple[ArchiveRef, ...]:
        """The archives that its settings depend on."""
        return consulted(self.refs, self.arms)

    @property
    def ready(self) -> Settings:
        """The settings, once they are settled."""
        assert self.settings is not None
        return self.settings


class Collected:
    """Bundles of a campaign, one in memory at a time, and their sum when all have been seen."""

    def __init__(
        self, found: Iterator[Bundle], ended: Callable[[], None], total: PhaseFactor | None = None
    ) -> None:
        self._found, self._ended, self._total = found, ended, total
        self._sums = TreeSum[PhaseFactor]()

    def __iter__(self) -> Iterator[Bundle]:
        for bundle in self._found:
            self._sums.add(bundle.phase)
            yield bundle
        self._ended()

    @property
    def total(self) -> PhaseFactor | None:
        """The sum; None if nothing is fitted."""
        return self._sums.result() if self._total is None else self._total


class Work:
    """Hands out work and takes back what comes of it.

    Args:
        workers: who does it.
        options: how archives are read.
        where: results of single archives are kept.
        reporter: of progress.

    Attributes:
        broken: archives that could not be used, campaigns that could not be settled.
        read: archives that were read.
    """

    def __init__(
        self, workers: Workers, options: Options, where: Where, reporter: Reporter
    ) -> None:
        self.broken: list[Broken] = []
        self.read = 0
        self._workers, self._options = workers, options
        self._where, self._reporter = where, reporter
        self._loose: dict[tuple[ArchiveRef, ...], Bundle] = {}
        self._far_sums: Iterator[Summed[PhaseFactor, Done]] = iter(())
        self._task: Task | None = None

    def settle(self, campaigns: Sequence[Campaign]) -> list[Campaign]:
        """Give each campaign its settings; returns those that have some.

        Those of an arm are decided on the first of its campaigns that can be read.
        """
        arms: dict[str, Settings] = {}
        left = list(campaigns)
        while left:
            first = {one.key.arm: one for one in reversed(left) if one.key.arm not in arms}
            now = list(first.values()) or left
            self._settle_all(now, arms)
            arms |= {arm: one.settings for arm, one in first.items() if one.settings is not None}
            left = [one for one in left if first and first.get(one.key.arm) is not one]
        return [one for one in campaigns if one.settings is not None]

    def _settle_all(self, campaigns: Sequence[Campaign], arms: Mapping[str, Settings]) -> None:
        """Settle campaigns, those of decided arms by their settings.

        A campaign is asked again as long as archives that it was asked for turn out to be broken.
        """
        for one in campaigns:
            one.arms = arms.get(one.key.arm)
            one.settings = known_settings(one.consulted, self._options, one.arms, self._where)
        left = [one for one in campaigns if one.settings is None]
        while left:
            tasks = [
                ArchiveTask(
                    one.key.campaign,
                    campaign_settled,
                    (one.consulted, self._options, one.arms, self._where),
                )
                for one in left
            ]
            notes = self._ask(tasks, "settling campaigns")
            again = []
            for one, note in zip(left, notes, strict=True):
                settled, count = isinstance(note, Settled), len(one.refs)
                one.settings = note.settings if settled else None
                self._drop(one, note.broken if settled else self._unreadable(one.consulted))
                if one.settings is None and one.refs and len(one.refs) < count:
                    again.append(one)
                elif one.settings is None and (one.refs or not settled):
                    reason = _why_not_settled(one) if settled else note.reason
                    self.broken.append(Broken(one.key.campaign, reason))
            left = again

    def reduce(self, campaigns: Sequence[Campaign]) -> None:
        """Have all bundles of the campaigns reduced and kept.

        Where that cannot be seen here the work only begins, and campaigns are to be collected in
        the same order.
        """
        for one in campaigns:
            one.bundles = bundles([ref for ref in one.refs if ref.use != "standstill"])
        if not self._workers.near:
            tasks = [[self._reduction(one, refs) for refs in one.bundles] for one in campaigns]
            share = _archives(campaigns) / max(1, sum(map(len, tasks)))
            self._far_sums = self._workers.sums_in_turn(
                tasks, operator.add, done=lambda count: self._advance(share * count)
            )
            return
        missing = []
        for one in campaigns:
            missing += [
                (one, k)
                for k, refs in enumerate(one.bundles)
                if not is_kept(refs, one.ready, self._where)
            ]
        notes = self._ask(
            [self._reduction(one, one.bundles[k]) for one, k in missing],
            "reading archives",
            sum(len(one.bundles[k]) for one, k in missing),
        )
        for (one, k), note in zip(missing, notes, strict=True):
            if isinstance(note, Done):
                self._take(one.bundles[k], note)
            else:
                one.bundles[k] = self._one_by_one(one, one.bundles[k])

    @contextmanager
    def collecting(self, campaigns: Sequence[Campaign]) -> Iterator[None]:
        """Report how far all of them are collected; where work is far away, how far it is."""
        near = self._workers.near
        title = "estimating" if near else "reading archives and estimating"
        total = len(campaigns) if near else _archives(campaigns)
        with self._reporter.task(title, total) as self._task:
            try:
                yield
            finally:
                self._task = None

    def collected(self, one: Campaign) -> Collected:
        """The bundles of a campaign, once it is settled and reduced."""
        if not self._workers.near:
            return self._far(one, next(self._far_sums))
        found = (self._bundle(one, refs) for refs in one.bundles)
        return Collected(found, lambda: self._advance(1, one.key.campaign))

    def _one_by_one(self, one: Campaign, refs: Sequence[ArchiveRef]) -> tuple[ArchiveRef, ...]:
        """Reduce a bundle that ended its process archive by archive; returns those that do not."""
        good: tuple[ArchiveRef, ...] = ()
        for ref in refs:
            longer = (*good, ref)
            (note,) = self._ask([self._reduction(one, longer)], f"reading {ref.name} by itself")
            if isinstance(note, Done):
                self._loose.pop(good, None)
                self._take(longer, note)
                good = longer
            else:
                self.broken.append(Broken(ref.location, note.reason))
        return good

    def _bundle(self, one: Campaign, refs: tuple[ArchiveRef, ...]) -> Bundle:
        """What was kept of a bundle; read anew where that is damaged."""
        if not refs:
            return Bundle((), (), None)
        found = self._loose.pop(refs, None) or kept_bundle(refs, one.ready, self._where)
        if found is not None:
            return found
        (note,) = self._ask([self._reduction(one, refs)], f"reading {refs[0].name} again")
        if isinstance(note, Done):
            self._take(refs, note)
        else:
            refs = self._one_by_one(one, refs)
        found = self._loose.pop(refs, None) or kept_bundle(refs, one.ready, self._where)
        if found is None:
            raise CacheError(
                one.key.campaign, "what was kept of it vanished", remedy="run the batch again"
            )
        return found

    def _far(self, one: Campaign, found: Summed[PhaseFactor, Done]) -> Collected:
        """A campaign reduced and added up where its archives are; again without what crashed."""
        for attempt in range(_ROUNDS):
            crashed = {k: note for k, note in enumerate(found.notes) if isinstance(note, Broken)}
            if not crashed:
                break
            for k, note in crashed.items():
                if attempt == _ROUNDS - 1:
                    self.broken += [Broken(ref.location, note.reason) for ref in one.bundles[k]]
                else:
                    one.bundles[k] = self._one_by_one(one, one.bundles[k])
            one.bundles = [refs for refs in one.bundles if refs]
            if attempt < _ROUNDS - 1:
                tasks = [self._reduction(one, refs) for refs in one.bundles]
                (found,) = self._workers.sums([tasks], operator.add)
        notes = [note for note in found.notes if isinstance(note, Done)]
        self.read += sum(note.read for note in notes)
        without_sums = (note.bundle for note in notes if note.bundle is not None)
        return Collected(without_sums, lambda: self._advance(0, one.key.campaign), found.total)

    def _reduction(self, one: Campaign, refs: tuple[ArchiveRef, ...]) -> ArchiveTask[Any, Done]:
        function = bundle_kept if self._workers.near else bundle_sent
        return ArchiveTask(refs[0].location, function, (refs, one.ready, self._where))

    def _take(self, refs: tuple[ArchiveRef, ...], done: Done) -> None:
        if self._workers.near:
            self.read += done.read
            if done.bundle is not None:
                self._loose[refs] = done.bundle

    def _unreadable(self, refs: Sequence[ArchiveRef]) -> list[Broken]:
        """Those that cannot be opened, or end the process that does."""
        tasks = [ArchiveTask(ref.location, opened_once, (ref,)) for ref in refs]
        notes = self._ask(tasks, "opening archives one by one")
        return [note for note in notes if isinstance(note, Broken)]

    def _drop(self, one: Campaign, broken: Sequence[Broken]) -> None:
        paths = {each.path for each in broken}
        self.broken += broken
        one.refs = tuple(ref for ref in one.refs if ref.location not in paths)

    def _ask(
        self, tasks: Sequence[ArchiveTask[Any, Any]], title: str, total: float | None = None
    ) -> list[Any]:
        """The notes of tasks, each by itself."""
        if not tasks:
            return []
        groups = [[one] for one in tasks]
        if self._task is not None:  # one bar at a time
            self._advance(0, title)
            return [one.notes[0] for one in self._workers.sums(groups, operator.add)]
        share = (total or len(tasks)) / len(tasks)
        with self._reporter.task(title, total or len(tasks)) as progress:
            found = self._workers.sums(
                groups, operator.add, done=lambda count: progress.advance(share * count)
            )
        return [one.notes[0] for one in found]

    def _advance(self, units: float, note: str = "") -> None:
        if self._task is not None:
            self._task.advance(units, note)


def _why_not_settled(one: Campaign) -> str:
    if one.consulted:
        return "none of its archives says how it is to be read"
    return "it holds no excitation"


def _archives(campaigns: Sequence[Campaign]) -> int:
    """How many archives of them are reduced."""
    return sum(len(refs) for one in campaigns for refs in one.bundles)
