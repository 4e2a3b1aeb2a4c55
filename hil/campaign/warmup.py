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

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.cell import Cell
from hil.files import write_or_tell
from hil.reading import lies_there, text_of
from planner import FourierSeries, PiecewiseCubic

from .errors import CampaignFolderError
from .folder import read_back
from .intervals import Interval
from .operator import DriftCurve
from .quality import Problem

if TYPE_CHECKING:
    from .run import Run
    from .runner import Runner

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
    """One motion of a warm-up.

    Attributes:
        archive: its file name.
        friction: of each joint (n) [N·m], None for one that hardly moves.
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
        if not lies_there(path):
            return None
        try:
            found = read_back(cls, text_of(path))
        except (OSError, ValueError) as error:
            raise CampaignFolderError(
                path.parent, f"{path.name} is damaged ({error})", "remove that file"
            ) from error
        return found if found.plan_hash == plan_hash else None

    def save(self, path: Path) -> None:
        """Write it.

        Raises:
            OutputError: the disk refuses.
        """
        content = {"format_version": FORMAT_VERSION, **asdict(self)}
        write_or_tell(path, json.dumps(content, indent=1) + "\n")

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
        """This warm-up after one more motion, and what has come of it.

        Args:
            archive: file name.
            friction: (n,) [N·m], NaN for a joint that hardly moves.
            least: motions at least.
            most: and at most.
        """
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
    """Measures the friction of archived repetitions of one motion.

    Args:
        cell: with its nominal model.
        trajectory: the motion.
    """

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
    """Repeats the excitation until friction hardly changes any more.

    Args:
        run: whose joints are to be warm.

    Attributes:
        pauses: after which this run warmed up anew, in sentences.
        threshold: change per motion that counts as warm; 0 where no warm-up is wanted.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._meter: FrictionMeter | None = None
        self.pauses: list[str] = []
        self.threshold = drift_wanted(run.cell, only_simulated=run.simulated)

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
            return self.pauses
        cold = f"the arm was not warm when the repetitions began ({_sentence(found)})"
        return [cold, *self.pauses]

    def next_motion(self) -> Interval | None:
        """What a warm-up would run next, None where none is wanted."""
        if self.threshold == 0.0:
            return None
        return self._interval(self._found() or self._new())

    def expected(self) -> list[float]:
        """Durations [s] of the motions that it runs at least."""
        motion = self.next_motion()
        state = self._found() or self._new()
        if motion is None or state.outcome != "going on":
            return []
        missing = self._run.cell.campaign.warmup_least - len(state.motions)
        return [motion.trajectory.duration] * max(missing, 0)

    def run(self, runner: Runner) -> None:
        """Run as many motions as it takes; none where the arm is warm, or none are wanted.

        Raises:
            RepetitionsRejectedError: a motion was slowed again and again.
        """
        if self.threshold == 0.0:
            return
        state = self._present()
        self._run.watch.drift = state.curve
        while state.outcome == "going on":
            interval = self._interval(state)
            if len(state.motions) >= self._run.cell.campaign.warmup_least:
                self._run.watch.expect(interval.trajectory.duration)
            name = runner.play_until_good(
                interval, len(state.motions) + 1, self._run.cell.campaign.warmup_most
            )
            state = replace(self._with(state, name), moved_at=time.time())
            state.save(self._run.folder.warmup)
            self._run.watch.drift = state.curve
            self._run.watch.note(_sentence(state))
        self._run.reporter.say(_sentence(state))

    def keep(self, runner: Runner) -> None:
        """Warm up anew where the joints have cooled down since they moved last.

        Raises:
            RepetitionsRejectedError: as `run`.
        """
        found = self._found()
        if self.threshold and found is not None and found.motions and found.cold(time.time()):
            self.run(runner)

    def lost(self, began: float) -> Problem | None:
        """What is wrong with a repetition that began then [s since 1970]; None if it was warm.

        A hold before it may last as long as a person likes.
        """
        found = self._found()
        if not self.threshold or found is None or not found.motions or not found.cold(began):
            return None
        return Problem(f"{_rested(found, began)} when it began and was assumed to be cold", True)

    def moved(self) -> None:
        """A motion has ended that keeps the joints warm."""
        found = self._found()
        if found is not None:
            replace(found, moved_at=time.time()).save(self._run.folder.warmup)

    def _found(self) -> WarmUp | None:
        return WarmUp.load(self._run.folder.warmup, self._run.plan_hash)

    def _new(self) -> WarmUp:
        return WarmUp(self._run.plan_hash, self._run.cell.joint_names, self.threshold)

    def _interval(self, state: WarmUp) -> Interval:
        plan = self._run.plan
        return Interval("warmup", state.next_index, plan.excitation.trajectory, plan.moves)

    def _with(self, state: WarmUp, name: str) -> WarmUp:
        """The warm-up after the motion of an archive."""
        settings = self._run.cell.campaign
        self._meter = self._meter or FrictionMeter(
            self._run.cell, self._run.plan.excitation.trajectory
        )
        friction = self._meter.measure(self._run.folder.archives / name)
        return state.with_motion(name, friction, settings.warmup_least, settings.warmup_most)

    def _present(self) -> WarmUp:
        """The warm-up to go on with; a new one where the joints have cooled down.

        A motion that is entered in the manifest and not here was the last one of a run that was
        killed between the two.
        """
        state = replace(self._found() or self._new(), threshold=self.threshold)
        index = state.next_index
        name = self._run.folder.whole("warmup", index)
        last = self._run.folder.whole("warmup", index + 1) is None
        if state.outcome == "going on" and name is not None and last:
            written = (self._run.folder.archives / name).stat().st_mtime
            state = replace(self._with(state, name), moved_at=max(state.moved_at or 0.0, written))
            state.save(self._run.folder.warmup)
        if state.motions and state.cold(time.time()):
            rested = _rested(state, time.time())
            self._run.reporter.say(f"{rested} and is assumed to be cold: warming up anew")
            self.pauses.append(f"{rested} during the campaign, and was warmed up anew")
            state = state.cooled()
        return state


def _rested(state: WarmUp, now: float) -> str:
    """How long the arm has rested, as the beginning of a sentence."""
    if state.moved_at is None:
        return "the arm had rested"
    if now < state.moved_at:
        return "the arm moved last at a time that is still to come (a clock was put back)"
    return f"the arm had rested for {(now - state.moved_at) / 60.0:.0f} min"


def _sentence(state: WarmUp) -> str:
    """Where a warm-up stands, in a sentence."""
    done, change = len(state.motions), float(state.curve.change[-1])
    text = f"warm-up: friction changes by {change:.2%} a motion after {done} motions"
    if state.outcome == "warm":
        return f"{text}; below {state.threshold:.2%} counts as warm"
    if state.outcome == "not warm":
        return f"{text}; still not below {state.threshold:.2%}, and no more motions were allowed"
    return text
