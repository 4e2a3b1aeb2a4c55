"""Notes for the reader of a run's results, as values; `run_messages` words them."""

from __future__ import annotations

from dataclasses import dataclass

from hil.control.motion_refusals import LowerLimit

from .dry_run_record import DryRunRecord
from .joint_warm_up import WarmUpRecord
from .operator import OperatorFault
from .quality_problems import ReplacedRepetitions


@dataclass(frozen=True)
class LowerCurrentLimits:
    """Current limits of the controller that were used, as the cell's are higher."""

    limits: tuple[LowerLimit, ...]


@dataclass(frozen=True)
class AgainstGravity:
    """A dry run in which torques of joints ran against the model's gravity."""

    record: DryRunRecord


@dataclass(frozen=True)
class NotWarm:
    """Repetitions that began before the arm was warm."""

    record: WarmUpRecord


@dataclass(frozen=True)
class WarmedUpAgain:
    """A rest during the campaign, after which the arm was warmed up again."""

    rest: float | None  #: [s]; None: unknown


RunNote = (
    LowerCurrentLimits
    | AgainstGravity
    | NotWarm
    | WarmedUpAgain
    | ReplacedRepetitions
    | OperatorFault
)
