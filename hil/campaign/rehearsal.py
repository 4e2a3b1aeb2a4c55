"""Result of a rehearsal: `rehearsal.json`, written by `hil.campaign.rehearsal_run`."""

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
"""The two runs of a rehearsal."""
CRITERIA: Final = (
    f"motions ({AS_MODELLED})",
    f"current ({AS_MODELLED})",
    "excitation",
    "parameters",
    "unseen motion",
    f"motions ({EFFECTS})",
    f"current ({EFFECTS})",
)
"""All criteria of a rehearsal."""


class Criterion(Frozen):
    """One criterion of a rehearsal."""

    name: str
    value: float | None
    """Null where it could not be determined."""
    bound: float
    """The largest value that passes."""
    passed: StrictBool
    sentence: str


class Rehearsal(Frozen):
    """The rehearsal of one plan."""

    format_version: Literal[1] = FORMAT_VERSION
    plan_hash: str
    """Of cell, URDF and plan as they were rehearsed."""
    seed: int
    """Of the simulated parameters, the noise and the link faults."""
    passed: StrictBool
    criteria: list[Criterion]
    assumed: list[str]
    """Assumed properties of the simulated arm, in sentences."""
    not_seen: list[str]
    """What this rehearsal cannot detect, in sentences."""
    repetitions: int
    motion_seconds: float
    software: dict[str, str]
    failed_seeds: tuple[int, ...] = ()
    """Seeds with which this plan failed before."""
    motion_hash: str = ""
    """As `plan_hash`, without the number of repetitions; empty in files of older versions."""

    @model_validator(mode="after")
    def _judged_by_its_criteria(self) -> Self:
        """Require that it passed if and only if it met every criterion."""
        met = [one.name for one in self.criteria if one.passed]
        if self.passed != (len(met) == len(self.criteria) and set(met) == {*CRITERIA}):
            raise ValueError("passed is not what its criteria say")
        return self

    @classmethod
    def load(cls, folder: CampaignFolder) -> Rehearsal | None:
        """Return the rehearsal of a campaign, of any plan; None without one.

        Raises:
            CampaignFolderError: the file cannot be read.
        """
        remedy = f"rehearse again (`hil rehearse {folder.root} --again`)"
        return load_record(cls, folder.rehearsal, remedy, strict=False)

    def save(self, path: Path) -> None:
        """Write the file (OutputError if the disk refuses)."""
        write_output(path, self.model_dump_json(indent=1) + "\n")

    def covers(self, folder: CampaignFolder, plan_hash: str) -> bool:
        """Return whether it is of this plan, up to the number of repetitions."""
        if self.plan_hash == plan_hash:
            return True
        return folder.plan_hash == plan_hash and folder.motion_hash == self.motion_hash

    @property
    def failures(self) -> tuple[str, ...]:
        """Criteria that were not met, in sentences."""
        return tuple(one.sentence for one in self.criteria if not one.passed)

    def after(self, before: Rehearsal | None) -> Rehearsal:
        """Return this rehearsal with the seeds with which the same plan failed before."""
        same = before is not None and (
            before.plan_hash == self.plan_hash or before.motion_hash == self.motion_hash
        )
        if before is None or not same:
            return self
        failed = {*before.failed_seeds} | (set() if before.passed else {before.seed})
        return self.model_copy(update={"failed_seeds": tuple(sorted(failed - {self.seed}))})

    @property
    def warning(self) -> str | None:
        """Warning of a passed rehearsal, in a sentence; None for none."""
        if not self.passed or not self.failed_seeds:
            return None
        seeds = ", ".join(map(str, self.failed_seeds))
        return f"the rehearsal passed with seed {self.seed}, but failed with seed {seeds}"

    @property
    def line(self) -> str:
        """Its result, in one sentence."""
        if self.passed:
            but = "" if self.warning is None else f"; {self.warning}"
            return (
                f"the rehearsal passed all {len(self.criteria)} criteria; what it cannot detect "
                f"is in rehearsal.json (not_seen){but}"
            )
        return f"the rehearsal failed: {'; '.join(self.failures)}"
