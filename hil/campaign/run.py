"""One run of a campaign: what is still missing of it, in order, behind the gates.

Everything that is sent has been checked before the first motion; each motion is archived, judged
and entered in the manifest before the next one begins, so that a run which is killed at any moment
goes on with the first motion that is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveHeader, ArchiveName, ArchiveSpec, open_archive
from hil.archive.live import LiveView
from hil.cell import Cell
from hil.errors import ArchiveError
from hil.motion_checks import MotionChecks
from hil.progress import Reporter, Task
from hil.reading import parse_json
from hil.recording import archive_spec, dated_anew, origin_of
from hil.version import software
from identification.excitation.excitation import trajectory_from_dict

from .dry_run import OVERRIDE, SIMULATED, DryRunStage, DryRunState, said_of
from .errors import ArmChangedError, MotionFailedError, RepetitionsRejectedError
from .folder import CampaignFolder
from .gates import require_as_rehearsed, require_gates
from .intervals import REPEATED, Interval, StraightMoves, player_of, require_sound, wanted
from .link import Link
from .live_link import LiveLink
from .motion_link import MotionLink, active_checks, narrower_limits
from .operator import Operator, RunWatch, Stop
from .plan import CampaignPlan, moves_to_dict
from .quality import Entering, Rejected
from .warmup import WarmUpStage

if TYPE_CHECKING:
    from .campaign import Campaign

Array = NDArray[np.float64]

MOST_BY_HAND: Final = 10
"""Attempts at one motion that a person, or a script in his place, may hold or slow."""


@dataclass(frozen=True)
class RunResult:
    """What a run has done, and where the campaign stands after it.

    Attributes:
        campaign: its folder.
        plan_hash: of the plan that was run.
        simulated: whether nothing but a simulated arm can have moved.
        archives: file names made by this run, in order, whatever became of them.
        rejected: of these, the motions that failed their quality check.
        adopted: archives that an earlier run closed and was killed before it entered them.
        dry_run: whether a person has accepted it; "left out" where the caller did without.
        against_gravity: joints whose torque ran against the model's gravity in the dry run.
        warm_up: "warm", "not warm", "going on", or "none" where none was wanted.
        repetitions: of the excitation that are whole now, of how many.
        validations: likewise of the validation motions.
        complete: whether nothing is missing any more.
        cycles: archived by this run.
        notes: what a reader must know.
    """

    campaign: str
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
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)


@dataclass(eq=False)
class Run:
    """One run of a campaign; what is wanted of it is said in `Campaign.run`.

    Attributes:
        said: of where archives come from, by the caller (`provenance`).
        archives: file names so far, whatever became of them.
        notes: what a reader must know.
        plan_hash: of exactly this cell, URDF and plan, in memory and on the disk; "" at first.
    """

    campaign: Campaign
    link: MotionLink | None
    stop: Stop
    reporter: Reporter
    operator: Operator
    said: Mapping[str, str] | None = None
    durable: bool | None = None
    unrehearsed: bool = False
    dry_run_only: bool = False
    accept_dry_run: bool = False
    accept_torque: tuple[str, ...] = ()
    live: LiveView | None = None
    repetitions: int | None = None
    archives: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    plan_hash: str = ""

    def __post_init__(self) -> None:
        campaign = self.campaign
        self.folder: CampaignFolder = campaign.folder
        self.cell: Cell = campaign.cell
        self.plan: CampaignPlan = campaign.plan
        self.watch = RunWatch(self.operator, self.stop)
        self.wanted = wanted(self.cell, self.plan, self.repetitions)
        self.simulated: bool = (self.cell if self.link is None else self.link).only_simulated
        self.virtual = isinstance(self.link, Link) or (
            self.link is None and self.cell.controller.transport == "simulated"
        )

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Goes into the metadata of every archive."""
        return provenance_of(self)

    @cached_property
    def entering(self) -> Entering:
        """Judges archives and enters them in the manifest."""
        return Entering(self.folder, self.cell, self.plan.excitation.trajectory)

    def missing(self, *kinds: str) -> list[Interval]:
        """What of these kinds (of all, if none is named) is still to be run at full speed."""
        return [
            one
            for one in self.wanted
            if one.kind in (kinds or (one.kind,)) and self.folder.whole(one.kind, one.index) is None
        ]

    def spec(self, interval: Interval) -> ArchiveSpec:
        """The archive of the next attempt at an interval."""
        name = self.folder.next_name(interval.kind, interval.index)
        # One seed is one campaign to the byte, whatever its folder is called.
        simulated = self.provenance.get(SIMULATED) == said_of(True)
        metadata = {
            **({} if simulated else {"campaign": self.folder.root.resolve().name}),
            "plan_hash": self.plan_hash,
            **{f"software.{package}": version for package, version in software().items()},
            **dated_anew(self.provenance),
        }
        plan = {"trajectory": interval.trajectory.to_dict()}
        if interval.kind in REPEATED:  # with how it was found
            plan = {"excitation": self.plan.excitation.to_dict()}
        durable = not self.virtual if self.durable is None else self.durable
        return archive_spec(
            self.cell,
            self.folder.archives / name.filename,
            metadata,
            plan | moves_to_dict(interval.moves),
            durable=durable,
        )

    def made(self, header: ArchiveHeader) -> bool:
        """Whether an archive with this header was made of exactly this plan, by such an arm."""
        arm = self.provenance.get(SIMULATED)
        return header.plan_hash == self.plan_hash and header.simulated == arm

    def execute(self) -> RunResult:
        """See `Campaign.run`; a controller is connected only where something is missing."""
        with self.folder.locked():
            self.folder.require_unchanged()
            self.plan_hash = self.folder.hash_of(self.cell, self.plan)
            dry_run, warm_up = DryRunStage(self), WarmUpStage(self)
            require_gates(self, dry_run)
            warming = warm_up.next_motion()
            slowly = [*dry_run.intervals, *([] if warming is None else [warming])]
            self.entering.adopt([*self.wanted, *slowly], self.made)
            slow = dry_run.missing()
            if not slow:
                dry_run.settle()
            full = [] if self.dry_run_only else self.missing()
            cycles = 0
            if slow or full:
                with self._connected(dry_run, warm_up, slow, full) as runner:
                    dry_run.run(runner)
                    if full:
                        self._run_all(runner, warm_up)
                    runner.go_back(OVERRIDE if self.dry_run_only else 1.0)
                cycles = runner.cycles
            return self._result(dry_run, warm_up, cycles)

    def _run_all(self, runner: Runner, warm_up: WarmUpStage) -> None:
        """Warm-up, the arm at rest, repetitions while the joints are warm, validation motions."""
        if self.missing("excitation", "validation"):
            warm_up.run(runner)
        # Twice: later repetitions may show that the first one was of no use.
        for kind in ("standstill", "excitation", "excitation", "validation"):
            total = sum(one.kind == kind for one in self.wanted)
            keeping = warm_up if kind == "excitation" else None
            for interval in self.missing(kind):
                runner.play_until_good(interval, interval.index + 1, total, keeping)
                if keeping is not None:
                    self.watch.note(f"{interval}: good, {self.entering.agreement()}")
                elif kind == "validation":
                    warm_up.moved()

    @contextmanager
    def _connected(
        self,
        dry_run: DryRunStage,
        warm_up: WarmUpStage,
        slow: Sequence[Interval],
        full: Sequence[Interval],
    ) -> Iterator[Runner]:
        """The controller with its drive on, and all motions checked with its limits.

        Raises:
            MotionRefusedError: a motion, or a way between two, must not be sent; nothing was.
            NotRehearsedError: the controller's figures are not those that were rehearsed.
            ControllerFault: it did not come up, or the connection did not end as it should.
        """
        from hil.cell_link import cell_link  # which opens links of campaigns

        cell, reporter = self.cell, self.reporter
        checks = MotionChecks.of(cell)
        if checks.not_checked is not None:
            reporter.say(checks.not_checked)
        warming = warm_up.next_motion() if full else None
        sent = [*slow, *full, *([] if warming is None else [warming])]
        # What is wrong with a motion itself is reported before anything is connected.
        require_sound(sent, checks)
        own = cell_link(cell, live=self.live) if self.link is None else nullcontext(self.link)
        with own as link:
            link.connection.report = reporter.say
            if isinstance(link, LiveLink):
                for note in link.notes():
                    reporter.say(f"note: {note}")
                if link.live is not None:
                    reporter.say(link.live.notice)
            where = link.connect(self.stop)
            require_as_rehearsed(self, link.connection, dry_run.found())
            narrowed = active_checks(cell, link.connection, checks)
            if narrowed is not checks:  # the controller's own limits, for the first time known
                require_sound(sent, narrowed)
            if below := narrower_limits(cell, link.connection, "current_limit"):
                self.notes.append(
                    f"the controller's own current limits counted ({'; '.join(below)})"
                )
            # A dry run and a warm-up go the ways of the motions that they are made of.
            straight = StraightMoves(cell, narrowed)
            joined = straight.joining([*slow, *full], where)
            runner = Runner(self, link, straight, where)
            times = runner.times(joined, len(slow))
            if any(one.kind != "standstill" for one in full):
                times += warm_up.expected()
            self.watch.expect(times)
            with reporter.task("running the campaign (s of motion)", sum(times)) as runner.task:
                yield runner
            link.close()

    def _result(self, dry_run: DryRunStage, warm_up: WarmUpStage, cycles: int) -> RunResult:
        """What was done, and where the campaign stands."""
        missing, found = self.missing(), dry_run.found()

        def whole(kind: str) -> tuple[int, int]:
            total = sum(one.kind == kind for one in self.wanted)
            return total - sum(one.kind == kind for one in missing), total

        return RunResult(
            campaign=str(self.folder.root),
            plan_hash=self.plan_hash,
            simulated=self.simulated,
            archives=tuple(self.archives),
            rejected=tuple(self.entering.rejected),
            adopted=tuple(self.entering.adopted),
            dry_run=dry_run.state,
            against_gravity=() if found is None else found.against_gravity,
            warm_up=warm_up.outcome,
            repetitions=whole("excitation"),
            validations=whole("validation"),
            complete=not missing,
            cycles=cycles,
            notes=(
                *self.notes,
                *(f"dry run: {text}" for text in (() if found is None else found.warnings)),
                *warm_up.notes,
                *self.entering.notes,
                *self.watch.troubles,
            ),
        )


def provenance_of(run: Run) -> dict[str, str]:
    """What is said of where archives come from; a time of day only in real time.

    The caller alone knows what a link of his simulates, but not whether it leads to a real arm.
    """
    own: Mapping[str, str] = {}
    if not run.virtual:
        own = origin_of(run.cell, only_simulated=run.simulated, virtual=False)
    elif run.said is None:
        from hil.simulation import simulated_provenance  # it opens links of ours

        own = simulated_provenance(run.cell, effects=False)
    return {**own, **(run.said or {}), SIMULATED: said_of(run.simulated)}


class Runner:
    """One connection of a run: what is played goes to the controller and into an archive.

    Args:
        run: whose motions are played.
        link: to its controller; connected.
        straight: ways between the motions.
        where: (n,) [rad] where the arm was first, and goes back to.

    Attributes:
        task: receives the seconds of motion done.
    """

    task: Task

    def __init__(self, run: Run, link: MotionLink, straight: StraightMoves, where: Array) -> None:
        self._run, self._link, self._straight, self._where = run, link, straight, where
        self._at, self._before, self._moves = where, link.cycles, 0
        self._seen = None if run.unrehearsed else seen_in_dry_run(run.folder)

    @property
    def cycles(self) -> int:
        """Archived so far."""
        return self._link.cycles - self._before

    def times(self, joined: Sequence[Interval], slow: int) -> list[float]:
        """Seconds of each motion and way; the first `slow` motions, and ways to them, go slowly."""
        times, watched = [], slow > 0
        for one in joined:
            share = OVERRIDE if slow else 1.0
            if one.kind == "move":
                unseen = one.from_arm if watched else self._unseen(one)
                share = self._slowed(OVERRIDE) if slow or unseen else 1.0
            else:
                slow = max(0, slow - 1)
            times.append(one.trajectory.duration / share)
        return times

    def play(self, interval: Interval, number: int, total: int, most: float = 1.0) -> str:
        """Go to where a motion begins, run it, and return the name of its archive.

        The archive is whole and not entered in the manifest yet.

        Raises:
            MotionFailedError: it ended otherwise than planned, or was not begun after a stop.
            ControllerFault: it was not accepted, or the link broke.
        """
        start, end = interval.places(self._run.cell.home)
        self._go(start, most)
        name = self._play(interval, number, total, most)
        self._at = end
        return name

    def play_until_good(
        self, interval: Interval, number: int, total: int, warm_up: WarmUpStage | None = None
    ) -> str:
        """Run a motion, judge it and enter it; again where it fails its check.

        An attempt that a person held or slowed counts as failed only if the request is still for
        less than full speed: then the next one would go the same way. Others of them are counted
        apart, for a script that slows the arm by rule would have it move for ever.

        Args:
            interval: the motion.
            number: which of its kind, from 1.
            total: of how many.
            warm_up: warms the arm up before each attempt, and says whether it was warm when the
                motion began; None for a motion that may be run by a cold arm.

        Returns:
            Name of the archive that is of use.

        Raises:
            RepetitionsRejectedError: it failed too often.
            ArmChangedError: later attempts agree with each other, and not with those that count.
        """
        run, reasons, by_hand = self._run, list[str](), list[str]()
        while len(reasons) <= run.cell.campaign.bad_repetitions and len(by_hand) < MOST_BY_HAND:
            if warm_up is not None:
                warm_up.keep(self)
            name = self.play(interval, number, total)
            cold = None if warm_up is None else warm_up.lost(run.watch.began)
            problem = run.entering.enter(interval, name, cold)
            if warm_up is not None and cold is None:
                warm_up.moved()
            if problem is None:
                return name
            run.watch.expect([interval.trajectory.duration])
            run.watch.note(f"{interval}: rejected, {problem.sentence}")
            run.reporter.say(
                f"{interval} ({name}) is rejected: {problem.sentence}; the motion is run again"
            )
            if problem.later:
                raise ArmChangedError(
                    str(interval), problem.sentence, problem.reference, problem.later
                )
            still = not problem.by_hand or run.watch.request().override < 1.0
            (reasons if still else by_hand).append(problem.sentence)
        raise RepetitionsRejectedError(
            str(interval), reasons if len(by_hand) < MOST_BY_HAND else by_hand
        )

    def go_back(self, most: float = 1.0) -> None:
        """Go home, and from there to where the arm was first; `most` is the largest override."""
        self._go(self._run.cell.home, most)
        self._go(self._where, most)

    def _go(self, target: Array, most: float) -> None:
        """Go a straight way; what nobody has watched yet is not gone faster than a dry run."""
        way = self._straight.between(self._at, target, self._moves)
        if way is not None:
            self._moves += 1
            slow = self._slowed(min(most, OVERRIDE) if self._unseen(way) else most)
            name = self._play(way, way.index + 1, way.index + 1, slow)
            self._run.folder.add(name, "completed")
            if self._seen is not None and most <= OVERRIDE:
                self._seen.append(way.ends)
        self._at = target

    def _slowed(self, share: float) -> float:
        """The override of a way, planned at `approach_speed`, for a share of full speed."""
        return min(1.0, share / self._run.cell.campaign.approach_speed)

    def _unseen(self, way: Interval) -> bool:
        """Whether nobody has watched this way in the dry run, where somebody has to.

        One from or to where the arm happens to stand counts as unseen: whoever jogged it there
        may have done so for a reason.
        """
        if self._seen is None:
            return False
        return way.from_arm or not any(way.leads(*ends) for ends in self._seen)

    def _play(self, interval: Interval, number: int, total: int, most: float) -> str:
        run = self._run
        if run.stop.requested:
            raise MotionFailedError(str(interval), "stopped", "it had not begun")
        spec, duration = run.spec(interval), interval.trajectory.duration
        run.watch.begin(interval.kind, number, total, duration, most)
        player = player_of(run.cell, interval.trajectory)
        ended = self._link.run(player, spec, run.stop, override=most, watch=run.watch)
        archived = spec.path.name if ended.outcome == "completed" or spec.path.exists() else None
        if archived is not None:  # else it was stopped before
            run.archives.append(archived)
        if ended.outcome != "completed":
            if archived is not None:
                run.folder.add(archived, ended.outcome, ended.reason)
            refused = self._link.connection.refused if ended.outcome == "refused" else None
            recorder = None if refused is None else refused.flight_recorder
            raise MotionFailedError(str(interval), ended.outcome, ended.reason, recorder, archived)
        self.task.advance(duration / most, str(interval))
        return spec.path.name


def seen_in_dry_run(folder: CampaignFolder) -> list[tuple[Array, Array]]:
    """From where to where (n,) [rad] the ways of a dry run led, by its archives.

    Raises:
        CampaignFolderError: the manifest cannot be read.
    """
    entries = [one for one in folder.manifest() if one.outcome == "completed"]
    kinds = [name.kind if (name := ArchiveName.parse(one.name)) else "" for one in entries]
    last = max((k for k, kind in enumerate(kinds) if kind == "dryrun"), default=0)
    found = []
    for entry, kind in zip(entries[:last], kinds[:last], strict=True):
        if kind == "move":
            with suppress(ArchiveError, ValueError, KeyError, TypeError):  # not seen, then
                archive = open_archive(folder.archives / entry.name, fields=())
                motion = trajectory_from_dict(parse_json(archive.text("plan.json"))["trajectory"])
                found.append(Interval("move", 0, motion).ends)
    return found
