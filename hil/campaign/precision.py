"""Precision of a running campaign: measured after each repetition, and when it is enough.

The estimate is the posterior that `hil identify` computes, with the friction law and delay of the
cell file. Its intervals are cluster-robust: what the model cannot explain in the same place of
every repetition counts as one error, however often it is repeated. Only the rest falls with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.design.given import given_sources
from hil.design.requirements import Requirement, require_known, requirements_from
from hil.design.result import RESULT
from hil.design.settings import load_settings
from hil.design.wanted import ReferenceMotions, Wanted
from hil.errors import InputError
from hil.identify.cell_context import torque_scale
from hil.identify.estimating import Posterior, with_uncertain_scale
from hil.identify.options import FIXED
from hil.identify.prepared import samples_of, stated_settings
from hil.identify.sources import Source, gather_sources
from hil.progress import Reporter
from hil.reading import path_exists
from hil.terminal_text import plural
from identification.excitation import midpoints
from identification.factor.factor import Factor, inverse_variance
from identification.selection.settings import Strength

from .precision_record import IN_A_ROW, Look, PrecisionRecord, Reached
from .state import CampaignState

Array = NDArray[np.float64]

_REFERENCE_PERIOD: Final = 0.04  # s


@dataclass(frozen=True, eq=False)
class Measured:
    """Required quantities (k,) by some repetitions, with halves of their 95 % intervals."""

    wanted: Wanted
    values: Array  #: (k,)
    half: Array  #: (k,)
    noise: Array  #: share of the variance that differs between repetitions (k,)


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
        self._cell, self._requirements = campaign.cell, tuple(requirements)
        self._settings = stated_settings(campaign.cell, FIXED)
        motions = [
            midpoints(motion.trajectory, _REFERENCE_PERIOD) for motion in campaign.plan.validation
        ]
        self._reference = ReferenceMotions(campaign.cell.model, motions)
        self._factors: dict[Path, Factor] = {}
        paths = given_to(campaign)
        sources = given_sources(campaign.cell, paths) if paths else ()
        earlier = [self._reduced(source) for source in sources]
        self._earlier = sum(earlier[1:], earlier[0]) if earlier else None
        self.earlier = len(earlier)  #: number of those recordings

    def measure(self, paths: Sequence[Path]) -> Look:
        """Return the precision that some repetitions give together; archives are read once."""
        measured = self.estimate(paths)
        ratios = measured.half / measured.wanted.quantities.allowed
        reached = []
        for k, requirement in enumerate(self._requirements):
            mine = np.flatnonzero(measured.wanted.owners == k)
            worst = int(mine[np.argmax(ratios[mine])])
            more = [
                further(len(paths), ratios[direction], measured.noise[direction])
                for direction in mine.tolist()
            ]
            counts = [count for count in more if count is not None]
            most = max(counts) if len(counts) == len(more) else None
            half = float(ratios[worst]) * requirement.value
            reached.append(Reached(str(requirement), measured.wanted.labels[worst], half, most))
        return Look(len(paths), tuple(reached))

    def estimate(self, paths: Sequence[Path]) -> Measured:
        """Return what some repetitions together say of the required quantities."""
        for path in paths:
            if path not in self._factors:
                (source,) = gather_sources([path], FIXED.split, in_sample=True).training
                self._factors[path] = self._reduced(source)
        factors = [self._factors[path] for path in paths]
        total = sum(factors[1:], factors[0])
        if self._earlier is not None:
            total = total + self._earlier
        posterior = Posterior.of(self._cell, total, "auto", Strength())
        estimate = posterior.free(total).estimate
        scale = torque_scale(self._cell, (), simulated=self._cell.only_simulated)
        stated = with_uncertain_scale(estimate, total, posterior.precision, scale)
        weights = inverse_variance(estimate.noise_std**2)
        information = total.weighted(weights).A + posterior.precision
        wanted = self._reference.wanted(
            self._requirements, estimate.values, information / posterior.design_effect
        )
        directions = wanted.quantities.directions
        variance = np.einsum("kp,pq,kq->k", directions, stated.covariance, directions)
        moved = np.asarray(np.linalg.solve(information, directions.T))
        return Measured(
            wanted=wanted,
            values=directions @ estimate.values,
            half=stated.interval_factor * np.sqrt(variance),
            noise=noise_shares(factors, weights, estimate.values, moved, self._earlier),
        )

    def _reduced(self, source: Source) -> Factor:
        samples = samples_of(source, self._cell, self._settings)
        return Factor.by_time(self._cell.model, samples)


def noise_shares(
    factors: Sequence[Factor],
    weights: Array,
    values: Array,
    moved: Array,
    earlier: Factor | None = None,
) -> Array:
    """Return the share of the variances (k,) that differs between repetitions of a motion.

    The rest is the same in all of them, or of the `earlier` recordings. `moved` (p, k) are the
    inverse information times the directions. NaN for one repetition.
    """
    count = len(factors)
    if count < 2:
        return np.full(moved.shape[1], np.nan)
    blocks = min(len(factor) for factor in factors)
    pulls = np.array([factor.scores(weights, values)[:blocks] @ moved for factor in factors])
    whole = np.sum(pulls.sum(axis=0) ** 2, axis=0)
    if earlier is not None:
        whole += np.sum((earlier.scores(weights, values) @ moved) ** 2, axis=0)
    scatter = np.sum((pulls - pulls.mean(axis=0)) ** 2, axis=(0, 1)) * count / (count - 1)
    return np.asarray(np.clip(scatter / np.where(whole > 0.0, whole, 1.0), 0.0, 1.0))


def further(repetitions: int, ratio: float, share: float) -> int | None:
    """Return how many more repetitions bring a ratio to one, None if none do.

    `share` of its square falls with the number of repetitions, the rest does not.
    """
    if ratio <= 1.0:
        return 0
    left = 1.0 / ratio**2 - (1.0 - share)
    if not left > 0.0:  # NaN as well
        return None
    return max(1, math.ceil(repetitions * share / left) - repetitions)


class PrecisionStage:
    """Measures each repetition of a run, and ends the repetitions when they are enough."""

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
            for count in range(max(1, done - IN_A_ROW + 1), done + 1):
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
        self._reporter.say(self._record.message)

    def _look(self, count: int) -> None:
        paths = self._campaign.folder.completed("excitation")[:count]
        self._record = self._record.with_look(self._meter.measure(paths), self._limit)


def given_to(campaign: CampaignState) -> tuple[Path, ...]:
    """Return the recordings that the design in the folder of a campaign adds to."""
    path = campaign.folder.root / RESULT
    if not path_exists(path):
        return ()
    return tuple(Path(name) for name in load_settings(path).objective.given)


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
        stated = load_settings(folder.root / RESULT).objective.precision
        if stated:
            return requirements_from(stated)
    raise InputError(
        folder.root,
        "neither its design nor an earlier run states a precision",
        field="--until-precise",
        remedy='state it, for example --precision "parameters 5 %, torque 10"',
    )
