"""What is kept of the archives that were read, one file each, so that nothing is read twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from hil.files import make_folder, write_or_tell
from hil.reading import text_of
from hil.results.frozen import Frozen

from .forms import MotionForm

VERSION = 2
"""Counted up when the same archives come to give other numbers."""

PLANTED: Final = "planted"
"""Name of the planted parameters among the estimates."""


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
    n_samples: int
    """Of one repetition, as it was executed."""
    correlation: list[list[float]]
    duration: float
    time: list[float]
    position: list[list[float]]
    """Joint by joint, of the first repetition."""
    velocity: list[list[float]]


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


class ExampleRecord(Frozen):
    """One motion in time, low-passed for the eye; lists are joint by joint."""

    archive: str
    time: list[float]
    measured: list[list[float]]
    predicted: dict[str, list[list[float]]]


class ScoreRecord(Record):
    """How well several estimates predict the motions of one class."""

    durations: list[float]
    samples: list[int]
    """Of each motion, from the first to the last at which a joint moves."""
    left_out: list[list[int]]
    """How many of them the errors leave out, each per joint: at rest, near ends, at reversals."""
    forms: list[MotionForm]
    """Of each motion: the error of any other estimate."""
    scores: dict[str, list[MotionScore]]
    examples: list[ExampleRecord]


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
