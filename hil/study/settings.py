"""Settings and folder of a study."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field

from hil.base.errors import InputError
from hil.base.files import lock_folder, write_output
from hil.base.safe_input import read_text
from hil.results.results import Frozen

Count = Annotated[int, Field(strict=True, ge=1)]

PRINTED_DURATION: Final = 16.0
"""Duration of the paper's motion of method B, 15 996 samples at 1 kHz, s."""
PRINTED_REPETITIONS: Final = 30
"""Executions of each excitation in the paper."""


class Effort(Frozen):
    """Size of a genetic search."""

    population: int = Field(ge=4)
    generations: Count

    @property
    def tried(self) -> int:
        """Number of evaluated motions."""
        return self.population * self.generations


class StudySettings(Frozen):
    """Settings that determine the results of a study."""

    seed: int = Field(ge=0, description="of searches, held-out motions and the simulated cell")
    searches: int = Field(ge=2, description="searches of each method")
    repetitions: int = Field(ge=2, description="executions of each excitation")
    motions: int = Field(ge=4, description="held-out motions, half of each class")
    duration: float = Field(gt=0.0, description="duration of every excitation, s")
    shortest: float = Field(
        gt=0.0, le=1.0, description="share of it that a motion through via points takes at least"
    )
    effects: bool = Field(description="whether to study model errors")
    effort_a: Effort = Field(description="for each free choice of method A")
    effort_b: Effort = Field(description="for each free choice of method B")
    effort_gradient: Effort = Field(description="of the genetic search before the gradient")
    gradient_steps: Count = Field(description="of method gradient")
    cell: str = Field(default="", description="digest of the cell, empty for the paper's NS 16")


BOOTSTRAP_DRAWS: Final = 2000
"""Draws of every interval by resampling."""
FULL_STUDY: Final = StudySettings(
    seed=1,
    searches=10,
    repetitions=2,
    motions=30,
    duration=PRINTED_DURATION,
    shortest=0.97,
    effects=True,
    # Of about the same processor time for each method; that of the gradient is its preset.
    effort_a=Effort(population=40, generations=16),
    effort_b=Effort(population=64, generations=20),
    effort_gradient=Effort(population=96, generations=4),
    gradient_steps=180,
)
"""Ten searches of each method, 30 held-out motions as in the paper."""

QUICK_STUDY: Final = FULL_STUDY.model_copy(
    update={
        "searches": 3,
        "motions": 8,
        "effort_a": Effort(population=16, generations=4),
        "effort_b": Effort(population=24, generations=6),
        "effort_gradient": Effort(population=24, generations=4),
        "gradient_steps": 16,
    }
)
"""The same procedure in minutes, too small to draw conclusions about the methods."""


def study_settings(*, quick: bool = False, effects: bool = True, **given: Any) -> StudySettings:
    """Return the settings of the full or quick study, replaced where not None."""
    changes = {name: value for name, value in given.items() if value is not None}
    return StudySettings.model_validate(
        (QUICK_STUDY if quick else FULL_STUDY).model_dump() | {"effects": effects} | changes
    )


@dataclass(frozen=True)
class StudyFolder:
    """Paths in the folder of a study."""

    root: Path

    def design(self, key: str, choice: str) -> Path:
        """Return the folder of one search with one of the open choices of its method."""
        return self.root / "designs" / key / choice

    def campaign(self, key: str) -> Path:
        """Return the campaign folder of the excitation that one search found."""
        return self.root / "campaigns" / key

    @property
    def settings(self) -> Path:
        """File of the settings."""
        return self.root / "study.json"

    def locked(self) -> AbstractContextManager[None]:
        """Create and lock the folder."""
        return lock_folder(self.root, "study", "--output")

    def begin(self, settings: StudySettings) -> None:
        """Write the settings, or raise InputError if an existing study has others."""
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
