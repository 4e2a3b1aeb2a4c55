"""Rehearsal: what it found, in `rehearsal.json`."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal, Self

from pydantic import StrictBool, model_validator

from hil.archive.campaign_archives import load_record
from hil.base.files import write_output
from hil.base.terminal_text import typed
from hil.results.results import Frozen

from .folder import CampaignFolder

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


class RehearsalCriterion(Frozen):
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
    criteria: list[RehearsalCriterion]
    assumed: list[str]
    """Assumed properties of the simulated arm, in sentences."""
    not_seen: list[str]
    """What this rehearsal cannot detect, in sentences."""
    repetitions: int
    motion_seconds: float
    software: dict[str, str]

    @model_validator(mode="after")
    def _judged_by_its_criteria(self) -> Self:
        """Require that it passed if and only if it met every criterion."""
        met = [criterion.name for criterion in self.criteria if criterion.passed]
        if self.passed != (len(met) == len(self.criteria) and set(met) == {*CRITERIA}):
            raise ValueError("passed is not what its criteria say")
        return self

    @classmethod
    def load(cls, folder: CampaignFolder) -> Rehearsal | None:
        """Return the rehearsal of a campaign, of any plan; None without one.

        Raises:
            CampaignFolderError: the file cannot be read.
        """
        remedy = f"rehearse again (`hil rehearse {typed(folder.root)} --again`)"
        return load_record(cls, folder.rehearsal, remedy, strict=False)

    def save(self, path: Path) -> None:
        """Write the file (OutputError if the disk refuses)."""
        write_output(path, self.model_dump_json(indent=1) + "\n")

    @property
    def failures(self) -> tuple[str, ...]:
        """Criteria that were not met, in the sentences of the file."""
        return tuple(criterion.sentence for criterion in self.criteria if not criterion.passed)
