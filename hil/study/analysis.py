"""All campaigns of one condition: estimates from each, and how each predicts every class."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.campaign import CampaignFolder
from hil.campaign.plan import moves_from_dict
from hil.errors import ArchiveError, InputError
from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.sources import gather_sources
from hil.identify.summary import executed_rows, moving_rows
from hil.progress import Reporter, Silent
from identification import Factor, RobotModel
from identification.estimators.repetitions import estimate_repetitions
from identification.excitation import correlation, coupling_index, information, log10_det
from identification.signals.samples import Samples
from identification.validation.prediction import for_figure
from planner import FlyDistance, FlyPercent, InvalidPlanFile
from planner.commands import Fly

from .campaigns import Workers
from .records import (
    CLASSES,
    PLANTED,
    ExampleRecord,
    FitRecord,
    MotionClass,
    Record,
    ScoreRecord,
    digest,
    low_passed,
    motion_form,
    read_record,
    write_record,
)

Array = NDArray[np.float64]

SHOWN: Final = 1200
"""Rows of a series that a figure is drawn from, at most."""
FIGURE_DIGITS: Final = 5
_MOVES: Final = 1e-3
"""rad/s or m/s: a joint that is faster moves."""


def fit(archives: Sequence[Path], inputs: str) -> FitRecord:
    """Estimate from each repetition and from all (eq. 4)."""
    prepared = _prepared(archives)
    model, recordings = prepared.sources.cell.model, prepared.fitted
    found = estimate_repetitions(model, recordings)
    first, source = recordings[0], prepared.sources.training[0]
    rows = executed_rows(source, first)
    executed = Factor.zero(model)
    for one, own in zip(recordings, prepared.sources.training, strict=True):
        part = executed_rows(own, one)
        motion = one.motion.rows(part)
        executed = executed + Factor.from_samples(model, motion, one.torque[part])
    gram, count = information(executed), rows.stop - rows.start
    shown = _thinned(rows)
    return FitRecord(
        inputs=inputs,
        repetitions=[one.name for one in prepared.sources.training],
        values=[one.values.tolist() for one in found.repetitions],
        pooled=found.pooled.values.tolist(),
        pooled_std=found.pooled.std.tolist(),
        undetermined=list(found.pooled.undetermined),
        noise_std=found.pooled.noise_std.tolist(),
        log10_det=log10_det(gram, count * len(recordings)),
        coupling_index=coupling_index(gram),
        n_samples=count,
        correlation=correlation(gram).tolist(),
        duration=float(first.motion.time[rows.stop - 1] - first.motion.time[rows.start]),
        time=_rounded(first.motion.time[shown] - first.motion.time[rows.start]),
        position=[_rounded(column) for column in first.motion.position[shown].T],
        velocity=[_rounded(column) for column in first.motion.velocity[shown].T],
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
    runs: list[Samples] = []
    names: list[str] = []
    for key, archives in groups:
        prepared = _prepared(archives)
        runs += prepared.fitted
        # Every campaign numbers its archives from 0.
        names += [f"{key}/{source.name}" for source in prepared.sources.training]
    model = prepared.sources.cell.model
    table = np.array(list(estimates.values()), dtype=np.float64)
    truth = list(estimates).index(PLANTED) if PLANTED in estimates else None
    by_motion = [_errors(model, table, run, truth) for run in runs]
    usable = [run.usable[_motion_rows(run)] for run in runs]
    errors: dict[str, dict[str, Any]] = {"own": {}} | {
        quantity: {
            name: [some[quantity][k].tolist() for some in by_motion]
            for k, name in enumerate(estimates)
            if quantity != "own" or k != truth
        }
        for quantity in by_motion[0]
    }
    examples = []
    if shown:
        every = np.mean([errors["overall"][name] for name in shown], axis=0)
        typical = int(np.argsort(every, kind="stable")[(len(every) - 1) // 2])
        series = {name: np.asarray(estimates[name]) for name in shown}
        examples.append(_example(model, runs[typical], names[typical], series))
    return ScoreRecord(
        inputs=inputs,
        durations=[float(run.motion.time[-1] - run.motion.time[0]) for run in runs],
        samples=[len(rows) for rows in usable],
        left_out=[np.count_nonzero(~rows, axis=0).tolist() for rows in usable],
        forms=[motion_form(model, name, run) for name, run in zip(names, runs, strict=True)],
        examples=examples,
        **errors,
    )


def _errors(model: RobotModel, table: Array, run: Samples, truth: int | None) -> dict[str, Array]:
    """Errors of every row of a table of estimates (k, p) on one motion: (k,), `mean_abs` (k, n).

    The regressor and the low-pass, which cost most, are made once for all of them. `own` is what an
    estimate adds to what the planted values, one of the rows, leave: noise and unmodelled effects.
    """
    left = np.zeros((*run.torque.shape, len(table)))
    blocks, columns = run.regressor(model)
    for j, (block, used) in enumerate(zip(blocks, columns, strict=True)):
        left[:, j] = run.torque[:, j, None] - block @ table[:, used].T

    def filtered(error: Array) -> Array:
        return low_passed(run, error.reshape(len(error), -1)).reshape(error.shape)

    everywhere, whole = filtered(left), _motion_rows(run)
    left[~run.usable] = 0.0
    slow = np.where(run.usable[..., None], filtered(left), 0.0)
    torque = np.where(run.usable, run.torque, 0.0)
    rows = np.maximum(np.count_nonzero(run.usable, axis=0), 1)
    found = {
        "overall": _relative(slow, torque),
        "all_rows": _relative(everywhere[whole], run.torque[whole]),
        "mean_abs": (np.abs(slow).sum(axis=0) / rows[:, None]).T,
    }
    if truth is not None:
        found["own"] = _relative(left - left[..., truth, None], torque)
    return found


def _relative(error: Array, torque: Array) -> Array:
    """||e|| / ||tau|| (k,) of errors (m, n, k) over all joints."""
    return np.asarray(np.sqrt((error**2).sum(axis=(0, 1)) / (torque**2).sum()))


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
    """Numbers of a figure, to as many digits as an eye could want."""
    return [float(f"{value:.{FIGURE_DIGITS}g}") for value in values.tolist()]


R = TypeVar("R", bound=Record)


@dataclass(frozen=True)
class Run:
    """One excitation that was executed.

    Attributes:
        key: names it among the others.
        label: for people.
        root: its campaign folder.
    """

    key: str
    label: str
    root: Path

    @property
    def folder(self) -> CampaignFolder:
        """The same, to be read."""
        return CampaignFolder(self.root)

    def archives(self, kind: str) -> tuple[tuple[str, str], ...]:
        """Names and checksums of its whole archives of one kind.

        Raises:
            CampaignFolderError: there is no manifest that can be read.
        """
        names = [path.name for path in self.folder.completed(kind)]
        sums = {entry.name: entry.sha256 for entry in self.folder.manifest()}
        return tuple((name, sums[name]) for name in names)

    def paths(self, names: Sequence[str]) -> list[Path]:
        """Its archives of these names, and those of the standstill, for the noise of positions."""
        standstill = [name for name, _ in self.archives("standstill")]
        return [self.folder.archives / name for name in (*names, *standstill)]


def fit_all(
    runs: Sequence[Run], fits: Path, reporter: Reporter, workers: Workers
) -> dict[str, FitRecord]:
    """Estimate from the excitations of each run; what was read before is not read again.

    Raises:
        InputError: a run has no whole excitation.
    """
    tasks = []
    for run in runs:
        archives = run.archives("excitation")
        if not archives:
            raise InputError(run.root, "holds no whole excitation", remedy="run the campaign first")
        inputs = digest([*archives, *run.archives("standstill")], {})
        place = fits / f"{run.key}.json"
        tasks.append((place, inputs, fit, (run.paths([name for name, _ in archives]), inputs)))
    found = _all(FitRecord, tasks, "estimating (excitations)", reporter, workers)
    return {run.key: record for run, record in zip(runs, found, strict=True)}


def score_all(
    runs: Sequence[Run],
    fits: Path,
    estimates: Mapping[str, Array],
    shown: Sequence[str],
    reporter: Reporter,
    workers: Workers,
) -> dict[str, ScoreRecord]:
    """Predict the held-out motions of all runs, class by class; by class."""
    values = {name: estimate.tolist() for name, estimate in estimates.items()}
    names = {run.key: classes_of(run) for run in runs}
    tasks, found = [], [one for one in CLASSES if any(one in own for own in names.values())]
    for one in found:
        members = [(run, names[run.key][one]) for run in runs if one in names[run.key]]
        sums = [run.archives(kind) for run, _ in members for kind in ("validation", "standstill")]
        inputs = digest(
            [archive for some in sums for archive in some],
            {"estimates": values, "shown": [*shown], "archives": [own for _, own in members]},
        )
        groups = [(run.key, run.paths(own)) for run, own in members]
        place = fits / f"{'+'.join(key for key, _ in groups)}-{one}.json"
        tasks.append((place, inputs, score, (groups, inputs, values, list(shown))))
    title = "predicting (classes of motion)"
    return dict(zip(found, _all(ScoreRecord, tasks, title, reporter, workers), strict=True))


def _all(
    kind: type[R],
    tasks: Sequence[tuple[Path, str, Callable[..., R], tuple[Any, ...]]],
    title: str,
    reporter: Reporter,
    workers: Workers,
) -> list[R]:
    """Records by place and inputs; those missing, or of other archives, are made by the function.

    The function is called with the given arguments.
    """
    found = {k: read_record(place, kind, inputs) for k, (place, inputs, *_) in enumerate(tasks)}
    missing = [k for k, record in found.items() if record is None]
    with reporter.task(title, len(tasks)) as task:
        task.advance(len(tasks) - len(missing))
        made = workers.map(
            make_record,
            [(place, function, *own) for place, _, function, own in (tasks[k] for k in missing)],
            done=lambda count: task.advance(count),
        )
    found |= dict(zip(missing, made, strict=True))
    return [record for record in found.values() if record is not None]


def make_record(place: Path, function: Callable[..., R], *arguments: Any) -> R:
    """In a child: read archives, and write the record before anything else can fail."""
    record = function(*arguments)
    write_record(place, record)
    return record


def classes_of(run: Run) -> dict[MotionClass, list[str]]:
    """Names of the held-out archives of a run by the class of their planned motion."""
    found: dict[MotionClass, list[str]] = {}
    for name, _ in run.archives("validation"):
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

    Raises:
        ArchiveError: its plan is not what it should be.
    """
    try:
        return class_of(plan_in(archive))
    except InvalidPlanFile as error:
        raise ArchiveError(archive.path, f"its plan cannot be read: {error}") from error


def class_of(plan: Mapping[str, Any]) -> MotionClass:
    """Class of a planned motion: what an archive's `plan.json` says of it.

    A motion in pieces without its moves counts as fly-by, as the interpolator runs it.

    Raises:
        InvalidPlanFile: the moves that it lists are none.
    """
    trajectory = plan.get("trajectory")
    if isinstance(trajectory, dict) and trajectory.get("type") == "fourier_series":
        return "sinusoid"
    moves = moves_from_dict(plan)
    if moves is None or any(_rounds(move.fly) for move in moves.moves):
        return "fly-by"
    return "stop-to-stop"


def _rounds(fly: Fly) -> bool:
    match fly:
        case FlyPercent(percent):
            return percent > 0.0
        case FlyDistance(distance):
            return distance > 0.0
    return False
