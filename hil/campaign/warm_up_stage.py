"""The warm-up of a run: the excitation is repeated until friction hardly changes."""

from __future__ import annotations

import time
from dataclasses import replace

from hil.base.progress import Reporter
from hil.control.motions import CampaignMotion

from .joint_warm_up import FrictionMeter, WarmUpRecord, drift_wanted
from .motion_runner import RunArchives, Runner
from .operator import ExpectedMotion, RunWatch
from .quality_messages import rest_words
from .quality_problems import ColdStart
from .record_messages import warm_up_line
from .run_notes import NotWarm, RunNote, WarmedUpAgain
from .state import CampaignState


class WarmUpStage:
    """Repeats the excitation until friction hardly changes any more.

    Args:
        campaign: that is run.
        archives: of this run.
        watch: progress and requests of the operator.
        reporter: of progress.
    """

    def __init__(
        self,
        campaign: CampaignState,
        archives: RunArchives,
        watch: RunWatch,
        reporter: Reporter,
    ) -> None:
        self._campaign = campaign
        self._cell = campaign.cell
        self._path = campaign.folder.warmup
        self._archives = archives
        self._watch = watch
        self._reporter = reporter
        self._pauses: list[WarmedUpAgain] = []
        self._threshold = drift_wanted(campaign.cell, only_simulated=archives.simulated)

    @property
    def outcome(self) -> str:
        """State of the warm-up: "none", "going on", "warm" or "not warm"."""
        record = self._stored()
        return "none" if record is None else record.outcome

    @property
    def notes(self) -> list[RunNote]:
        """What a reader of the results must know."""
        record = self._stored()
        if record is None or record.outcome != "not warm":
            return [*self._pauses]
        return [NotWarm(record), *self._pauses]

    def next_motion(self) -> list[CampaignMotion]:
        """Return the next motion of a warm-up; none where no warm-up is wanted."""
        return [self._motion_of(self._state())] if self._threshold else []

    def expected(self) -> list[ExpectedMotion]:
        """Return the motions that it runs at least."""
        state = self._state()
        motions = self.next_motion()
        if state.outcome != "going on":
            return []
        missing = self._cell.campaign.warmup_least - len(state.motions)
        return [ExpectedMotion(one.trajectory.duration) for one in motions] * max(missing, 0)

    def run(self, runner: Runner) -> None:
        """Run motions until the arm is warm, if any are missing (RepetitionsRejectedError)."""
        if not self._threshold or not self._campaign.missing("excitation", "validation"):
            return
        state = self._present()
        settings = self._cell.campaign
        meter = FrictionMeter(self._campaign.cell, self._campaign.plan.excitation.trajectory)
        while state.outcome == "going on":
            motion = self._motion_of(state)
            done = len(state.motions)
            if done >= settings.warmup_least:
                self._watch.expect([ExpectedMotion(motion.trajectory.duration)])
            name = runner.run_until_accepted(motion, done + 1, settings.warmup_most)
            friction = meter.measure(self._campaign.folder.archives / name)
            state = state.with_motion(name, friction, settings.warmup_least, settings.warmup_most)
            state = replace(state, moved_at=time.time())
            state.save(self._path)
            self._reporter.say(warm_up_line(state))

    def rewarm(self, runner: Runner) -> None:
        """Warm up again if the joints have cooled down."""
        if self._cold(time.time()) is not None:
            self.run(runner)

    def cold_start(self, began: float) -> ColdStart | None:
        """Return the problem of a repetition that began cold [s since 1970], as after a hold."""
        record = self._cold(began)
        if record is None:
            return None
        return ColdStart(record.rest_before(began))

    def motion_ended(self) -> None:
        """Record that a motion that warms the joints has ended."""
        record = self._stored()
        if record is not None:
            replace(record, moved_at=time.time()).save(self._path)

    def _stored(self) -> WarmUpRecord | None:
        return WarmUpRecord.load(self._path, self._archives.plan_hash)

    def _state(self) -> WarmUpRecord:
        """Return the warm-up from its file, or a new one."""
        new = WarmUpRecord(self._archives.plan_hash, self._cell.joint_names, self._threshold)
        return replace(self._stored() or new, threshold=self._threshold)

    def _cold(self, when: float) -> WarmUpRecord | None:
        """Return a warm-up after which the arm has cooled down by `when` [s since 1970]."""
        record = self._stored() if self._threshold else None
        return record if record is not None and record.motions and record.cold(when) else None

    def _motion_of(self, state: WarmUpRecord) -> CampaignMotion:
        plan = self._campaign.plan
        index = len(state.earlier) + len(state.motions)
        return CampaignMotion("warmup", index, plan.excitation.trajectory, plan.moves)

    def _present(self) -> WarmUpRecord:
        """Return the warm-up to continue; a new one if the joints have cooled down."""
        state = self._state()
        if state.motions and state.cold(time.time()):
            rest = state.rest_before(time.time())
            self._reporter.say(f"{rest_words(rest)} and is assumed to be cold: warming up again")
            self._pauses.append(WarmedUpAgain(rest))
            return state.cooled()
        return state
