"""What a study is asked for: how much is searched, run and predicted; the full and the quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import Field

from hil.errors import InputError
from hil.reading import text_of
from hil.results.frozen import Frozen

Count = Annotated[int, Field(strict=True, ge=1)]


class Effort(Frozen):
    """How hard a search tries: individuals in a generation, and generations."""

    population: int = Field(ge=4)
    generations: Count

    @property
    def tried(self) -> int:
        """Motions that are looked at."""
        return self.population * self.generations


class StudySettings(Frozen):
    """Everything that decides about the numbers of a study, and nothing else."""

    seed: int = Field(ge=0, description="of searches, held-out motions and the simulated cell")
    repetitions: int = Field(ge=2, description="executions of each excitation")
    motions: int = Field(ge=2, description="held-out motions of each class")
    effects: bool = Field(description="whether all is run again with what the model leaves out")
    effort_a: Effort = Field(description="of each search of method A")
    effort_b: Effort = Field(description="of each search of method B, the ablations' too")
    ablation_repetitions: Count
    fly: tuple[float, ...] = Field(description="fly-by shares of B's via points, run again")
    n_via: tuple[int, ...] = Field(description="via points K of searches like B's")
    coupling_weight: tuple[float, ...] = Field(description="lambda_2 of searches like B's")
    subsets: tuple[int, ...] = Field(description="numbers of repetitions that are fitted")
    noise: tuple[float, ...] = Field(description="multiples of the cell's current noise")
    cell: str = Field(
        default="", description="digest of the simulated cell, empty for the NS 16 of the paper"
    )

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read settings that `to_json` wrote.

        Raises:
            InputError: they cannot be read.
        """
        try:
            return cls.model_validate_json(text_of(path))
        except (OSError, ValueError) as error:
            raise InputError(
                path, "is not the settings of a study", remedy="name another folder (--output)"
            ) from error

    def to_json(self) -> str:
        """As indented JSON."""
        return self.model_dump_json(indent=1) + "\n"


FULL: Final = StudySettings(
    seed=1,
    repetitions=30,
    motions=30,
    effects=True,
    # The sizes of the paper's Table 1; method A has them for each of its four searches.
    effort_a=Effort(population=100, generations=120),
    effort_b=Effort(population=150, generations=120),
    ablation_repetitions=3,
    fly=(0.0, 0.25, 0.5, 0.75, 1.0),
    n_via=(3, 4, 6, 10, 14),
    coupling_weight=(0.0, 0.3, 0.6, 0.9, 1.0),
    subsets=(1, 2, 5, 10, 20, 30),
    noise=(0.0, 1.0, 4.0, 16.0),
)
"""As in the paper: 30 executions, 30 motions, searches of its size."""

QUICK: Final = StudySettings(
    seed=1,
    repetitions=4,
    motions=10,  # with fewer, no outcome at all could pass the correction for nine comparisons
    effects=True,
    effort_a=Effort(population=40, generations=12),
    effort_b=Effort(population=40, generations=12),
    ablation_repetitions=1,
    fly=(0.0, 0.5, 1.0),
    n_via=(4, 6, 10),
    coupling_weight=(0.0, 0.3, 0.9),
    subsets=(1, 2, 4),
    noise=(0.0, 1.0, 16.0),
)
"""The same way in minutes: it shows how the study works, and little about the methods."""


def study_settings(
    *,
    quick: bool = False,
    repetitions: int | None = None,
    motions: int | None = None,
    seed: int | None = None,
    effects: bool = True,
) -> StudySettings:
    """The full or the quick study with some settings replaced; None keeps a setting."""
    base = QUICK if quick else FULL
    given = {"repetitions": repetitions, "motions": motions, "seed": seed}
    changes = {name: value for name, value in given.items() if value is not None}
    return StudySettings.model_validate(base.model_dump() | changes | {"effects": effects})
