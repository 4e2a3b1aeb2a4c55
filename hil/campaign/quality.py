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
_FIRST_FOLLOWING: Final = 0.05
"""Share of the following-error threshold by which the first repetitions may differ (rms)."""
_FIRST_CURRENT: Final = 0.1
"""Share of the motion's rms current by which they may."""
_LEAST_FOLLOWING: Final = 0.005
_LEAST_CURRENT: Final = 0.02
"""Likewise: differences below that never reject, however well the earlier ones agree."""
_WIDE: Final = 3.0
"""Times the median difference of the earlier ones that is never rejected."""
_OUTLYING: Final = 6.0
"""Robust standard deviations above the median difference."""


@dataclass(frozen=True)
class Groups:
    """Repetitions of two kinds: each agrees with its own and with none of the others.

    Attributes:
        reference: file names of those that count.
        later: of attempts that were rejected for being unlike them.
    """

    reference: tuple[str, ...]
    later: tuple[str, ...]

    def with_one(self, name: str) -> Groups:
        """One more later attempt."""
        return Groups(self.reference, (*self.later, name))


@dataclass(frozen=True)
class Problem:
    """Why a motion is of no use.

    Attributes:
        sentence: in words.
        by_hand: whether somebody held or slowed it: that says nothing against the arm.
        apart: whether it is only unlike the repetitions before it.
        against: where so many attempts agree with it that the arm itself may be another by now.
    """

    sentence: str
    by_hand: bool = False
    apart: bool = False
    against: Groups | None = None

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
            position=columns["position"][rows],
            current=columns["target_current"][rows],
            commanded=position[rows],
            missed=missed,
        )


def problem_of(
    played: Played, trajectory: PiecewiseCubic | FourierSeries, cell: Cell
) -> Problem | None:
    """What is wrong with a motion by itself; None if nothing is.

    Args:
        played: it, as archived.
        trajectory: it, as planned.
        cell: its period and current limits.
    """
    wanted = int(np.ceil(trajectory.duration / cell.period - 1e-6))
    torn = torn_or_slowed(played, trajectory, cell)
    if torn is not None:
        return torn
    if played.missed > MISSED_SHARE * wanted:
        words = f"{played.missed} of {wanted} packets were missed; {MISSED_SHARE:.0%} are bearable"
        return Problem(words)
    return _stuck(played, cell) or _saturation(played.current, cell)


def torn_or_slowed(
    played: Played, trajectory: PiecewiseCubic | FourierSeries, cell: Cell
) -> Problem | None:
    """Whether a motion is not all there, or was held or slowed: it is another motion then."""
    wanted, rows = int(np.ceil(trajectory.duration / cell.period - 1e-6)), len(played.commanded)
    if rows < wanted - 1:
        return Problem(f"{rows} of its {wanted} cycles are archived")
    times = np.minimum(np.arange(rows) * cell.period, trajectory.duration)
    planned = trajectory.sample(times)[0]
    offset = played.commanded[0] - planned[0]
    off = np.abs(played.commanded - planned - offset).max(axis=1)
    if off.max() <= OFF_PATH:
        return None
    at = int(np.argmax(off > OFF_PATH)) * cell.period
    return Problem(
        f"it was held or slowed about {at:.1f} s after its begin, so it is no repetition; leave "
        "the override at 100 %",
        by_hand=True,
    )


def unrest(played: Played, cell: Cell) -> Problem | None:
    """What is wrong with a recording of the arm at rest: the noise of its sensors is read from it.

    Args:
        played: it, as archived.
        cell: its joints' names.
    """
    rows = min(round(STANDSTILL_WINDOW / cell.period), len(played.position) - 1)
    speed = np.abs(played.position[rows:] - played.position[:-rows]).max(axis=0) / (
        rows * cell.period
    )
    allowed = np.maximum(cell.model.friction.standstill, _ARM_MOVED / STANDSTILL_WINDOW)
    joint = int(np.argmax(speed / allowed))
    if speed[joint] <= allowed[joint]:
        return None
    return Problem(
        f"{cell.joint_names[joint]} moved at {speed[joint]:.2g} rad/s while the arm was to stand "
        f"still; below {allowed[joint]:.2g} rad/s it counts as at rest"
    )


def _stuck(played: Played, cell: Cell) -> Problem | None:
    """A joint that stands while it is commanded to move: nothing is estimated from such data."""
    for joint, name in enumerate(cell.joint_names):
        found = stuck(played.position[:, joint], played.commanded[:, joint])
        if found is not None:
            start, travel = found
            return Problem(
                f"{name} is stuck: its position stays the same from {start * cell.period:.2f} s "
                f"after the begin on while it is commanded to move by {travel:.3g}"
            )
    return None


def _saturation(current: Array, cell: Cell) -> Problem | None:
    high = np.abs(current) >= SATURATED * cell.drive_train.current_limit
    for joint, column in enumerate(high.T):
        run = _longest_run(column)
        if run >= SATURATED_CYCLES:
            return Problem(
                f"the current of {cell.joint_names[joint]} was at its limit for "
                f"{run * cell.period * 1e3:.0f} ms"
            )
    return None


def _longest_run(flags: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


@dataclass(frozen=True, eq=False)
class Difference:
    """Of one repetition from the median of others, rms over time, (n,) each.

    Attributes:
        position: as a share of the following-error threshold.
        current: as a share of the motion's rms current.
    """

    position: Array
    current: Array


class RepetitionCheck:
    """Compares repetitions of one motion with the last ones that were found good.

    Args:
        cell: whose thresholds count.
        trajectory: the motion.
    """

    def __init__(self, cell: Cell, trajectory: PiecewiseCubic | FourierSeries) -> None:
        self._cell, self._trajectory = cell, trajectory
        self._earlier: deque[Played] = deque(maxlen=COMPARED)
        self._differences: deque[Difference] = deque(maxlen=2 * COMPARED)

    def learn(self, archives: Sequence[Path]) -> None:
        """Take in repetitions that were found good before."""
        for path in archives[-2 * COMPARED :]:
            self.accept(Played.of(open_archive(path, fields=FIELDS)))

    def accept(self, played: Played) -> None:
        """Compare later ones with this one too."""
        if self._earlier:
            self._differences.append(self._difference(played))
        self._earlier.append(played)

    @property
    def known(self) -> int:
        """Repetitions that a new one is compared with."""
        return len(self._earlier)

    def problem(self, played: Played) -> Problem | None:
        """Why a repetition is of no use; None if it is good."""
        found = problem_of(played, self._trajectory, self._cell)
        if found is not None or not self._earlier:
            return found
        new = self._difference(played)
        for what, values, first, least in (
            ("position", new.position, _FIRST_FOLLOWING, _LEAST_FOLLOWING),
            ("current", new.current, _FIRST_CURRENT, _LEAST_CURRENT),
        ):
            past = np.array([getattr(one, what) for one in self._differences])
            bound = _bounds(past, first, least, len(values))
            joint = int(np.argmax(values / bound))
            if values[joint] > bound[joint]:
                return self._problem(what, joint, float(values[joint]), float(bound[joint]))
        return None

    @property
    def agreement(self) -> str:
        """How well the last good repetition agrees with those before, in a few words."""
        if not self._differences:
            return "nothing to compare with yet"
        return f"currents agree within {self._differences[-1].current.max():.1%} (rms)"

    def _difference(self, played: Played) -> Difference:
        rows = min(len(played.position), *(len(one.position) for one in self._earlier))
        cell = self._cell
        usual = np.median([one.position[:rows] for one in self._earlier], axis=0)
        apart = np.sqrt(np.mean((played.position[:rows] - usual) ** 2, axis=0))
        currents = np.median([one.current[:rows] for one in self._earlier], axis=0)
        off = np.sqrt(np.mean((played.current[:rows] - currents) ** 2, axis=0))
        size = np.sqrt(np.mean(currents**2, axis=0))
        floor = 1e-3 * cell.drive_train.current_limit
        return Difference(apart / following_threshold(cell), off / np.maximum(size, floor))

    def _problem(self, what: str, joint: int, value: float, bound: float) -> Problem:
        name, earlier = self._cell.joint_names[joint], len(self._earlier)
        scale = "the following-error threshold" if what == "position" else "its rms current"
        return Problem(
            f"the {what} of {name} differs from that of the {earlier} repetitions before by "
            f"{value:.2%} of {scale} (rms); {bound:.2%} are allowed",
            apart=True,
        )


def following_threshold(cell: Cell) -> Array:
    """The cell's following-error thresholds as joint angles (n,) [rad]."""
    turns = np.array(cell.drive_table.following_error)
    return np.asarray(np.abs(cell.drive_train.joint_from_motor) @ (2.0 * np.pi * turns))


def _bounds(past: Array, first: float, least: float, n_joints: int) -> Array:
    """Largest difference allowed (n,), from those of earlier repetitions (k, n)."""
    if len(past) < FEWEST - 1:
        return np.full(n_joints, first)
    middle = np.median(past, axis=0)
    scatter = 1.4826 * np.median(np.abs(past - middle), axis=0)
    usual = np.maximum(_WIDE * middle, middle + _OUTLYING * scatter)
    return np.asarray(np.maximum(usual, least))


_JUDGED: Final = frozenset({"standstill", "excitation", "validation", "warmup"})
_FEWEST_ALIKE: Final = 2
"""Attempts that must agree before they speak against what counts."""


@dataclass(frozen=True)
class Rejected:
    """A motion that ended well and is of no use.

    Attributes:
        archive: its file name.
        reason: in words.
    """

    archive: str
    reason: str


class Entering:
    """Enters archives in a campaign's manifest.

    Only after an archive says itself that it is rejected does the manifest: whoever finds the file
    alone, or in a folder whose run was killed, must not pool it either.

    Args:
        folder: of the campaign.
        cell: of the campaign.
        motion: its excitation.

    Attributes:
        rejected: what was found to be of no use.
        adopted: what an earlier run completed and did not live to enter.
        notes: what a reader must know of how repetitions were judged.
    """

    def __init__(
        self, folder: CampaignFolder, cell: Cell, motion: PiecewiseCubic | FourierSeries
    ) -> None:
        self._folder, self._cell, self._motion = folder, cell, motion
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

    def adopt(self, intervals: Sequence[Interval], made: Callable[[ArchiveHeader], bool]) -> None:
        """Enter archives that an earlier run completed and was killed before it entered them.

        Args:
            intervals: what a run may have made.
            made: whether an archive was made of this plan, by its header.
        """
        sought = {(one.kind, one.index): one for one in intervals}
        entered = {entry.name for entry in self._folder.manifest()}
        found = sorted(path.name for path in self._folder.archives.glob("*.mcap"))
        for name in (one for one in found if one not in entered):
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
