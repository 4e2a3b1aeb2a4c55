"""Types of a batch: references, summaries, estimates, results, errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.errors import InputError
from identification.factor.factor import Estimate, Factor

Array = NDArray[np.float64]

Level = Literal["repetition", "campaign", "pooled"]
BatchEstimator = Literal["auto", "wls", "consistent"]
"""Estimators that need factors only, and no samples."""


class CacheError(InputError):
    """The cache folder cannot be written to."""


class GroupKey(NamedTuple):
    """Key of archives that are fitted together."""

    arm: str  #: digest of URDF, model, friction law and drive train
    campaign: str  #: the folder the archives were recorded into
    setup: str = ""  #: delay and payload stated by their cells, as text; "" for neither


def name_of(location: str) -> str:
    """Return the file name of a path."""
    return location.rsplit("/", 1)[-1]


def folder_of(location: str) -> str:
    """Return the folder of a path."""
    return location.rsplit("/", 1)[0]


@dataclass(frozen=True, slots=True)
class ArchiveRef:
    """Location and properties of an archive, without its samples."""

    location: str  #: path
    sha256: str  #: of all bytes
    #: "excitation" (fitted), "validation" (predicted), "standstill" (noise), or the kind of an
    #: archive that a batch does not use, for which `arm` and `cell` are ""
    use: str
    #: see :class:`GroupKey`
    arm: str
    campaign: str
    index: int  #: of the interval within its kind; 0 for imported ones
    cell: str  #: digest of the texts of cell file and URDF
    motion: str  #: digest of the planned motion, "" where unknown
    when: str = ""  #: time of recording, ISO 8601; "" in simulation
    setup: str = ""
    stamp: tuple[int, ...] = ()  #: size, times [ns] and inode of the file when it was hashed
    kind: str = ""  #: as in its metadata
    attempt: int = 0  #: 0 where the archive does not number them
    outcome: str = "completed"  #: how the recording ended
    record: str = ""  #: digest of the metadata
    simulated: bool = False  #: whether only a simulated arm moved

    @property
    def name(self) -> str:
        """File name."""
        return name_of(self.location)

    @property
    def folder(self) -> str:
        """Folder of the file."""
        return folder_of(self.location)

    @property
    def key(self) -> GroupKey:
        """Group of the archive."""
        return GroupKey(self.arm, self.campaign, self.setup)

    @property
    def order(self) -> tuple[str, str, str, int, str, str]:
        """Sort key: sums are added in this order."""
        return *self.key, self.index, self.name, self.sha256


class Unused(NamedTuple):
    """An archive or campaign that was not used, and why."""

    path: str
    reason: str


@dataclass(frozen=True, eq=False)
class Summary:
    """Cached results of one archive, beside the sum of several."""

    ref: ArchiveRef
    total: Factor  #: its factor as one block
    #: the estimate from it alone, with cluster-robust covariance; None of a validation run
    fit: Estimate | None
    design_effect: float  #: ratio of its mean variance to that of white residuals
    warnings: tuple[str, ...] = ()  #: about the archive
    #: (n, p, p + 1), see :func:`identification.estimators.delay.rate_products`; None where the
    #: delay is known, or the archive is not fitted
    products: Array | None = None


@dataclass(frozen=True, eq=False)
class Bundle:
    """Results of several archives of one campaign."""

    summaries: tuple[Summary, ...] = ()  #: of the readable ones, in their order
    #: sum of the factors of those that are fitted; None if there are none
    total: Factor | None = None
    broken: tuple[Unused, ...] = ()  #: the others
    read: int = 0  #: number of archives that were read, broken ones included
    cached: int = 0  #: number of the others


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot by its digest, see :class:`GroupKey`, with one of its cells."""

    digest: str
    cell: Cell

    @property
    def name(self) -> str:
        """The cell's name with the begin of the digest, since names may be equal."""
        return f"{self.cell.name}-{self.digest[:8]}"


@dataclass(frozen=True, eq=False, slots=True)
class LevelEstimate:
    """Parameters from one repetition, one campaign, or all campaigns of an arm.

    Fields of the same name are those of :class:`identification.factor.factor.Estimate`.
    """

    level: Level
    arm: str  #: digest of the arm, a key of `BatchResult.arms`
    campaign: str  #: folder; "" if pooled
    #: location and digest of the archive of a repetition; "" otherwise
    archive: str
    sha256: str
    when: str  #: time of the (first) recording, ISO 8601, "" if unknown
    repetitions: int  #: archives that were fitted
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array  #: (p,), infinite where undetermined
    covariance: Array | None  #: (p, p); None for a repetition, of which there may be very many
    interval_factor: float
    samples: NDArray[np.intp]
    noise_std: Array
    torque_rms: Array  #: of the fitted rows per joint (n,) [N·m or N]
    unseen_rms: Array  #: torque error per joint (n,) on the campaign's validation runs; NaN if none
    unseen_torque_rms: Array  #: torque per joint (n,) there; NaN if none
    condition: float
    undetermined: tuple[str, ...]
    method: str
    settings: str  #: digest of the settings; "" where campaigns with different ones are pooled
    warnings: tuple[str, ...] = ()  #: about the archives and the estimate
    #: payload and delay that the cell states, as text; "" if neither, or if campaigns with
    #: different ones are pooled
    setup: str = ""


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Result of a batch."""

    estimator: str
    arms: Mapping[str, Arm]  #: by digest
    repetitions: tuple[LevelEstimate, ...]  #: of all campaigns, in the order of `ArchiveRef.order`
    campaigns: tuple[LevelEstimate, ...]  #: in the same order
    pooled: tuple[LevelEstimate, ...]  #: one per arm
    broken: tuple[Unused, ...]  #: archives and campaigns (by folder) that could not be used
    skipped: tuple[Unused, ...]  #: archives that are not intended for fitting
    read: int  #: archives whose factor was computed
    cached: int  #: archives whose factor was cached
    code: str  #: digest of the programs
