"""What passes between the parts of a batch: references, summaries, estimates, results, errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from identification.factor.factor import Estimate, Factor
from identification.factor.phases import PhaseFactor
from identification.model.payload import Payload

Array = NDArray[np.float64]

Level = Literal["repetition", "campaign", "pooled"]
BatchEstimator = Literal["auto", "wls", "consistent"]
"""The estimators that need factors only, and no sample."""

Stamp = tuple[int, ...]
"""What changes when a file is written to: size, times [ns], inode."""


class ChangedError(ArchiveError):
    """An archive that was written to while the batch ran."""

    def __init__(self, location: str) -> None:
        super().__init__(location, "was changed while it was read", remedy="run the batch again")


class CacheError(InputError):
    """A cache folder that cannot be written to."""


class GroupKey(NamedTuple):
    """Archives that are fitted together.

    Attributes:
        arm: digest of URDF, model, friction law and drive train.
        campaign: the folder the archives were recorded into.
        setup: delay and payload that their cells state, in words; "" for neither.
    """

    arm: str
    campaign: str
    setup: str = ""


@dataclass(frozen=True, slots=True)
class ArchiveRef:
    """One archive: where it lies, and what it is, without its samples.

    Attributes:
        location: path or URL.
        sha256: of all bytes.
        use: "excitation" (fitted), "validation" (predicted), "standstill" (noise), or the kind of
            an archive that a batch does not use; of such a one `arm` and `cell` are "".
        arm, campaign, setup: see :class:`GroupKey`.
        index: of the interval within its kind; 0 for imported ones.
        cell: digest of the texts of cell file and URDF.
        motion: digest of the planned motion, "" where none is known.
        when: time of recording, ISO 8601; "" in simulation.
        stamp: of the file when it was hashed; None of a remote one.
        kind: as its metadata say.
        attempt: at the interval; 0 where the archive does not number them.
        outcome: how the recording ended.
        record: digest of the metadata.
        simulated: whether no arm moved.
    """

    location: str
    sha256: str
    use: str
    arm: str
    campaign: str
    index: int
    cell: str
    motion: str
    when: str = ""
    setup: str = ""
    stamp: Stamp | None = None
    kind: str = ""
    attempt: int = 0
    outcome: str = "completed"
    record: str = ""
    simulated: bool = False

    @property
    def name(self) -> str:
        """File name."""
        return self.location.rsplit("/", 1)[-1]

    @property
    def key(self) -> GroupKey:
        """The group it belongs to."""
        return GroupKey(self.arm, self.campaign, self.setup)

    @property
    def order(self) -> tuple[str, str, str, int, str, str]:
        """Sums go in this order, whatever order archives were found in."""
        return *self.key, self.index, self.name, self.sha256


class Broken(NamedTuple):
    """An archive of which nothing was used, and why."""

    path: str
    reason: str


@dataclass(frozen=True, eq=False)
class Summary:
    """What is cached of each archive beside the sum of all.

    Attributes:
        ref: the archive.
        total: its factor as one block.
        fit: the estimate from it alone, with cluster-robust covariance; None of a validation run.
        design_effect: ratio of its mean variance to that of white residuals.
        warnings: what a reader must know of it.
        products: (n, p, p + 1), see
            :func:`identification.estimators.delay.rate_products`; None where the delay
            is known, or nothing is fitted.
    """

    ref: ArchiveRef
    total: PhaseFactor
    fit: Estimate | None
    design_effect: float
    warnings: tuple[str, ...] = ()
    products: Array | None = None


@dataclass(frozen=True, eq=False)
class Bundle:
    """Some archives of one campaign, reduced together.

    Attributes:
        refs: those asked for, in their order.
        summaries: of those that could be read, in their order.
        phase: sum of the factors of those that are fitted; None where none is.
        broken: the others.
        read: archives that were read for it; the rest comes from the cache.
    """

    refs: tuple[ArchiveRef, ...]
    summaries: tuple[Summary, ...] = ()
    phase: PhaseFactor | None = None
    broken: tuple[Broken, ...] = ()
    read: int = 0


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot that archives belong to: its digest, see :class:`GroupKey`, and one of its cells."""

    digest: str
    cell: Cell

    @property
    def name(self) -> str:
        """The cell's name, and enough of the digest to tell arms with one name apart."""
        return f"{self.cell.name}-{self.digest[:8]}"


@dataclass(frozen=True, eq=False, slots=True)
class LevelEstimate:
    """Parameters from one repetition, one campaign, or all campaigns of an arm.

    Names, units, values, noise, samples, condition and method are those of
    :class:`identification.factor.factor.Estimate`.

    Attributes:
        level: which of these.
        arm: digest of the arm, a key of `BatchResult.arms`.
        campaign: folder; "" if pooled.
        archive, sha256: location and digest of the archive of a repetition; "" otherwise.
        when: time of the (first) recording, ISO 8601, "" if unknown.
        repetitions: archives that were fitted.
        std: (p,), infinite where undetermined.
        covariance: (p, p); None for a repetition, of which there may be very many.
        torque_rms: of the fitted rows per joint (n,) [N·m or N].
        unseen_rms: torque error per joint (n,) on the campaign's validation runs; NaN if none.
        unseen_torque_rms: torque per joint (n,) there; NaN if none.
        settings: digest of the settings; "" where campaigns with different ones are pooled.
        warnings: what a reader must know.
        speed_rms: per axis (n,), see :func:`hil.batch.estimates.speed_rms`; None for a repetition.
        information: weighted Gram matrix (p, p) of the fitted rows; None for a repetition.
        setup: what the cell states that archives of one arm may differ in, in words; "" if
            nothing, or if campaigns with different ones are pooled.
        payload: that the cell states; None for none, or if pooled.
        unseen: sum of the factors of the validation runs; None if there are none.
    """

    level: Level
    arm: str
    campaign: str
    archive: str
    sha256: str
    when: str
    repetitions: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array
    covariance: Array | None
    interval_factor: float
    samples: NDArray[np.intp]
    noise_std: Array
    torque_rms: Array
    unseen_rms: Array
    unseen_torque_rms: Array
    condition: float
    undetermined: tuple[str, ...]
    method: str
    settings: str
    warnings: tuple[str, ...] = ()
    speed_rms: Array | None = None
    information: Array | None = None
    setup: str = ""
    payload: Payload | None = None
    unseen: Factor | None = None


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Everything a batch found.

    Attributes:
        estimator: by name.
        arms: by digest.
        repetitions: of all campaigns, in the order of `ArchiveRef.order`.
        campaigns: likewise, by arm and time.
        pooled: one per arm.
        broken: archives, and campaigns (by folder), that could not be used.
        skipped: archives that are not meant to be fitted, and why.
        read: archives whose factor was computed.
        cached: archives whose factor was known.
        code: digest of the programs.
    """

    estimator: str
    arms: Mapping[str, Arm]
    repetitions: tuple[LevelEstimate, ...]
    campaigns: tuple[LevelEstimate, ...]
    pooled: tuple[LevelEstimate, ...]
    broken: tuple[Broken, ...]
    skipped: tuple[Broken, ...]
    read: int
    cached: int
    code: str
