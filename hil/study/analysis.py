"""All campaigns of one condition: estimates from each, and how each predicts every class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
    ScoreRecord,
    digest,
    read_record,
    write_record,
)

Array = NDArray[np.float64]


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
        folder = CampaignFolder(self.root)
        names = [path.name for path in folder.completed(kind)]
        sums = {entry.name: entry.sha256 for entry in folder.manifest()}
        return tuple((name, sums[name]) for name in names)

    def reading(self, kind: str, names: Sequence[str] | None = None) -> Reading:
        """Its archives of one kind, all or those named."""
        folder = CampaignFolder(self.root)

        def paths(chosen: Sequence[str]) -> tuple[Path, ...]:
            return tuple(folder.archives / name for name in chosen)

        chosen = [name for name, _ in self.archives(kind)] if names is None else names
        return Reading(paths(chosen), paths([name for name, _ in self.archives("standstill")]))


def fit_all(
    runs: Sequence[Run], fits: Path, reporter: Reporter, workers: Workers
) -> dict[str, FitRecord]:
    """Estimate from the excitations of each run; what was read before is not read again.

    Raises:
        InputError: a run has no whole excitation.
    """
    inputs = {}
    for run in runs:
        archives = run.archives("excitation")
        if not archives:
            raise InputError(run.root, "holds no whole excitation", remedy="run the campaign first")
        inputs[run.key] = digest([*archives, *run.archives("standstill")], {})
    found = {
        run.key: read_record(_place(fits, run.key), FitRecord, inputs[run.key]) for run in runs
    }
    missing = [run for run in runs if found[run.key] is None]
    with reporter.task("estimating (excitations)", len(runs)) as task:
        task.advance(len(runs) - len(missing))
        made = workers.map(
            fit_and_keep,
            [
                (run.reading("excitation"), inputs[run.key], _place(fits, run.key))
                for run in missing
            ],
            done=lambda count: task.advance(count),
        )
    found |= {run.key: record for run, record in zip(missing, made, strict=True)}
    return {key: record for key, record in found.items() if record is not None}


def score_all(
    runs: Sequence[Run],
    fits: Path,
    estimates: Mapping[str, Array],
    shown: Sequence[str],
    reporter: Reporter,
    workers: Workers,
) -> dict[str, ScoreRecord]:
    """Predict the held-out motions of all runs, class by class; by class."""
    tasks = []
    values = {name: estimate.tolist() for name, estimate in estimates.items()}
    for run in runs:
        for motion_class, names in classes_of(run).items():
            sums = dict(run.archives("validation"))
            archives = [(name, sums[name]) for name in names]
            inputs = digest(
                [*archives, *run.archives("standstill")], {"estimates": values, "shown": [*shown]}
            )
            tasks.append((run, motion_class, names, inputs))
    places = [_place(fits, f"{run.key}-{motion_class}") for run, motion_class, _, _ in tasks]
    found = [
        read_record(place, ScoreRecord, inputs)
        for place, (_, _, _, inputs) in zip(places, tasks, strict=True)
    ]
    missing = [k for k, record in enumerate(found) if record is None]
    with reporter.task("predicting (classes of motion)", len(tasks)) as task:
        task.advance(len(tasks) - len(missing))
        made = workers.map(
            score_and_keep,
            [
                (
                    tasks[k][0].reading("validation", tasks[k][2]),
                    tasks[k][3],
                    values,
                    list(shown),
                    places[k],
                )
                for k in missing
            ],
            done=lambda count: task.advance(count),
        )
    for k, made_now in zip(missing, made, strict=True):
        found[k] = made_now
    by_class: dict[str, ScoreRecord] = {}
    for (run, motion_class, _, _), record in zip(tasks, found, strict=True):
        assert record is not None
        named = _named(record, run.key)
        there = by_class.get(motion_class)
        by_class[motion_class] = named if there is None else _together(there, named)
    return {name: by_class[name] for name in CLASSES if name in by_class}


def fit_and_keep(reading: Reading, inputs: str, place: Path) -> FitRecord:
    """In a child: estimate, and write it down before anything else can go wrong."""
    record = fit(reading, inputs)
    write_record(place, record)
    return record


def score_and_keep(
    reading: Reading,
    inputs: str,
    estimates: Mapping[str, Sequence[float]],
    shown: Sequence[str],
    place: Path,
) -> ScoreRecord:
    """In a child: predict, and write it down."""
    record = score(reading, inputs, estimates, shown)
    write_record(place, record)
    return record


def classes_of(run: Run) -> dict[MotionClass, list[str]]:
    """Names of the held-out archives of a run by the class that their own plan tells."""
    found: dict[MotionClass, list[str]] = {}
    folder = CampaignFolder(run.root)
    for name, _ in run.archives("validation"):
        motion_class = class_in(open_archive(folder.archives / name))
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

    A motion in pieces whose moves were not kept is taken for fly-by, the interpolator's own way.

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
    return record.model_copy(
        update={
            "scores": {
                name: [one.model_copy(update={"archive": f"{key}/{one.archive}"}) for one in some]
                for name, some in record.scores.items()
            },
            "forms": [
                one.model_copy(update={"archive": f"{key}/{one.archive}"}) for one in record.forms
            ],
            "examples": [
                one.model_copy(update={"archive": f"{key}/{one.archive}"})
                for one in record.examples
            ],
        }
    )


def _together(first: ScoreRecord, second: ScoreRecord) -> ScoreRecord:
    return first.model_copy(
        update={
            "durations": [*first.durations, *second.durations],
            "samples": [*first.samples, *second.samples],
            "left_out": [*first.left_out, *second.left_out],
            "forms": [*first.forms, *second.forms],
            "scores": {k: [*first.scores[k], *second.scores[k]] for k in first.scores},
            "examples": [*first.examples, *second.examples],
        }
    )


def _place(fits: Path, key: str) -> Path:
    return fits / f"{key}.json"
