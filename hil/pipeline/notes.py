"""Notes of the results about recordings, settings and estimate; `note_messages` words them.

Nothing reads the words back: what follows from a note follows from its fields.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto

from hil.pipeline.torque_scale import TorqueScale
from identification.estimators.delay import DelayEstimate
from identification.signals.masks import RowReason
from identification.signals.sample_times import SampleTimes, TimeBase
from identification.validation.consistency import ConsistencyCheck
from identification.validation.finding import Finding


@dataclass(frozen=True)
class Note:
    """A note."""


# Recordings


@dataclass(frozen=True)
class StatedText(Note):
    """A sentence stored in an archive or a folder, or by an earlier import."""

    text: str
    recording: str = ""


@dataclass(frozen=True)
class RejectedArchive(Note):
    """A recording that was rejected, and is left out."""

    recording: str
    reason: str  #: as the archive has it


@dataclass(frozen=True)
class EndedEarly(Note):
    """A recording that did not end as planned."""

    recording: str
    outcome: str  #: as the archive has it


@dataclass(frozen=True)
class NotJudged(Note):
    """An archive that is missing from its campaign's manifest."""

    recording: str


@dataclass(frozen=True)
class RepairedArchive(Note):
    """An archive that was repaired with loss."""


@dataclass(frozen=True)
class OtherMeaning(Note):
    """How a recording differs from its description, as a finding."""

    finding: Finding
    joints: tuple[str, ...]  #: names of the arm's joints, which the finding numbers

    def __hash__(self) -> int:  # a finding has mappings
        return hash((self.finding.key, self.finding.joints, self.joints))


@dataclass(frozen=True)
class AssumedTorqueConstants(Note):
    """Torque constants of the cell are assumed."""

    can_be_weighed: bool  #: whether a known payload shows them


@dataclass(frozen=True)
class AssumedPayload(Note):
    """The payload was not weighed before it was recorded."""


@dataclass(frozen=True)
class RestPredicted(Note):
    """The end of the only recording is held out."""

    fitted: float  #: share of it


@dataclass(frozen=True)
class LastHeldOut(Note):
    """The last of several recordings is held out."""

    recording: str


@dataclass(frozen=True)
class MergedSamples(Note):
    """Samples with the time stamp of the sample before them."""

    count: int
    recording: str = ""


@dataclass(frozen=True)
class TimesUsed(Note):
    """Which times of the samples of a recording are used, and why."""

    recording: str
    times: SampleTimes


@dataclass(frozen=True)
class UnevenClock(Note):
    """A clock that is uneven, or has gaps."""

    recording: str
    base: TimeBase


@dataclass(frozen=True)
class PositionNoise(Note):
    """Source of the estimated noise of the positions."""

    at_standstill: bool


@dataclass(frozen=True)
class FittedRows(Note):
    """How many rows are fitted, and why others are not."""

    rows: int  #: one joint at one sample each
    excluded: Mapping[RowReason, float]  #: shares of the rows


# Delay of the torque


@dataclass(frozen=True)
class EstimatedDelay(Note):
    """The delay of the torque, with its interval."""

    estimate: DelayEstimate


@dataclass(frozen=True)
class NoOtherDelay(Note):
    """Only the assumed delay was applied."""

    assumed: float  #: [s]
    beside_low_pass: bool = False  #: of the torque, whose lag the estimate may be


@dataclass(frozen=True)
class CompensatedDelay(Note):
    """A delay of all axes was compensated."""

    delay: float  #: [s]
    stated: float | None = None  #: [s], with which the estimate was combined


class WhyNotApplied(Enum):
    """Why a delay that was estimated is not applied."""

    UNDETERMINED = auto()
    PREDICTS_WORSE = auto()
    PREDICTS_NO_BETTER = auto()


@dataclass(frozen=True)
class DelayNotApplied(Note):
    """An estimated delay was not applied."""

    estimate: DelayEstimate
    reason: WhyNotApplied


# Estimate


@dataclass(frozen=True)
class LoadNotConverged(Note):
    """Friction that grows with load still changed the torque in the last pass."""

    change: float  #: share of the torque
    passes: int


@dataclass(frozen=True)
class IntervalUnits(Note):
    """Torque units of the intervals, and what absolute ones assume."""

    scale: TorqueScale


@dataclass(frozen=True)
class ElasticGears(Note):
    """The intervals allow for elastic gears."""


@dataclass(frozen=True)
class PoorlySeparated(Note):
    """The motion separates some parameters poorly."""

    condition: float  #: of the scaled normal equations
    from_sums: bool = False  #: whether only sums of squares are there, in which digits are lost


@dataclass(frozen=True)
class UnrestrictedBodies(Note):
    """Physically inconsistent bodies were allowed because no others were found."""

    reason: str  #: of the solver


@dataclass(frozen=True)
class ManyOutliers(Note):
    """Too many rows of a joint stand out to be outliers."""

    joint: str
    share: float  #: of its rows


@dataclass(frozen=True)
class ReweightingNotConverged(Note):
    """A robust fit did not converge."""

    iterations: int


@dataclass(frozen=True)
class PriorContradicted(Note):
    """Data and stated bodies differ."""

    parameters: tuple[str, ...]
    deviations: float  #: standard deviations that each exceeds


@dataclass(frozen=True)
class WeakInstruments(Note):
    """Commands that hardly show some parameters."""

    parameters: tuple[str, ...]


# Validation


class NoEssentialParameters(Enum):
    """Why no essential parameters are chosen."""

    NOTHING_HELD_OUT = auto()


@dataclass(frozen=True)
class NotConsistent(Note):
    """No physically consistent parameters were found."""

    reason: str  #: of the solver


@dataclass(frozen=True)
class CostlyBodies(Note):
    """Physically consistent bodies predict worse."""

    check: ConsistencyCheck


@dataclass(frozen=True)
class NotEssential(Note):
    """No essential parameters were chosen."""

    reason: NoEssentialParameters | str  #: a text is that of the solver
