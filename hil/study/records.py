"""Records of the archives that were read, one JSON file each, so that none is read twice.

The error that parameters leave is linear in them, Phi pi - tau, and so is a low-pass. Its squared
length is therefore y' G y with y = [-pi; 1] and G the Gram matrix of the low-passed [Phi | tau]:
one matrix for each motion gives the error of every estimate, without its archive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.batch.workers import LocalWorkers
from hil.campaign import CampaignFolder
from hil.campaign.plan import moves_from_dict
from hil.errors import ArchiveError, InputError
from hil.files import make_folder, write_or_tell
from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.summary import executed_rows, moving_rows
from hil.io import json_digest
from hil.progress import Reporter, Silent
from hil.reading import text_of
from hil.results import Frozen
from identification import Factor, RobotModel
from identification.estimators.least_squares import estimate_repetitions
from identification.excitation import correlation, coupling_index, information, log10_det
from identification.signals.samples import Samples
from identification.signals.smoothing import low_pass
from identification.validation.prediction import FIGURE_BANDWIDTH, for_figure
from planner import FlyDistance, FlyPercent, InvalidPlanFile

from .campaigns import in_children

Array = NDArray[np.float64]
MotionClass = Literal["fly-by", "stop-to-stop", "sinusoid"]

VERSION: Final = 6
"""Counted up when the same archives come to give other numbers, or a record another form."""
PLANTED: Final = "planted"
"""Name of the planted parameters among the estimates."""
CLASSES: Final[tuple[MotionClass, ...]] = ("fly-by", "stop-to-stop", "sinusoid")
SHOWN: Final = 1200
"""Rows of a series that a figure is drawn from, at most."""
FIGURE_DIGITS: Final = 5
_MOVES: Final = 1e-3
"""rad/s or m/s: a joint that is faster moves."""


class Record(Frozen):
    """What one reading of archives gave; `inputs` is a digest of all that it rests on."""

    inputs: str


class Fitted(Frozen):
    """Estimate from all repetitions of one excitation; lists are in the model's order."""

    pooled: list[float]
    pooled_std: list[float]
    undetermined: list[str]
    log10_det: float
    """Of the motion as it was executed, as the next ones."""
    coupling_index: float
    correlation: list[list[float]]
    time: list[float]
    position: list[list[float]]
    """Joint by joint, of the first repetition."""


class FitRecord(Record, Fitted):
    """Estimates from the repetitions of one excitation."""

    repetitions: list[str]
    values: list[list[float]]
    """Of each repetition by itself (eq. 4)."""
    n_samples: int
    """Of one repetition, as it was executed."""
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
    torque_squared: float
    """Sum of the measured torque²."""
    slow: list[list[float]]
    """Of the low-passed [Phi | tau] (p + 1, p + 1)."""
    whole: list[list[float]]
    """Of Phi as it is (p, p)."""


class ScoreRecord(Record):
    """The motions of one class, and what of their errors the forms do not give."""

    durations: list[float]
    samples: list[int]
    """Of each motion, from the first to the last at which a joint moves."""
    left_out: list[list[int]]
    """How many of them the errors leave out, each per joint: at rest, near ends, at reversals."""
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
        record = kind.model_validate_json(text_of(path))
    except (OSError, ValueError):
        return None
    return record if record.inputs == inputs else None


def write_record(path: Path, record: Record) -> None:
    """Write a record."""
    make_folder(path.parent)
    write_or_tell(path, record.model_dump_json() + "\n")


# What a motion says of any estimate


class ClassForms(NamedTuple):
    """The forms of all motions of one class; m motions, n joints, p parameters.

    Attributes:
        slow: of the low-passed [Phi | tau], all joints together (m, p + 1, p + 1).
        whole: of Phi, likewise (m, p, p).
        torque_squared: sum over all joints (m,).
    """

    slow: Array
    whole: Array
    torque_squared: Array

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


def fit(archives: Sequence[Path], inputs: str) -> FitRecord:
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
    groups: Sequence[tuple[str, Sequence[Path]]],
    inputs: str,
    estimates: Mapping[str, Sequence[float]],
    shown: Sequence[str],
) -> ScoreRecord:
    """Predict held-out motions by several estimates.

    Args:
        groups: key of each campaign, its held-out archives and those of its standstill.
        inputs: digest of all this rests on.
        estimates: parameters (p,) by name.
        shown: estimates of the example in time, drawn on the motion of median error.
    """
    runs: dict[str, Samples] = {}  # every campaign numbers its archives from 0
    for key, archives in groups:
        prepared = _prepared(archives)
        names = [f"{key}/{source.name}" for source in prepared.sources.training]
        runs |= zip(names, prepared.fitted, strict=True)
    model = prepared.sources.cell.model
    table = np.array(list(estimates.values()), dtype=np.float64)
    errors = [_errors(model, table, run) for run in runs.values()]
    usable = [run.usable[_motion_rows(run)] for run in runs.values()]
    forms = [motion_form(model, name, run) for name, run in runs.items()]
    examples = []
    if shown:
        series = {name: np.asarray(estimates[name]) for name in shown}
        both = ClassForms.of(forms)
        every = np.mean([both.overall(one) for one in series.values()], axis=0)
        typical = list(runs)[int(np.argsort(every, kind="stable")[(len(every) - 1) // 2])]
        examples.append(_example(model, runs[typical], typical, series))
    return ScoreRecord(
        inputs=inputs,
        durations=[float(run.motion.time[-1] - run.motion.time[0]) for run in runs.values()],
        samples=[len(rows) for rows in usable],
        left_out=[np.count_nonzero(~rows, axis=0).tolist() for rows in usable],
        forms=forms,
        mean_abs={n: [one[k].tolist() for one, _ in errors] for k, n in enumerate(estimates)},
        all_rows={n: [float(one[k]) for _, one in errors] for k, n in enumerate(estimates)},
        examples=examples,
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


@dataclass(frozen=True)
class Run:
    """One excitation that was executed: its key among the others, label, and campaign folder."""

    key: str
    label: str
    root: Path

    @property
    def folder(self) -> CampaignFolder:
        """The same, to be read."""
        return CampaignFolder(self.root)

    def archives(self, *kinds: str) -> dict[str, str]:
        """Checksums of its whole archives of some kinds by name.

        Raises:
            CampaignFolderError: there is no manifest that can be read.
        """
        names = [path.name for kind in kinds for path in self.folder.completed(kind)]
        sums = {entry.name: entry.sha256 for entry in self.folder.manifest()}
        return {name: sums[name] for name in names}

    def paths(self, names: Sequence[str]) -> list[Path]:
        """Its archives of these names, and those of the standstill, for the noise of positions."""
        return [self.folder.archives / name for name in (*names, *self.archives("standstill"))]


@dataclass(frozen=True, eq=False)
class Reader:
    """Reads archives in child processes, and keeps what it read as records in a folder."""

    fits: Path
    reporter: Reporter
    workers: LocalWorkers

    def fit(self, runs: Sequence[Run]) -> dict[str, FitRecord]:
        """Estimate from the excitations of each run, by key.

        Raises:
            InputError: a run has no whole excitation.
        """
        tasks = []
        for run in runs:
            if not (archives := run.archives("excitation")):
                problem, remedy = "holds no whole excitation", "run the campaign first (hil run)"
                raise InputError(run.root, problem, remedy=remedy)
            inputs = _digest([*run.archives("excitation", "standstill").items()], {})
            tasks.append((run.key, inputs, (run.paths([*archives]), inputs)))
        found = self._read(FitRecord, fit, tasks, "estimating (excitations)")
        return {run.key: record for run, record in zip(runs, found, strict=True)}

    def score(
        self, runs: Sequence[Run], estimates: Mapping[str, Array], shown: Sequence[str]
    ) -> dict[str, ScoreRecord]:
        """Predict the held-out motions of all runs, class by class; by class."""
        values = {name: estimate.tolist() for name, estimate in estimates.items()}
        names = {run.key: classes_of(run) for run in runs}
        tasks, found = [], [one for one in CLASSES if any(one in own for own in names.values())]
        for one in found:
            members = [(run, names[run.key][one]) for run in runs if one in names[run.key]]
            sums = [
                s for run, _ in members for s in run.archives("validation", "standstill").items()
            ]
            others = {"estimates": values, "shown": [*shown], "archives": [o for _, o in members]}
            inputs = _digest(sums, others)
            groups = [(run.key, run.paths(own)) for run, own in members]
            place = f"{'+'.join(key for key, _ in groups)}-{one}"
            tasks.append((place, inputs, (groups, inputs, values, [*shown])))
        records = self._read(ScoreRecord, score, tasks, "predicting (classes of motion)")
        return dict(zip(found, records, strict=True))

    def _read(
        self,
        kind: type[R],
        function: Callable[..., R],
        tasks: Sequence[tuple[str, str, tuple[Any, ...]]],
        title: str,
    ) -> list[R]:
        """Records by name and inputs; those missing, or of other inputs, the function makes."""
        places = [self.fits / f"{name}.json" for name, _, _ in tasks]
        found = [read_record(p, kind, own) for p, (_, own, _) in zip(places, tasks, strict=True)]
        missing = [k for k, record in enumerate(found) if record is None]
        calls = [(places[k], (places[k], function, *tasks[k][2])) for k in missing]
        made = in_children(make_record, calls, title, self.reporter, self.workers, of=len(tasks))
        fresh = iter(made)
        return [next(fresh) if record is None else record for record in found]


def make_record(place: Path, function: Callable[..., R], *arguments: Any) -> R:
    """In a child: read archives, and write the record before anything else can fail."""
    record = function(*arguments)
    write_record(place, record)
    return record


def _digest(archives: Sequence[tuple[str, str]], others: Mapping[str, Any]) -> str:
    """Digest of archives (name, checksum) and of whatever else a record rests on."""
    return json_digest([VERSION, list(archives), others])


def classes_of(run: Run) -> dict[MotionClass, list[str]]:
    """Names of the held-out archives of a run by the class of their planned motion."""
    found: dict[MotionClass, list[str]] = {}
    for name in run.archives("validation"):
        motion_class = class_in(open_archive(run.folder.archives / name))
        found.setdefault(motion_class, []).append(name)
    return found


def plan_in(archive: Archive) -> dict[str, Any]:
    """What an archive says of its planned motion; {} where it says nothing that can be read."""
    try:
        return archive.table("plan.json")
    except ArchiveError:
        return {}


def class_in(archive: Archive) -> MotionClass:
    """Class of the planned motion in an archive.

    A motion in pieces without its moves counts as fly-by, as the interpolator runs it.

    Raises:
        ArchiveError: its plan is not what it should be.
    """
    plan = plan_in(archive)
    trajectory = plan.get("trajectory")
    if isinstance(trajectory, dict) and trajectory.get("type") == "fourier_series":
        return "sinusoid"
    try:
        moves = moves_from_dict(plan)
    except InvalidPlanFile as error:
        raise ArchiveError(archive.path, f"its plan cannot be read: {error}") from error
    for move in () if moves is None else moves.moves:
        match move.fly:
            case FlyPercent(extent) | FlyDistance(extent) if extent > 0.0:
                return "fly-by"
    return "fly-by" if moves is None else "stop-to-stop"
