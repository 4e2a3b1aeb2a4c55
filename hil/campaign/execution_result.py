"""What a run has done."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

DryRunState = Literal["accepted", "to be accepted", "left out"]


@dataclass(frozen=True)
class Rejected:
    """A motion that ended well and is of no use.

    Attributes:
        archive: its file name.
        reason: in words.
    """

    archive: str
    reason: str


@dataclass(frozen=True)
class RunResult:
    """What a run has done, and where the campaign stands after it.

    Attributes:
        campaign: its folder.
        plan_hash: of the plan that was run.
        simulated: whether nothing but a simulated arm can have moved.
        archives: file names made by this run, in order, whatever became of them.
        rejected: of these, the motions that failed their quality check.
        adopted: archives that an earlier run closed and was killed before it entered them.
        dry_run: whether a person has accepted it; "left out" where the caller did without.
        against_gravity: joints whose torque ran against the model's gravity in the dry run.
        warm_up: "warm", "not warm", "going on", or "none" where none was wanted.
        repetitions: of the excitation that are whole now, of how many.
        validations: likewise of the validation motions.
        complete: whether nothing is missing any more.
        cycles: archived by this run.
        notes: what a reader must know.
    """

    campaign: str
    plan_hash: str
    simulated: bool
    archives: tuple[str, ...]
    rejected: tuple[Rejected, ...]
    adopted: tuple[str, ...]
    dry_run: DryRunState
    against_gravity: tuple[str, ...]
    warm_up: str
    repetitions: tuple[int, int]
    validations: tuple[int, int]
    complete: bool
    cycles: int
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)
