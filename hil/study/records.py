"""Records of the archives that were read, one JSON file each, so that none is read twice.

The error that parameters leave is linear in them, Phi pi - tau, and so is a low-pass. Its squared
length is therefore y' G y with y = [-pi; 1] and G the Gram matrix of the low-passed [Phi | tau]:
one matrix for each motion gives the error of every estimate, without its archive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from hil.batch.workers import LocalWorkers
from hil.campaign import CampaignFolder
from hil.files import json_digest, make_folder, write_output
from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.summary import executed_rows, moving_rows
from hil.progress import Reporter, Silent
from hil.reading import read_text
from hil.results import Frozen
from identification import Factor, RobotModel
from identification.estimators.least_squares import estimate_repetitions
from identification.excitation import correlation, coupling_index, information, log10_det
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass
from identification.validation.prediction import FIGURE_BANDWIDTH, for_figure

from .campaigns import OWN_CLASS, in_children

Array = NDArray[np.float64]

VERSION: Final = 7
"""Counted up when the same archives come to give other numbers, or a record another form."""
PLANTED: Final = "planted"  #: Name of the planted parameters among the estimates
SHOWN: Final = 1200  #: Rows of a series that a figure is drawn from, at most
FIGURE_DIGITS: Final = 5
_MOVES: Final = 1e-3  # rad/s or m/s: a joint that is faster moves


class Record(Frozen):
    """What one reading of archives gave; `inputs` is a digest of all that it rests on."""

    inputs: str


class Fitted(Frozen):
    """Estimate from all repetitions of one excitation; lists are in the model's order."""

    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    log10_det: float  #: Of the motion as it was executed, as the next ones
    coupling_index: float
    correlation: list[list[float]]
    time: list[float]
    position: list[list[float]]  #: Joint by joint, of the first repetition


class FitRecord(Record, Fitted):
    """Estimates from the repetitions of one excitation."""

    repetitions: list[str]
    values: list[list[float]]  #: Of each repetition by itself (eq. 4).
    n_samples: int  #: Of one repetition, as it was executed
    duration: float


class ExampleRecord(Frozen):
    """One motion in time, low-passed for the figure; lists are joint by joint."""

    archive: str
    time: list[float]
    measured: list[list[float]]
    predicted: dict[str, list[list[float]]]


class MotionForm(Frozen):
    """Gram matrices of one held-out motion, over its usable rows, all joints; p parameters."""

    archive: str
    torque_squared: float  #: Sum of the measured torque²
    slow: list[list[float]]  #: Of the low-passed [Phi | tau] (p + 1, p + 1)
    whole: list[list[float]]  #: Of Phi as it is (p, p)


class ScoreRecord(Record):
    """The motions of one class, and what of their errors the forms do not give."""

    durations: list[float]
    left_out: list[float]
    """Share of the samples, from the first to the last at which a joint moves, that the errors
    leave out, per joint: at rest, near ends, at reversals."""
    forms: list[MotionForm]
    mean_abs: dict[str, list[list[float]]]
    """By estimate, motion by motion: mean |e| per joint, N·m."""
    all_rows: dict[str, list[float]]
    """By estimate: relative error of each motion, rows that are left out included."""
    examples: list[ExampleRecord]


R = TypeVar("R", bound=Record)


def read_record(path: Path, kind: type[R], inputs: str) -> R | None:
    """The record in a file, if it rests on these inputs."""
    try:
        record = kind.model_validate_json(read_text(path))
    except (OSError, ValueError):
        return None
    return record if record.inputs == inputs else None


def write_record(path: Path, record: Record) -> None:
    """Write a record."""
    make_folder(path.parent)
    write_output(path, record.model_dump_json() + "\n")


# What a motion says of any estimate


class ClassForms(NamedTuple):
    """The forms of all motions of one class; m motions, n joints, p parameters."""

    slow: Array  #: of the low-passed [Phi | tau], all joints together (m, p + 1, p + 1)
    whole: Array  #: of Phi, likewise (m, p, p)
    torque_squared: Array  #: sum over all joints (m,)

    @classmethod
    def of(cls, forms: Sequence[MotionForm]) -> ClassForms:
        """Arrays of the forms of the motions."""
        whole = np.array([one.whole for one in forms])
        slow = np.array([one.slow for one in forms])
        return cls(slow, whole, np.array([one.torque_squared for one in forms]))

    def torque_kernels(self, values: Array) -> Array:
        """Inner products (m, r, r) of the low-passed errors that r estimates (r, p) leave.

        The error of a weighted mean of estimates is the same mean of their errors.
        """
        left = np.column_stack([-values, np.ones(len(values))])
        return np.asarray(left @ self.slow @ left.T)

    def own_kernels(self, values: Array, truth: Array) -> Array:
        """The same (m, r, r) of Phi (pi - truth), the errors of the estimates themselves."""
        away = values - truth
        return np.asarray(away @ self.whole @ away.T)

    def relative(self, kernels: Array, weights: Array) -> Array:
        """Error over torque (m, s) of weighted means of estimates, weights (s, r), on each motion.

        `kernels` (m, r, r) are of one of the two kinds above.
        """
        squared = np.maximum(((weights @ kernels) * weights).sum(axis=2), 0.0)
        return np.asarray(np.sqrt(squared / self.torque_squared[:, None]))

    def overall(self, estimate: Array) -> Array:
        """||e|| / ||tau|| of one estimate (p,) on each motion (m,), low-passed."""
        return self.relative(self.torque_kernels(estimate[None]), np.ones((1, 1)))[:, 0]

    def own(self, estimate: Array, truth: Array) -> Array:
        """||Phi (pi - truth)|| / ||tau|| of one estimate (p,) on each motion (m,)."""
        return self.relative(self.own_kernels(estimate[None], truth), np.ones((1, 1)))[:, 0]


def motion_form(model: RobotModel, archive: str, run: Samples) -> MotionForm:
    """Form of one motion; rows that are not usable count as zero, as in the errors."""
    n = model.n_parameters
    whole, slow = np.zeros((n, n)), np.zeros((n + 1, n + 1))
    for j, (block, used) in enumerate(zip(*run.regressor(model), strict=True)):
        usable = run.usable[:, j]
        table = np.column_stack([block, run.torque[:, j]]) * usable[:, None]
        whole[np.ix_(used, used)] += table[:, :-1].T @ table[:, :-1]
        passed, both = low_passed(run, table)[usable], [*used, n]
        slow[np.ix_(both, both)] += passed.T @ passed
    return MotionForm(
        archive=archive,
        torque_squared=float((np.where(run.usable, run.torque, 0.0) ** 2).sum()),
        slow=slow.tolist(),
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


# Reading archives


def fit(inputs: str, archives: Sequence[Path]) -> FitRecord:
    """Estimate from each repetition and from all (eq. 4)."""
    prepared = _prepared(archives)
    model, sources = prepared.sources.cell.model, prepared.sources.training
    found = estimate_repetitions(model, prepared.fitted)
    executed = Factor.zero(model)
    parts = [executed_rows(own, one) for own, one in zip(sources, prepared.fitted, strict=True)]
    for one, part in zip(prepared.fitted, parts, strict=True):
        executed = executed + Factor.from_samples(model, one.motion.rows(part), one.torque[part])
    gram, motion, rows = information(executed), prepared.fitted[0].motion, parts[0]
    shown, count = motion.rows(_thinned(rows)), rows.stop - rows.start
    return FitRecord(
        inputs=inputs,
        repetitions=[one.name for one in sources],
        values=[one.values.tolist() for one in found.repetitions],
        pooled=found.pooled.values.tolist(),
        pooled_std=found.pooled.std.tolist(),
        undetermined=list(found.pooled.undetermined),
        log10_det=log10_det(gram, count * len(sources)),
        coupling_index=coupling_index(gram),
        n_samples=count,
        correlation=correlation(gram).tolist(),
        duration=float(motion.time[rows.stop - 1] - motion.time[rows.start]),
        time=_rounded(shown.time - shown.time[0]),
        position=[_rounded(column) for column in shown.position.T],
    )


def score(
    inputs: str, archives: Sequence[Path], key: str, estimates: Mapping[str, Sequence[float]]
) -> ScoreRecord:
    """Predict held-out motions of a campaign by several estimates (p,).

    `archives` are those of its standstill, too. The motion of median error is predicted in time by
    the first two estimates.
    """
    prepared = _prepared(archives)
    names = [f"{key}/{source.name}" for source in prepared.sources.training]
    runs = dict(zip(names, prepared.fitted, strict=True))
    model = prepared.sources.cell.model
    table = np.array(list(estimates.values()), dtype=np.float64)
    errors = [_errors(model, table, run) for run in runs.values()]
    usable = [run.usable[_motion_rows(run)] for run in runs.values()]
    forms = [motion_form(model, name, run) for name, run in runs.items()]
    both, series = ClassForms.of(forms), dict(zip(estimates, table[:2], strict=False))
    every = np.mean([both.overall(one) for one in series.values()], axis=0)
    typical = list(runs)[int(np.argsort(every, kind="stable")[(len(every) - 1) // 2])]
    return ScoreRecord(
        inputs=inputs,
        durations=[float(run.motion.time[-1] - run.motion.time[0]) for run in runs.values()],
        left_out=(1.0 - np.mean(np.concatenate(usable), axis=0)).tolist(),
        forms=forms,
        mean_abs={n: [one[k].tolist() for one, _ in errors] for k, n in enumerate(estimates)},
        all_rows={n: [float(one[k]) for _, one in errors] for k, n in enumerate(estimates)},
        examples=[_example(model, runs[typical], typical, series)],
    )


def _errors(model: RobotModel, table: Array, run: Samples) -> tuple[Array, Array]:
    """Low-passed errors of every row of a table of estimates (k, p) on one motion.

    Mean |e| per joint over usable rows (k, n), and the relative error over all rows (k,). The
    regressor and the low-pass, which cost most, are made once for all of them.
    """
    left = np.zeros((*run.torque.shape, len(table)))
    for j, (block, used) in enumerate(zip(*run.regressor(model), strict=True)):
        left[:, j] = run.torque[:, j, None] - block @ table[:, used].T

    def filtered(error: Array) -> Array:
        return low_passed(run, error.reshape(len(error), -1)).reshape(error.shape)

    whole = _motion_rows(run)
    squared = (filtered(left)[whole] ** 2).sum(axis=(0, 1)) / (run.torque[whole] ** 2).sum()
    left[~run.usable] = 0.0
    slow = np.where(run.usable[..., None], filtered(left), 0.0)
    rows = np.maximum(np.count_nonzero(run.usable, axis=0), 1)
    return (np.abs(slow).sum(axis=0) / rows[:, None]).T, np.sqrt(squared)


def _motion_rows(run: Samples) -> slice:
    """Samples from the first to the last at which a joint moves."""
    moving = np.flatnonzero((np.abs(run.motion.velocity) > _MOVES).any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)


def _prepared(archives: Sequence[Path]) -> Prepared:
    """All archives as they are fitted; nothing is held out of what is asked for."""
    options = replace(FIXED, in_sample=True)
    sources = gather_sources(archives, options.split, in_sample=True)
    return prepare_sources(sources, options, Silent())


def _example(
    model: RobotModel, run: Samples, name: str, estimates: Mapping[str, Array]
) -> ExampleRecord:
    time, shown = run.motion.time, _thinned(moving_rows(run))

    def joints(torque: Array) -> list[list[float]]:
        return [_rounded(column) for column in for_figure(time, torque)[shown].T]

    return ExampleRecord(
        archive=name,
        time=_rounded(time[shown] - time[shown.start]),
        measured=joints(run.torque),
        predicted={
            name: joints(run.predicted_torque(model, values)) for name, values in estimates.items()
        },
    )


def _thinned(rows: slice) -> slice:
    return slice(rows.start, rows.stop, max(1, (rows.stop - rows.start) // SHOWN))


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.{FIGURE_DIGITS}g}") for value in values.tolist()]


# Campaigns


def archives_of(root: Path, *kinds: str) -> dict[str, str]:
    """Checksums of a campaign's whole archives of some kinds, by name."""
    folder = CampaignFolder(root)
    sums = {entry.name: entry.sha256 for entry in folder.manifest()}
    return {path.name: sums[path.name] for kind in kinds for path in folder.completed(kind)}


@dataclass(frozen=True, eq=False)
class Reader:
    """Reads archives in child processes, and keeps what it read as records in a folder."""

    fits: Path
    reporter: Reporter
    workers: LocalWorkers

    def fit(self, roots: Mapping[str, Path]) -> dict[str, FitRecord]:
        """Estimate from the excitations of each campaign, by key."""
        records = self._read(
            fit,
            [(key, root, "excitation", {}, ()) for key, root in roots.items()],
            "estimating (excitations)",
        )
        return dict(zip(roots, records, strict=True))

    def score(
        self, roots: Mapping[str, Path], estimates: Mapping[str, Array]
    ) -> dict[str, ScoreRecord]:
        """Predict the held-out motions of each class; the first two estimates in time, too."""
        values = {name: estimate.tolist() for name, estimate in estimates.items()}
        tasks = [
            (f"{key}-{name}", roots[key], "validation", values, (key, values))
            for key, name in OWN_CLASS.items()
        ]
        records = self._read(score, tasks, "predicting (classes of motion)")
        return dict(zip(OWN_CLASS.values(), records, strict=True))

    def _read(
        self,
        function: Callable[..., R],
        tasks: Sequence[tuple[str, Path, str, object, tuple[Any, ...]]],
        title: str,
    ) -> list[R]:
        """Records of a function by name, root, kind of archives, what else they rest on, and rest.

        Archives of the standstill are read as well, for the noise of positions.
        """
        calls = []
        for name, root, kind, others, arguments in tasks:
            sums, place = archives_of(root, kind, "standstill"), self.fits / f"{name}.json"
            paths = [CampaignFolder(root).archives / one for one in sums]
            inputs = json_digest([VERSION, list(sums.items()), others])
            calls.append((place, (place, function, inputs, paths, *arguments)))
        return in_children(made, calls, title, self.reporter, self.workers, of=len(tasks))


def made(place: Path, function: Callable[..., R], inputs: str, *arguments: Any) -> R:
    """In a child: the record in a file, or a new one, written before anything else can fail."""
    kind: type[R] = get_type_hints(function)["return"]
    record = read_record(place, kind, inputs)
    if record is None:
        record = function(inputs, *arguments)
        write_record(place, record)
    return record
