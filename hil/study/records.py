"""Estimates and predictions from the archives of a study, cached as JSON records.

The torque error Phi pi - tau is linear in the parameters pi, also after a low-pass. Its squared
norm is y' G y with y = [-pi; 1] and G the Gram matrix of the low-passed [Phi | tau], so that one
matrix per motion gives the error of any estimate.
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
"""To be incremented when numbers or format of the records change."""
PLANTED: Final = "planted"  #: Key of the true parameters among the estimates
SHOWN: Final = 1200  #: Maximum number of rows of a series in a figure
FIGURE_DIGITS: Final = 5
_MOVING: Final = 1e-3  # speed above which a joint moves, rad/s or m/s


class Record(Frozen):
    """A cached result."""

    inputs: str  #: Digest of everything it depends on


class Fitted(Frozen):
    """Estimate from all repetitions of one excitation."""

    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    log10_det: float  #: Of the executed motion
    coupling_index: float  #: Of the executed motion
    correlation: list[list[float]]  #: Of the executed motion
    time: list[float]
    position: list[list[float]]  #: Per joint, of the first repetition


class FitRecord(Record, Fitted):
    """Estimates from the repetitions of one excitation."""

    repetitions: list[str]
    values: list[list[float]]  #: Of each repetition (eq. 4)
    n_samples: int  #: Of one repetition
    duration: float


class ExampleRecord(Frozen):
    """Time series of one motion, low-passed for the figure; lists are per joint."""

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
    """Prediction of the held-out motions of one class."""

    durations: list[float]
    left_out: list[float]
    """Share of the moving samples that the errors exclude (rest, ends, reversals), per joint."""
    forms: list[MotionForm]
    mean_abs: dict[str, list[list[float]]]
    """Mean |e| by estimate, motion and joint, N·m."""
    all_rows: dict[str, list[float]]
    """Relative error over all rows, by estimate and motion."""
    examples: list[ExampleRecord]


R = TypeVar("R", bound=Record)


def read_record(path: Path, kind: type[R], inputs: str) -> R | None:
    """Return the record in a file, None if it is absent or of other inputs."""
    try:
        record = kind.model_validate_json(read_text(path))
    except (OSError, ValueError):
        return None
    return record if record.inputs == inputs else None


def write_record(path: Path, record: Record) -> None:
    """Write a record."""
    make_folder(path.parent)
    write_output(path, record.model_dump_json() + "\n")


# Errors of estimates on motions


class ClassForms(NamedTuple):
    """Gram matrices of the m motions of one class, all joints; p parameters."""

    slow: Array  #: of the low-passed [Phi | tau] (m, p + 1, p + 1)
    whole: Array  #: of Phi (m, p, p)
    torque_squared: Array  #: sum over all joints (m,)

    @classmethod
    def of(cls, forms: Sequence[MotionForm]) -> ClassForms:
        """Stack the matrices of motions."""
        whole = np.array([one.whole for one in forms])
        slow = np.array([one.slow for one in forms])
        return cls(slow, whole, np.array([one.torque_squared for one in forms]))

    def torque_kernels(self, values: Array) -> Array:
        """Return the inner products (m, r, r) of the low-passed errors of r estimates (r, p)."""
        left = np.column_stack([-values, np.ones(len(values))])
        return np.asarray(left @ self.slow @ left.T)

    def own_kernels(self, values: Array, truth: Array) -> Array:
        """Return the inner products (m, r, r) of Phi (pi - truth)."""
        away = values - truth
        return np.asarray(away @ self.whole @ away.T)

    def relative(self, kernels: Array, weights: Array) -> Array:
        """Return relative errors (m, s) of weighted means: kernels (m, r, r), weights (s, r)."""
        squared = np.maximum(((weights @ kernels) * weights).sum(axis=2), 0.0)
        return np.asarray(np.sqrt(squared / self.torque_squared[:, None]))

    def overall(self, estimate: Array) -> Array:
        """Return ||e|| / ||tau|| of one estimate (p,) on each motion (m,), low-passed."""
        return self.relative(self.torque_kernels(estimate[None]), np.ones((1, 1)))[:, 0]

    def own(self, estimate: Array, truth: Array) -> Array:
        """Return ||Phi (pi - truth)|| / ||tau|| of one estimate (p,) on each motion (m,)."""
        return self.relative(self.own_kernels(estimate[None], truth), np.ones((1, 1)))[:, 0]


def motion_form(model: RobotModel, archive: str, run: Samples) -> MotionForm:
    """Return the Gram matrices of one motion over its usable rows."""
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
    """Low-pass values (m, c) as in the paper's Fig. 4, per segment; zero without usable rows."""
    slow = np.zeros_like(values)
    for part in run.segments:
        if run.usable[part].any():
            slow[part] = low_pass(run.motion.time[part], values[part], FIGURE_BANDWIDTH)
    return slow


# Estimation and prediction


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
    """Predict the held-out motions of a campaign by several estimates (p,).

    `archives` are of the held-out motions and the standstill; series are of the motion of median
    error.
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
    """Return low-passed errors of estimates on one motion.

    These are mean |e| per joint over usable rows (k, n) and the relative error over all rows (k,).
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
    """Return the samples from the first to the last at which a joint moves."""
    moving = np.flatnonzero((np.abs(run.motion.velocity) > _MOVING).any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)


def _prepared(archives: Sequence[Path]) -> Prepared:
    """Prepare all archives for a fit."""
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
    """Return the checksums of a campaign's complete archives of some kinds, by name."""
    folder = CampaignFolder(root)
    sums = {entry.name: entry.sha256 for entry in folder.manifest()}
    return {path.name: sums[path.name] for kind in kinds for path in folder.completed(kind)}


@dataclass(frozen=True, eq=False)
class Reader:
    """Estimates and predicts in child processes, with records cached in a folder."""

    fits: Path
    reporter: Reporter
    workers: LocalWorkers

    def fit(self, roots: Mapping[str, Path]) -> dict[str, FitRecord]:
        """Estimate from the excitations of each campaign, by key."""
        records = self._read(
            fit,
            [(key, root, "excitation", ()) for key, root in roots.items()],
            "estimating (excitations)",
        )
        return dict(zip(roots, records, strict=True))

    def score(
        self, roots: Mapping[str, Path], estimates: Mapping[str, Array]
    ) -> dict[str, ScoreRecord]:
        """Predict the held-out motions of each class, see :func:`score`."""
        values = {name: estimate.tolist() for name, estimate in estimates.items()}
        tasks = [
            (f"{key}-{name}", roots[key], "validation", (key, values))
            for key, name in OWN_CLASS.items()
        ]
        records = self._read(score, tasks, "predicting (classes of motion)")
        return dict(zip(OWN_CLASS.values(), records, strict=True))

    def _read(
        self,
        function: Callable[..., R],
        tasks: Sequence[tuple[str, Path, str, tuple[Any, ...]]],
        title: str,
    ) -> list[R]:
        """Return the records of tasks: name, campaign, kind of archives, arguments."""
        calls = []
        for name, root, kind, arguments in tasks:
            sums, place = archives_of(root, kind, "standstill"), self.fits / f"{name}.json"
            paths = [CampaignFolder(root).archives / one for one in sums]
            inputs = json_digest([VERSION, list(sums.items()), arguments])
            calls.append((place, (place, function, inputs, paths, *arguments)))
        return in_children(made, calls, title, self.reporter, self.workers)


def made(place: Path, function: Callable[..., R], inputs: str, *arguments: Any) -> R:
    """Return the record of a file if it is valid, else a new one."""
    kind: type[R] = get_type_hints(function)["return"]
    record = read_record(place, kind, inputs)
    if record is None:
        record = function(inputs, *arguments)
        write_record(place, record)
    return record
