"""A design in its folder: search, final check, result file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

from hil.base.errors import HilError, InputError, OperatorStopError, UnsafeError
from hil.base.files import convert_write_errors, json_digest, lock_folder, write_atomically
from hil.base.progress import Reporter
from hil.base.safe_input import open_file
from hil.base.toml_text import to_text
from hil.cell import AngleFrame, Cell
from hil.control.messages import violation_text
from identification import excitation
from identification.excitation.collision_messages import unchecked_text
from identification.text import duration_text

from .messages import criteria_text, infeasible_text, no_excitation
from .problem import problem_of, search_settings
from .result import RESULT, DesignResult, fingerprint
from .settings import DesignSettings, SettingsError, load_settings

PICTURE = "excitation.png"
SETTINGS = "settings.toml"
JOURNAL = "search.journal"
DESIGN_FILES = frozenset((RESULT, PICTURE, SETTINGS, JOURNAL))
"""Files of a design; the folder may contain a campaign too."""

_MARK = "# The settings of the search in this folder"
_HEAD = f"{_MARK}, for `hil design --resume`.\n"


class DesignFolder:
    """Paths of a design's files in a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.result = root / RESULT
        self.picture = root / PICTURE
        self.settings = root / SETTINGS
        self.journal = root / JOURNAL

    def create(self, settings: DesignSettings, *, force: bool) -> None:
        """Write the settings of a new design; with `force` remove an earlier one.

        Raises:
            InputError: there is a design already, or the folder cannot be written to.
        """
        present = [path for path in (self.result, self.journal) if path.exists()]
        if self._has_settings():
            present.append(self.settings)
        elif self.settings.exists():
            problem = "exists and belongs to no design, which would write its settings there"
            remedy = "choose another folder (-o), or move the file"
            raise InputError(self.settings, problem, remedy=remedy)
        if present and not force:
            problem = f"has a design already ({present[0].name})"
            remedy = "resume it (--resume), choose another folder (-o), or add --force"
            raise InputError(self.root, problem, remedy=remedy)
        with convert_write_errors(self.root):
            for path in (self.result, self.picture, self.journal, self.settings):
                path.unlink(missing_ok=True)
            write_atomically(self.settings, _HEAD + "\n" + to_text(settings.to_dict(), {}))

    def resumed_settings(self) -> DesignSettings:
        """Return the settings of the design in this folder.

        Raises:
            InputError: there is none.
        """
        if not self._has_settings():
            remedy = "start one without --resume, or give its folder (-o)"
            raise InputError(self.root, "has no design to resume", remedy=remedy)
        return load_settings(self.settings)

    def _has_settings(self) -> bool:
        """Whether the folder has settings that a design wrote."""
        try:
            with open_file(self.settings) as file:
                return file.read(len(_MARK)) == _MARK.encode()
        except OSError:
            return False

    @contextmanager
    def opened_journal(self) -> Iterator[BinaryIO]:
        """Open or create the journal.

        Raises:
            InputError: it cannot be opened.
        """
        with convert_write_errors(self.root):
            if self.journal.exists():
                open_file(self.journal).close()  # regular files only
            # unbuffered, so that closing the file cannot fail
            file = self.journal.open("r+b" if self.journal.exists() else "x+b", buffering=0)
        with file:
            yield cast(BinaryIO, file)


def _flat(settings: DesignSettings) -> dict[str, Any]:
    """Return settings by dotted names."""
    return {
        f"{name}.{key}" if key else name: entry
        for name, table in settings.to_dict().items()
        for key, entry in (table.items() if isinstance(table, dict) else [("", table)])
    }


@dataclass(frozen=True, eq=False)
class Designed:
    """Problem, design and stored result of a search."""

    problem: excitation.Problem
    design: excitation.Design
    result: DesignResult


def run_design(
    folder: DesignFolder,
    cell: Cell,
    settings: DesignSettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    stop: Callable[[], bool] = lambda: False,
    given: excitation.Given | None = None,
    precision: excitation.Precision | None = None,
    promised: Callable[[excitation.Excitation], list[dict[str, Any]]] | None = None,
    carrying: Cell | None = None,
    resume: bool = False,
    force: bool = False,
    then: Callable[[Designed], None] = lambda _: None,
) -> Designed:
    """Search a motion for a cell as :func:`run_search` does, and write it into a folder.

    A stopped search writes its best motion, marked as incomplete, and a journal, with which
    `resume` continues it. The folder is locked until `then` has returned.

    Args:
        folder: of the design.
        cell: of the arm.
        settings: of the search.
        reporter: of progress.
        workers: processes of the planner.
        stop: request of the operator.
        given: information of the earlier recordings in the settings.
        precision: what their requirements stand for.
        promised: returns what a motion promises for each of these, for the file.
        carrying: cell with a payload that currents and torques must allow for.
        resume: continue a stopped search.
        force: replace an existing design.
        then: called with the result.

    Raises:
        InputError: the folder has a design already, is locked, or cannot be written to.
        UnsafeError: the motion does not pass the final check.
        HilError: see :func:`run_search`.
    """
    problem = problem_of(carrying or cell, settings, given, precision)
    if problem.objective.given is not None:
        seconds = problem.objective.given.duration
        reporter.say(
            f"the criteria count {duration_text(seconds)} of motion in the given recordings"
        )
    with lock_folder(folder.root, "search", "-o"):
        if resume:
            if settings != folder.resumed_settings():
                raise SettingsError(
                    folder.settings,
                    "differ from the requested settings",
                    remedy="resume the search without options, or start one in another folder (-o)",
                )
        else:
            folder.create(settings, force=force)
        arm = carrying or cell
        design = _searched(folder, arm, settings, reporter, problem, workers=workers, stop=stop)
        trajectory = design.excitation.trajectory
        broken = problem.constraints.violations(trajectory, excitation.sampled(trajectory))
        if broken:
            reason = violation_text(broken[0], AngleFrame.of(cell))
            raise UnsafeError(f"the motion does not pass the final check: {reason}")
        result = DesignResult.of(cell, settings, design, problem.objective)
        if promised is not None:
            result = result.with_precision(promised(design.excitation))
        result.save(folder.result)
        done = Designed(problem, design, result)
        then(done)
    return done


def _searched(
    folder: DesignFolder,
    cell: Cell,
    settings: DesignSettings,
    reporter: Reporter,
    problem: excitation.Problem,
    *,
    workers: int,
    stop: Callable[[], bool],
) -> excitation.Design:
    """Search with the journal of the folder."""
    identity: dict[str, dict[str, Any]] = {
        "settings": _flat(settings),
        "cell": fingerprint(cell),
        "criteria": {"names": list(excitation.CRITERIA)},
    }
    if (given := problem.objective.given) is not None:
        identity["given"] = {
            "duration": given.duration,
            "information": json_digest(given.mean.tolist()),
        }
    if (wanted := problem.objective.precision) is not None:
        quantities = wanted.quantities
        arrays = [quantities.directions, quantities.allowed, wanted.density]
        if isinstance(quantities, excitation.LoadQuantities):
            arrays += [quantities.change, quantities.root]
        identity["precision"] = {"digest": json_digest([array.tolist() for array in arrays])}
    with folder.opened_journal() as file:
        journal = _journal(file, identity, reporter)
        design = run_search(
            cell,
            settings,
            reporter,
            workers=workers,
            stop=stop,
            problem=problem,
            journal=journal,
        )
    if journal.error is not None:
        reporter.say(
            f"the last scores are not in the journal ({journal.error.strerror}); a resumed "
            "search computes them again"
        )
    return design


def run_search(
    cell: Cell,
    requested: DesignSettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    stop: Callable[[], bool] = lambda: False,
    problem: excitation.Problem | None = None,
    journal: excitation.Journal | None = None,
) -> excitation.Design:
    """Search a motion for a cell, or for a given problem.

    Args:
        cell: of the arm.
        requested: settings of the search.
        reporter: of progress.
        workers: processes of the planner.
        stop: request of the operator.
        problem: of the search; default: from cell and settings.
        journal: of the scores.

    Raises:
        NoExcitationError: no motion satisfies all constraints.
        OperatorStopError: it was stopped before there was a feasible motion.
        SettingsError, CellError: the settings do not fit the cell.
    """
    problem = problem or problem_of(cell, requested)
    settings = search_settings(requested)
    checker = problem.constraints.checker
    total = excitation.most_evaluations(settings)
    unchecked = None if checker is None else unchecked_text(checker.exceptions)
    if unchecked is not None:
        reporter.say(unchecked)
    done = 0
    note = "scoring the first motions"
    with (
        reporter.task("designing (motions)", total) as task,
        excitation.Population(problem, workers) as population,
    ):
        task.advance(0, note)

        def scored(count: int) -> None:
            nonlocal done
            done += count
            task.advance(count, note)

        def update(progress: excitation.SearchProgress) -> None:
            """Report a generation, whose scores may be from the journal."""
            nonlocal note
            note = _note(progress)
            scored(progress.evaluated - done)

        try:
            design = excitation.search(
                population, settings, journal=journal, progress=update, scored=scored, stop=stop
            )
        except excitation.NoFeasibleMotionError as error:
            raise _without_motion(error, cell, requested, checker) from error
        if design.complete:  # with fewer motions than the limit
            task.advance(total - done, "done")
    if design.exhausted:
        reporter.say(
            f"ended after {design.generations} of {settings.generations} generations: mating "
            "gave no new motions; raise mutation, crossover or population in [search]"
        )
    return design


def _without_motion(
    error: excitation.NoFeasibleMotionError,
    cell: Cell,
    requested: DesignSettings,
    checker: excitation.CollisionChecker | None,
) -> HilError:
    """Return the error about a search that was stopped, or ended, without a feasible motion."""
    frame = AngleFrame.of(cell)
    if not error.stopped:
        return no_excitation(error, frame, checker, requested, cell.model.chain)
    text = infeasible_text(error, frame)
    return OperatorStopError(f"stopped before a feasible motion was found: {text}")


def _note(progress: excitation.SearchProgress) -> str:
    where = {
        "search": f"generation {progress.generation} of {progress.generations}",
        "gradient": "improving by the gradient",
    }[progress.phase]
    if math.isnan(progress.best[0]):
        return f"{where}, {progress.feasible} feasible"
    return f"{where}, {criteria_text(progress.best)}"


def _journal(file: BinaryIO, identity: Mapping[str, Any], reporter: Reporter) -> excitation.Journal:
    try:
        journal = excitation.Journal(file, identity)
    except excitation.JournalError as error:
        remedy = "resume with the same cell and settings, or start again (--force)"
        raise InputError(file.name, str(error), remedy=remedy) from error
    except OSError as error:
        problem = f"cannot be read or written ({error.strerror})"
        remedy = "free disk space or repair the disk, then try again (--resume)"
        raise InputError(file.name, problem, remedy=remedy) from error
    if journal.damaged:
        reporter.say(
            f"{journal.damaged} bytes of the journal are damaged; their scores are computed again"
        )
    return journal
