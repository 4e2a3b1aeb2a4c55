"""Precision of a campaign over its repetitions, as `precision.json` records it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, Self

from hil.archive.campaign_archives import load_record
from hil.precision.requirements import MIN_CONSECUTIVE_MET, Requirement, requirements_from

from .folder import save_record

MIN_REPETITIONS: Final = 3
"""Repetitions before a campaign ends because more of them do not help."""
OVERDUE_FACTOR: Final = 2
"""Times as many repetitions as were predicted, after which more of them count as no help: the
prediction takes for noise what differs between repetitions in another way, such as friction that
falls while the arm gets warm."""
_VERSION: Final = 1


@dataclass(frozen=True)
class Reached:
    """One requirement after some repetitions.

    Attributes:
        requirement: as typed.
        worst: quantity that is worst.
        half: half of its 95 % interval, in units of the requirement.
        more: further repetitions that would meet it; None if none do, or after one repetition.
    """

    requirement: str
    worst: str
    half: float
    more: int | None

    @property
    def wanted(self) -> Requirement:
        """The requirement."""
        return requirements_from([self.requirement])[0]

    @property
    def ratio(self) -> float:
        """Interval over the required one."""
        return self.half / self.wanted.value


@dataclass(frozen=True)
class PrecisionLook:
    """Precision after some repetitions."""

    repetitions: int
    reached: tuple[Reached, ...]

    @property
    def worst(self) -> Reached:
        """The requirement that is missed most."""
        return max(self.reached, key=lambda reached: reached.ratio)

    @property
    def met(self) -> bool:
        """Whether all requirements are met."""
        return self.worst.ratio <= 1.0


@dataclass(frozen=True)
class PrecisionRecord:
    """Precision of a campaign over its repetitions; `precision.json`.

    Attributes:
        plan_hash: of the plan.
        requirements: as typed.
        looks: one for each repetition, in order.
        outcome: "going on"; "met"; "out of reach", if more repetitions do not help; or "limit".
        unit: a "repetition", or a "pair" of them without and with a payload.
    """

    plan_hash: str
    requirements: tuple[str, ...]
    looks: tuple[PrecisionLook, ...] = ()
    outcome: Literal["going on", "met", "out of reach", "limit"] = "going on"
    unit: Literal["repetition", "pair"] = "repetition"

    @classmethod
    def load(cls, path: Path, plan_hash: str) -> Self | None:
        """Read the file; None without one for this plan (CampaignFolderError if damaged)."""
        record = load_record(cls, path, "remove that file")
        return record if record is not None and record.plan_hash == plan_hash else None

    def save(self, path: Path) -> None:
        """Write the file (OutputError if the disk refuses)."""
        save_record(path, self, _VERSION)

    def with_look(self, look: PrecisionLook, limit: int) -> PrecisionRecord:
        """Return the record after another repetition, of at most `limit`."""
        earlier = tuple(each for each in self.looks if each.repetitions < look.repetitions)
        reached = tuple(
            replace(each, more=None) if _is_overdue(earlier, look, k) else each
            for k, each in enumerate(look.reached)
        )
        look = replace(look, reached=reached)
        looks = (*earlier, look)
        longer = replace(self, looks=looks)
        last = looks[-MIN_CONSECUTIVE_MET:]
        if len(last) == MIN_CONSECUTIVE_MET and all(recent.met for recent in last):
            return replace(longer, outcome="met")
        if look.repetitions >= limit:
            return replace(longer, outcome="limit")
        unreachable = [
            reached.ratio > 1.0
            and (reached.more is None or look.repetitions + reached.more > limit)
            for reached in look.reached
        ]
        promising = [reached.ratio > 1.0 for reached in look.reached]
        if look.repetitions >= MIN_REPETITIONS and any(unreachable) and unreachable == promising:
            return replace(longer, outcome="out of reach")
        return replace(longer, outcome="going on")

    @property
    def measured(self) -> int:
        """Repetitions at the last look, 0 without one."""
        return self.looks[-1].repetitions if self.looks else 0

    @property
    def ended(self) -> bool:
        """Whether no more repetitions are run."""
        return self.outcome != "going on"


def _is_overdue(before: Sequence[PrecisionLook], look: PrecisionLook, index: int) -> bool:
    """Return whether a requirement is unmet `OVERDUE_FACTOR` times as long as was predicted."""
    if look.reached[index].ratio <= 1.0:
        return False
    for earlier in reversed(before):
        reached = earlier.reached[index]
        if reached.ratio <= 1.0:
            return False
        if reached.more and look.repetitions - earlier.repetitions >= OVERDUE_FACTOR * reached.more:
            return True
    return False
