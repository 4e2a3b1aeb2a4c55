"""Judges each archive when it is closed, and enters it in the manifest with what it is worth."""

from __future__ import annotations

from hil.archive import ArchiveName, open_archive
from hil.archive.amend import REJECTED, amend_outcome
from hil.cell import Cell
from hil.errors import ArchiveError

from .execution_archive import Archiving, not_entered
from .execution_result import Rejected
from .folder import CampaignFolder
from .intervals import Interval
from .plan import CampaignPlan
from .quality import FIELDS, Played, Problem, RepetitionCheck, problem_of, torn_or_slowed


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
    """

    def __init__(self, folder: CampaignFolder, cell: Cell, plan: CampaignPlan) -> None:
        self._folder, self._cell, self._motion = folder, cell, plan.excitation.trajectory
        self._check = RepetitionCheck(cell, self._motion)
        self._check.learn(folder.completed("excitation"))
        self.rejected: list[Rejected] = []
        self.adopted: list[str] = []

    def enter(self, interval: Interval, name: str) -> Problem | None:
        """Judge the whole archive of an interval and enter it; why it is of no use, or None."""
        played, problem = None, None
        if interval.kind in ("excitation", "validation", "warmup"):
            played = self._played(name)
            if interval.kind == "excitation":
                problem = self._judged(played)
            else:
                # A cold arm may want more current than it has: that is what warming up is for.
                judge = problem_of if interval.kind == "validation" else torn_or_slowed
                problem = judge(played, interval.trajectory, self._cell)
        if problem is not None:
            amend_outcome(self._folder.archives / name, REJECTED, problem.sentence)
            self._folder.add(name, REJECTED, problem.sentence)
            self.rejected.append(Rejected(name, problem.sentence))
            return problem
        self._folder.add(name, "completed")
        if played is not None and interval.kind == "excitation":
            self._check.accept(played)
        return None

    def _judged(self, played: Played) -> Problem | None:
        """What is wrong with a repetition; where it is the first one that is, that is rejected."""
        problem = self._check.problem(played)
        if problem is None or not problem.apart or self._check.known != 1:
            return problem
        good = self._folder.completed("excitation")
        alike = next((one for one in self._unlike_the_first() if self._alike(one, played)), None)
        if alike is None or len(good) != 1:
            return problem
        first = good[0]
        reason = f"{alike} and the repetition after it agree with each other, and not with this one"
        amend_outcome(first, REJECTED, reason)
        self._folder.reject(first.name, reason)
        self.rejected.append(Rejected(first.name, reason))
        self._check = RepetitionCheck(self._cell, self._motion)
        return None

    def _unlike_the_first(self) -> list[str]:
        """Repetitions that were rejected, and that nothing is wrong with by themselves."""
        return [
            entry.name
            for entry in self._folder.manifest()
            if (name := ArchiveName.parse(entry.name)) is not None
            and (name.kind, entry.outcome) == ("excitation", REJECTED)
        ]

    def _alike(self, name: str, played: Played) -> bool:
        """Whether a repetition agrees with a rejected one, which is good by itself."""
        try:
            other = self._played(name)
        except ArchiveError:
            return False
        if problem_of(other, self._motion, self._cell) is not None:
            return False
        check = RepetitionCheck(self._cell, self._motion)
        check.accept(other)
        return check.problem(played) is None

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
            outcome = (archive.outcome or {}).get("outcome")
            if archive.complete and outcome == "completed" and archiving.made(archive.metadata):
                self.adopted.append(name)
                self.enter(interval, name)
