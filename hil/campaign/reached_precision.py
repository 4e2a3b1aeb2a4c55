"""Precision of a running campaign: measured after each repetition, and when it is enough.

The estimate is the posterior that `hil identify` computes, with the settings that it would choose
from the first repetition; the delay is renewed by the first `DELAY_SEARCH_SECONDS` of them. Its
intervals are cluster-robust: what the model cannot explain in the same place of every repetition
counts as one error, however often it is repeated. Only the rest falls with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.progress import Reporter, Silent
from hil.base.safe_input import path_exists
from hil.base.terminal_text import plural
from hil.design.result import RESULT
from hil.design.settings import recorded_settings
from hil.pipeline.estimating import estimate_with, with_loading
from hil.pipeline.options import Options
from hil.pipeline.prepared import (
    DELAY_SEARCH_SECONDS,
    Prepared,
    decide,
    prepared_with,
    reduction_of,
    renewed_delay,
    versions_of,
)
from hil.pipeline.sources import Source, gather_sources
from hil.precision.forecast import REFERENCE_PERIOD
from hil.precision.given_recordings import given_sources
from hil.precision.required_quantities import ReferenceMotions, RequiredQuantities
from hil.precision.requirements import (
    MIN_CONSECUTIVE_MET,
    Requirement,
    require_known,
    requirements_from,
)
from identification.estimators.delay import CombinedDelay, delay_sensitivity
from identification.estimators.torque_scale import absolute
from identification.excitation import midpoints
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import Factor
from identification.reduction.reduction import MAX_UNMODELLED_REPETITIONS, Reduction
from identification.signals.samples import Samples

from .precision_record import PrecisionLook, PrecisionRecord, Reached
from .record_messages import precision_line
from .state import CampaignState


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Required quantities (k,) by some repetitions, with halves of their 95 % intervals."""

    required: RequiredQuantities
    values: Array  #: (k,)
    half: Array  #: (k,)
    noise: Array  #: share of the variance that falls with repetitions (k,)
    estimate: Estimate  #: of all parameters, including chosen effects


class _Reduced(NamedTuple):
    """A recording by the settings of a campaign."""

    source: Source
    samples: Samples
    reduction: Reduction


class PrecisionMeter:
    """Measures the precision of the archived repetitions of a campaign.

    The recordings that its motion was designed to add to (`hil design --given`) count with them.
    """

    def __init__(self, campaign: CampaignState, requirements: Sequence[Requirement]) -> None:
        require_known(requirements, campaign.cell.model)
        if any(requirement.kind == "mass" for requirement in requirements):
            raise InputError(
                None,
                "the mass of a payload needs motions with the payload",
                field="--precision",
                remedy="run it with --payload NAME",
            )
        self._campaign = campaign
        self._requirements = tuple(requirements)
        paths = given_to(campaign)
        self._given = given_sources(campaign.cell, paths) if paths else ()
        self._options = Options()
        self._first: Path | None = None  # repetition that the settings were chosen from
        self.earlier = len(self._given)  #: number of earlier recordings

    def measure(self, paths: Sequence[Path]) -> PrecisionLook:
        """Return the precision that some repetitions give together; archives are read once."""
        measured = self.estimate(paths)
        ratios = measured.half / measured.required.quantities.allowed
        reached = []
        for k, requirement in enumerate(self._requirements):
            mine = np.flatnonzero(measured.required.owners == k)
            worst = int(mine[np.argmax(ratios[mine])])
            more = [
                further_repetitions(len(paths), ratios[direction], measured.noise[direction])
                for direction in mine.tolist()
            ]
            counts = [count for count in more if count is not None]
            most = max(counts) if len(counts) == len(more) else None
            half = float(ratios[worst]) * requirement.value
            reached.append(Reached(str(requirement), measured.required.labels[worst], half, most))
        return PrecisionLook(len(paths), tuple(reached))

    def estimate(self, paths: Sequence[Path]) -> MeasuredMotion:
        """Estimate the required quantities from some repetitions together."""
        if self._first != paths[0]:
            self._choose(paths[0])
        for path in paths:
            if path not in self._repetitions:
                (source,) = gather_sources([path], self._options.split, in_sample=True).training
                few = bool(self._earlier) or len(self._repetitions) < MAX_UNMODELLED_REPETITIONS
                self._repetitions[path] = self._reduced(source, unmodelled=few)
        repetitions = [self._repetitions[path] for path in paths]
        recordings = (*self._earlier, *repetitions)
        prepared, later = self._prepared_of(recordings)
        reductions = [recording.reduction for recording in recordings]
        rates = Reduction.total(prepared.sources.cell.model, reductions).rates
        estimation = estimate_with(prepared, self._options, Silent(), reductions)
        pooled = estimation.result.pooled
        posterior = estimation.posterior
        stated = estimation.stated
        if rates is not None and later:
            moved = later * delay_sensitivity(
                pooled, estimation.result.factor, rates, posterior.precision
            )
            pooled, stated = (
                replace(estimate, values=estimate.values + moved) for estimate in (pooled, stated)
            )
        values = pooled.values
        weights = inverse_variance(pooled.noise_std**2)
        information = estimation.result.factor.weighted(weights).A + posterior.precision
        required = self._reference.required(
            self._requirements, values, information / posterior.design_effect
        )
        directions = required.quantities.directions
        own, with_scale = (_variances(directions, each) for each in (stated, absolute(stated)))
        variance = np.where(required.absolute, with_scale, own)
        # The errors of delay, gears and torque scale, which are in it as well, do not fall.
        of_rows = _variances(directions, posterior.free(estimation.result.factor).estimate)
        moved = np.asarray(np.linalg.solve(information, directions.T))
        of_repetitions = [repetition.reduction.factor for repetition in repetitions]
        longest = max(factor.block for factor in of_repetitions)
        of_repetitions = [factor.of_blocks(longest) for factor in of_repetitions]
        earlier = [recording.reduction.factor for recording in self._earlier]
        return MeasuredMotion(
            required=required,
            values=directions @ values,
            half=stated.interval_factor * np.sqrt(variance),
            noise=np.minimum(of_rows / variance, 1.0)
            * noise_shares(
                of_repetitions,
                weights,
                values,
                moved,
                sum(earlier[1:], earlier[0]) if earlier else None,
            ),
            estimate=stated,
        )

    def _prepared_of(self, recordings: Sequence[_Reduced]) -> tuple[Prepared, float]:
        """Return recordings by the settings of all looks, and how much later the torque is [s].

        The delay by all of them is another one than that of the settings, and has its own error.
        """
        training = tuple(recording.source for recording in recordings)
        settings = self._prepared.settings
        delay = self._delay_by(training[len(self._earlier) :] + training[: len(self._earlier)])
        prepared = replace(
            self._prepared,
            sources=replace(
                self._prepared.sources, training=training, same_motion=not self._earlier
            ),
            fitted=tuple(recording.samples for recording in recordings),
            settings=replace(settings, delay_variance=delay.variance),
        )
        return prepared, delay.mean - settings.preprocessing.torque_delay

    def _delay_by(self, training: tuple[Source, ...]) -> CombinedDelay:
        """Return the delay by the first recordings, as many as `DELAY_SEARCH_SECONDS` needs."""
        ends = np.cumsum([np.ptp(source.recording.time) for source in training])
        some = training[: 1 + int(np.searchsorted(ends, DELAY_SEARCH_SECONDS))]
        paths = tuple(source.path for source in some)
        if paths not in self._delays:
            sources = replace(self._sources, training=some)
            self._delays[paths] = renewed_delay(sources, self._prepared.settings, self._options)
        return self._delays[paths]

    def _choose(self, path: Path) -> None:
        """Choose the settings from a repetition, as `hil identify` does, for all looks."""
        campaign = self._campaign
        standstill = campaign.folder.completed("standstill")
        sources = gather_sources([*standstill, path], self._options.split, in_sample=True)
        # The validation runs, which the campaign holds out, are recorded later.
        sources = replace(sources, in_sample=False, held_out=())
        settings = with_loading(decide(sources, self._options, Silent()).settings, sources)
        self._sources = sources
        self._prepared = prepared_with(sources, settings, Silent())
        motions = [
            midpoints(motion.trajectory, REFERENCE_PERIOD) for motion in campaign.plan.validation
        ]
        model = self._prepared.sources.cell.model
        self._reference = ReferenceMotions(model, motions, campaign.cell.model.parameter_names)
        self._earlier = [self._reduced(source, unmodelled=True) for source in self._given]
        self._repetitions: dict[Path, _Reduced] = {}
        self._delays: dict[tuple[Path, ...], CombinedDelay] = {}
        self._first = path

    def _reduced(self, source: Source, *, unmodelled: bool) -> _Reduced:
        cell = self._prepared.sources.cell
        settings = self._prepared.settings
        versions = versions_of(source, cell, settings)
        reduction = reduction_of(cell, settings, versions, unmodelled=unmodelled)
        return _Reduced(source, versions[0], reduction)


def _variances(directions: Array, estimate: Estimate) -> Array:
    """Return the variances (k,) of linear functions (k, p) of the parameters."""
    return np.asarray(np.einsum("kp,pq,kq->k", directions, estimate.covariance, directions))


def noise_shares(
    factors: Sequence[Factor],
    weights: Array,
    values: Array,
    moved: Array,
    earlier: Factor | None = None,
) -> Array:
    """Return the share of the variances (k,) that differs from one repetition to the next.

    The rest is the same in all of them, or changes slowly, as the friction of an arm that gets warm
    (von Neumann 1941), or is of the earlier recordings. NaN for one repetition.

    Args:
        factors: of the repetitions.
        weights: of the joints (n,).
        values: parameters (p,).
        moved: inverse information times the directions (p, k).
        earlier: factor of earlier recordings, if any.
    """
    count = len(factors)
    if count < 2:
        return np.full(moved.shape[1], np.nan)
    blocks = min(len(factor) for factor in factors)
    pulls = np.array([factor.scores(weights, values)[:blocks] @ moved for factor in factors])
    whole = np.sum(pulls.sum(axis=0) ** 2, axis=0)
    if earlier is not None:
        whole += np.sum((earlier.scores(weights, values) @ moved) ** 2, axis=0)
    scatter = 0.5 * np.sum(np.diff(pulls, axis=0) ** 2, axis=(0, 1)) * count / (count - 1)
    return np.asarray(np.clip(scatter / np.where(whole > 0.0, whole, 1.0), 0.0, 1.0))


def further_repetitions(repetitions: int, ratio: float, share: float) -> int | None:
    """Return how many more repetitions bring a ratio to one, None if none do.

    `share` of its square falls with the number of repetitions, the rest does not.
    """
    if ratio <= 1.0:
        return 0
    variance = 1.0 / ratio**2 - (1.0 - share)
    if not variance > 0.0:  # NaN as well
        return None
    return max(1, math.ceil(repetitions * share / variance) - repetitions)


class PrecisionStage:
    """Measures each repetition of a run, and ends the repetitions when they are enough.

    Args:
        campaign: that is run.
        requirements: on its precision.
        plan_hash: of cell, URDF and plan.
        reporter: of progress.
    """

    def __init__(
        self,
        campaign: CampaignState,
        requirements: Sequence[Requirement],
        plan_hash: str,
        reporter: Reporter,
    ) -> None:
        self._campaign = campaign
        self._reporter = reporter
        self._path = campaign.folder.precision
        self._limit = campaign.cell.campaign.repetitions
        self._meter = PrecisionMeter(campaign, requirements)
        if self._meter.earlier:
            recordings = plural(self._meter.earlier, "earlier recording")
            reporter.say(f"the precision counts the {recordings} that the motion adds to")
        texts = tuple(str(requirement) for requirement in requirements)
        self._record = PrecisionRecord(plan_hash, texts)
        record = PrecisionRecord.load(self._path, plan_hash)
        if record is not None and record.requirements == texts:
            self._record = record

    def begin(self) -> None:
        """Measure the repetitions of earlier runs; a new requirement may need more of them."""
        done = len(self._campaign.folder.completed("excitation"))
        if done == 0 or not self._record.looks or self._record.looks[-1].repetitions != done:
            self._record = replace(self._record, looks=(), outcome="going on")
            for count in range(max(1, done - MIN_CONSECUTIVE_MET + 1), done + 1):
                self._look(count)
        self._record.save(self._path)

    @property
    def ended(self) -> bool:
        """Whether no more repetitions are run."""
        return self._record.ended

    def repeated(self) -> None:
        """Measure the precision after another repetition, and report it."""
        self._look(len(self._campaign.folder.completed("excitation")))
        self._record.save(self._path)
        self._reporter.say(precision_line(self._record))

    def _look(self, count: int) -> None:
        paths = self._campaign.folder.completed("excitation")[:count]
        self._record = self._record.with_look(self._meter.measure(paths), self._limit)


def given_to(campaign: CampaignState) -> tuple[Path, ...]:
    """Return the recordings that the design in the folder of a campaign adds to."""
    path = campaign.folder.root / RESULT
    if not path_exists(path):
        return ()
    return tuple(Path(name) for name in recorded_settings(path).objective.given)


def requirements_of(campaign: CampaignState, texts: Sequence[str]) -> tuple[Requirement, ...]:
    """Return the requirements of texts, else of an earlier run, else of the design in the folder.

    Raises:
        InputError: there are none, or one is invalid.
    """
    folder = campaign.folder
    if texts:
        return requirements_from(texts)
    record = PrecisionRecord.load(folder.precision, folder.plan_hash)
    if record is not None:
        return requirements_from(record.requirements)
    if (folder.root / RESULT).exists():
        stated = recorded_settings(folder.root / RESULT).objective.precision
        if stated:
            return requirements_from(stated)
    raise InputError(
        folder.root,
        "neither its design nor an earlier run states a precision",
        field="--until-precise",
        remedy='state it, for example --precision "parameters 5 %, torque 10"',
    )
