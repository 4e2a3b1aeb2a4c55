"""Settings and folder of a study."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

from hil.base.errors import InputError
from hil.base.files import lock_folder, write_output
from hil.base.safe_input import read_text
from hil.results.results import Frozen

Count = Annotated[int, Field(strict=True, ge=1)]


class Effort(Frozen):
    """Size of a search."""

    population: int = Field(ge=4)
    generations: Count

    @property
    def tried(self) -> int:
        """Number of evaluated motions."""
        return self.population * self.generations


class StudySettings(Frozen):
    """Settings that determine the results of a study."""

    seed: int = Field(ge=0, description="of searches, held-out motions and the simulated cell")
    repetitions: int = Field(ge=2, description="executions of each excitation")
    motions: int = Field(ge=2, description="held-out motions")
    effects: bool = Field(description="whether to repeat it with unmodelled effects")
    effort_a: Effort = Field(description="of each search of method A")
    effort_b: Effort = Field(description="of the search of method B")
    cell: str = Field(default="", description="digest of the cell, empty for the paper's NS 16")


FULL: Final = StudySettings(
    seed=1,
    repetitions=30,
    motions=30,
    effects=True,
    # Sizes of the paper's Table 1; for method A, of each of its searches.
    effort_a=Effort(population=100, generations=120),
    effort_b=Effort(population=150, generations=120),
)
"""Sizes of the paper: 30 executions, 30 motions."""

QUICK: Final = FULL.model_copy(
    update={
        "repetitions": 4,
        "motions": 10,
        "effort_a": Effort(population=40, generations=12),
        "effort_b": Effort(population=40, generations=12),
    }
)
"""The same procedure in minutes, too small to draw conclusions about the methods."""


def study_settings(
    *,
    quick: bool = False,
    repetitions: int | None = None,
    motions: int | None = None,
    seed: int | None = None,
    effects: bool = True,
) -> StudySettings:
    """Return the settings of the full or quick study, with those replaced that are not None."""
    given = {"repetitions": repetitions, "motions": motions, "seed": seed, "effects": effects}
    changes = {name: value for name, value in given.items() if value is not None}
    return StudySettings.model_validate((QUICK if quick else FULL).model_dump() | changes)


@dataclass(frozen=True)
class StudyFolder:
    """Paths in the folder of a study."""

    root: Path

    def design(self, key: str) -> Path:
        """Return the folder of one search."""
        return self.root / "designs" / key

    def campaign(self, condition: str, key: str) -> Path:
        """Return the campaign folder of one excitation under one condition."""
        return self.root / "campaigns" / condition / key

    @property
    def settings(self) -> Path:
        """File of the settings."""
        return self.root / "study.json"

    def locked(self) -> AbstractContextManager[None]:
        """Create and lock the folder."""
        return lock_folder(self.root, "study", "--output")

    def begin(self, settings: StudySettings) -> None:
        """Write the settings, or raise InputError unless they are those of the existing study."""
        remedy = "use another folder (--output)"
        if not self.settings.exists():
            if any(self.root.iterdir()):
                raise InputError(self.root, "is not empty and contains no study", remedy=remedy)
            write_output(self.settings, settings.to_json())
            return
        try:
            old = StudySettings.model_validate_json(read_text(self.settings))
        except (OSError, ValueError) as error:
            problem = f"is not the settings of a study ({error})"
            raise InputError(self.settings, problem, remedy=remedy) from error
        for name in StudySettings.model_fields:
            new = getattr(settings, name)
            existing = getattr(old, name)
            if new != existing:
                raise InputError(
                    self.settings,
                    f"the study in this folder was started with {existing!s}, not {new!s}",
                    field=name,
                    remedy=f"use the same settings to resume it, or {remedy}",
                )
