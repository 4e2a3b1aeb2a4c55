"""A design in its folder from beginning to end: search, check once more, write down."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

from hil.cell import AngleFrame, Cell
from hil.errors import InputError, OperatorStopError, UnsafeError
from hil.files import lock_folder, write_atomically
from hil.motion_checks import violation_text
from hil.progress import Reporter
from hil.reading import open_file
from identification import excitation
from planner.toml_text import to_text

from .advice import criteria_text, forbidden, no_excitation
from .problem import Knowledge, problem_of, search_settings
from .result import RESULT, DesignResult, fingerprint
from .settings import DesignSettings, SettingsError, load_settings

PICTURE, SETTINGS, JOURNAL = "excitation.png", "settings.toml", "search.journal"
DESIGN_FILES = frozenset((RESULT, PICTURE, SETTINGS, JOURNAL))
"""What a design leaves; a campaign of its motion may lie beside it."""

_HEAD = "# The settings of the search in this folder; `hil design --resume` goes on with them.\n"


class DesignFolder:
    """Paths of a design's files below one folder, and who may write them."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.result, self.picture = root / RESULT, root / PICTURE
        self.settings, self.journal = root / SETTINGS, root / JOURNAL

    def held(self) -> AbstractContextManager[None]:
        """Make the folder, and keep every other search out of it until this is left."""
        return lock_folder(self.root, "search", "-o")

    def begin(self, settings: DesignSettings, *, force: bool) -> None:
        """Make room for a new design, and write down what is asked for; the folder is held.

        Raises:
            InputError: there is a design already and it is not to be replaced, or the folder
                cannot be written to.
        """
        ours = [path for path in (self.result, self.journal) if path.exists()]
        if self._begun():
            ours.append(self.settings)
        elif self.settings.exists():
            problem = "is in the way: the settings of the design are to be written there"
            remedy = "name another folder (-o), or move the file"
            raise InputError(self.settings, problem, remedy=remedy)
        if ours and not force:
            problem = f"holds a design already ({ours[0].name})"
            remedy = "go on with it (--resume), name another folder (-o), or add --force"
            raise InputError(self.root, problem, remedy=remedy)
        with self._written():
            for path in (self.result, self.picture, self.journal, self.settings):
                path.unlink(missing_ok=True)
            write_atomically(self.settings, _HEAD + "\n" + to_text(settings.to_dict(), {}))

    def interrupted(self) -> DesignSettings:
        """Return the settings of the design in this folder.

        Raises:
            InputError: there is none.
        """
        if not self._begun():
            remedy = "begin one without --resume, or name its folder (-o)"
            raise InputError(self.root, "holds no design to go on with", remedy=remedy)
        return load_settings(self.settings)

    def _begun(self) -> bool:
        """Whether the settings in the folder are those of a design, not a person's own."""
        try:
            with open_file(self.settings) as file:
                return file.read(len(_HEAD)) == _HEAD.encode()
        except OSError:
            return False

    @contextmanager
    def opened_journal(self) -> Iterator[BinaryIO]:
        """Open the journal, a new one if there is none; the folder is held.

        Raises:
            InputError: the disk refuses.
        """
        with self._written():
            # Without a buffer nothing is left that closing the file would fail to write.
            if self.journal.exists():
                open_file(self.journal).close()  # which refuses what is no file
            file = self.journal.open("r+b" if self.journal.exists() else "x+b", buffering=0)
        with file:
            yield cast(BinaryIO, file)

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            problem = f"cannot be written to ({error.strerror})"
            remedy = "make room, or name another folder (-o)"
            raise InputError(self.root, problem, remedy=remedy) from error


def _flat(settings: DesignSettings) -> dict[str, Any]:
    """Return settings by their dotted names."""
    return {
        f"{name}.{key}" if key else name: entry
        for name, table in settings.to_dict().items()
        for key, entry in (table.items() if isinstance(table, dict) else [("", table)])
    }


def require_same(asked: DesignSettings, there: DesignSettings, path: Path) -> None:
    """Refuse to go on with a search under other settings than those it began with.

    Raises:
        SettingsError: names the first field that differs.
    """
    ours, theirs = _flat(asked), _flat(there)
    for field in sorted(ours.keys() | theirs.keys()):
        if ours.get(field) != theirs.get(field):
            raise SettingsError(
                path,
                f"was {theirs.get(field)!r} when the search began",
                field=f"{field} = {ours.get(field)!r}",
                remedy="resume it without other settings, or begin anew in another folder (-o)",
            )


@dataclass(frozen=True, eq=False)
class Designed:
    """A search that came to an end, and what was written down of it."""

    problem: excitation.Problem
    design: excitation.Design
    result: DesignResult


def run_search(
    cell: Cell,
    settings: DesignSettings,
    reporter: Reporter,
    *,
    workers: int = 2,
    known: Knowledge | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> excitation.Design:
    """Search a motion for a cell.

    The result does not depend on the number of `workers`, processes that score motions. The motion
    is to add to what is `known` from an earlier estimate. `stop` is asked between generations; true
    ends the search with the best motion so far. A motion that hangs holds a generation up for a
    minute or two.

    Raises:
        NoExcitationError: no motion keeps every constraint: which forbids it, where, by how much.
        OperatorStopError: it was stopped before there was one.
        SettingsError, CellError: settings and cell do not fit together.
    """
    problem = problem_of(cell, settings, known)
    return _searched(problem, cell, settings, reporter, workers, stop)


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
    archives = () if known is None else known.archives
    with folder.held():
        if resume:  # another search may have been there since they were read
            require_same(settings, folder.interrupted(), folder.settings)
        else:
            folder.begin(settings, force=force)
        earlier = {} if known is None else dict(archives) | {"repetitions": known.repetitions}
        identity = {"settings": _flat(settings), "cell": fingerprint(cell), "earlier": earlier}
        with folder.opened_journal() as file:
            journal = _journal(file, identity, reporter)
            try:
                design = _searched(problem, cell, settings, reporter, workers, stop, journal)
            finally:
                journal.close()
        if journal.recalled:
            reporter.say(f"{journal.recalled} motions were known from the journal")
        if journal.error is not None:
            reporter.say(
                f"the journal lacks the last motions ({journal.error.strerror}); a search "
                "resumed from it scores them anew"
            )
        trajectory = design.excitation.trajectory  # as it is going to be run
        broken = problem.constraints.violations(trajectory, excitation.sampled(trajectory))
        if broken:
            reason = violation_text(broken[0], AngleFrame.of(cell))
            raise UnsafeError(f"the motion found does not pass its last check: {reason}")
        result = DesignResult.of(cell, settings, design, problem.objective, archives)
        result.save(folder.result)
        done = Designed(problem, design, result)
        then(done)
    return done


def _searched(
    problem: excitation.Problem,
    cell: Cell,
    asked: DesignSettings,
    reporter: Reporter,
    workers: int,
    stop: Callable[[], bool],
    journal: excitation.Journal | None = None,
) -> excitation.Design:
    settings, checker = search_settings(asked), problem.constraints.checker
    frame, total = AngleFrame.of(cell), excitation.most_evaluations(settings)
    if checker is not None and checker.exceptions is not None:
        reporter.say(checker.exceptions)
    done, note, troubled = 0, "scoring the first motions", False
    with (
        reporter.task("designing (motions)", total) as task,
        excitation.Population(problem, workers) as found,
    ):
        task.advance(0, note)

        def scored(count: int) -> None:
            nonlocal done
            done += count
            task.advance(count, note)

        def entered(progress: excitation.Progress) -> None:
            """A generation is scored, or was in the journal."""
            nonlocal note, troubled
            note = _note(progress)
            scored(progress.evaluated - done)
            if journal is not None and journal.error is not None and not troubled:
                troubled = True
                reporter.say(
                    f"the journal cannot be written ({journal.error.strerror}); the search goes "
                    "on, and writes it as soon as there is room"
                )

        try:
            design = excitation.search(
                found, settings, journal=journal, progress=entered, scored=scored, stop=stop
            )
        except excitation.NoFeasibleMotionError as error:
            if error.stopped:
                raise OperatorStopError(
                    "stopped before there was a motion that keeps every constraint: "
                    f"{forbidden(error, frame)}"
                ) from error
            raise no_excitation(error, frame, checker, asked) from error
        if design.complete:  # a polish or a mating that found nothing new needed fewer
            task.advance(total - done, "done")
    if design.exhausted:
        reporter.say(
            f"ended after {len(design.history)} of {settings.generations} generations: mating "
            "brought no motion that was not there before; raise mutation, crossover or population "
            "in [search]"
        )
    return design


def _note(progress: excitation.Progress) -> str:
    where = {
        "sample": "looking at random motions",
        "search": f"generation {progress.generation} of {progress.generations}",
        "polish": "polishing",
    }[progress.phase]
    if math.isnan(progress.best[0]):
        return f"{where}, {progress.feasible} feasible"
    return f"{where}, {criteria_text(progress.best, 1)}"


def _journal(file: BinaryIO, identity: Mapping[str, Any], reporter: Reporter) -> excitation.Journal:
    try:
        journal = excitation.Journal(file, identity)
    except excitation.JournalError as error:
        remedy = "resume with the same cell, settings and archives, or begin anew (--force)"
        raise InputError(file.name, str(error), remedy=remedy) from error
    except OSError as error:
        problem = f"cannot be read or written ({error.strerror})"
        remedy = "make room or mend the disk, then try again (--resume)"
        raise InputError(file.name, problem, remedy=remedy) from error
    if journal.damaged:
        reporter.say(
            f"{journal.damaged} bytes of the journal are damaged; what they held is scored anew"
        )
    return journal
