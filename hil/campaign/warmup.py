"""Warm-up: the excitation is repeated until friction changes but little from motion to motion.

**Measure.** Over a motion that begins and ends at rest, inertial and gravity torques do no work on
the whole; what a joint's torque does beyond that of the rigid arm,

    F_j = (∫ tau_j qd_j dt - ∫ tau_rigid,j qd_j dt) / ∫ |qd_j| dt,

is its friction torque, averaged along the way. The rigid part is that of the nominal model on the
planned motion: the same in each repetition, so that its error drops out of every change.

**Criterion.** The change per motion is the slope of a straight line through the last motions
(Theil and Sen: the median of all slopes between two of them), as a share of the friction.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.cell import Cell
from planner import FourierSeries, PiecewiseCubic

from .folder import load_record, save_record
from .intervals import Interval
from .operator import DriftCurve
from .quality import Problem

if TYPE_CHECKING:
    from .run import Run, Runner

Array = NDArray[np.float64]

DEFAULT_DRIFT: Final = 0.002
"""Change per motion that counts as warm on a real arm. Thirty repetitions then change friction by
a few per cent at most; with half a minute each and a time constant of 20 min, which is usual, the
slope falls to it from 1 % within about 40 motions."""
WINDOW: Final = 4
"""Motions that a slope is read from."""
COLD_AFTER: Final = 600.0
"""s without motion after which the joints are assumed to have cooled down."""
FORMAT_VERSION: Final = 2
"""1 did not say when the joints moved last."""
_FIELDS: Final = ("torque", "commanded_position", "position")
_LEAST_SHARE: Final = 0.02
"""Of a joint's rms torque: less friction than that is not the nominal model's to tell."""
_LEAST_WAY: Final = 1e-2
"""rad; a joint that goes less far tells nothing."""


def drift_wanted(cell: Cell, *, only_simulated: bool | None = None) -> float:
    """Change per motion below which the arm counts as warm; 0 where no warm-up is wanted.

    Args:
        cell: its own link says whether only a simulated arm can move, where that is left out.
        only_simulated: of the link that is really used.
    """
    wanted = cell.campaign.warmup_drift
    if wanted is not None:
        return wanted
    simulated = cell.only_simulated if only_simulated is None else only_simulated
    return 0.0 if simulated else DEFAULT_DRIFT


@dataclass(frozen=True)
class WarmMotion:
    """One motion of a warm-up: file name of its archive, and friction of each joint (n) [N·m].

    None for a joint that hardly moves.
    """

    archive: str
    friction: tuple[float | None, ...]


@dataclass(frozen=True)
class WarmUp:
    """Warm-up of a campaign; `warmup.json`.

    Attributes:
        plan_hash: of the plan it belongs to.
        joint_names: of the n joints.
        threshold: change per motion that counts as warm.
        motions: of the present warm-up, in order.
        outcome: "going on", "warm", or "not warm" where the most motions were not enough.
        earlier: motions of warm-ups whose warmth was lost in a pause, oldest first.
        moved_at: when a motion that keeps the joints warm ended last [s since 1970]; None if that
            is not known.
    """

    plan_hash: str
    joint_names: tuple[str, ...]
    threshold: float
    motions: tuple[WarmMotion, ...] = ()
    outcome: Literal["going on", "warm", "not warm"] = "going on"
    earlier: tuple[WarmMotion, ...] = ()
    moved_at: float | None = None

    def __post_init__(self) -> None:
        if any(len(one.friction) != len(self.joint_names) for one in self.motions):
            raise ValueError("a motion has not one friction for each joint")

    @classmethod
    def load(cls, path: Path, plan_hash: str) -> Self | None:
        """Read it; None where there is none for this plan.

        Raises:
            CampaignFolderError: the file is damaged.
        """
        found = load_record(cls, path, "is damaged", "remove that file")
        return found if found is not None and found.plan_hash == plan_hash else None

    def save(self, path: Path) -> None:
        """Write it.

        Raises:
            OutputError: the disk refuses.
        """
        save_record(path, self, FORMAT_VERSION)

    @property
    def next_index(self) -> int:
        """Of the archive of the next motion; none is given twice."""
        return len(self.earlier) + len(self.motions)

    def cold(self, now: float) -> bool:
        """Whether the joints have cooled down by `now` [s since 1970].

        Not known, or in the future (a clock was put back): cold. A motion too many harms nothing.
        """
        return self.moved_at is None or not 0.0 <= now - self.moved_at <= COLD_AFTER

    @property
    def curve(self) -> DriftCurve:
        """Friction and its change, motion by motion."""
        friction = np.array([one.friction for one in self.motions], dtype=np.float64)
        friction = friction.reshape(len(self.motions), len(self.joint_names))
        change = [change_per_motion(friction[: k + 1]) for k in range(len(friction))]
        return DriftCurve(self.joint_names, friction, np.array(change), self.threshold)

    def with_motion(self, archive: str, friction: Array, least: int, most: int) -> WarmUp:
        """This warm-up after one more motion, with its friction (n,) [N·m], and what came of it."""
        known = tuple(float(f) if np.isfinite(f) else None for f in friction)
        longer = replace(self, motions=(*self.motions, WarmMotion(archive, known)))
        done, change = len(longer.motions), longer.curve.change[-1]
        if done >= max(least, WINDOW) and change <= self.threshold:
            return replace(longer, outcome="warm")
        untold = done >= least and np.isnan(change)  # more motions would not tell either
        return replace(longer, outcome="not warm") if untold or done >= most else longer

    def cooled(self) -> WarmUp:
        """A new warm-up after this one was lost in a pause."""
        earlier = (*self.earlier, *self.motions)
        return replace(self, motions=(), outcome="going on", earlier=earlier)

    @property
    def sentence(self) -> str:
        """Where it stands; it has had a motion."""
        done, change = len(self.motions), float(self.curve.change[-1])
        text = f"warm-up: friction changes by {change:.2%} a motion after {done} motions"
        if self.outcome == "warm":
            return f"{text}; below {self.threshold:.2%} counts as warm"
        if self.outcome == "not warm":
            return f"{text}; still not below {self.threshold:.2%}, and no more motions were allowed"
        return text

    def rested(self, now: float) -> str:
        """How long the arm has rested, as the beginning of a sentence."""
        if self.moved_at is None:
            return "the arm had rested"
        if now < self.moved_at:
            return "the arm moved last at a time that is still to come (a clock was put back)"
        return f"the arm had rested for {(now - self.moved_at) / 60.0:.0f} min"


def change_per_motion(friction: Sequence[Array] | Array) -> float:
    """Largest change per motion of any joint at the end of a row of motions, as a share.

    Args:
        friction: (k, n) [N·m].

    Returns:
        NaN for fewer than two motions, or if no joint moves.
    """
    last = np.asarray(friction, dtype=np.float64)[-WINDOW:]
    moves = np.isfinite(last).all(axis=0) if len(last) else np.zeros(0, bool)
    if len(last) < 2 or not moves.any():
        return float("nan")
    # Theil's slope: the median over all pairs, which one motion that went wrong does not move.
    first, second = np.triu_indices(len(last), k=1)
    known = last[:, moves]
    slopes = np.median((known[second] - known[first]) / (second - first)[:, None], axis=0)
    return float(np.max(np.abs(slopes) / np.abs(np.median(known, axis=0))))


class FrictionMeter:
    """Measures the friction of archived repetitions of one motion."""

    def __init__(self, cell: Cell, trajectory: PiecewiseCubic | FourierSeries) -> None:
        self._period, self._trajectory = cell.period, trajectory
        model, values = cell.model, cell.nominal_values()
        rigid = np.where(model.friction_columns, 0.0, values)
        times = np.arange(0.0, trajectory.duration, cell.period)
        q, qd, qdd = trajectory.sample(times)
        torque = model.torque(rigid, q, qd, qdd) + model.load_torque(q, qd, qdd)
        self._rigid_work = (torque * qd).sum(axis=0) * cell.period
        self._way = np.abs(qd).sum(axis=0) * cell.period

    def measure(self, path: Path) -> Array:
        """Friction torque of each joint along the way (n,) [N·m]; NaN where it hardly moves.

        Raises:
            ArchiveError: the archive cannot be read.
        """
        columns = open_archive(path, fields=_FIELDS).recorded(*_FIELDS)
        rows = ~np.isnan(columns["commanded_position"]).any(axis=1)
        torque = columns["torque"][rows]
        # Measured, not commanded: while the arm lags behind, inertial torque works on the command.
        work = (torque * np.gradient(columns["position"][rows], axis=0)).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            friction = (work - self._rigid_work) / self._way
        size = np.sqrt(np.mean(torque**2, axis=0))
        known = (self._way > _LEAST_WAY) & (np.abs(friction) > _LEAST_SHARE * size)
        return np.where(known, friction, np.nan)


class WarmUpStage:
    """Repeats the excitation until friction hardly changes any more."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._meter: FrictionMeter | None = None
        self._pauses: list[str] = []
        self._threshold = drift_wanted(run.cell, only_simulated=run.simulated)

    @property
    def outcome(self) -> str:
        """How the warm-up stands: "none", "going on", "warm" or "not warm"."""
        found = self._found()
        return "none" if found is None else found.outcome

    @property
    def notes(self) -> list[str]:
        """What a reader of the results must know."""
        found = self._found()
        if found is None or found.outcome != "not warm":
            return self._pauses
        cold = f"the arm was not warm when the repetitions began ({found.sentence})"
        return [cold, *self._pauses]

    def next_motion(self) -> Interval | None:
        """What a warm-up would run next, None where none is wanted."""
        return self._interval(self._state()) if self._threshold else None

    def expected(self) -> list[float]:
        """Durations [s] of the motions that it runs at least."""
        state, motion = self._state(), self.next_motion()
        if motion is None or state.outcome != "going on":
            return []
        missing = self._run.cell.campaign.warmup_least - len(state.motions)
        return [motion.trajectory.duration] * max(missing, 0)

    def run(self, runner: Runner) -> None:
        """Run as many motions as it takes; none where the arm is warm, or none are wanted.

        Raises:
            RepetitionsRejectedError: a motion was slowed again and again.
        """
        if not self._threshold:
            return
        run, state = self._run, self._present()
        run.watch.warms(state.curve)
        while state.outcome == "going on":
            interval, done = self._interval(state), len(state.motions)
            if done >= run.cell.campaign.warmup_least:
                run.watch.expect([interval.trajectory.duration])
            name = runner.play_until_good(interval, done + 1, run.cell.campaign.warmup_most)
            state = self._saved(state, name, time.time())
            run.watch.warms(state.curve)
            run.watch.note(state.sentence)
        run.reporter.say(state.sentence)

    def keep(self, runner: Runner) -> None:
        """Warm up anew where the joints have cooled down since they moved last.

        Raises:
            RepetitionsRejectedError: as `run`.
        """
        if self._cold(time.time()) is not None:
            self.run(runner)

    def lost(self, began: float) -> Problem | None:
        """What is wrong with a repetition that began then [s since 1970]; None if it was warm.

        A hold before it may last as long as a person likes.
        """
        found = self._cold(began)
        if found is None:
            return None
        return Problem(f"{found.rested(began)} when it began and was assumed to be cold", True)

    def moved(self) -> None:
        """A motion has ended that keeps the joints warm."""
        found = self._found()
        if found is not None:
            replace(found, moved_at=time.time()).save(self._run.folder.warmup)

    def _found(self) -> WarmUp | None:
        return WarmUp.load(self._run.folder.warmup, self._run.plan_hash)

    def _state(self) -> WarmUp:
        """As it was written down, or a new one."""
        new = WarmUp(self._run.plan_hash, self._run.cell.joint_names, self._threshold)
        return replace(self._found() or new, threshold=self._threshold)

    def _cold(self, when: float) -> WarmUp | None:
        """The warm-up whose warmth is lost by then [s since 1970]; None where none is."""
        found = self._found() if self._threshold else None
        return found if found is not None and found.motions and found.cold(when) else None

    def _interval(self, state: WarmUp) -> Interval:
        plan = self._run.plan
        return Interval("warmup", state.next_index, plan.excitation.trajectory, plan.moves)

    def _saved(self, state: WarmUp, name: str, moved_at: float) -> WarmUp:
        """The warm-up after the motion of an archive, written down."""
        run, settings = self._run, self._run.cell.campaign
        self._meter = self._meter or FrictionMeter(run.cell, run.plan.excitation.trajectory)
        friction = self._meter.measure(run.folder.archives / name)
        state = state.with_motion(name, friction, settings.warmup_least, settings.warmup_most)
        state = replace(state, moved_at=moved_at)
        state.save(run.folder.warmup)
        return state

    def _present(self) -> WarmUp:
        """The warm-up to go on with; a new one where the joints have cooled down.

        A motion that is entered in the manifest and not here was the last one of a run that was
        killed between the two.
        """
        run, state = self._run, self._state()
        name = run.folder.whole("warmup", state.next_index)
        last = run.folder.whole("warmup", state.next_index + 1) is None
        if state.outcome == "going on" and name is not None and last:
            written = (run.folder.archives / name).stat().st_mtime
            state = self._saved(state, name, max(state.moved_at or 0.0, written))
        if state.motions and state.cold(time.time()):
            rested = state.rested(time.time())
            run.reporter.say(f"{rested} and is assumed to be cold: warming up anew")
            self._pauses.append(f"{rested} during the campaign, and was warmed up anew")
            return state.cooled()
        return state
