"""Judges each archive when it is closed, and enters it in the manifest with what it is worth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Final

from hil.archive import ArchiveName, open_archive
from hil.archive.header import REJECTED
from hil.archive.repair import amend_outcome
from hil.cell import Cell
from hil.errors import ArchiveError

from .execution_archive import Archiving, not_entered
from .execution_result import Rejected
from .folder import CampaignFolder
from .intervals import Interval
from .plan import CampaignPlan
from .quality import (
    FIELDS,
    Groups,
    Played,
    Problem,
    RepetitionCheck,
    problem_of,
    torn_or_slowed,
    unrest,
)

_JUDGED: Final = frozenset({"standstill", "excitation", "validation", "warmup"})
_FEWEST_ALIKE: Final = 2
"""Attempts that must agree before they speak against what counts."""


class Entering:
    """Enters archives in a campaign's manifest.

    Only after an archive says itself that it is rejected does the manifest: whoever finds the file
    alone, or in a folder whose run was killed, must not pool it either.

    Args:
        folder: of the campaign.
        cell: of the campaign.
        plan: of the campaign.

    Attributes:
        rejected: what was found to be of no use.
        adopted: what an earlier run completed and did not live to enter.
        notes: what a reader must know of how repetitions were judged.
    """

    def __init__(self, folder: CampaignFolder, cell: Cell, plan: CampaignPlan) -> None:
        self._folder, self._cell, self._motion = folder, cell, plan.excitation.trajectory
        self._check = RepetitionCheck(cell, self._motion)
        self._check.learn(folder.completed("excitation"))
        self.rejected: list[Rejected] = []
        self.adopted: list[str] = []
        self.notes: list[str] = []

    def enter(self, interval: Interval, name: str, known: Problem | None = None) -> Problem | None:
        """Judge the whole archive of an interval and enter it; why it is of no use, or None.

        Args:
            interval: what was run.
            name: of the archive.
            known: what is wrong with it, where that is known already.
        """
        played, problem = None, known
        if problem is None and interval.kind in _JUDGED:
            played = self._played(name)
            if interval.kind == "excitation":
                problem = self._judged(played)
            elif interval.kind == "standstill":
                problem = unrest(played, self._cell)
            else:
                # A cold arm may want more current than it has: that is what warming up is for.
                judge = problem_of if interval.kind == "validation" else torn_or_slowed
                problem = judge(played, interval.trajectory, self._cell)
        if problem is not None:
            amend_outcome(self._folder.archives / name, REJECTED, problem.sentence)
            self._folder.add(name, REJECTED, problem.sentence)
            self.rejected.append(Rejected(name, problem.sentence))
            if problem.against is not None:
                return replace(problem, against=problem.against.with_one(name))
            return problem
        self._folder.add(name, "completed")
        if played is not None and interval.kind == "excitation":
            self._check.accept(played)
        return None

    def _judged(self, played: Played) -> Problem | None:
        """What is wrong with a repetition.

        One that is unlike those that count may be right all the same. Where enough later attempts
        agree with each other and not with the only one that counts, that one is rejected: nothing
        speaks for it. Where two or more that agree count, no vote tells a disturbed beginning from
        an arm that was changed: a person has to look.
        """
        problem = self._check.problem(played)
        if problem is None or not problem.apart:
            return problem
        good = self._folder.completed("excitation")
        alike, beside = self._alike(played)
        enough = max(_FEWEST_ALIKE, self._cell.campaign.bad_repetitions)
        if len(alike) + 1 < max(enough, beside + 2):
            return problem
        if len(good) > 1:
            groups = Groups(tuple(path.name for path in good), alike)
            return replace(problem, against=groups)
        reason = f"{', '.join(alike)} and the next repetition agree with each other, not with this"
        for path in good:
            amend_outcome(path, REJECTED, reason)
            self._folder.reject(path.name, reason)
            self.rejected.append(Rejected(path.name, reason))
            self.notes.append(
                f"{path.name} was the only repetition that counted, and was rejected because "
                f"{len(alike) + 1} later ones agree with each other and not with it: it was "
                "disturbed, or the arm was changed after it"
            )
        self._check = RepetitionCheck(self._cell, self._motion)
        return None

    def _alike(self, played: Played) -> tuple[tuple[str, ...], int]:
        """Attempts that agree with this one and each other, and how many do with the good ones.

        Of those that were rejected since one was good: what was unlike an earlier one that counted
        says nothing against those that count now.
        """
        check, alike, beside = RepetitionCheck(self._cell, self._motion), list[str](), 0
        check.accept(played)
        for name, other in self._sound_but_rejected().items():
            beside += self._check.problem(other) is None
            if check.problem(other) is None:
                check.accept(other)
                alike.append(name)
        return tuple(alike), beside

    def _sound_but_rejected(self) -> dict[str, Played]:
        """Repetitions rejected since the last good one, and sound by themselves, in order."""
        found: dict[str, Played] = {}
        for entry in self._folder.manifest():
            name = ArchiveName.parse(entry.name)
            if name is None or name.kind != "excitation":
                continue
            if entry.outcome != REJECTED:
                found.clear()
                continue
            with suppress(ArchiveError):
                played = self._played(entry.name)
                if problem_of(played, self._motion, self._cell) is None:
                    found[entry.name] = played
        return found

    def _played(self, name: str) -> Played:
        return Played.of(open_archive(self._folder.archives / name, fields=FIELDS))

    def agreement(self) -> str:
        """How well the last good repetition agrees with those before, in a few words."""
        return self._check.agreement

    def adopt(self, archiving: Archiving, intervals: list[Interval]) -> None:
        """Enter archives that an earlier run completed and was killed before it entered them.

        Args:
            archiving: knows the plan that they must have been made of.
            intervals: what a run may have made.
        """
        sought = {(one.kind, one.index): one for one in intervals}
        for name in not_entered(self._folder):
            parsed = ArchiveName.parse(name)
            interval = None if parsed is None else sought.get((parsed.kind, parsed.index))
            if interval is None or self._folder.whole(interval.kind, interval.index) is not None:
                continue
            try:
                archive = open_archive(self._folder.archives / name, fields=())
            except ArchiveError:
                continue  # torn at its head: done again
            completed = archive.outcome is not None and archive.outcome.outcome == "completed"
            if archive.complete and completed and archiving.made(archive.header):
                self.adopted.append(name)
                self.enter(interval, name)
