"""Whether a motion that ended well is of use: looked at when its archive is closed.

Repetitions are compared set-point by set-point, not by the clock: across a packet that was missed
the motion waits. What repetitions of one motion differ by is noise, and friction that changes
slowly; a larger difference means that something touched the arm, slipped, or was changed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.events import MotionStarted
from hil.archive import Archive, ArchiveHeader, ArchiveName, open_archive
from hil.archive.header import REJECTED
from hil.archive.repair import amend_outcome
from hil.cell import Cell
from hil.errors import ArchiveError
from identification.signals.noise import STANDSTILL_WINDOW
from identification.signals.recording import stuck
from planner import FourierSeries, PiecewiseCubic

from .folder import CampaignFolder
from .intervals import Interval

Array = NDArray[np.float64]

_SENT: Final = ("commanded_position", "commanded_velocity")
FIELDS: Final = ("cycle", "gap", "position", "target_current", *_SENT)
"""Columns of an archive that are looked at."""
MISSED_SHARE: Final = 0.01
"""Of all cycles: more missed packets than that, and the recording is too torn."""
OFF_PATH: Final = 1e-4
"""rad between set-point and plan: the motion is made of float32 targets, exact to 2e-6."""
_ARM_MOVED: Final = 5e-4
"""rad; more than an encoder's noise, less than any motion makes in a second."""
SATURATED: Final = 0.98
"""Share of the current limit that counts as reaching it."""
SATURATED_CYCLES: Final = 3
"""So many in a row are no noise."""
COMPARED: Final = 9
"""Earlier repetitions that a new one is compared with."""
FEWEST: Final = 4
"""Earlier repetitions that tell their own scatter."""
_CHANNELS: Final = (
    ("position", "the following-error threshold", 0.05, 0.005),
    ("current", "its rms current", 0.1, 0.02),
)
"""What is compared; its scale; the share of it by which the first repetitions may differ (rms); and
the share that never rejects, however well the earlier ones agree."""
_WIDE: Final = 3.0
"""Times the median difference of the earlier ones that is never rejected."""
_OUTLYING: Final = 6.0
"""Robust standard deviations above the median difference."""
_FEWEST_ALIKE: Final = 2
"""Attempts that must agree before they speak against what counts."""

Motion = PiecewiseCubic | FourierSeries


@dataclass(frozen=True)
class Problem:
    """Why a motion is of no use.

    Attributes:
        sentence: in words.
        by_hand: whether somebody held or slowed it: that says nothing against the arm.
        apart: whether it is only unlike the repetitions before it.
        reference, later: where so many attempts agree with it that the arm itself may be another
            by now: file names of the repetitions that count, and of those attempts.
    """

    sentence: str
    by_hand: bool = False
    apart: bool = False
    reference: tuple[str, ...] = ()
    later: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.sentence


@dataclass(frozen=True, eq=False)
class Played:
    """The part of an archive in which the arm was commanded; row k is set-point k.

    One that was sent again because the controller had not taken it is there once.

    Attributes:
        position: (m, n) measured [rad].
        current: (m, n) [A].
        commanded: (m, n) [rad].
        missed: packets that never arrived.
    """

    position: Array
    current: Array
    commanded: Array
    missed: int

    @classmethod
    def of(cls, archive: Archive) -> Played:
        """Its rows from the first set-point of the motion on.

        A controller may open its axes before a motion is asked for; it is held there till then.

        Raises:
            ArchiveError: it is no archive of a motion of ours.
        """
        columns = archive.recorded(*_SENT, "target_current", "gap")
        began = [event.time for event in archive.events if event.name == MotionStarted.__name__]
        rows = ~np.isnan(columns["commanded_position"]).any(axis=1)
        if began:
            rows &= columns["stamp"] >= round(began[-1] * 1e9)
        missed = int(columns["gap"][rows].sum())
        position, velocity = (columns[name] for name in _SENT)
        same = (np.diff(position, axis=0, prepend=np.nan) == 0.0).all(axis=1)
        rows &= ~(same & (velocity != 0.0).any(axis=1))
        return cls(
            columns["position"][rows], columns["target_current"][rows], position[rows], missed
        )


def problem_of(played: Played, trajectory: Motion, cell: Cell) -> Problem | None:
    """What is wrong with a motion by itself; None if nothing is."""
    if (torn := torn_or_slowed(played, trajectory, cell)) is not None:
        return torn
    wanted = int(np.ceil(trajectory.duration / cell.period - 1e-6))
    if played.missed > MISSED_SHARE * wanted:
        words = f"{played.missed} of {wanted} packets were missed; {MISSED_SHARE:.0%} are bearable"
        return Problem(words)
    high = np.abs(played.current) >= SATURATED * cell.drive_train.current_limit
    for joint, name in enumerate(cell.joint_names):
        # A joint that stands while it is commanded to move: nothing is estimated from such data.
        found = stuck(played.position[:, joint], played.commanded[:, joint])
        if found is not None:
            start, travel = found
            return Problem(
                f"{name} is stuck: its position stays the same from {start * cell.period:.2f} s "
                f"after the begin on while it is commanded to move by {travel:.3g}"
            )
    for name, column in zip(cell.joint_names, high.T, strict=True):
        edges = np.flatnonzero(np.diff(column.astype(np.int8), prepend=0, append=0))
        longest = int((edges[1::2] - edges[::2]).max(initial=0))
        if longest >= SATURATED_CYCLES:
            lasted = f"{longest * cell.period * 1e3:.0f} ms"
            return Problem(f"the current of {name} was at its limit for {lasted}")
    return None


def torn_or_slowed(played: Played, trajectory: Motion, cell: Cell) -> Problem | None:
    """Whether a motion is not all there, or was held or slowed: it is another motion then."""
    wanted, rows = int(np.ceil(trajectory.duration / cell.period - 1e-6)), len(played.commanded)
    if rows < wanted - 1:
        return Problem(f"{rows} of its {wanted} cycles are archived")
    times = np.minimum(np.arange(rows) * cell.period, trajectory.duration)
    off = played.commanded - trajectory.sample(times)[0]
    off = np.abs(off - off[0]).max(axis=1)
    if off.max() <= OFF_PATH:
        return None
    at = int(np.argmax(off > OFF_PATH)) * cell.period
    return Problem(
        f"it was held or slowed about {at:.1f} s after its begin, so it is no repetition; leave "
        "the override at 100 %",
        by_hand=True,
    )


def unrest(played: Played, _trajectory: Motion, cell: Cell) -> Problem | None:
    """What is wrong with a recording of the arm at rest, from which its sensors' noise is read."""
    rows = min(round(STANDSTILL_WINDOW / cell.period), len(played.position) - 1)
    moved = np.abs(played.position[rows:] - played.position[:-rows]).max(axis=0)
    speed = moved / (rows * cell.period)
    allowed = np.maximum(cell.model.friction.standstill, _ARM_MOVED / STANDSTILL_WINDOW)
    joint = int(np.argmax(speed / allowed))
    if speed[joint] <= allowed[joint]:
        return None
    return Problem(
        f"{cell.joint_names[joint]} moved at {speed[joint]:.2g} rad/s while the arm was to stand "
        f"still; below {allowed[joint]:.2g} rad/s it counts as at rest"
    )


_JUDGES: Final = {
    "standstill": unrest,
    "validation": problem_of,
    # A cold arm may want more current than it has: that is what warming up is for.
    "warmup": torn_or_slowed,
}
"""By kind of motion; repetitions are compared as well, and other motions are not judged."""


class RepetitionCheck:
    """Compares repetitions of one motion with the last ones that were found good."""

    def __init__(self, cell: Cell, trajectory: Motion) -> None:
        self._cell, self._trajectory = cell, trajectory
        self._earlier: deque[Played] = deque(maxlen=COMPARED)
        self._differences: deque[Array] = deque(maxlen=2 * COMPARED)

    def learn(self, archives: Sequence[Path]) -> None:
        """Take in repetitions that were found good before."""
        for path in archives[-2 * COMPARED :]:
            self.accept(Played.of(open_archive(path, fields=FIELDS)))

    def accept(self, played: Played) -> None:
        """Compare later ones with this one too."""
        if self._earlier:
            self._differences.append(self._difference(played))
        self._earlier.append(played)

    def problem(self, played: Played) -> Problem | None:
        """Why a repetition is of no use; None if it is good."""
        found = problem_of(played, self._trajectory, self._cell)
        if found is not None or not self._earlier:
            return found
        new, past = self._difference(played), np.array(self._differences)
        for row, (what, scale, first, least) in enumerate(_CHANNELS):
            bound = np.full(len(new[row]), first)
            if len(past) >= FEWEST - 1:
                middle = np.median(past[:, row], axis=0)
                scatter = 1.4826 * np.median(np.abs(past[:, row] - middle), axis=0)
                usual = np.maximum(_WIDE * middle, middle + _OUTLYING * scatter)
                bound = np.maximum(usual, least)
            joint = int(np.argmax(new[row] / bound))
            if new[row, joint] > bound[joint]:
                return Problem(
                    f"the {what} of {self._cell.joint_names[joint]} differs from that of the "
                    f"{len(self._earlier)} repetitions before by {new[row, joint]:.2%} of {scale} "
                    f"(rms); {bound[joint]:.2%} are allowed",
                    apart=True,
                )
        return None

    @property
    def agreement(self) -> str:
        """How well the last good repetition agrees with those before, in a few words."""
        if not self._differences:
            return "nothing to compare with yet"
        return f"currents agree within {self._differences[-1][1].max():.1%} (rms)"

    def _difference(self, played: Played) -> Array:
        """Of a repetition from the median of the earlier ones, rms over time (2, n).

        Positions as shares of the following-error thresholds, currents of the motion's rms current.
        """
        rows = min(len(played.position), *(len(one.position) for one in self._earlier))
        usual = np.median([one.position[:rows] for one in self._earlier], axis=0)
        currents = np.median([one.current[:rows] for one in self._earlier], axis=0)
        size = np.maximum(_rms(currents), 1e-3 * self._cell.drive_train.current_limit)
        apart = _rms(played.position[:rows] - usual) / following_threshold(self._cell)
        return np.array([apart, _rms(played.current[:rows] - currents) / size])


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def following_threshold(cell: Cell) -> Array:
    """The cell's following-error thresholds as joint angles (n,) [rad]."""
    turns = np.array(cell.drive_table.following_error)
    return np.asarray(np.abs(cell.drive_train.joint_from_motor) @ (2.0 * np.pi * turns))


@dataclass(frozen=True)
class Rejected:
    """A motion that ended well and is of no use: the file name of its archive, and why."""

    archive: str
    reason: str


class Entering:
    """Enters archives in a campaign's manifest.

    Only after an archive says itself that it is rejected does the manifest: whoever finds the file
    alone, or in a folder whose run was killed, must not pool it either.

    Attributes:
        rejected: what was found to be of no use.
        adopted: what an earlier run completed and did not live to enter.
        notes: what a reader must know of how repetitions were judged.
    """

    def __init__(self, folder: CampaignFolder, cell: Cell, motion: Motion) -> None:
        self._folder, self._cell, self._motion = folder, cell, motion
        self._check = RepetitionCheck(cell, self._motion)
        self._check.learn(folder.completed("excitation"))
        self.rejected: list[Rejected] = []
        self.adopted: list[str] = []
        self.notes: list[str] = []

    def enter(self, interval: Interval, name: str, known: Problem | None = None) -> Problem | None:
        """Judge the whole archive of an interval and enter it; why it is of no use, or None."""
        problem, played = known, None
        if problem is None and interval.kind == "excitation":
            played = self._played(name)
            problem = self._judged(played)
        elif problem is None and (judge := _JUDGES.get(interval.kind)) is not None:
            problem = judge(self._played(name), interval.trajectory, self._cell)
        if problem is None:
            self._folder.add(name, "completed")
            if played is not None:
                self._check.accept(played)
            return None
        amend_outcome(self._folder.archives / name, REJECTED, problem.sentence)
        self._folder.add(name, REJECTED, problem.sentence)
        self.rejected.append(Rejected(name, problem.sentence))
        return replace(problem, later=(*problem.later, name)) if problem.reference else problem

    def agreement(self) -> str:
        """How well the last good repetition agrees with those before, in a few words."""
        return self._check.agreement

    def adopt(self, intervals: Sequence[Interval], made: Callable[[ArchiveHeader], bool]) -> None:
        """Enter archives that an earlier run completed and was killed before it entered them."""
        sought = {(one.kind, one.index): one for one in intervals}
        entered = {entry.name for entry in self._folder.manifest()}
        found = {path.name for path in self._folder.archives.glob("*.mcap")}
        for name in sorted(found - entered):
            parsed = ArchiveName.parse(name)
            interval = None if parsed is None else sought.get((parsed.kind, parsed.index))
            if interval is None or self._folder.whole(interval.kind, interval.index) is not None:
                continue
            try:
                archive = open_archive(self._folder.archives / name, fields=())
            except ArchiveError:
                continue  # torn at its head: done again
            completed = archive.outcome is not None and archive.outcome.outcome == "completed"
            if archive.complete and completed and made(archive.header):
                self.adopted.append(name)
                self.enter(interval, name)

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
            return replace(problem, reference=tuple(path.name for path in good), later=alike)
        reason = f"{', '.join(alike)} and the next repetition agree with each other, not with this"
        for path in good:
            amend_outcome(path, REJECTED, reason)
            self._folder.add(path.name, REJECTED, reason)
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

        Of sound ones that were rejected since one was good: what was unlike an earlier one that
        counted says nothing against those that count now.
        """
        rejected = list[str]()
        for entry in self._folder.manifest():
            name = ArchiveName.parse(entry.name)
            if name is not None and name.kind == "excitation":
                rejected = [*rejected, entry.name] if entry.outcome == REJECTED else []
        check, alike, beside = RepetitionCheck(self._cell, self._motion), list[str](), 0
        check.accept(played)
        for one in rejected:
            with suppress(ArchiveError):
                other = self._played(one)
                if problem_of(other, self._motion, self._cell) is None:
                    beside += self._check.problem(other) is None
                    if check.problem(other) is None:
                        check.accept(other)
                        alike.append(one)
        return tuple(alike), beside

    def _played(self, name: str) -> Played:
        return Played.of(open_archive(self._folder.archives / name, fields=FIELDS))
