"""Runs motions one after the other, with the straight ways between them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveName, open_archive
from hil.cell import Cell
from hil.errors import ArchiveError
from hil.motion_checks import MotionChecks
from hil.progress import Task
from hil.reading import json_of
from identification.excitation.excitation import trajectory_from_dict
from planner import FourierSeries

from .dry_run import OVERRIDE
from .errors import ArmChangedError, MotionFailedError, RepetitionsRejectedError
from .folder import CampaignFolder
from .intervals import AT_REST_TOLERANCE, Interval, ends, player_of, require_sound, way
from .motion_link import MotionLink
from .run import REPEATED, Run

if TYPE_CHECKING:
    from .warmup import WarmUpStage

Array = NDArray[np.float64]
Ends = tuple[Array, Array]

MOST_BY_HAND: Final = 10
"""Attempts at one motion that a person, or a script in his place, may hold or slow."""


@dataclass(eq=False)
class Runner:
    """One connection of a run: what is played goes to the controller and into an archive.

    Attributes:
        run: whose motions are played.
        link: to its controller; connected.
        moves: between the motions.
        where: (n,) [rad] where the arm was first, and goes back to.
        task: receives the seconds of motion done.
    """

    run: Run
    link: MotionLink
    moves: StraightMoves
    where: Array
    task: Task
    _at: Array = field(init=False)
    _before: int = field(init=False)

    def __post_init__(self) -> None:
        self._at, self._before = self.where, self.link.cycles

    @property
    def cycles(self) -> int:
        """Archived so far."""
        return self.link.cycles - self._before

    def play(self, interval: Interval, number: int, total: int, most: float = 1.0) -> str:
        """Go to where a motion begins, run it, and return the name of its archive.

        The archive is whole and not entered in the manifest yet.

        Args:
            interval: the motion.
            number: which of its kind, from 1.
            total: of how many.
            most: largest override.

        Raises:
            MotionFailedError: it ended otherwise than planned, or was not begun after a stop.
            ControllerFault: it was not accepted, or the link broke.
        """
        start, end = self._ends(interval)
        self._go(start, most)
        name = self._play(interval, number, total, most)
        self._at = end
        return name

    def play_until_good(
        self, interval: Interval, number: int, total: int, warm_up: WarmUpStage | None = None
    ) -> str:
        """Run a motion, judge it and enter it; again where it fails its check.

        An attempt that a person held or slowed counts as failed only if the request is still for
        less than full speed: then the next one would go the same way. Others of them are counted
        apart, for a script that slows the arm by rule would have it move for ever.

        Args:
            interval: the motion.
            number: which of its kind, from 1.
            total: of how many.
            warm_up: warms the arm up before each attempt, and says whether it was warm when the
                motion began; None for a motion that may be run by a cold arm.

        Returns:
            Name of the archive that is of use.

        Raises:
            RepetitionsRejectedError: it failed too often.
            ArmChangedError: later attempts agree with each other, and not with those that count.
        """
        run, reasons, by_hand = self.run, list[str](), list[str]()
        while len(reasons) <= run.cell.campaign.bad_repetitions and len(by_hand) < MOST_BY_HAND:
            if warm_up is not None:
                warm_up.keep(self)
            name = self.play(interval, number, total)
            cold = None if warm_up is None else warm_up.lost(run.watch.began)
            problem = run.entering.enter(interval, name, cold)
            if warm_up is not None and cold is None:
                warm_up.moved()
            if problem is None:
                return name
            run.watch.expect(interval.trajectory.duration)
            run.watch.note(f"{interval}: rejected, {problem.sentence}")
            run.reporter.say(
                f"{interval} ({name}) is rejected: {problem.sentence}; the motion is run again"
            )
            if problem.against is not None:
                groups = problem.against
                raise ArmChangedError(
                    str(interval), problem.sentence, groups.reference, groups.later
                )
            still = not problem.by_hand or run.watch.request().override < 1.0
            (reasons if still else by_hand).append(problem.sentence)
        raise RepetitionsRejectedError(
            str(interval), reasons if len(by_hand) < MOST_BY_HAND else by_hand
        )

    def go_back(self, most: float = 1.0) -> None:
        """Go home, and from there to where the arm was first; `most` is the largest override."""
        self._go(self.run.cell.home, most)
        self._go(self.where, most)

    def _go(self, target: Array, most: float) -> None:
        """Go a straight way; what nobody has watched yet is not gone faster than a dry run."""
        way = self.moves.between(self._at, target)
        if way is not None:
            share = min(most, OVERRIDE) if self.moves.unseen(way) else most
            slow = min(1.0, share / self.run.cell.campaign.approach_speed)
            name = self._play(way, way.index + 1, way.index + 1, slow)
            self.run.folder.add(name, "completed")
            if most <= OVERRIDE:
                self.moves.saw(way)
        self._at = target

    def _ends(self, interval: Interval) -> tuple[Array, Array]:
        """Those of an excitation are its own; all other motions are planned from home to home."""
        own = interval.kind in (*REPEATED, "dryrun")
        if own or isinstance(interval.trajectory, FourierSeries):
            return ends(interval)
        return self.run.cell.home, self.run.cell.home

    def _play(self, interval: Interval, number: int, total: int, most: float) -> str:
        run = self.run
        if run.stop.requested:
            raise MotionFailedError(str(interval), "stopped", "it had not begun")
        spec, duration = run.spec(interval), interval.trajectory.duration
        run.watch.begin(interval.kind, number, total, duration, most)
        player = player_of(run.cell, interval.trajectory)
        ended = self.link.run(player, spec, run.stop, override=most, watch=run.watch)
        archived = spec.path.name if ended.outcome == "completed" or spec.path.exists() else None
        if archived is not None:  # else it was stopped before
            run.archives.append(archived)
        if ended.outcome != "completed":
            if archived is not None:
                run.folder.add(archived, ended.outcome)
            refused = self.link.connection.refused if ended.outcome == "refused" else None
            recorder = None if refused is None else refused.flight_recorder
            raise MotionFailedError(str(interval), ended.outcome, ended.reason, recorder, archived)
        self.task.advance(duration / most, str(interval))
        return spec.path.name


class StraightMoves:
    """Knows the ways that were planned and checked beforehand, and plans others like them.

    Args:
        cell: whose arm goes.
        checks: those of the cell.
        known: intervals with sound ways among them.
        seen: from where to where (n,) [rad] ways led that somebody watched in the dry run; None
            where nobody needs to.
    """

    def __init__(
        self,
        cell: Cell,
        checks: MotionChecks,
        known: Sequence[Interval],
        seen: Sequence[Ends] | None,
    ) -> None:
        self._cell, self._checks = cell, checks
        self._known = [interval for interval in known if interval.kind == "move"]
        self._seen = None if seen is None else [*seen]
        self._given = 0

    def unseen(self, way: Interval) -> bool:
        """Whether nobody has watched this way in the dry run.

        One from or to where the arm happens to stand counts as unseen: whoever jogged it there
        may have done so for a reason.
        """
        if self._seen is None:
            return False
        return way.from_arm or not any(_leads(way, *known) for known in self._seen)

    def saw(self, way: Interval) -> None:
        """A way was gone slowly in the dry run."""
        if self._seen is not None:
            self._seen.append(ends(way))

    def between(self, start: Array, end: Array) -> Interval | None:
        """The next way from `start` to `end` (n,) [rad]; None where they are the same.

        Raises:
            MotionRefusedError: a way that was not known is not free.
        """
        if np.max(np.abs(end - start)) <= AT_REST_TOLERANCE:
            return None
        found = next((one for one in self._known if _leads(one, start, end)), None)
        if found is None:
            found = way(self._cell, start, end)
            require_sound([found], self._checks)
            self._known.append(found)
        self._given += 1
        return replace(found, index=self._given - 1)


def seen_in_dry_run(folder: CampaignFolder) -> list[Ends]:
    """From where to where (n,) [rad] the ways of a dry run led, by its archives.

    Raises:
        CampaignFolderError: the manifest cannot be read.
    """
    found: list[Ends] = []
    entries = [one for one in folder.manifest() if one.outcome == "completed"]
    kinds = [name.kind if (name := ArchiveName.parse(one.name)) else "" for one in entries]
    last = max((k for k, kind in enumerate(kinds) if kind == "dryrun"), default=0)
    for entry, kind in zip(entries[:last], kinds[:last], strict=True):
        if kind != "move":
            continue
        with suppress(ArchiveError, ValueError, KeyError, TypeError):  # not seen, then
            archive = open_archive(folder.archives / entry.name, fields=())
            motion = trajectory_from_dict(json_of(archive.text("plan.json"))["trajectory"])
            start, end = motion.sample(np.array([0.0, motion.duration]))[0]
            found.append((start, end))
    return found


def _leads(interval: Interval, start: Array, end: Array) -> bool:
    first, last = ends(interval)
    apart = max(np.max(np.abs(first - start)), np.max(np.abs(last - end)))
    return bool(apart <= AT_REST_TOLERANCE)
