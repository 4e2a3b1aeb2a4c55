"""One run of a campaign: the motions that are missing, in order, behind the gates.

Everything is checked before the first motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from typing import Any

from hil.base.progress import Reporter
from hil.campaign.reached_precision import PrecisionStage
from hil.control.cell_link import cell_link
from hil.control.connection import active_checks, lower_limits
from hil.control.link import MotionLink
from hil.control.motion_checks import MotionChecks
from hil.control.motions import CampaignMotion, CheckedMoves, require_allowed
from identification.excitation.collision_messages import unchecked_text

from .dry_run_record import MAX_DRY_RUN_OVERRIDE, DryRunState
from .dry_run_stage import DryRunStage
from .gates import require_as_rehearsed, require_dry_run, require_gates
from .motion_runner import RunArchives, Runner, RunOptions
from .operator import RunWatch
from .precision_record import PrecisionRecord
from .quality import Rejected
from .record_messages import precision_line
from .run_messages import run_lines
from .run_notes import AgainstGravity, LowerCurrentLimits, RunNote
from .state import CampaignState
from .warm_up_stage import WarmUpStage


@dataclass(frozen=True)
class RunResult:
    """What a run has done, and the progress of the campaign after it.

    Attributes:
        command: runs the campaign again.
        simulated: whether only a simulated arm can have moved.
        archives: file names made by this run, in order, whatever their outcome.
        rejected: of these, the motions that failed their quality check.
        adopted: archives of an earlier run that was killed before it entered them.
        dry_run: whether the operator has accepted it; "left out" where the caller did without.
        against_gravity: joints whose torque had the opposite sign of gravity in the dry run.
        warm_up: "warm", "not warm", "going on", or "none" where none was wanted.
        repetitions, validations: how many are complete now, and how many there are to be.
        complete: whether no motion is missing.
        cycles: archived by this run.
        precision: what the repetitions reached of a required one; None if none was required.
        notes: what a reader must know.
    """

    campaign: str
    command: str
    plan_hash: str
    simulated: bool
    archives: tuple[str, ...]
    rejected: tuple[Rejected, ...]
    adopted: tuple[str, ...]
    dry_run: DryRunState
    against_gravity: tuple[str, ...]
    warm_up: str
    repetitions: tuple[int, int]
    validations: tuple[int, int]
    complete: bool
    cycles: int
    precision: PrecisionRecord | None
    notes: tuple[RunNote, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return {
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "rejected": [
                {"archive": each.archive, "reason": each.reason} for each in self.rejected
            ],
            "precision": "" if self.precision is None else precision_line(self.precision),
            "notes": run_lines(self.notes),
        }


def run_motions(
    campaign: CampaignState,
    link: MotionLink | None,
    watch: RunWatch,
    reporter: Reporter,
    options: RunOptions,
) -> RunResult:
    """Run the missing motions of a campaign; see `Campaign.run`.

    Args:
        campaign: state of its folder.
        link: to the controller; default: the cell's.
        watch: of the run.
        reporter: of progress.
        options: of the run.
    """
    with campaign.folder.locked():
        campaign.folder.require_unchanged()
        return _CampaignRun(campaign, link, watch, reporter, options).execute()


class _CampaignRun:
    """The stages of one run, on a link (None for the cell's own), behind the gates."""

    def __init__(
        self,
        campaign: CampaignState,
        link: MotionLink | None,
        watch: RunWatch,
        reporter: Reporter,
        options: RunOptions,
    ) -> None:
        self._campaign = campaign
        self._link = link
        self._options = options
        self._watch = watch
        self._reporter = reporter
        plan_hash = campaign.folder.hash_of(campaign.cell, campaign.plan)
        simulated = (campaign.cell if link is None else link).only_simulated
        require_gates(
            campaign, link, plan_hash, simulated=simulated, unrehearsed=options.unrehearsed
        )
        # A requirement that cannot be measured is refused before an operator watches a dry run.
        self._precision = (
            PrecisionStage(campaign, options.until_precise, plan_hash, reporter)
            if options.until_precise
            else None
        )
        self._archives = RunArchives(campaign, link, options, plan_hash)
        self._dry_run = DryRunStage(campaign, self._archives, watch, options)
        if not options.unrehearsed:
            # Refused before anything moves if the dry run could not be accepted afterwards.
            require_dry_run(
                campaign.folder,
                self._dry_run.record(),
                options,
                simulated=simulated,
                can_answer=watch.operator.can_answer,
            )
        self._warm_up = WarmUpStage(campaign, self._archives, watch, reporter)

    def execute(self) -> RunResult:
        """Run the missing motions; a controller is connected only where some are missing."""
        options = self._options
        dry_run = self._dry_run
        self._archives.adopt(dry_run.motions)
        if self._precision is not None:
            self._precision.begin()
        slow = dry_run.missing()
        full = [] if options.dry_run_only else self._missing()
        if not slow:
            dry_run.accept()
        if slow or full:
            with self._connected(slow, full) as runner:
                dry_run.run(runner)
                if full:
                    self._warm_up.run(runner)
                    # Later repetitions may show that the first one was disturbed.
                    for kind in ("standstill", "excitation", "excitation", "validation"):
                        self._run_missing(runner, kind)
                runner.go_back(MAX_DRY_RUN_OVERRIDE if options.dry_run_only else 1.0)
        return self._result()

    @contextmanager
    def _connected(
        self, slow: Sequence[CampaignMotion], full: Sequence[CampaignMotion]
    ) -> Iterator[Runner]:
        """Connect the controller, check all motions with its limits, and close the link after."""
        cell = self._campaign.cell
        reporter = self._reporter
        checks = MotionChecks.of(cell)
        unchecked = unchecked_text(checks.checker.exceptions)
        if unchecked is not None and self._options.say_unchecked:
            reporter.say(unchecked)
        sent = [*slow, *full, *(self._warm_up.next_motion() if full else ())]
        # What is wrong with a motion itself is reported before anything is connected.
        require_allowed(sent, checks)
        live = self._options.live
        given = self._link
        stop = self._watch.stop
        own = cell_link(cell, live=live, report=reporter.say, stop=stop)
        with own if given is None else nullcontext(given) as link:
            link.connection.report = reporter.say
            for note in link.notes():
                reporter.say(f"note: {note}")
            if link.live is not None:
                reporter.say(link.live.notice)
            start = link.connect(stop)
            require_as_rehearsed(self._campaign, link.connection)
            narrowed = active_checks(cell, link.connection, checks)
            if narrowed is not checks:  # the controller's own limits are known only now
                require_allowed(sent, narrowed)
            if below := lower_limits(cell, link.connection, "current_limit"):
                self._archives.notes.append(LowerCurrentLimits(below))
            # Dry run and warm-up use the moves of the motions that they are made of.
            straight = CheckedMoves(cell, narrowed)
            joined = straight.with_moves([*slow, *full], start)
            runner = Runner(
                self._campaign,
                link,
                self._archives,
                self._watch,
                reporter,
                warmth=self._warm_up,
                straight=straight,
                start=start,
                options=self._options,
            )
            before = link.cycles
            expected = runner.expected(joined, len(slow))
            if any(motion.kind != "standstill" for motion in full):
                expected += self._warm_up.expected()
            self._watch.expect(expected)
            total = sum(motion.time() for motion in expected)
            with reporter.task("running the campaign (s of motion)", total) as runner.task:
                yield runner
            link.close()
        self._archives.cycles = link.cycles - before

    def _run_missing(self, runner: Runner, kind: str) -> None:
        """Run the missing motions of a kind; repetitions only while the joints are warm."""
        _, total = self._campaign.progress(kind)
        for motion in self._missing(kind):
            precision = self._precision if kind == "excitation" else None
            if precision is not None and precision.ended:
                return
            runner.run_until_accepted(motion, motion.index + 1, total)
            if precision is not None:
                precision.repeated()
            if kind == "validation":
                self._warm_up.motion_ended()

    def _missing(self, *kinds: str) -> list[CampaignMotion]:
        """Return what the options require to run at full speed."""
        most = self._options.repetitions
        only = self._options.only
        return [
            motion
            for motion in self._campaign.missing(*kinds)
            if (most is None or motion.kind != "excitation" or motion.index < most)
            and (only is None or (motion.kind, motion.index) in only)
        ]

    def _result(self) -> RunResult:
        campaign = self._campaign
        archives = self._archives
        dry_run = self._dry_run.record()
        replaced = archives.review.replaced
        return RunResult(
            campaign=str(campaign.folder.root),
            command=campaign.folder.run_command,
            plan_hash=archives.plan_hash,
            simulated=archives.simulated,
            archives=tuple(archives.names),
            rejected=tuple(archives.review.rejected),
            adopted=tuple(archives.review.adopted),
            dry_run=self._dry_run.state,
            against_gravity=() if dry_run is None else dry_run.against_gravity,
            warm_up=self._warm_up.outcome,
            repetitions=campaign.progress("excitation"),
            validations=campaign.progress("validation"),
            complete=not campaign.missing(),
            cycles=archives.cycles,
            precision=campaign.precision,
            notes=(
                *archives.notes,
                *((AgainstGravity(dry_run),) if dry_run and dry_run.against_gravity else ()),
                *self._warm_up.notes,
                *(() if replaced is None else (replaced,)),
                *self._watch.faults,
            ),
        )
