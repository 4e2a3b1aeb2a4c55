"""The whole batch: found, settled, reduced, added up, estimated."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import cast

from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import Options
from hil.progress import Reporter
from identification import IdentificationError
from identification.factor.phases import PhaseFactor
from identification.model.payload import Payload

from .cache import Where
from .discovery import discover
from .errors import NothingToFitError
from .estimates import Estimator, Together, plus, repetition_level, sum_level
from .factors import cell_from, cell_in, opened
from .keys import code_digest, settings_digest
from .tree_sum import TreeSum
from .types import (
    ESTIMATORS,
    ArchiveRef,
    Arm,
    BatchEstimator,
    BatchResult,
    Broken,
    GroupKey,
    LevelEstimate,
    Summary,
)
from .work import Campaign, Work
from .workers import Workers


@dataclass(frozen=True)
class Plan:
    """How a batch is run.

    Attributes:
        options: as of `hil identify`, with an estimator that needs no sample; a single recording is
            never split.
        cache: folder for what is kept; None: beside the archives.
        keep: whether anything is kept at all.
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
        CacheError: nothing can be kept where it should be.
    """
    with _kept(plan) as where:
        found = discover(roots, where, workers, reporter)
        check(found.refs)
        work = Work(workers, plan.options, where, reporter)
        work.broken += found.broken
        campaigns = [
            Campaign(key, tuple(refs)) for key, refs in groupby(found.refs, lambda ref: ref.key)
        ]
        campaigns = work.settle(campaigns)
        work.reduce(campaigns)
        return _Estimates(plan, work, where).result(campaigns, found.skipped)


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

    def result(self, campaigns: Sequence[Campaign], skipped: tuple[Broken, ...]) -> BatchResult:
        """Estimate everything."""
        with self._work.collecting(campaigns):
            for digest, members in groupby(campaigns, lambda one: one.key.arm):
                self._arm(digest, list(members))
        if not self._repetitions:
            raise self._nothing()
        return BatchResult(
            estimator=self._plan.estimator,
            arms=self._arms,
            repetitions=tuple(self._repetitions),
            campaigns=tuple(self._campaigns),
            pooled=tuple(self._pooled),
            broken=tuple(dict.fromkeys(map(_once, self._work.broken))),
            skipped=skipped,
            read=self._work.read,
            cached=sum(len(refs) for one in campaigns for refs in one.bundles) - self._work.read,
            code=code_digest(),
        )

    def _arm(self, digest: str, members: Sequence[Campaign]) -> None:
        """Campaigns of one arm, and all of them together."""
        settings = members[0].ready
        self._arms[digest] = Arm(digest, settings.law(self._cell(members[0].refs[0])))
        if self._plan.estimator == "prior":
            _require_one_belief(members)
        estimator = Estimator(self._plan.estimator, self._arms[digest].cell, settings)
        everything, sums = Together(), TreeSum[PhaseFactor]()
        levels: list[LevelEstimate] = []
        for one in members:
            together, phase, found = self._campaign(one, estimator)
            levels += found
            if phase is not None:
                sums.add(phase)
                everything.add(together)
        self._campaigns += levels
        whole, keys = sums.result(), {ref.key for ref in everything.refs}
        if len(keys) == 1:
            self._pooled += [
                replace(one, level="pooled", campaign="", payload=None) for one in levels
            ]
        elif whole is not None:
            with self._failing(f"arm {digest[:8]}"):
                centre = estimator.centre(whole)
                self._pooled.append(
                    sum_level("pooled", estimator, everything, whole, centre, _setups(keys))
                )

    def _campaign(
        self, one: Campaign, estimator: Estimator
    ) -> tuple[Together, PhaseFactor | None, list[LevelEstimate]]:
        """Archives of one campaign, the sum of those that are fitted, and the estimate if any."""
        together, used = Together(), settings_digest(one.ready)
        together.settings.add(used)
        waiting: list[Summary] = []  # for the centre of all; of very many archives if need be only
        collected = self._work.collected(one)
        for bundle in collected:
            self._work.broken += bundle.broken
            for summary in bundle.summaries:
                together.doubts.note(summary)
                if summary.ref.use == "excitation":
                    if estimator.draws:
                        waiting.append(summary)
                    else:
                        together.repetitions.append(repetition_level(estimator, summary, used))
                    together.refs.append(summary.ref)
                    together.products = plus(together.products, summary.products)
                else:
                    together.unseen = plus(together.unseen, summary.total)
        phase = collected.total
        levels: list[LevelEstimate] = []
        if phase is None:
            return together, None, levels
        with self._failing(one.key.campaign):
            centre = estimator.centre(phase)
            together.repetitions += [
                repetition_level(estimator, summary, used, centre) for summary in waiting
            ]
            payload = _carried(self._cell(together.refs[0]))
            levels.append(
                sum_level("campaign", estimator, together, phase, centre, payload=payload)
            )
        self._repetitions += together.repetitions
        return together, phase, levels

    @contextmanager
    def _failing(self, name: str) -> Iterator[None]:
        """What cannot be estimated is listed with the reason, and costs nothing else."""
        try:
            yield
        except IdentificationError as error:
            self._work.broken.append(Broken(name, str(error)))

    def _cell(self, ref: ArchiveRef) -> Cell:
        """The cell of an archive."""
        kept = self._where.store(ref.location).get(ref.cell)
        texts = [] if kept is None else [kept.header.get(n) for n in ("cell.toml", "robot.urdf")]
        if texts and all(isinstance(text, str) for text in texts):
            return cell_from(*texts)
        with opened(ref) as archive:
            return cell_in(archive)

    def _nothing(self) -> NothingToFitError:
        problem = "there is no excitation and no imported recording that can be fitted"
        broken = list(dict.fromkeys(map(_once, self._work.broken)))
        if broken:
            path, reason = broken[0]
            problem += (
                f"; {path} could not be used: {reason}"
                if len(broken) == 1
                else f"; {len(broken)} could not be used, the first of them {path}: {reason}"
            )
        return NothingToFitError(None, problem)


def _once(one: Broken) -> Broken:
    """Without the path in the reason, where it stands already."""
    return Broken(one.path, one.reason.removeprefix(f"{one.path}: "))


def _carried(cell: Cell) -> Payload | None:
    """The payload that a cell states; None for one of no weight and inertia."""
    payload = cell.model.payload
    return payload if payload is not None and payload.parameters.any() else None


def _setups(keys: Collection[GroupKey]) -> list[str]:
    """What is to be known of campaigns whose cells state different things."""
    counts = Counter(key.setup for key in keys)
    if len(counts) < 2:
        return []
    stated = "; ".join(
        f"{setup or 'nothing'} ({count} {'campaign' if count == 1 else 'campaigns'})"
        for setup, count in sorted(counts.items())
    )
    return [
        f"pooled over campaigns whose cells state different things, known and taken off: {stated}"
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
