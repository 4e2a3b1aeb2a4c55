"""The whole batch: found, settled, reduced, added up, estimated."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from hil.cell import Cell
from hil.progress import Reporter, Task
from identification import IdentificationError
from identification.phase_factor import PhaseFactor

from .cache import Where
from .discovery import discover
from .errors import NothingToFitError
from .estimates import Estimator, Unseen, repetition_level, sum_level
from .factors import cell_from, cell_in, opened
from .keys import code_digest, settings_digest
from .tree_sum import TreeSum
from .types import (
    ArchiveRef,
    Arm,
    BatchEstimator,
    BatchResult,
    Broken,
    Choices,
    Level,
    LevelEstimate,
)
from .work import Campaign, Work
from .workers import Workers


@dataclass(frozen=True)
class Plan:
    """How a batch is run.

    Attributes:
        estimator: by name.
        choices: of the preprocessing.
        cache: folder for what is kept; None: beside the archives.
        keep: whether anything is kept at all.
    """

    estimator: BatchEstimator = "wls"
    choices: Choices = Choices()  # noqa: RUF009 - frozen
    cache: Path | None = None
    keep: bool = True


def reidentify(
    roots: Sequence[str], plan: Plan, workers: Workers, reporter: Reporter, *, threads: int = 1
) -> BatchResult:
    """Identify every arm from all its archives: repetition by repetition, campaign, and pooled.

    The numbers are those of `hil identify` on the archives of a campaign. They do not depend on
    the order in which archives are found, nor on who computes what.

    Args:
        roots: folders, archives, or URLs of either.
        plan: how.
        workers: who does the work on archives.
        reporter: of progress.
        threads: that hash archives.

    Raises:
        NothingToFitError: there is not one archive that can be fitted.
        InputError: a place does not exist, or the estimator does not suit an arm.
        CacheError: nothing can be kept where it should be.
    """
    with _kept(plan) as where:
        found = discover(roots, where, threads=threads, reporter=reporter)
        work = Work(workers, plan.choices, where, reporter)
        work.broken += found.broken
        campaigns = [
            Campaign(key, tuple(refs)) for key, refs in groupby(found.refs, lambda ref: ref.key)
        ]
        campaigns = work.settle(campaigns)
        work.reduce(campaigns)
        return _Estimates(plan, work, where).result(campaigns, found.skipped, reporter)


@contextmanager
def _kept(plan: Plan) -> Iterator[Where]:
    """Where results of single archives are kept, if only as long as the batch runs."""
    if plan.keep:
        yield Where(None if plan.cache is None else str(plan.cache.resolve()))
        return
    with tempfile.TemporaryDirectory(prefix="hil-batch-") as folder:
        yield Where(folder)


class _Estimates:
    """What comes of the work, arm by arm, with one bundle in memory at a time."""

    def __init__(self, plan: Plan, work: Work, where: Where) -> None:
        self._plan, self._work, self._where = plan, work, where
        self._arms: dict[str, Arm] = {}
        self._repetitions: list[LevelEstimate] = []
        self._campaigns: list[LevelEstimate] = []
        self._pooled: list[LevelEstimate] = []

    def result(
        self, campaigns: Sequence[Campaign], skipped: tuple[Broken, ...], reporter: Reporter
    ) -> BatchResult:
        """Estimate everything."""
        with reporter.task("estimating", len(campaigns)) as task:
            for digest, members in groupby(campaigns, lambda one: one.key.arm):
                self._arm(digest, list(members), task)
        if not self._repetitions:
            raise self._nothing()
        return BatchResult(
            estimator=self._plan.estimator,
            arms=self._arms,
            repetitions=tuple(self._repetitions),
            campaigns=tuple(self._campaigns),
            pooled=tuple(self._pooled),
            broken=tuple(dict.fromkeys(self._work.broken)),
            skipped=skipped,
            read=self._work.read,
            cached=sum(len(refs) for one in campaigns for refs in one.bundles) - self._work.read,
            code=code_digest(),
        )

    def _arm(self, digest: str, members: Sequence[Campaign], task: Task) -> None:
        """Campaigns of one arm, and all of them together."""
        self._arms[digest] = Arm(digest, self._cell(members[0].refs[0]))
        estimator = Estimator(self._plan.estimator, self._arms[digest].cell)
        everything: list[ArchiveRef] = []
        sums, unseen, settings, levels = TreeSum[PhaseFactor](), Unseen(), set(), []
        for one in members:
            refs, phase, own = self._campaign(one, estimator)
            task.advance(1, one.key.campaign)
            if phase is None:
                continue
            used = settings_digest(one.ready)
            levels += self._level("campaign", estimator, refs, phase, own, used)
            sums.add(phase)
            settings.add(used)
            everything += refs
            unseen += own
        whole = sums.result()
        self._campaigns += levels
        if whole is None:
            return
        if len({ref.campaign for ref in everything}) == 1:
            self._pooled += [replace(one, level="pooled", campaign="") for one in levels]
            return
        used = settings.pop() if len(settings) == 1 else ""
        self._pooled += self._level("pooled", estimator, everything, whole, unseen, used)

    def _campaign(
        self, one: Campaign, estimator: Estimator
    ) -> tuple[list[ArchiveRef], PhaseFactor | None, Unseen]:
        """Archives of one campaign that are fitted, their sum, and what is predicted."""
        used = settings_digest(one.ready)
        refs: list[ArchiveRef] = []
        unseen = Unseen()
        collected = self._work.collected(one)
        for bundle in collected:
            self._work.broken += bundle.broken
            for summary in bundle.summaries:
                if summary.ref.use == "excitation":
                    refs.append(summary.ref)
                    self._repetitions.append(repetition_level(estimator, summary, used))
                else:
                    unseen += Unseen(summary.total)
        return refs, collected.total, unseen

    def _level(
        self,
        level: Level,
        estimator: Estimator,
        refs: Sequence[ArchiveRef],
        phase: PhaseFactor,
        unseen: Unseen,
        settings: str,
    ) -> list[LevelEstimate]:
        """The estimate from a sum; none, and the reason among what is broken, if it fails."""
        try:
            return [sum_level(level, estimator, refs, phase, unseen, settings)]
        except IdentificationError as error:
            name = refs[0].campaign if level == "campaign" else f"arm {refs[0].arm[:8]}"
            self._work.broken.append(Broken(name, str(error)))
            return []

    def _cell(self, ref: ArchiveRef) -> Cell:
        """The cell of an archive."""
        kept = self._where.store(ref.location).get(ref.cell)
        if kept is not None:
            return cell_from(kept.header["cell.toml"], kept.header["robot.urdf"])
        with opened(ref) as archive:
            return cell_in(archive)

    def _nothing(self) -> NothingToFitError:
        problem = "there is no excitation and no imported recording that can be fitted"
        broken = self._work.broken
        if broken:
            problem += f"; {len(broken)} archives are broken, such as {broken[0].path}"
            problem += f" ({broken[0].reason})"
        return NothingToFitError(None, problem)
