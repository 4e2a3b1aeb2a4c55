"""Runs motions one after the other, with the moves between them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.progress import Task
from planner import FourierSeries

from .dry_run import OVERRIDE
from .errors import MotionFailedError
from .execution_archive import REPEATED, Archiving
from .execution_watch import RunWatch
from .intervals import Interval, ends, player_of
from .motion_link import MotionLink
from .stop import Stop
from .straight_moves import StraightMoves

Array = NDArray[np.float64]


@dataclass(eq=False)
class Runner:
    """One connection of a run: what is played goes to the controller and into an archive.

    Attributes:
        cell: of the campaign.
        link: to its controller; connected.
        moves: between the motions.
        archiving: describes the archives.
        stop: brings the arm to rest on its path.
        watch: shows each motion to the operator.
        task: receives the seconds of motion done.
        where: (n,) [rad] where the arm was first, and goes back to.
        archives: file names so far, whatever became of them.
    """

    cell: Cell
    link: MotionLink
    moves: StraightMoves
    archiving: Archiving
    stop: Stop
    watch: RunWatch
    task: Task
    where: Array
    archives: list[str] = field(default_factory=list)
    _at: Array = field(init=False)

    def __post_init__(self) -> None:
        self._at = self.where

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
        name = self._run(interval, number, total, most)
        self._at = end
        return name

    def go_back(self, most: float = 1.0) -> None:
        """Go home, and from there to where the arm was first; `most` is the largest override."""
        self._go(self.cell.home, most)
        self._go(self.where, most)

    def _go(self, target: Array, most: float) -> None:
        """Go a straight way; what nobody has watched yet is not gone faster than a dry run."""
        way = self.moves.between(self._at, target)
        if way is not None:
            share = min(most, OVERRIDE) if self.moves.unseen(way) else most
            slow = min(1.0, share / self.cell.campaign.approach_speed)
            name = self._run(way, way.index + 1, way.index + 1, slow)
            self.archiving.folder.add(name, "completed")
            if most <= OVERRIDE:
                self.moves.saw(way)
        self._at = target

    def _ends(self, interval: Interval) -> tuple[Array, Array]:
        """Those of an excitation are its own; all other motions are planned from home to home."""
        own = interval.kind in (*REPEATED, "dryrun")
        if own or isinstance(interval.trajectory, FourierSeries):
            return ends(interval)
        return self.cell.home, self.cell.home

    def _run(self, interval: Interval, number: int, total: int, most: float) -> str:
        if self.stop.requested:
            raise MotionFailedError(str(interval), "stopped", "it had not begun")
        spec, duration = self.archiving.spec(interval), interval.trajectory.duration
        self.watch.begin(interval.kind, number, total, duration, most)
        ended = self.link.run(
            player_of(self.cell, interval.trajectory),
            spec,
            self.stop,
            override=most,
            watch=self.watch,
        )
        if ended.outcome == "completed" or spec.path.exists():  # else it was stopped before
            self.archives.append(spec.path.name)
        if ended.outcome != "completed":
            archived = spec.path.name if spec.path.exists() else None
            if archived is not None:
                self.archiving.folder.add(archived, ended.outcome)
            refused = self.link.connection.refused if ended.outcome == "refused" else None
            recorder = None if refused is None else refused.flight_recorder
            raise MotionFailedError(str(interval), ended.outcome, ended.reason, recorder, archived)
        self.task.advance(duration / most, str(interval))
        return spec.path.name
