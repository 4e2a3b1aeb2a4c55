"""All campaigns of one condition: estimates from each, and how each predicts every class."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, foreign_json, open_archive
from hil.campaign import CampaignFolder
from hil.campaign.plan import moves_from_dict
from hil.errors import ArchiveError, InputError
from hil.progress import Reporter
from planner import FlyDistance, FlyPercent, InvalidPlanFile
from planner.commands import Fly

from .campaigns import Workers
from .reading_archives import Reading, fit, score
from .records import (
    CLASSES,
    FitRecord,
    MotionClass,
    Record,
    ScoreRecord,
    digest,
    read_record,
    write_record,
)

Array = NDArray[np.float64]
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

    def reading(self, kind: str, names: Sequence[str] | None = None) -> Reading:
        """Its archives of one kind, all or those named."""

        def paths(chosen: Sequence[str]) -> tuple[Path, ...]:
            return tuple(self.folder.archives / name for name in chosen)

        chosen = [name for name, _ in self.archives(kind)] if names is None else names
        return Reading(paths(chosen), paths([name for name, _ in self.archives("standstill")]))


def fit_all(
    runs: Sequence[Run], fits: Path, reporter: Reporter, workers: Workers
) -> dict[str, FitRecord]:
    """Estimate from the excitations of each run; what was read before is not read again.

    Raises:
        InputError: a run has no whole excitation.
    """
    tasks: list[_Task[FitRecord]] = []
    for run in runs:
        archives = run.archives("excitation")
        if not archives:
            raise InputError(run.root, "holds no whole excitation", remedy="run the campaign first")
        inputs = digest([*archives, *run.archives("standstill")], {})
        place = fits / f"{run.key}.json"
        tasks.append(_Task(place, inputs, FitRecord, fit, (run.reading("excitation"), inputs)))
    found = _all(tasks, "estimating (excitations)", reporter, workers)
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
    tasks: list[_Task[ScoreRecord]] = []
    values = {name: estimate.tolist() for name, estimate in estimates.items()}
    classes = [(run, name, names) for run in runs for name, names in classes_of(run).items()]
    for run, name, names in classes:
        sums = dict(run.archives("validation"))
        archives = [(one, sums[one]) for one in names] + [*run.archives("standstill")]
        inputs = digest(archives, {"estimates": values, "shown": [*shown]})
        arguments = (run.reading("validation", names), inputs, values, list(shown))
        place = fits / f"{run.key}-{name}.json"
        tasks.append(_Task(place, inputs, ScoreRecord, score, arguments))
    found = _all(tasks, "predicting (classes of motion)", reporter, workers)
    by_class: dict[str, ScoreRecord] = {}
    for (run, name, _), record in zip(classes, found, strict=True):
        named = _named(record, run.key)
        by_class[name] = _together(by_class[name], named) if name in by_class else named
    return {name: by_class[name] for name in CLASSES if name in by_class}


@dataclass(frozen=True, eq=False)
class _Task(Generic[R]):
    """A record, and how to make it from archives."""

    place: Path
    inputs: str
    kind: type[R]
    function: Callable[..., R]
    arguments: tuple[Any, ...]


def _all(tasks: Sequence[_Task[R]], title: str, reporter: Reporter, workers: Workers) -> list[R]:
    """The records; those that are missing, or rest on other archives, are made."""
    found = {k: read_record(one.place, one.kind, one.inputs) for k, one in enumerate(tasks)}
    missing = [k for k, record in found.items() if record is None]
    with reporter.task(title, len(tasks)) as task:
        task.advance(len(tasks) - len(missing))
        made = workers.map(
            make_record,
            [(tasks[k].place, tasks[k].function, *tasks[k].arguments) for k in missing],
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
    plan = foreign_json.loads(archive.attachments.get("plan.json", b""))
    return plan if isinstance(plan, dict) else {}


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


def _named(record: ScoreRecord, key: str) -> ScoreRecord:
    """The same with archives named after their run, since every campaign counts from 0."""
    forms, examples = (
        [one.model_copy(update={"archive": f"{key}/{one.archive}"}) for one in some]
        for some in (record.forms, record.examples)
    )
    return record.model_copy(update={"forms": forms, "examples": examples})


def _together(first: ScoreRecord, second: ScoreRecord) -> ScoreRecord:
    """Two records of the same estimates on different motions."""

    def joined(name: str) -> Any:
        some, more = getattr(first, name), getattr(second, name)
        if isinstance(some, dict):
            return {key: [*values, *more[key]] for key, values in some.items()}
        return [*some, *more]

    return first.model_copy(
        update={name: joined(name) for name in ScoreRecord.model_fields if name != "inputs"}
    )
