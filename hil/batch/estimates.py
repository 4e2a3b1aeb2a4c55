"""Estimates of a batch from reduced archives: by repetition, by campaign, and by arm."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.files import json_digest
from hil.cell import Cell
from hil.pipeline.estimating import fit_with_prior, posterior_of
from hil.pipeline.estimators import fit_of
from hil.pipeline.notes import Note, PoorlySeparated, UnrestrictedBodies
from identification import IdentificationError
from identification.estimators.consistent import SolverError
from identification.estimators.covariance import solve_with_prior
from identification.factor.estimate import Estimate
from identification.factor.factor import MAX_GRAM_CONDITION, Factor, require_rows
from identification.reduction.intervals import widened
from identification.reduction.posterior import Posterior
from identification.reduction.reduction import Reduction
from identification.selection.settings import Settings

from .archive_discovery import ArchiveRef, cell_from
from .archive_reduction import (
    ReducedArchives,
    Summary,
    ToReduce,
    added,
    packed_estimates,
    plus,
    reduce_archives,
    settings_digest,
    unpacked_estimates,
)
from .cache import Arrays, CacheLocation, code_digest
from .cluster import SkippedArchive
from .notes import DifferentSetups, MoreNotes, OfSomeArchives
from .setup import NO_SETUP, Setup

Level = Literal["repetition", "campaign", "pooled", "siblings"]
BatchEstimator = Literal["auto", "wls", "consistent"]
"""Estimators that need factors only, and no samples."""

_MAX_SHOWN_WARNINGS: Final = 12  # different warnings that are listed


@dataclass(frozen=True, eq=False)
class BatchArm:
    """A robot by its digest, see :class:`GroupKey`, with one of its cells."""

    digest: str
    cell: Cell
    robot: str = ""  #: name or serial number; "" if it is the only one of its type
    arm_type: str = ""  #: digest that robots of one type share

    @property
    def name(self) -> str:
        """The cell's name with the begin of the digest, since names may be equal."""
        kind = f"{self.cell.name}-{(self.arm_type or self.digest)[:8]}"
        return f"{self.robot} ({kind})" if self.robot else kind


@dataclass(frozen=True, eq=False)
class BatchEstimate:
    """An estimate from one repetition, one campaign, or all campaigns of an arm."""

    level: Level
    arm: str  #: digest of the arm, a key of `BatchResult.arms`
    campaign: str  #: folder; "" if pooled
    when: str  #: time of the (first) recording, ISO 8601, "" if unknown
    repetitions: int  #: archives that were fitted
    estimate: Estimate
    torque_rms: Array  #: of the fitted rows per joint (n,) [N·m or N]
    unseen_rms: Array  #: torque error per joint (n,) on the campaign's validation runs; NaN if none
    unseen_torque_rms: Array  #: torque per joint (n,) there; NaN if none
    settings: str  #: digest of the settings; "" where campaigns with different ones are pooled
    warnings: tuple[Note, ...] = ()  #: about the archives and the estimate
    setup: Setup = NO_SETUP  #: that the cell states; empty if campaigns with others are pooled
    #: location and digest of the archive of a repetition; "" otherwise
    archive: str = ""
    sha256: str = ""
    #: of a repetition what its recording has in addition to its motion, such as temperatures
    facts: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ArmModel:
    """Everything that an estimate of an arm needs in addition to factors; pickled to workers."""

    digest: str
    cell: str  #: text of its cell file
    urdf: str
    settings: Settings
    estimator: BatchEstimator
    robot: str = ""  #: see :class:`BatchArm`, also the following
    arm_type: str = ""


@dataclass(frozen=True, eq=False)
class EstimateGroup:
    """Archives that are fitted together: the sums that predict and are predicted."""

    refs: tuple[ArchiveRef, ...] = ()  #: archives that were fitted
    total: Reduction | None = None  #: sum over them; None if there are none
    values: tuple[Array, ...] = ()  #: parameters (p,) from each of them
    unseen: Factor | None = None  #: sum of the totals of validation runs; None if none
    #: every archive, with the warnings about it
    warned: tuple[tuple[ArchiveRef, tuple[Note, ...]], ...] = ()
    settings: frozenset[str] = frozenset()  #: digests
    setups: frozenset[Setup] = frozenset()  #: that the cells state
    key: tuple[str, ...] = ()  #: of all that the estimate of the campaigns follows from

    @classmethod
    def of(cls, reduced: ReducedArchives, settings: Settings, key: str) -> EstimateGroup:
        """Return the group of one campaign, without the estimates from each archive.

        Args:
            reduced: archives of the campaign.
            settings: of the campaign.
            key: of the archives and how they were reduced.
        """
        fitted = [summary for summary in reduced.summaries if summary.ref.use == "excitation"]
        group = cls(
            refs=tuple(summary.ref for summary in fitted),
            total=reduced.total,
            warned=tuple((summary.ref, summary.warnings) for summary in reduced.summaries),
            settings=frozenset({settings_digest(settings)}),
            setups=frozenset(summary.ref.setup for summary in fitted),
            key=(key, *(summary.ref.sha256 for summary in reduced.summaries)),
        )
        for summary in reduced.summaries:
            if summary.ref.use != "excitation":
                group = replace(group, unseen=plus(group.unseen, summary.total))
        return group

    def __add__(self, other: EstimateGroup) -> EstimateGroup:
        """Return both groups together."""
        return EstimateGroup(
            refs=self.refs + other.refs,
            total=plus(self.total, other.total),
            values=self.values + other.values,
            unseen=plus(self.unseen, other.unseen),
            warned=self.warned + other.warned,
            settings=self.settings | other.settings,
            setups=self.setups | other.setups,
            key=self.key + other.key,
        )


@dataclass(frozen=True, eq=False)
class CampaignResult:
    """Estimates of a campaign, which the client receives."""

    estimates: tuple[BatchEstimate, ...]  #: of its repetitions, then of itself; none if it failed
    broken: tuple[SkippedArchive, ...]
    read: int  #: archives whose factor was computed
    cached: int  #: archives whose factor was cached


# Tasks


def estimate_campaign(
    parts: Sequence[ReducedArchives | SkippedArchive],
    key: str,
    cache: CacheLocation,
    arm: ArmModel,
    settings: Settings,
    campaign: str,
) -> tuple[CampaignResult, EstimateGroup]:
    """Estimate one campaign from its reduced archives; return also what a pooled estimate needs.

    Args:
        parts: archives, reduced or skipped.
        key: of all these archives.
        cache: of the estimates.
        arm: model of the arm.
        settings: of the campaign, with its own noise.
        campaign: its name.

    Raises:
        CacheError: the cache cannot be written.
    """
    reduced = added(part for part in parts if isinstance(part, ReducedArchives))
    estimator = ArmEstimator(arm)
    group = EstimateGroup.of(reduced, settings, key)
    estimates: list[BatchEstimate] = []
    broken = [*reduced.broken, *(part for part in parts if isinstance(part, SkippedArchive))]
    if group.total is not None:
        try:
            fitted = [each for each in reduced.summaries if each.ref.use == "excitation"]
            found = estimator.cached(group, fitted, cache)
            digest = settings_digest(settings)
            *singles, whole = found.estimates
            group = replace(group, values=tuple(each.values for each in singles))
            estimates = [
                *map(estimator.repetition, fitted, singles, [digest] * len(fitted)),
                estimator.sum("campaign", group, whole, found.notes),
            ]
        except IdentificationError as error:
            broken.append(SkippedArchive(campaign, str(error)))
    result = CampaignResult(tuple(estimates), tuple(broken), reduced.read, reduced.cached)
    return result, group


def estimate_cached(
    partitions: Sequence[Sequence[ToReduce]],
    key: str,
    cache: CacheLocation,
    arm: ArmModel,
    settings: Settings,
    campaign: str,
) -> tuple[CampaignResult, EstimateGroup]:
    """Estimate one campaign from its archives; each partition has a cached sum.

    Reading a sum takes less time than a task of its own.

    Args:
        partitions: archives whose sums are cached together.
        key: of all these archives.
        cache: of the sums and estimates.
        arm: model of the arm.
        settings: of the campaign, with its own noise.
        campaign: its name.

    Raises:
        CacheError: the cache cannot be written.
    """
    parts = [reduce_archives(partition, settings, cache) for partition in partitions]
    return estimate_campaign(parts, key, cache, arm, settings, campaign)


def result_of(
    pair: tuple[CampaignResult, EstimateGroup] | SkippedArchive,
) -> CampaignResult | SkippedArchive:
    """Return what the client receives of a campaign."""
    return pair if isinstance(pair, SkippedArchive) else pair[0]


def group_of(
    pairs: Sequence[tuple[CampaignResult, EstimateGroup] | SkippedArchive],
) -> EstimateGroup:
    """Return the campaigns with an excitation as one group."""
    groups = [pair[1] for pair in pairs if not isinstance(pair, SkippedArchive)]
    fitted = (
        replace(group, total=group.total.for_all_rows())
        for group in groups
        if group.total is not None
    )
    return sum(fitted, EstimateGroup())


def estimate_arm(
    parts: Sequence[EstimateGroup], cache: CacheLocation, arm: ArmModel
) -> BatchEstimate | SkippedArchive | None:
    """Estimate an arm from sums over its campaigns; None if there is no excitation.

    Raises:
        CacheError: the cache cannot be written.
    """
    group = sum(parts, EstimateGroup())
    if group.total is None:
        return None
    notes = list[Note]()
    if len(group.setups) > 1:
        notes.append(DifferentSetups(tuple(sorted(group.setups))))
    estimator = ArmEstimator(arm)
    try:
        found = estimator.cached(group, (), cache)
        return estimator.sum("pooled", group, found.estimates[-1], [*found.notes, *notes])
    except IdentificationError as error:
        return SkippedArchive(f"arm {arm.digest[:8]}", str(error))


# Estimates


class GroupEstimates(NamedTuple):
    """Estimates from each of some archives, then from their sum, and notes on the estimator."""

    estimates: tuple[Estimate, ...]
    notes: tuple[UnrestrictedBodies, ...] = ()


class ArmEstimator:
    """Estimates of one arm from sums, as `hil.pipeline.estimating` makes them; cached."""

    def __init__(self, arm: ArmModel) -> None:
        settings = arm.settings
        self._key = json_digest([arm.estimator, arm.cell, arm.urdf, asdict(settings)])
        self.name = arm.estimator
        self.cell = cell_from(arm.cell, arm.urdf, settings.friction)
        self.model = self.cell.model
        self._settings = settings

    def cached(
        self, group: EstimateGroup, fitted: Sequence[Summary], cache: CacheLocation
    ) -> GroupEstimates:
        """Return the estimates from each of `fitted` and from the group, from the cache if there.

        Raises:
            IdentificationError: there is no estimate.
            CacheError: the cache cannot be written.
        """
        place = group.refs[0].origin
        levels = [len(fitted), *sorted(group.settings), *group.key]
        key = json_digest(["estimates", self._key, levels, code_digest()])
        model = self.cell.model
        entry = cache.read(place, key)
        try:
            if entry is not None:
                content, arrays = entry
                each = unpacked_estimates(
                    content["estimates"], arrays, model.parameter_names, model.units
                )
                return GroupEstimates(tuple(each), tuple(map(UnrestrictedBodies, content["notes"])))
        except (KeyError, ValueError, TypeError, IndexError):  # not an entry of this program
            pass
        found = self.of_each(group, fitted)
        numbers: Arrays = {}
        stated = packed_estimates(found.estimates, numbers)
        notes = [note.reason for note in found.notes]
        cache.write(place, key, {"estimates": stated, "notes": notes}, numbers)
        return found

    def of_each(self, group: EstimateGroup, fitted: Sequence[Summary]) -> GroupEstimates:
        """Estimate from each of `fitted` and from the group.

        The intervals of the group are at least as wide as the scatter of repetitions of one motion,
        and allow for everything that `hil identify` intervals do.

        Raises:
            IdentificationError: there is no estimate.
        """
        total, settings = group.total, self._settings
        assert total is not None
        require_rows(self.model, total.factor)
        notes: tuple[UnrestrictedBodies, ...] = ()
        if self.name == "auto":
            posterior, fit, notes = fit_with_prior(
                self.cell, total.factor, self.name, settings.strength
            )
            whole = fit.estimate
            share = 1.0 / len(group.refs)
            singles = [self.of_archive(summary, posterior, share) for summary in fitted]
        else:
            posterior = posterior_of(self.cell, total.factor, self.name, settings.strength)
            whole = fit_of(self.model, self.name)((), total.factor)
            # without the bodies' restriction, as the scatter of `hil identify`
            singles = [summary.fit for summary in fitted if summary.fit is not None]
        values = np.array([each.values for each in singles] or group.values)
        motions = {ref.motion for ref in group.refs}
        is_one_motion = len(motions) == 1 and "" not in motions
        whole = widened(
            whole,
            total,
            posterior,
            posterior.precision if self.name == "auto" else None,
            delay_variance=settings.delay_variance,
            repetitions=values if is_one_motion else None,
            torque_scale=np.zeros(self.model.n_joints),  # in units of the torque of the arm
            recordings=[summary.total for summary in fitted],
        ).estimate
        return GroupEstimates((*singles, whole), notes)

    def of_archive(self, summary: Summary, posterior: Posterior, share: float) -> Estimate:
        """Return the estimate from one archive, this share of the archives of the posterior.

        The scatter of the scores is that of the archive by itself.
        """
        scatter = summary.scatter
        assert scatter is not None, "it was fitted"
        # A copy: the total itself does not cache what is computed here.
        total = summary.total.merged(max(1, len(summary.total)))
        try:
            result = posterior.fit(total, share)
        except SolverError:
            result = posterior.free(total, share)
        precision = share * posterior.precision
        weights = posterior.weights(total, share)
        solution = solve_with_prior(total.weighted(weights), precision)
        covariance = scatter.covariance(solution.root, precision, result.design_effect)
        return replace(
            result.estimate,
            covariance=covariance + np.outer(result.shift, result.shift),
            interval_factor=scatter.interval_factor,
            method=replace(result.estimate.method, blocks=scatter.blocks),
        )

    def repetition(self, summary: Summary, estimate: Estimate, settings: str) -> BatchEstimate:
        """Return the estimate from one archive, with the digest of the settings."""
        ref = summary.ref
        nothing = np.full(self.model.n_joints, np.nan)
        return BatchEstimate(
            level="repetition",
            arm=ref.arm,
            campaign=ref.campaign,
            when=ref.when,
            repetitions=1,
            estimate=estimate,
            torque_rms=_rms(summary.total),
            unseen_rms=nothing,
            unseen_torque_rms=nothing,
            settings=settings,
            warnings=summary.warnings,
            setup=ref.setup,
            archive=ref.origin,
            sha256=ref.sha256,
            facts=summary.numbers,
        )

    def sum(
        self, level: Level, group: EstimateGroup, estimate: Estimate, warnings: Sequence[Note]
    ) -> BatchEstimate:
        """Return the estimate from a campaign, or from all campaigns of the arm.

        Args:
            level: of the estimate.
            group: what is summed.
            estimate: from the sum.
            warnings: on the recordings.
        """
        assert group.total is not None
        refs = group.refs
        unseen = Factor.zero(self.model) if group.unseen is None else group.unseen
        is_poor = not estimate.undetermined and estimate.condition > MAX_GRAM_CONDITION
        if self.name != "auto" and is_poor:
            poor = PoorlySeparated(estimate.condition, from_sums=True)
            warnings = (poor, *warnings)
        return BatchEstimate(
            level=level,
            arm=refs[0].arm,
            campaign=refs[0].campaign if level == "campaign" else "",
            when=min((ref.when for ref in refs if ref.when), default=""),
            repetitions=len(refs),
            estimate=estimate,
            torque_rms=_rms(group.total.factor),
            unseen_rms=_rms(unseen, unseen.squared_errors(estimate.values)),
            unseen_torque_rms=_rms(unseen),
            settings=next(iter(group.settings)) if len(group.settings) == 1 else "",
            warnings=(*warnings, *frequent_notes(group.warned)),
            setup=next(iter(group.setups)) if len(group.setups) == 1 else NO_SETUP,
        )


def frequent_notes(warned: Sequence[tuple[ArchiveRef, Sequence[Note]]]) -> tuple[Note, ...]:
    """Return notes on archives with the archives they concern, most frequent first."""
    counts = Counter(note for _, notes in warned for note in notes)
    first = {note: ref for ref, notes in reversed(warned) for note in notes}
    found = list[Note]()
    for note, count in counts.most_common(_MAX_SHOWN_WARNINGS):
        example = f"{first[note].campaign.rsplit('/', 1)[-1]}/{first[note].name}"
        is_of_all = count == len(warned)
        found.append(note if is_of_all else OfSomeArchives(note, count, len(warned), example))
    if len(counts) > _MAX_SHOWN_WARNINGS:
        found.append(MoreNotes(len(counts) - _MAX_SHOWN_WARNINGS))
    return tuple(found)


def _rms(factor: Factor, squares: Array | None = None) -> Array:
    """Return the RMS per joint (n,) of sums over rows, by default of the torque; NaN of none."""
    squares = factor.squared_torque if squares is None else squares
    return np.asarray(np.sqrt(squares / np.where(factor.samples > 0, factor.samples, np.nan)))


def relative_error(error: Array, torque: Array, rows: NDArray[np.intp] | None = None) -> float:
    """Return the RMS error over the RMS torque of all joints; NaN where unknown.

    Both are given per joint (n,), for `rows` (n,) rows or equally many.
    """
    count = np.ones(len(error)) if rows is None else rows.astype(np.float64)
    usable = (count > 0.0) & np.isfinite(error) & np.isfinite(torque)
    whole = float(count[usable] @ torque[usable] ** 2)
    return math.sqrt(float(count[usable] @ error[usable] ** 2) / whole) if whole > 0.0 else math.nan
