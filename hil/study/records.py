"""What is kept of the archives that were read, one file each, so that nothing is read twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence, Sized
from pathlib import Path
from typing import Annotated, Any, Final, Self, TypeVar

from pydantic import Field, model_validator

from hil.files import make_folder, write_or_tell
from hil.reading import text_of
from hil.results.frozen import Frozen

from .forms import MotionForm

VERSION = 2
"""Counted up when the same archives come to give other numbers."""

PLANTED: Final = "planted"
"""Name of the planted parameters among the estimates."""


Count = Annotated[int, Field(ge=0, lt=2**53)]
"""What a float holds exactly: counts are averaged."""


class Record(Frozen):
    """What one reading of archives gave; `inputs` is a digest of all that it rests on."""

    inputs: str


class FitRecord(Record):
    """Estimates from the repetitions of one excitation; lists are in the model's order."""

    repetitions: list[str]
    values: list[list[float]]
    """Of each repetition by itself (eq. 4)."""
    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    noise_std: list[float]
    log10_det: float
    coupling_index: float
    n_samples: Count
    """Of one repetition, as it was executed."""
    correlation: list[list[float]]
    duration: float
    time: list[float]
    position: list[list[float]]
    """Joint by joint, of the first repetition."""
    velocity: list[list[float]]

    @model_validator(mode="after")
    def _of_one_model(self) -> Self:
        p, n = len(self.pooled), len(self.noise_std)
        _require(p > 0 and n > 0 and len(self.repetitions) > 0, "pooled, noise_std, repetitions")
        _require(_shaped(self.values, len(self.repetitions), p), "values")
        _require(len(self.pooled_std) == p, "pooled_std")
        _require(_shaped(self.correlation, p, p), "correlation")
        _require(_shaped(self.position, n, len(self.time)), "position")
        _require(_shaped(self.velocity, n, len(self.time)), "velocity")
        return self


class MotionScore(Frozen):
    """How well one estimate predicts one motion; lists are per joint.

    Errors are low-passed at 30 Hz, as the paper's Fig. 4 is: what is left is the model's, and not
    the noise of the currents, which is the same for every estimate.
    """

    archive: str
    overall: float
    """||e|| / ||tau|| over all joints."""
    unfiltered: float
    """The same without the low-pass."""
    all_rows: float
    """The same, low-passed, over the whole motion: rows at rest and at reversals are in it."""
    own: float | None
    """||Phi (pi - planted)|| / ||tau||: what the estimate itself is off by; null where nothing is
    planted."""
    relative: list[float]
    mean_abs: list[float]
    mean: list[float]

    @model_validator(mode="after")
    def _of_one_arm(self) -> Self:
        _require(len(self.relative) == len(self.mean_abs) == len(self.mean) > 0, "mean")
        return self


class ExampleRecord(Frozen):
    """One motion in time, low-passed for the eye; lists are joint by joint."""

    archive: str
    time: list[float]
    measured: list[list[float]]
    predicted: dict[str, list[list[float]]]

    @model_validator(mode="after")
    def _of_one_motion(self) -> Self:
        for name, joints in {"measured": self.measured, **self.predicted}.items():
            _require(_shaped(joints, len(self.measured), len(self.time)), name)
        return self


class ScoreRecord(Record):
    """How well several estimates predict the motions of one class."""

    durations: list[float]
    samples: list[Count]
    """Of each motion, from the first to the last at which a joint moves."""
    left_out: list[list[Count]]
    """How many of them the errors leave out, each per joint: at rest, near ends, at reversals."""
    forms: list[MotionForm]
    """Of each motion: the error of any other estimate."""
    scores: dict[str, list[MotionScore]]
    examples: list[ExampleRecord]

    @model_validator(mode="after")
    def _of_the_same_motions(self) -> Self:
        motions = len(self.durations)
        _require(motions == len(self.samples) == len(self.forms) > 0, "samples, forms")
        n = len(self.forms[0].columns)
        _require(all(len(one.columns) == n for one in self.forms), "forms")
        _require(len({one.n_parameters for one in self.forms}) == 1, "forms")
        _require(_shaped(self.left_out, motions, n), "left_out")
        for name, scores in self.scores.items():
            each = [one.relative for one in scores]
            _require(_shaped(each, motions, n), f"scores of {name}")
        _require(all(len(one.measured) == n for one in self.examples), "examples")
        return self

    def tells_of(self, archives: Sequence[str], estimates: Mapping[str, Sized]) -> bool:
        """Whether it is about these motions and estimates, by name and number of parameters."""
        sizes = {len(one) for one in estimates.values()}
        return (
            [one.archive for one in self.forms] == list(archives)
            and self.scores.keys() == estimates.keys()
            and sizes <= {self.forms[0].n_parameters}
        )


R = TypeVar("R", bound=Record)


def kept(path: Path, kind: type[R], inputs: str) -> R | None:
    """A record that rests on these inputs, if there is one that can be read."""
    try:
        record = kind.model_validate_json(text_of(path))
    except (OSError, ValueError):
        return None
    return record if record.inputs == inputs else None


def keep(path: Path, record: Record) -> None:
    """Write a record."""
    make_folder(path.parent)
    write_or_tell(path, record.model_dump_json() + "\n")


def digest(archives: Sequence[tuple[str, str]], others: Mapping[str, Any]) -> str:
    """Digest of archives (name, checksum) and of whatever else a record rests on."""
    content = json.dumps([VERSION, list(archives), others], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def read_or_make(path: Path, kind: type[R], inputs: str, make: Callable[[], R]) -> R:
    """The record in a file if it rests on the same, else a new one, which is written."""
    record = kept(path, kind, inputs)
    if record is None:
        record = make()
        keep(path, record)
    return record


def _shaped(rows: Sequence[Sequence[Any]], count: int, length: int) -> bool:
    """Whether there are so many rows of one length."""
    return len(rows) == count and all(len(row) == length for row in rows)


def _require(fits: bool, field: str) -> None:
    if not fits:
        raise ValueError(f"{field}: lengths that do not belong together")
