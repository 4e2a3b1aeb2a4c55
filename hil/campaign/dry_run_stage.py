"""The dry run of a run: every motion once slowly, then accepted by the operator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hil.base.errors import OperatorStopError
from hil.control.motions import CampaignMotion

from .dry_run_record import MAX_DRY_RUN_OVERRIDE, DryRunRecord, DryRunState, is_from
from .motion_runner import RunArchives, Runner, RunOptions
from .operator import RunWatch
from .record_messages import not_accepted
from .state import CampaignState


class DryRunStage:
    """Runs every motion once slowly before it is sent at full speed, and has it accepted.

    `state` is "accepted", "to be accepted", or "left out" where the caller did without.

    Args:
        campaign: whose motions are run.
        archives: of this run.
        watch: progress and requests of the operator.
        options: of this run.
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
        """Run the missing motions slowly, and have them accepted; see `accept`."""
        missing = self.missing()
        for slow in missing:
            name = runner.run_motion(slow, slow.index + 1, len(self.motions), MAX_DRY_RUN_OVERRIDE)
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
        """Return the name of its complete archive, if it is from this kind of arm."""
        name = self._folder.complete_archive(slow.kind, slow.index)
        made = name is not None and is_from(self._folder.archives / name, self._archives.simulated)
        return name if made else None
