"""Quality check of a completed motion, when its archive is closed.

Repetitions are compared set-point by set-point, not by time: the motion waits for a missed packet.
Beyond noise and slow changes of friction a difference means that the arm was disturbed or changed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from drivers.events import MotionStarted
from drivers.exchange.serving import MIN_ARM_MOVEMENT
from hil.archive import Archive, ArchiveHeader, ArchiveName, open_archive
from hil.archive.header import REJECTED
from hil.archive.repair import amend_outcome
from hil.base.arrays import Array
from hil.base.errors import ArchiveError
from hil.cell import Cell
from hil.control.motions import CampaignMotion
from hil.control.slips import slip_of
from identification.arrays import root_mean_square, runs_of
from identification.distributions import MAD_TO_STD
from identification.signals.noise import STANDSTILL_WINDOW_SECONDS
from identification.signals.recording import stuck
from planner import FourierSeries, PiecewiseCubic

from .folder import CampaignFolder
from .quality_messages import problem_words
from .quality_problems import (
    MAX_MISSED_SHARE,
    HeldOrSlowed,
    IncompleteArchive,
    MissedPackets,
    MovedAtRest,
    OtherRepetition,
    OthersAgree,
    QualityProblem,
    ReplacedRepetitions,
    SaturatedCurrent,
    Slipped,
    StuckJoint,
)

_SENT: Final = ("commanded_position", "commanded_velocity")
FIELDS: Final = ("cycle", "gap", "position", "target_current", *_SENT)
"""Columns of an archive that are checked."""
MAX_PATH_DEVIATION: Final = 1e-4
"""Largest distance of set-point and plan, rad; float32 targets are exact to 2e-6."""
SATURATION_SHARE: Final = 0.98  # Share of the current limit from which a current is saturated
MIN_SATURATED_CYCLES: Final = 3  # Saturated cycles in a row that are more than noise
COMPARED_REPETITIONS: Final = 9  # Earlier repetitions that a new one is compared with
# Earlier repetitions from which the bounds follow their own scatter
MIN_REPETITIONS_FOR_SCATTER: Final = 4
_CHANNELS: Final[tuple[tuple[Literal["position", "current"], float, float], ...]] = (
    ("position", 0.05, 0.005),
    ("current", 0.1, 0.02),
)
"""Quantity; share of following-error threshold or rms current by which the first repetitions may
differ (rms); and the least bound of later ones."""
# Least bound as a multiple of the median difference of the earlier ones
_MIN_BOUND_FACTOR: Final = 3.0
_OUTLIER_SIGMAS: Final = 6.0  # Robust standard deviations above the median difference
_MIN_ALIKE_REPETITIONS: Final = 2
"""Least number of attempts that agree with each other before the first repetition is rejected."""

Motion = PiecewiseCubic | FourierSeries


@dataclass(frozen=True, eq=False)
class Executed:
    """Part of an archive in which the arm was commanded; row k is set-point k, sent once or again.

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
    def of(cls, archive: Archive) -> Executed:
        """Return the rows from the first set-point of the motion on.

        A controller may open its axes before a motion is requested; it is held there until then.

        Raises:
            ArchiveError: it is no archive of a commanded motion.
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


def problem_of(executed: Executed, trajectory: Motion, cell: Cell) -> QualityProblem | None:
    """Return the problem of a single motion, or None."""
    if (problem := incomplete_or_slowed(executed, trajectory, cell)) is not None:
        return problem
    cycles = int(np.ceil(trajectory.duration / cell.period - 1e-6))
    if executed.missed > MAX_MISSED_SHARE * cycles:
        return MissedPackets(executed.missed, cycles)
    high = np.abs(executed.current) >= SATURATION_SHARE * cell.drive_train.current_limit
    for joint, name in enumerate(cell.joint_names):
        standstill = stuck(executed.position[:, joint], executed.commanded[:, joint])
        if standstill is not None:
            start, travel = standstill
            return StuckJoint(name, start * cell.period, travel)
    for name, column in zip(cell.joint_names, high.T, strict=True):
        longest = max((stop - start for start, stop in runs_of(column)), default=0)
        if longest >= MIN_SATURATED_CYCLES:
            return SaturatedCurrent(name, longest * cell.period)
    return None


def incomplete_or_slowed(
    executed: Executed, trajectory: Motion, cell: Cell
) -> QualityProblem | None:
    """Return the problem of a motion that is incomplete, or was held or slowed, or None."""
    cycles = int(np.ceil(trajectory.duration / cell.period - 1e-6))
    rows = len(executed.commanded)
    if rows < cycles - 1:
        return IncompleteArchive(rows, cycles)
    times = np.minimum(np.arange(rows) * cell.period, trajectory.duration)
    off = executed.commanded - trajectory.sample(times)[0]
    off = np.abs(off - off[0]).max(axis=1)
    if off.max() <= MAX_PATH_DEVIATION:
        return None
    return HeldOrSlowed(int(np.argmax(off > MAX_PATH_DEVIATION)) * cell.period)


def moving_arm(executed: Executed, _trajectory: Motion, cell: Cell) -> QualityProblem | None:
    """Return the problem of a recording of the arm at rest, in which it moved, or None."""
    rows = min(round(STANDSTILL_WINDOW_SECONDS / cell.period), len(executed.position) - 1)
    moved = np.abs(executed.position[rows:] - executed.position[:-rows]).max(axis=0)
    speed = moved / (rows * cell.period)
    allowed = np.maximum(
        cell.model.friction.standstill, MIN_ARM_MOVEMENT / STANDSTILL_WINDOW_SECONDS
    )
    joint = int(np.argmax(speed / allowed))
    if speed[joint] <= allowed[joint]:
        return None
    return MovedAtRest(cell.joint_names[joint], float(speed[joint]), float(allowed[joint]))


_JUDGES: Final = {
    "standstill": moving_arm,
    "validation": problem_of,
    # A cold arm may need more current than it has; that is why it is warmed up.
    "warmup": incomplete_or_slowed,
}
"""By kind of motion; repetitions are compared as well, and other motions are not checked."""


class RepetitionCheck:
    """Compares repetitions of one motion with the last accepted ones."""

    def __init__(self, cell: Cell, trajectory: Motion) -> None:
        self._cell = cell
        self._trajectory = trajectory
        self._earlier: deque[Executed] = deque(maxlen=COMPARED_REPETITIONS)
        self._differences: deque[Array] = deque(maxlen=2 * COMPARED_REPETITIONS)

    def learn(self, archives: Sequence[Path]) -> None:
        """Accept repetitions that were accepted by an earlier run."""
        for path in archives[-2 * COMPARED_REPETITIONS :]:
            self.accept(Executed.of(open_archive(path, fields=FIELDS)))

    def accept(self, executed: Executed) -> None:
        """Compare later repetitions with this one."""
        if self._earlier:
            self._differences.append(self._difference(executed))
        self._earlier.append(executed)

    def problem(self, executed: Executed) -> QualityProblem | None:
        """Return the problem of a repetition, or None."""
        problem = problem_of(executed, self._trajectory, self._cell)
        if problem is not None or not self._earlier:
            return problem
        new = self._difference(executed)
        past = np.array(self._differences)
        for row, (quantity, first, least) in enumerate(_CHANNELS):
            bound = np.full(len(new[row]), first)
            if len(past) >= MIN_REPETITIONS_FOR_SCATTER - 1:
                middle = np.median(past[:, row], axis=0)
                scatter = MAD_TO_STD * np.median(np.abs(past[:, row] - middle), axis=0)
                usual = np.maximum(_MIN_BOUND_FACTOR * middle, middle + _OUTLIER_SIGMAS * scatter)
                bound = np.maximum(usual, least)
            joint = int(np.argmax(new[row] / bound))
            if new[row, joint] > bound[joint]:
                return OtherRepetition(
                    quantity,
                    self._cell.joint_names[joint],
                    repetitions=len(self._earlier),
                    difference=float(new[row, joint]),
                    allowed=float(bound[joint]),
                )
        return None

    def _difference(self, executed: Executed) -> Array:
        """Return the difference from the median of the earlier ones, rms over time (2, n).

        Positions relative to the following-error thresholds, currents to the motion's rms current.
        """
        rows = min(
            len(executed.position), *(len(repetition.position) for repetition in self._earlier)
        )
        usual = np.median([repetition.position[:rows] for repetition in self._earlier], axis=0)
        currents = np.median([repetition.current[:rows] for repetition in self._earlier], axis=0)
        scale = np.maximum(root_mean_square(currents), 1e-3 * self._cell.drive_train.current_limit)
        apart = root_mean_square(executed.position[:rows] - usual) / following_threshold(self._cell)
        return np.array([apart, root_mean_square(executed.current[:rows] - currents) / scale])


def following_threshold(cell: Cell) -> Array:
    """Return the cell's following-error thresholds as joint angles (n,) [rad]."""
    turns = np.array(cell.drive_table.following_error)
    return np.asarray(np.abs(cell.drive_train.joint_from_motor) @ (2.0 * np.pi * turns))


@dataclass(frozen=True)
class Rejected:
    """A completed motion that was rejected: file name of its archive, and why."""

    archive: str
    problem: QualityProblem

    @property
    def reason(self) -> str:
        """Why, as its archive and the manifest state it."""
        return problem_words(self.problem)


class ArchiveReview:
    """Judges completed archives and enters them in a campaign's manifest.

    A rejection is written to the archive before the manifest: the file alone must not be used.

    Attributes:
        rejected: archives that failed their check.
        adopted: archives of an earlier run that was killed before it entered them.
        replaced: accepted repetitions that this run rejected, or None.
    """

    def __init__(self, folder: CampaignFolder, cell: Cell, motion: Motion) -> None:
        self._folder = folder
        self._cell = cell
        self._motion = motion
        self._check = RepetitionCheck(cell, self._motion)
        self._check.learn(folder.completed("excitation"))
        self.rejected: list[Rejected] = []
        self.adopted: list[str] = []
        self.replaced: ReplacedRepetitions | None = None

    def enter(
        self, motion: CampaignMotion, name: str, stated_problem: QualityProblem | None = None
    ) -> QualityProblem | None:
        """Judge the complete archive of a motion and enter it; return its problem or None."""
        problem = stated_problem
        executed = None
        if problem is None and motion.kind == "excitation":
            executed = self._executed(name)
            problem = self._judged(executed)
        elif problem is None and (judge := _JUDGES.get(motion.kind)) is not None:
            problem = judge(self._executed(name), motion.trajectory, self._cell)
        if problem is None:
            self._folder.add(name, "completed")
            if executed is not None:
                self._check.accept(executed)
            return None
        self._reject(name, problem)
        return problem

    def adopt(
        self, motions: Sequence[CampaignMotion], made: Callable[[ArchiveHeader], bool]
    ) -> None:
        """Enter archives of an earlier run that was killed before it entered them."""
        sought = {(motion.kind, motion.index): motion for motion in motions}
        entered = {entry.name for entry in self._folder.manifest()}
        archive_names = {path.name for path in self._folder.archives.glob("*.mcap")}
        for name in sorted(archive_names - entered):
            parsed = ArchiveName.parse(name)
            motion = None if parsed is None else sought.get((parsed.kind, parsed.index))
            if (
                motion is None
                or self._folder.complete_archive(motion.kind, motion.index) is not None
            ):
                continue
            try:
                archive = open_archive(self._folder.archives / name, fields=())
            except ArchiveError:
                continue  # truncated in its header: the motion is repeated
            completed = archive.outcome is not None and archive.outcome.outcome == "completed"
            if archive.complete and completed and made(archive.header):
                self.adopted.append(name)
                slip = slip_of(self._folder.archives / name)
                self.enter(motion, name, None if slip is None else Slipped(slip))

    def _judged(self, executed: Executed) -> QualityProblem | None:
        """Return the problem of a repetition, or None.

        Where enough later attempts agree with each other and not with the only accepted one, that
        one is rejected instead: once in a run, since a second time shows that they scatter. So are
        several accepted ones with missed packets, during which the controller moved the arm
        without a set-point, if as many attempts without a missed packet agree.
        """
        problem = self._check.problem(executed)
        accepted = [path.name for path in self._folder.completed("excitation")]
        if not isinstance(problem, OtherRepetition) or not accepted or self.replaced:
            return problem
        several = len(accepted) > 1
        if several and (executed.missed or not all(map(self._has_missed, accepted))):
            return problem
        alike, with_accepted = self._alike(executed, without_missed=several)
        enough = max(_MIN_ALIKE_REPETITIONS, self._cell.campaign.bad_repetitions, len(accepted))
        if len(alike) + 1 < max(enough, with_accepted + 2):
            return problem
        for name in accepted:
            self._reject(name, OthersAgree(tuple(alike), only_missed=several))
        self.replaced = ReplacedRepetitions(tuple(accepted), len(alike) + 1)
        self._check = RepetitionCheck(self._cell, self._motion)
        return None

    def _has_missed(self, name: str) -> bool:
        return self._executed(name).missed > 0

    def _reject(self, name: str, problem: QualityProblem) -> None:
        reason = problem_words(problem)
        amend_outcome(self._folder.archives / name, REJECTED, reason)
        self._folder.add(name, REJECTED, reason)
        self.rejected.append(Rejected(name, problem))

    def _alike(self, executed: Executed, *, without_missed: bool = False) -> tuple[list[str], int]:
        """Return attempts that agree with this one and each other, and how many with the accepted.

        Only valid attempts that were rejected since the last accepted one are compared, and on
        request only those without a missed packet; where attempts scatter, they agree with either.
        """
        rejected = list[str]()
        for entry in self._folder.manifest():
            if entry.kind == "excitation":
                rejected = [*rejected, entry.name] if entry.outcome == REJECTED else []
        check = RepetitionCheck(self._cell, self._motion)
        alike = list[str]()
        with_accepted = 0
        check.accept(executed)
        for attempt in rejected:
            with suppress(ArchiveError):
                other = self._executed(attempt)
                if without_missed and other.missed:
                    continue
                if problem_of(other, self._motion, self._cell) is None:
                    with_accepted += self._check.problem(other) is None
                    if check.problem(other) is None:
                        check.accept(other)
                        alike.append(attempt)
        return alike, with_accepted

    def _executed(self, name: str) -> Executed:
        return Executed.of(open_archive(self._folder.archives / name, fields=FIELDS))
