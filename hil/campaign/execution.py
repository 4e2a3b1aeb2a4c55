"""A run: what is still missing of a campaign, in order, behind the gates.

Dry run, warm-up, standstill, repetitions, validation, and back to where the arm was. Everything
that is sent has been checked before the first motion; each motion is archived, judged and entered
in the manifest before the next one begins, so that a run which is killed at any moment goes on
with the first motion that is missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hil.archive.live import LiveView
from hil.cell import Cell
from hil.motion_checks import MotionChecks
from hil.progress import Reporter, Silent

from .controller_limits import checks_in_force, narrower_currents
from .dry_run import OVERRIDE
from .execution_archive import Archiving, provenance_of
from .execution_result import DryRunState, RunResult
from .execution_runner import Runner
from .execution_watch import RunWatch
from .gates import (
    require_dry_run,
    require_link_of,
    require_one_world,
    require_own_figures,
    require_rehearsed,
    require_rehearsed_thresholds,
    require_simulated,
)
from .intervals import Interval, require_joined, require_sound, wanted, with_moves
from .link import Link
from .live_link import LiveLink
from .motion_link import MotionLink
from .operator import Operator, Unattended
from .quality_entry import Entering
from .repeating import any_warmth, play_until_good
from .stop import Stop
from .straight_moves import StraightMoves, seen_in_dry_run
from .warmup_stage import WarmUpStage

if TYPE_CHECKING:
    from .campaign import Campaign


from dataclasses import replace

from hil.errors import OperatorStopError

from .dry_run import DryRun, made_by
from .folder import CampaignFolder
from .gates import not_accepted


class DryRunStage:
    """Every motion that will be sent at full speed, once and slowly.

    Args:
        folder: of the campaign.
        cell: of the campaign.
        motions: excitations and validation motions; repetitions of one are looked at once.
        operator: may be asked.
        accept: whether the caller accepts without being asked.
        accept_torque: joints that the caller knows to run against the model's gravity.
        simulated: whether nothing but a simulated arm can move.
        plan_hash: of exactly the plan that is run.
        stop: asked for at the question, it is no answer.
    """

    def __init__(
        self,
        folder: CampaignFolder,
        cell: Cell,
        motions: Sequence[Interval],
        operator: Operator,
        *,
        accept: bool,
        accept_torque: Sequence[str],
        simulated: bool,
        plan_hash: str,
        stop: Stop,
    ) -> None:
        self._folder, self._cell, self._operator = folder, cell, operator
        self._accept, self._simulated = accept, simulated
        self._plan_hash, self._stop = plan_hash, stop
        self._motions = [one for one in motions if one.kind == "validation" or one.index == 0]
        # Nobody knows beforehand what will contradict: only what an earlier run saw is accepted.
        self._known = tuple(accept_torque)
        if accept_torque and self.found() is None:
            self._known = ()

    def found(self) -> DryRun | None:
        """The dry run of exactly this plan and kind of arm; None where none counts."""
        return DryRun.that_counts(
            self._folder,
            plan_hash=self._plan_hash,
            motions=len(self._motions),
            simulated=self._simulated,
        )

    @property
    def intervals(self) -> list[Interval]:
        """The motions under the names of their slow runs."""
        return [replace(one, kind="dryrun", index=k) for k, one in enumerate(self._motions)]

    def missing(self) -> list[tuple[Interval, Interval]]:
        """Each motion that was not run slowly yet, and the same as a dry run."""
        both = zip(self._motions, self.intervals, strict=True)
        return [(one, slow) for one, slow in both if self._whole(slow) is None]

    def run(self, runner: Runner, entering: Entering) -> None:
        """Run what is missing, slowly."""
        for _, slow in self.missing():
            name = runner.play(slow, slow.index + 1, len(self._motions), OVERRIDE)
            entering.enter(slow, name)

    def settle(self, *, ask: bool = True) -> DryRunState:
        """Write down what was done, once all of it is, and have it accepted.

        Args:
            ask: whether it must be accepted now.

        Raises:
            DryRunError: it must be and is not.
            OperatorStopError: a stop was asked for instead of an answer.
        """
        found = self.found()
        if found is None:
            names = [name for slow in self.intervals if (name := self._whole(slow)) is not None]
            if len(names) < len(self._motions):
                return "to be accepted"
            found = DryRun.of(
                self._folder,
                self._cell,
                names,
                plan_hash=self._plan_hash,
                simulated=self._simulated,
            )
            found.save(self._folder.dry_run)
        if found.accepted is None:
            summary = found.summary(self._folder.root.resolve().name)
            unknown = [joint for joint in found.against_gravity if joint not in self._known]
            agreed = self._accept and not unknown
            if not agreed and self._operator.can_answer:
                agreed = self._operator.accept_dry_run(summary)
                if not agreed and self._stop.requested:
                    raise OperatorStopError(
                        f"{self._folder.root}: stopped instead of an answer; its slow dry run was "
                        "done, and is not accepted."
                    )
            if not agreed and ask:
                raise not_accepted(self._folder, unknown)
            if not agreed:
                return "to be accepted"
            found.accepted_now().save(self._folder.dry_run)
        return "accepted"

    def _whole(self, slow: Interval) -> str | None:
        """Name of its whole archive, if this kind of arm made it."""
        name = self._folder.whole(slow.kind, slow.index)
        made = name is not None and made_by(self._folder.archives / name, self._simulated)
        return name if made else None


@dataclass(frozen=True)
class Choices:
    """What the caller of a run wants of it.

    Attributes:
        unrehearsed: without rehearsal and dry run, which only a simulated arm allows.
        dry_run_only: end after the dry run.
        accept_dry_run: the caller accepts the dry run that was done; of a simulated arm also the
            one that this run does.
        accept_torque: joints whose torque ran against the model's gravity in the dry run that an
            earlier run did, and that the caller accepts by name.
        durable: wait at each flush until the disk has the data; None: in real time only.
        live: of the cell's own link: lets viewers look at what is recorded.
        repetitions: of the excitation that are enough for now, without validation motions; None
            for the whole plan.
    """

    unrehearsed: bool = False
    dry_run_only: bool = False
    accept_dry_run: bool = False
    accept_torque: tuple[str, ...] = ()
    durable: bool | None = None
    live: LiveView | None = None
    repetitions: int | None = None


def run_campaign(
    campaign: Campaign,
    link: MotionLink | None,
    stop: Stop | None,
    reporter: Reporter | None,
    *,
    operator: Operator | None,
    provenance: Mapping[str, str] | None,
    choices: Choices,
) -> RunResult:
    """See `Campaign.run`."""
    folder, cell = campaign.folder, campaign.cell
    operator = operator or Unattended()
    simulated = cell.only_simulated if link is None else link.only_simulated
    with folder.locked():
        folder.require_unchanged()
        # One hash of what is in memory and on the disk goes through the whole run.
        plan_hash = folder.hash_of(cell, campaign.plan)
        require_one_world(folder, simulated)
        if link is not None:
            require_link_of(cell, link, folder.root)
        virtual = isinstance(link, Link) or (link is None and _is_virtual(cell))
        archiving = Archiving(
            folder,
            cell,
            campaign.plan,
            provenance_of(cell, provenance, virtual=virtual, only_simulated=simulated),
            not virtual if choices.durable is None else choices.durable,
            plan_hash,
        )
        run = _Run(
            campaign, archiving, stop or Stop(), reporter or Silent(), operator, choices, simulated
        )
        run.require_gates()
        return run.all_of_it(link)


class _Run:
    """One run of a campaign, from the gates to the way back."""

    def __init__(
        self,
        campaign: Campaign,
        archiving: Archiving,
        stop: Stop,
        reporter: Reporter,
        operator: Operator,
        choices: Choices,
        simulated: bool,
    ) -> None:
        folder, cell, plan = campaign.folder, campaign.cell, campaign.plan
        self._folder, self._cell, self._archiving = folder, cell, archiving
        self._stop, self._reporter, self._choices = stop, reporter, choices
        self._operator, self._simulated = operator, simulated
        self._wanted = wanted(cell, plan, choices.repetitions)
        self._watch = RunWatch(operator, stop)
        self._entering = Entering(folder, cell, plan)
        self._warm_up = WarmUpStage(
            folder,
            cell,
            plan,
            archiving.plan_hash,
            reporter,
            self._watch,
            simulated=simulated,
        )
        self._dry_run = DryRunStage(
            folder,
            cell,
            [one for one in self._wanted if one.kind != "standstill"],
            operator,
            accept=choices.accept_dry_run,
            accept_torque=choices.accept_torque,
            simulated=simulated,
            plan_hash=archiving.plan_hash,
            stop=stop,
        )
        self._dry_state: DryRunState = "left out"
        self._notes: list[str] = []

    def require_gates(self) -> None:
        """Refuse what was not rehearsed, or whose dry run nobody can accept.

        Raises:
            NotRehearsedError, DryRunError: each says what to do.
        """
        choices = self._choices
        if choices.unrehearsed:
            require_simulated(self._folder, self._simulated)
            return
        rehearsal = require_rehearsed(self._folder, self._archiving.plan_hash)
        if (warning := rehearsal.warning) is not None:
            self._notes.append(warning)
            self._reporter.say(f"note: {warning}")
        require_dry_run(
            self._folder,
            self._dry_run.found(),
            can_answer=self._operator.can_answer or choices.dry_run_only,
            accept=choices.accept_dry_run,
            only_simulated=self._simulated,
        )

    def all_of_it(self, link: MotionLink | None) -> RunResult:
        """Run what is missing; connect only where something is."""
        warming = [] if (one := self._warm_up.next_motion()) is None else [one]
        self._entering.adopt(self._archiving, [*self._wanted, *self._dry_run.intervals, *warming])
        dry = [] if self._choices.unrehearsed else [one for one, _ in self._dry_run.missing()]
        if not dry:
            self._settle_dry_run()
        missing = [] if self._choices.dry_run_only else self._missing()
        archives: list[str] = []
        cycles = 0
        if dry or missing:
            checks = MotionChecks.of(self._cell)
            if checks.not_checked is not None:
                self._reporter.say(checks.not_checked)
            # What is wrong with a motion itself is reported before anything is connected.
            warming = warming if missing else []
            require_sound([*dry, *missing, *warming], checks)
            with self._opened(link) as opened:
                before = opened.cycles
                self._stages(opened, checks, dry, missing, warming, archives)
                cycles = opened.cycles - before
        return self._result(archives, cycles)

    def _opened(self, link: MotionLink | None) -> AbstractContextManager[MotionLink]:
        """The caller's link, or the cell's own."""
        if link is not None:
            return nullcontext(link)
        from hil.cell_link import cell_link  # which opens links of campaigns

        return cell_link(self._cell, live=self._choices.live)

    def _stages(
        self,
        link: MotionLink,
        checks: MotionChecks,
        dry: list[Interval],
        missing: list[Interval],
        warming: list[Interval],
        archives: list[str],
    ) -> None:
        link.connection.say = self._reporter.say
        if isinstance(link, LiveLink):
            for note in link.notes():
                self._reporter.say(f"note: {note}")
            if link.live is not None:
                self._reporter.say(link.live.invitation)
        where = link.connect(self._stop)
        require_own_figures(link, self._folder.root)
        found = None if self._choices.unrehearsed else self._dry_run.found()
        require_rehearsed_thresholds(self._cell, link, self._folder.root, found)
        narrowed = checks_in_force(self._cell, link.connection, checks)
        if narrowed is not checks:  # the controller's own limits, for the first time known
            checks = narrowed
            require_sound([*dry, *missing, *warming], checks)
        if below := narrower_currents(self._cell, link.connection):
            self._notes.append(f"the controller's own current limits counted ({'; '.join(below)})")
        # A dry run and a warm-up go the ways of the motions that they are made of.
        joined = with_moves(self._cell, [*dry, *missing], where)
        require_sound([one for one in joined if one.kind == "move"], checks)
        require_joined(joined)
        seen = None if self._choices.unrehearsed else seen_in_dry_run(self._folder)
        moves = StraightMoves(self._cell, checks, joined, seen)
        times = _times(joined, len(dry), moves, self._cell.campaign.approach_speed)
        if any(one.kind != "standstill" for one in missing):
            times += self._warm_up.expected()
        total = sum(times)
        with self._reporter.task("running the campaign (s of motion)", total) as task:
            runner = Runner(
                self._cell,
                link,
                moves,
                self._archiving,
                self._stop,
                self._watch,
                task,
                where,
                archives,
            )
            self._watch.time_left, self._watch.motions_left = total, len(times)
            if dry:
                self._dry_run.run(runner, self._entering)
                self._settle_dry_run()
            if any(one.kind != "standstill" for one in missing):
                self._warm_up.run(runner, self._entering)
            for interval in missing:
                self._run_until_good(runner, interval)
            if missing:  # the first repetition may have turned out to be of no use
                for interval in self._missing():
                    self._run_until_good(runner, interval)
            runner.go_back(OVERRIDE if self._choices.dry_run_only else 1.0)
        link.close()

    def _run_until_good(self, runner: Runner, interval: Interval) -> None:
        """Run a motion of the plan, as often as it takes and is allowed."""
        total = sum(one.kind == interval.kind for one in self._wanted)
        play_until_good(
            runner,
            self._entering,
            interval,
            interval.index + 1,
            total,
            self._reporter,
            warmth=self._warm_up if interval.kind == "excitation" else any_warmth,
        )
        if interval.kind == "validation":
            self._warm_up.moved()
        elif interval.kind == "excitation":
            self._watch.note(f"{interval}: good, {self._entering.agreement()}")

    def _settle_dry_run(self) -> None:
        if not self._choices.unrehearsed:
            self._dry_state = self._dry_run.settle(ask=not self._choices.dry_run_only)

    def _missing(self) -> list[Interval]:
        """What is still to be run at full speed."""
        return [one for one in self._wanted if self._folder.whole(one.kind, one.index) is None]

    def _result(self, archives: list[str], cycles: int) -> RunResult:
        missing = {(one.kind, one.index) for one in self._missing()}

        def whole(kind: str) -> tuple[int, int]:
            total = [one for one in self._wanted if one.kind == kind]
            return sum((one.kind, one.index) not in missing for one in total), len(total)

        found = None if self._choices.unrehearsed else self._dry_run.found()
        notes = [*self._notes]
        notes += [] if found is None else [f"dry run: {warning}" for warning in found.warnings]
        if (cold := self._warm_up.note) is not None:
            notes.append(cold)
        notes += self._warm_up.pauses
        notes += self._entering.notes
        notes += self._watch.troubles
        return RunResult(
            campaign=str(self._folder.root),
            plan_hash=self._archiving.plan_hash,
            simulated=self._simulated,
            archives=tuple(archives),
            rejected=tuple(self._entering.rejected),
            adopted=tuple(self._entering.adopted),
            dry_run=self._dry_state,
            against_gravity=() if found is None else found.against_gravity,
            warm_up=self._warm_up.outcome,
            repetitions=whole("excitation"),
            validations=whole("validation"),
            complete=not missing,
            cycles=cycles,
            notes=tuple(notes),
        )


def _times(
    joined: Sequence[Interval], dry: int, moves: StraightMoves, approach_speed: float
) -> list[float]:
    """Seconds of each motion and way: slow are the first `dry`, and ways that nobody has seen."""
    times, first = [], dry > 0
    slow_way = min(1.0, OVERRIDE / approach_speed)
    for one in joined:
        share = OVERRIDE if dry else 1.0
        if one.kind == "move":
            unseen = one.from_arm if first else moves.unseen(one)
            share = slow_way if dry or unseen else 1.0
        elif dry:
            dry -= 1
        times.append(one.trajectory.duration / share)
    return times


def _is_virtual(cell: Cell) -> bool:
    """Whether the cell's own link is one in virtual time."""
    return cell.controller.transport == "simulated"
