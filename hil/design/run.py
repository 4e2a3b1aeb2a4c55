"""A design from beginning to end: search, check once more, write down."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import BinaryIO, Final

from hil.cell import AngleFrame, Cell
from hil.errors import InputError, OperatorStopError, UnsafeError
from hil.motion_checks import violation_text
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
    most_evaluations,
    sampled,
    search,
)

from .advice import exhausted, forbidden, no_excitation
from .folder import DesignFolder, require_same
from .problem import Knowledge, problem_of, search_settings
from .result import DesignResult
from .settings import DesignSettings

_TITLE: Final = "designing (motions)"


@dataclass(frozen=True, eq=False)
class Designed:
    """A search that came to an end, and what was written down of it."""

    problem: Problem
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
        reporter: shows how far the search is, and its best motion so far.
        workers: processes that score motions; the result does not depend on how many.
        known: an earlier estimate, to which the motion is to add.
        journal: file that keeps what was scored, to resume from; None to keep nothing.
        stop: asked between generations; true ends the search with the best motion so far. A
            motion that hangs holds a generation up for a minute or two.

    Raises:
        NoExcitationError: no motion keeps every constraint: which forbids it, where, by how much.
        OperatorStopError: it was stopped before there was one.
        InputError: the journal is of another search, or cannot be read or begun.
        SettingsError, CellError: settings and cell do not fit together.
    """
    return _searched(
        problem_of(cell, settings, known),
        settings,
        AngleFrame.of(cell),
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
    then: Callable[[Designed], None] = lambda _: None,
) -> Designed:
    """Search a motion for a cell as :func:`run_search` does, and write it into a folder.

    A search that was stopped leaves its best motion, marked as incomplete, and a journal to go on
    from. With `resume` it goes on with the journal in the folder; with `force` it replaces a
    design that is there. No other search gets into the folder until `then`, called with what was
    written, has returned.

    Raises:
        InputError: there is a design in the folder and it is neither to be replaced nor resumed,
            another search is at work in it, or the disk refuses.
        UnsafeError: the motion found does not pass the check before it is written down.
        HilError: see :func:`run_search`.
    """
    problem = problem_of(cell, settings, known)  # before anything is replaced by what cannot be
    with folder.held():
        if resume:  # another search may have been there since they were read
            require_same(settings, folder.interrupted(), folder.settings)
        else:
            folder.begin(settings, force=force)
        with folder.opened_journal() as journal:
            design = _searched(
                problem,
                settings,
                AngleFrame.of(cell),
                reporter,
                workers=workers,
                journal=journal,
                stop=stop,
            )
        _check_once_more(problem, design, AngleFrame.of(cell))
        archives = () if known is None else known.archives
        result = DesignResult.of(cell, settings, design, problem.objective, archives)
        result.save(folder.result, cell)
        done = Designed(problem, design, result)
        then(done)
    return done


def _searched(
    problem: Problem,
    asked: DesignSettings,
    frame: AngleFrame,
    reporter: Reporter,
    *,
    workers: int,
    journal: BinaryIO | None,
    stop: Callable[[], bool],
) -> Design:
    settings, checker = search_settings(asked), problem.constraints.checker
    not_checked = None if checker is None else checker.exceptions
    if not_checked is not None:
        reporter.say(not_checked)
    with ExitStack() as stack:
        task = stack.enter_context(reporter.task(_TITLE, most_evaluations(settings)))
        bar = _Bar(task, reporter)
        population = stack.enter_context(Population(problem, workers))
        if journal is not None:
            bar.journal = run_journal = _journal(journal, problem, settings, reporter)
            stack.callback(run_journal.close)
        try:
            design = search(
                population,
                settings,
                journal=bar.journal,
                progress=bar.entered,
                scored=bar.scored,
                stop=stop,
            )
        except NoFeasibleMotionError as error:
            if error.stopped:
                raise OperatorStopError(
                    "stopped before there was a motion that keeps every constraint: "
                    f"{forbidden(error, frame)}"
                ) from error
            raise no_excitation(error, frame, checker, asked) from error
        bar.end(design)
    return design


class _Bar:
    """Shows a search's progress on a running task, and says what a person should know."""

    def __init__(self, task: Task, reporter: Reporter) -> None:
        self.journal: Journal | None = None
        self._task, self._reporter = task, reporter
        self._done, self._note = 0, "scoring the first motions"
        self._troubled = False
        task.advance(0, self._note)

    def scored(self, count: int) -> None:
        """So many more motions of a generation are scored."""
        self._done += count
        self._task.advance(count, self._note)

    def entered(self, progress: Progress) -> None:
        """A generation is scored, or was in the journal."""
        more, self._done = progress.evaluated - self._done, progress.evaluated
        self._note = _note(progress)
        self._task.advance(more, self._note)
        if self.journal is not None and self.journal.trouble is not None and not self._troubled:
            self._troubled = True
            self._reporter.say(
                f"the journal cannot be written ({self.journal.trouble.strerror}); the search goes "
                "on, and writes it as soon as there is room"
            )

    def end(self, design: Design) -> None:
        """The search has ended."""
        journal = self.journal
        if design.complete:  # a polish that settled, or mating that did, needed fewer
            rest = most_evaluations(design.settings) - self._done
            self._task.advance(rest, "done")
        if design.exhausted:
            self._reporter.say(exhausted(len(design.history), design.settings))
        if journal is None:
            return
        journal.close()
        if journal.recalled:
            self._reporter.say(f"{journal.recalled} motions were known from the journal")
        if journal.trouble is not None:
            self._reporter.say(
                f"the journal lacks the last motions ({journal.trouble.strerror}); a search "
                "resumed from it scores them anew"
            )


def _note(progress: Progress) -> str:
    where = {
        "sample": "looking at random motions",
        "search": f"generation {progress.generation} of {progress.generations}",
        "polish": "polishing",
    }[progress.phase]
    if math.isnan(progress.coupling_index):
        return f"{where}, {progress.feasible} feasible"
    return f"{where}, log det {progress.log10_det:.1f}, I_c {progress.coupling_index:.1f}"


def _journal(
    file: BinaryIO, problem: Problem, settings: SearchSettings, reporter: Reporter
) -> Journal:
    try:
        journal = Journal(file, problem, settings)
    except ForeignJournalError as error:
        raise InputError(
            file.name,
            f"was begun with another {error.part}: {error}",
            remedy="resume with the same cell, settings and archives, or begin anew (--force)",
        ) from error
    except JournalError as error:
        raise InputError(file.name, str(error), remedy="begin anew (--force)") from error
    except OSError as error:
        raise InputError(
            file.name,
            f"cannot be read or written ({error.strerror})",
            remedy="make room or mend the disk, then try again (--resume)",
        ) from error
    if journal.damaged:
        reporter.say(
            f"{journal.damaged} bytes of the journal are damaged; what they held is scored anew"
        )
    return journal


def _check_once_more(problem: Problem, design: Design, frame: AngleFrame) -> None:
    """Refuse to write down a motion that, as it is going to be run, breaks a constraint."""
    trajectory = design.excitation.trajectory
    found = problem.constraints.violations(trajectory, sampled(trajectory))
    if found:
        reason = violation_text(found[0], frame)
        raise UnsafeError(f"the motion found does not pass its last check: {reason}")
