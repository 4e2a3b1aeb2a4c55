"""A design from beginning to end: search, check once more, write down."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import BinaryIO

from hil.cell import Cell
from hil.errors import InputError, OperatorStopError, UnsafeError
from hil.progress import Reporter, Task
from identification.excitation import (
    Design,
    ForeignJournalError,
    Journal,
    JournalError,
    NoFeasibleMotionError,
    Population,
    Problem,
    Progress,
    SearchSettings,
    sampled,
    search,
)

from .advice import no_excitation
from .folder import DesignFolder
from .knowledge import Knowledge
from .problem import problem_of, search_settings
from .result import DesignResult
from .settings import DesignSettings


@dataclass(frozen=True, eq=False)
class Designed:
    """A search that came to an end, and what was written down of it."""

    design: Design
    result: DesignResult


def run_search(
    cell: Cell,
    settings: DesignSettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    known: Knowledge | None = None,
    journal: BinaryIO | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Design:
    """Search a motion for a cell.

    Args:
        cell: the robot, its limits and surroundings.
        settings: of the design.
        reporter: is told how far the search is, and its best motion so far.
        workers: processes that score motions; the result does not depend on how many.
        known: an earlier estimate, to which the motion is to add.
        journal: file that keeps what was scored, to resume from; None to keep nothing.
        stop: asked between generations; true ends the search with the best motion so far.

    Raises:
        NoExcitationError: no motion keeps every constraint: which forbids it, where, by how much.
        OperatorStopError: it was stopped before there was one.
        InputError: the journal is of another search.
        SettingsError, CellError: settings and cell do not fit together.
    """
    return _searched(
        problem_of(cell, settings, known),
        search_settings(settings),
        reporter,
        workers=workers,
        journal=journal,
        stop=stop,
    )


def run_design(
    folder: DesignFolder,
    cell: Cell,
    settings: DesignSettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    known: Knowledge | None = None,
    stop: Callable[[], bool] = lambda: False,
    resume: bool = False,
    force: bool = False,
) -> Designed:
    """Search a motion for a cell as :func:`run_search` does, and write it into a folder.

    A search that was stopped leaves its best motion, marked as incomplete, and a journal to go on
    from. With `resume` it goes on with the journal in the folder; with `force` it replaces a
    design that is there.

    Raises:
        InputError: there is a design in the folder and it is neither to be replaced nor resumed.
        UnsafeError: the motion found does not pass the check before it is written down.
        HilError: see :func:`run_search`.
    """
    problem = problem_of(cell, settings, known)  # before anything is replaced by what cannot be
    if not resume:
        folder.begin(settings, force=force)
    with folder.opened_journal() as journal:
        design = _searched(
            problem,
            search_settings(settings),
            reporter,
            workers=workers,
            journal=journal,
            stop=stop,
        )
    _check_once_more(problem, design)
    archives = () if known is None else known.archives
    result = DesignResult.of(cell, settings, design, problem.objective, archives)
    result.save(folder.result, cell)
    return Designed(design, result)


def _searched(
    problem: Problem,
    settings: SearchSettings,
    reporter: Reporter,
    *,
    workers: int,
    journal: BinaryIO | None,
    stop: Callable[[], bool],
) -> Design:
    bar: _Bar | None = None
    with ExitStack() as stack:
        population = stack.enter_context(Population(problem, workers))
        kept = None if journal is None else _journal(journal, problem, settings)

        def told(progress: Progress) -> None:
            nonlocal bar
            if bar is None:
                title = "designing the excitation (motions)"
                bar = _Bar(stack.enter_context(reporter.task(title, progress.total)))
            bar.show(progress)

        try:
            return search(population, settings, journal=kept, progress=told, stop=stop)
        except NoFeasibleMotionError as error:
            if error.stopped:
                raise OperatorStopError(
                    f"stopped before there was a motion that keeps every constraint: {error}"
                ) from error
            raise no_excitation(error) from error


class _Bar:
    """Shows a search's progress on a running task."""

    def __init__(self, task: Task) -> None:
        self._task, self._done = task, 0

    def show(self, progress: Progress) -> None:
        self._task.advance(progress.evaluated - self._done, _note(progress))
        self._done = progress.evaluated


def _note(progress: Progress) -> str:
    where = {
        "sample": "looking at random motions",
        "search": f"generation {progress.generation} of {progress.generations}",
        "polish": "polishing",
    }[progress.phase]
    if math.isnan(progress.coupling_index):
        return f"{where}, {progress.feasible} feasible"
    return f"{where}, log det {progress.log10_det:.1f}, I_c {progress.coupling_index:.1f}"


def _journal(file: BinaryIO, problem: Problem, settings: SearchSettings) -> Journal:
    try:
        return Journal(file, problem, settings)
    except ForeignJournalError as error:
        raise InputError(
            file.name,
            f"was begun with another {error.part}: {error}",
            remedy="resume with the same cell, settings and archives, or begin anew (--force)",
        ) from error
    except JournalError as error:
        raise InputError(file.name, str(error), remedy="begin anew (--force)") from error


def _check_once_more(problem: Problem, design: Design) -> None:
    """Refuse to write down a motion that, as it is going to be run, breaks a constraint."""
    trajectory = design.excitation.trajectory
    found = problem.constraints.violations(trajectory, sampled(trajectory))
    if found:
        raise UnsafeError(f"the motion found does not pass its last check: {found[0]}")
