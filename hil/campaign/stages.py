"""Stages of a run before the repetitions: an accepted dry run, and the warm-up."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from hil.base.errors import OperatorStopError
from hil.base.progress import Reporter
from hil.control.motions import CampaignMotion

from .dry_run import OVERRIDE, DryRunRecord, DryRunState, is_from, not_accepted
from .joint_warm_up import FrictionMeter, WarmUpRecord, drift_wanted
from .motion_runner import RunArchives, Runner, RunOptions
from .operator import ExpectedMotion, RunWatch
from .quality import QualityProblem
from .state import CampaignState


class DryRunStage:
    """Runs every motion that is to be sent at full speed once slowly, and has it accepted.

    `state` is "accepted", "to be accepted", or "left out" where the caller did without.
    """

    def __init__(
        self,
        campaign: CampaignState,
        archives: RunArchives,
        watch: RunWatch,
        options: RunOptions,
    ) -> None:
        self._campaign = campaign
        self._folder = campaign.folder
        self._options = options
        self._archives = archives
        self._watch = watch
        self.state: DryRunState = "left out" if options.unrehearsed else "to be accepted"
        motions = [
            motion for motion in campaign.motions
            if motion.kind == "validation" or (motion.kind, motion.index) == ("excitation", 0)
        ]  # fmt: skip
        self.motions = [replace(motion, kind="dryrun", index=k) for k, motion in enumerate(motions)]
        # Only what an earlier run measured can be accepted, not what this one is going to.
        named = options.accept_torque
        self._known = named if named and self.record() else ()

    def record(self) -> DryRunRecord | None:
        """Return the dry run of this plan and kind of arm; None without a valid one."""
        archives = self._archives
        if self._options.unrehearsed:
            return None
        return DryRunRecord.load_valid(
            self._folder,
            plan_hash=archives.plan_hash,
            motions=len(self.motions),
            simulated=archives.simulated,
        )

    def missing(self) -> list[CampaignMotion]:
        """Return the motions that were not run slowly yet."""
        motions = [] if self._options.unrehearsed else self.motions
        return [motion for motion in motions if self._complete(motion) is None]

    def run(self, runner: Runner) -> None:
        """Run what is missing slowly, and have it accepted; see `accept`."""
        missing = self.missing()
        for slow in missing:
            name = runner.run_motion(slow, slow.index + 1, len(self.motions), OVERRIDE)
            self._archives.review.enter(slow, name)
        if missing:
            self.accept()

    def accept(self) -> None:
        """Write `dry_run.json` once all motions are done, and have it accepted.

        Raises:
            DryRunError: it must be accepted now and is not.
            OperatorStopError: the operator stopped instead of answering.
        """
        archives = self._archives
        record = self.record()
        if self._options.unrehearsed:
            return
        if record is None:
            names = [name for slow in self.motions if (name := self._complete(slow)) is not None]
            if len(names) < len(self.motions):
                return
            record = DryRunRecord.of(
                self._campaign,
                names,
                plan_hash=archives.plan_hash,
                simulated=archives.simulated,
            )
            record.save(self._folder.dry_run)
        if record.accepted is None:
            unknown = [joint for joint in record.against_gravity if joint not in self._known]
            if not self._agreed(record, unknown):
                if not self._options.dry_run_only:
                    raise not_accepted(self._folder, record, unknown)
                return
            record.accepted_now().save(self._folder.dry_run)
        self.state = "accepted"

    def _agreed(self, record: DryRunRecord, unknown: Sequence[str]) -> bool:
        """Return whether caller or operator accepts it; unknown joints only the operator can."""
        operator = self._watch.operator
        stop = self._watch.stop
        if self._options.accept_dry_run and not unknown:
            return True
        agreed = operator.can_answer and operator.accept_dry_run(record)
        if operator.can_answer and not agreed and stop.requested:
            raise OperatorStopError(
                f"{self._folder.root}: stopped by the operator; its dry run was done, and is not "
                "accepted."
            )
        return agreed

    def _complete(self, slow: CampaignMotion) -> str | None:
        """Return the name of its complete archive, if it is of this kind of arm."""
        name = self._folder.complete_archive(slow.kind, slow.index)
        made = name is not None and is_from(self._folder.archives / name, self._archives.simulated)
        return name if made else None


class WarmUpStage:
    """Repeats the excitation until friction hardly changes any more."""

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
        self._pauses: list[str] = []
        self._threshold = drift_wanted(campaign.cell, only_simulated=archives.simulated)

    @property
    def outcome(self) -> str:
        """State of the warm-up: "none", "going on", "warm" or "not warm"."""
        record = self._stored()
        return "none" if record is None else record.outcome

    @property
    def notes(self) -> list[str]:
        """What a reader of the results must know."""
        record = self._stored()
        if record is None or record.outcome != "not warm":
            return self._pauses
        cold = f"the arm was not warm when the repetitions began ({record.sentence})"
        return [cold, *self._pauses]

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
            self._reporter.say(state.sentence)

    def rewarm(self, runner: Runner) -> None:
        """Warm up again if the joints have cooled down."""
        if self._cold(time.time()) is not None:
            self.run(runner)

    def cold_start(self, began: float) -> QualityProblem | None:
        """Return the problem of a repetition that began cold [s since 1970], as after a hold."""
        record = self._cold(began)
        if record is None:
            return None
        return QualityProblem(f"{record.rested(began)} when it began and was assumed to be cold")

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
            rested = state.rested(time.time())
            self._reporter.say(f"{rested} and is assumed to be cold: warming up again")
            self._pauses.append(f"{rested} during the campaign, and was warmed up again")
            return state.cooled()
        return state
