"""Records of the archives that were read, one JSON file each, so that none is read twice.

The error that parameters leave is linear in them, Phi pi - tau, and so is a low-pass. Its squared
length is therefore y' G y with y = [-pi; 1] and G the Gram matrix of the low-passed [Phi | tau]:
one matrix for each motion gives the error of every estimate, without its archive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.files import make_folder, write_or_tell
from hil.io import json_digest
from hil.reading import text_of
from hil.results.frozen import Frozen
from identification import RobotModel
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass
from identification.validation.prediction import FIGURE_BANDWIDTH

Array = NDArray[np.float64]
MotionClass = Literal["fly-by", "stop-to-stop", "sinusoid"]

VERSION: Final = 5
"""Counted up when the same archives come to give other numbers, or a record another form."""
PLANTED: Final = "planted"
"""Name of the planted parameters among the estimates."""
CLASSES: Final[tuple[MotionClass, ...]] = ("fly-by", "stop-to-stop", "sinusoid")


class Record(Frozen):
    """What one reading of archives gave; `inputs` is a digest of all that it rests on."""

    inputs: str


class Fitted(Frozen):
    """Estimate from all repetitions of one excitation; lists are in the model's order."""

    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    noise_std: list[float]
    log10_det: float
    """Of the motion as it was executed, as the next ones."""
    coupling_index: float
    correlation: list[list[float]]
    time: list[float]
    position: list[list[float]]
    """Joint by joint, of the first repetition."""
    velocity: list[list[float]]


class FitRecord(Record, Fitted):
    """Estimates from the repetitions of one excitation."""

    repetitions: list[str]
    values: list[list[float]]
    """Of each repetition by itself (eq. 4)."""
    n_samples: int
    """Of one repetition, as it was executed."""
    duration: float


class ClassErrors(Frozen):
    """Relative errors ||e|| / ||tau|| of estimates on the motions of a class, over all joints.

    They are low-passed at 30 Hz as the paper's Fig. 4 is: what remains is the error of the model,
    and not the noise of the currents, which is the same for every estimate.
    """

    durations: list[float]
    overall: dict[str, list[float]]
    own: dict[str, list[float]]
    """||Phi (pi - planted)|| / ||tau||, errors of the estimates themselves, where that is known."""
    mean_abs: dict[str, list[list[float]]]
    """Motion by motion, mean |e| per joint, N·m: the paper's Fig. 3."""
    all_rows: dict[str, list[float]]
    """As `overall`, over the whole motion: rows at rest, near ends and at reversals included."""


class ExampleRecord(Frozen):
    """One motion in time, low-passed for the figure; lists are joint by joint."""

    archive: str
    time: list[float]
    measured: list[list[float]]
    predicted: dict[str, list[list[float]]]


class MotionForm(Frozen):
    """Gram matrices of one held-out motion, over its usable rows; p parameters, n joints."""

    archive: str
    torque_squared: list[float]
    """Sum of the measured torque², per joint."""
    columns: list[list[int]]
    """Parameters that each joint's torque depends on."""
    slow: list[list[list[float]]]
    """Of the low-passed [Phi | tau] of each joint, in these columns and the last."""
    whole: list[list[float]]
    """Of Phi as it is, all joints together (p, p)."""


class ScoreRecord(Record, ClassErrors):
    """How well several estimates predict the motions of one class."""

    samples: list[int]
    """Of each motion, from the first to the last at which a joint moves."""
    left_out: list[list[int]]
    """How many of them the errors leave out, each per joint: at rest, near ends, at reversals."""
    forms: list[MotionForm]
    examples: list[ExampleRecord]


R = TypeVar("R", bound=Record)


def read_record(path: Path, kind: type[R], inputs: str) -> R | None:
    """The record in a file, if it rests on these inputs."""
    try:
        record = kind.model_validate_json(text_of(path))
    except (OSError, ValueError):
        return None
    return record if record.inputs == inputs else None


def write_record(path: Path, record: Record) -> None:
    """Write a record."""
    make_folder(path.parent)
    write_or_tell(path, record.model_dump_json() + "\n")


def digest(archives: Sequence[tuple[str, str]], others: Mapping[str, Any]) -> str:
    """Digest of archives (name, checksum) and of whatever else a record rests on."""
    return json_digest([VERSION, list(archives), others])


def motion_form(model: RobotModel, archive: str, run: Samples) -> MotionForm:
    """Form of one motion; rows that are not usable count as zero, as in the errors."""
    blocks, columns = run.regressor(model)
    n = model.n_parameters
    whole, slow = np.zeros((n, n)), []
    for j, (block, used) in enumerate(zip(blocks, columns, strict=True)):
        usable = run.usable[:, j]
        table = np.column_stack([block, run.torque[:, j]]) * usable[:, None]
        whole[np.ix_(used, used)] += table[:, :-1].T @ table[:, :-1]
        passed = low_passed(run, table)[usable]
        slow.append((passed.T @ passed).tolist())
    return MotionForm(
        archive=archive,
        torque_squared=(np.where(run.usable, run.torque, 0.0) ** 2).sum(axis=0).tolist(),
        columns=[[int(k) for k in used] for used in columns],
        slow=slow,
        whole=whole.tolist(),
    )


def low_passed(run: Samples, values: Array) -> Array:
    """Values (m, c) low-passed as the paper's Fig. 4 is, each segment of a recording by itself.

    A segment without a usable row stays zero.
    """
    slow = np.zeros_like(values)
    for part in run.segments:
        if run.usable[part].any():
            slow[part] = low_pass(run.motion.time[part], values[part], FIGURE_BANDWIDTH)
    return slow


@dataclass(frozen=True, eq=False)
class ClassForms:
    """The forms of all motions of one class; m motions, n joints, p parameters.

    Attributes:
        slow: of the low-passed [Phi | tau] (m, n, p + 1, p + 1).
        whole: of Phi, all joints together (m, p, p).
        torque_squared: (m, n).
    """

    slow: Array
    whole: Array
    torque_squared: Array

    @classmethod
    def of(cls, forms: Sequence[MotionForm]) -> ClassForms:
        """Arrays of the forms of the motions."""
        whole = np.array([one.whole for one in forms])
        size = whole.shape[1] + 1
        slow = np.zeros((len(forms), len(forms[0].columns), size, size))
        for m, one in enumerate(forms):
            for j, (used, gram) in enumerate(zip(one.columns, one.slow, strict=True)):
                index = [*used, size - 1]
                slow[m, j][np.ix_(index, index)] = gram
        return cls(slow, whole, np.array([one.torque_squared for one in forms]))

    def torque_kernels(self, values: Array, joint: int | None = None) -> Array:
        """Inner products (m, r, r) of the low-passed errors that r estimates (r, p) leave.

        The error of a weighted mean of estimates is the same mean of their errors. All joints
        together, or one of them.
        """
        gram = self.slow.sum(axis=1) if joint is None else self.slow[:, joint]
        left = np.column_stack([-values, np.ones(len(values))])
        return np.asarray(left @ gram @ left.T)

    def own_kernels(self, values: Array, truth: Array) -> Array:
        """The same (m, r, r) of Phi (pi - truth), the errors of the estimates themselves."""
        away = values - truth
        return np.asarray(away @ self.whole @ away.T)

    def overall(self, estimate: Array) -> Array:
        """||e|| / ||tau|| of one estimate (p,) on each motion (m,), low-passed."""
        return self._relative(self.torque_kernels(estimate[None]))

    def own(self, estimate: Array, truth: Array) -> Array:
        """||Phi (pi - truth)|| / ||tau|| of one estimate (p,) on each motion (m,)."""
        return self._relative(self.own_kernels(estimate[None], truth))

    def _relative(self, kernels: Array) -> Array:
        squared = np.maximum(kernels[:, 0, 0], 0.0)
        return np.asarray(np.sqrt(squared / self.torque_squared.sum(axis=1)))
