"""How the rehearsal of a plan went: `rehearsal.json`.

This says what was found; `hil.campaign.rehearsal_run` finds it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal, Self

from pydantic import StrictBool, model_validator

from hil.files import write_output
from hil.results import Frozen

from .folder import CampaignFolder, load_record

FORMAT_VERSION: Final = 1
AS_MODELLED: Final = "as modelled"
EFFECTS: Final = "with what the model leaves out"
"""The two runs of a rehearsal, in words."""
CRITERIA: Final = (
    f"motions ({AS_MODELLED})",
    f"current ({AS_MODELLED})",
    "excitation",
    "parameters",
    "unseen motion",
    f"motions ({EFFECTS})",
    f"current ({EFFECTS})",
)
"""What a rehearsal that passed was judged by, all of it."""


class Criterion(Frozen):
    """One thing that a rehearsal is judged by."""

    name: str
    value: float | None
    """What was found; null where it could not be found."""
    bound: float
    """The largest value that passes."""
    passed: StrictBool
    sentence: str


class Rehearsal(Frozen):
    """The rehearsal of exactly one plan."""

    format_version: Literal[1] = FORMAT_VERSION
    plan_hash: str
    """Of cell, URDF and plan as they were rehearsed."""
    seed: int
    """Of the planted parameters, the noise and the link's faults."""
    passed: StrictBool
    criteria: list[Criterion]
    assumed: list[str]
    """What the simulated arm has by assumption, in sentences."""
    not_seen: list[str]
    """What this rehearsal cannot show, in sentences."""
    repetitions: int
    motion_seconds: float
    software: dict[str, str]
    failed_seeds: tuple[int, ...] = ()
    """With which exactly this plan failed before."""
    motion_hash: str = ""
    """As `plan_hash`, whatever the number of repetitions; empty in files of older versions."""

    @model_validator(mode="after")
    def _judged_by_its_criteria(self) -> Self:
        """Passed is what met every criterion there is, and nothing else."""
        met = [one.name for one in self.criteria if one.passed]
        if self.passed != (len(met) == len(self.criteria) and set(met) == {*CRITERIA}):
            raise ValueError("passed is not what its criteria say")
        return self

    @classmethod
    def load(cls, folder: CampaignFolder) -> Rehearsal | None:
        """The rehearsal of a campaign, whatever plan it was of; None if there was none.

        Raises:
            CampaignFolderError: the file cannot be read.
        """
        return load_record(
            cls,
            folder.rehearsal,
            "cannot be read",
            f"rehearse again (`hil rehearse {folder.root} --again`)",
            strict=False,
        )

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all.

        Raises:
            OutputError: the disk refuses.
        """
        write_output(path, self.model_dump_json(indent=1) + "\n")

    def covers(self, folder: CampaignFolder, plan_hash: str) -> bool:
        """Whether it is the rehearsal of a plan, or of the same motions repeated as often or not.

        Raises:
            CampaignFolderError: cell, URDF or plan cannot be read.
        """
        if self.plan_hash == plan_hash:
            return True
        return folder.plan_hash == plan_hash and folder.motion_hash == self.motion_hash

    @property
    def failures(self) -> tuple[str, ...]:
        """What did not pass, in sentences."""
        return tuple(one.sentence for one in self.criteria if not one.passed)

    def after(self, before: Rehearsal | None) -> Rehearsal:
        """This one, with what the same plan failed with before: another seed does not undo it."""
        same = before is not None and (
            before.plan_hash == self.plan_hash or before.motion_hash == self.motion_hash
        )
        if before is None or not same:
            return self
        failed = {*before.failed_seeds} | (set() if before.passed else {before.seed})
        return self.model_copy(update={"failed_seeds": tuple(sorted(failed - {self.seed}))})

    @property
    def warning(self) -> str | None:
        """What a reader of one that passed must know, in a sentence; None for nothing."""
        if not self.passed or not self.failed_seeds:
            return None
        seeds = ", ".join(map(str, self.failed_seeds))
        return f"the rehearsal passed with seed {self.seed}, but failed with seed {seeds}"

    @property
    def line(self) -> str:
        """How it went, in one sentence."""
        if self.passed:
            but = "" if self.warning is None else f"; {self.warning}"
            return (
                f"the rehearsal passed all {len(self.criteria)} criteria; what it cannot see is "
                f"in rehearsal.json (not_seen){but}"
            )
        return f"the rehearsal failed: {'; '.join(self.failures)}"
