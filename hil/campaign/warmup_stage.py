"""The warm-up as a stage of a run."""

from __future__ import annotations

import time
from dataclasses import replace

from hil.cell import Cell
from hil.progress import Reporter

from .execution_runner import Runner
from .execution_watch import RunWatch
from .folder import CampaignFolder
from .intervals import Interval
from .plan import CampaignPlan
from .quality import Problem
from .quality_entry import Entering
from .repeating import play_until_good
from .warmup import FrictionMeter, WarmUp, drift_wanted


class WarmUpStage:
    """Repeats the excitation until friction hardly changes any more.

    Args:
        folder: of the campaign.
        cell: of the campaign.
        plan: of the campaign.
        plan_hash: of exactly that plan.
        reporter: informed of what is decided.
        watch: shows the curve.
        simulated: whether nothing but a simulated arm can move.

    Attributes:
        pauses: after which this run warmed up anew, in sentences.
        threshold: change per motion that counts as warm; 0 where no warm-up is wanted.
    """

    def __init__(
        self,
        folder: CampaignFolder,
        cell: Cell,
        plan: CampaignPlan,
        plan_hash: str,
        reporter: Reporter,
        watch: RunWatch,
        *,
        simulated: bool,
    ) -> None:
        self._folder, self._cell, self._plan = folder, cell, plan
        self._plan_hash, self._reporter, self._watch = plan_hash, reporter, watch
        self._meter: FrictionMeter | None = None
        self.pauses: list[str] = []
        self.threshold = drift_wanted(cell, only_simulated=simulated)

    @property
    def outcome(self) -> str:
        """How the warm-up stands: "none", "going on", "warm" or "not warm"."""
        found = self._found()
        return "none" if found is None else found.outcome

    @property
    def note(self) -> str | None:
        """What a reader of the results must know, None for nothing."""
        found = self._found()
        if found is None or found.outcome != "not warm":
            return None
        return f"the arm was not warm when the repetitions began ({_sentence(found)})"

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
        missing = self._cell.campaign.warmup_least - len(state.motions)
        return [motion.trajectory.duration] * max(missing, 0)

    def run(self, runner: Runner, entering: Entering) -> None:
        """Run as many motions as it takes; none where the arm is warm, or none are wanted.

        Raises:
            RepetitionsRejectedError: a motion was slowed again and again.
        """
        if self.threshold == 0.0:
            return
        state = self._present()
        self._watch.drift = state.curve
        while state.outcome == "going on":
            interval = self._interval(state)
            if len(state.motions) >= self._cell.campaign.warmup_least:
                self._watch.expect(interval.trajectory.duration)
            name = play_until_good(
                runner,
                entering,
                interval,
                len(state.motions) + 1,
                self._cell.campaign.warmup_most,
                self._reporter,
            )
            state = replace(self._with(state, name), moved_at=time.time())
            state.save(self._folder.warmup)
            self._watch.drift = state.curve
            self._watch.note(_sentence(state))
        self._reporter.say(_sentence(state))

    def keep(self, runner: Runner, entering: Entering) -> None:
        """Warm up anew where the joints have cooled down since they moved last.

        Raises:
            RepetitionsRejectedError: as `run`.
        """
        found = self._found()
        if self.threshold and found is not None and found.motions and found.cold(time.time()):
            self.run(runner, entering)

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
            replace(found, moved_at=time.time()).save(self._folder.warmup)

    def _found(self) -> WarmUp | None:
        return WarmUp.load(self._folder.warmup, self._plan_hash)

    def _new(self) -> WarmUp:
        return WarmUp(self._plan_hash, self._cell.joint_names, self.threshold)

    def _interval(self, state: WarmUp) -> Interval:
        plan = self._plan
        return Interval("warmup", state.next_index, plan.excitation.trajectory, plan.moves)

    def _with(self, state: WarmUp, name: str) -> WarmUp:
        """The warm-up after the motion of an archive."""
        settings = self._cell.campaign
        self._meter = self._meter or FrictionMeter(self._cell, self._plan.excitation.trajectory)
        friction = self._meter.measure(self._folder.archives / name)
        return state.with_motion(name, friction, settings.warmup_least, settings.warmup_most)

    def _present(self) -> WarmUp:
        """The warm-up to go on with; a new one where the joints have cooled down.

        A motion that is entered in the manifest and not here was the last one of a run that was
        killed between the two.
        """
        state = replace(self._found() or self._new(), threshold=self.threshold)
        index = state.next_index
        name = self._folder.whole("warmup", index)
        last = self._folder.whole("warmup", index + 1) is None
        if state.outcome == "going on" and name is not None and last:
            written = (self._folder.archives / name).stat().st_mtime
            state = replace(self._with(state, name), moved_at=max(state.moved_at or 0.0, written))
            state.save(self._folder.warmup)
        if state.motions and state.cold(time.time()):
            rested = _rested(state, time.time())
            self._reporter.say(f"{rested} and is assumed to be cold: warming up anew")
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
