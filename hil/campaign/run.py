"""One run of a campaign: the motions that are missing, in order, behind the gates.

Everything is checked before the first motion. Each motion is archived, judged and entered in the
manifest before the next one begins: a killed run is resumed with the first motion that is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveHeader, ArchiveSpec, open_archive
from hil.archive.live import LiveView
from hil.cell_link import cell_link
from hil.errors import ArchiveError
from hil.motion_checks import MotionChecks
from hil.progress import Reporter, Task
from hil.reading import parse_json
from hil.recording import archive_spec, origin_of, with_present_date
from hil.simulation import simulated_provenance
from hil.version import software
from identification.excitation.excitation import trajectory_from_dict

from .dry_run import OVERRIDE, SIMULATED, DryRunStage, DryRunState, yes_or_no
from .errors import MotionFailedError, RepetitionsRejectedError
from .folder import CampaignFolder
from .gates import require_as_rehearsed, require_gates
from .intervals import (
    REPEATED,
    Interval,
    StraightMoves,
    player_of,
    require_allowed,
)
from .link import NOT_STARTED, MotionLink, VirtualLink, active_checks, narrower_limits
from .live_link import LiveLink
from .operator import RunWatch
from .plan import moves_to_dict
from .quality import ArchiveReview, Rejected
from .warmup import WarmUpStage

if TYPE_CHECKING:
    from .campaign import Campaign

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunResult:
    """What a run has done, and the progress of the campaign after it.

    Attributes:
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
        """Return the result for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Choices:
    """What the caller of `Campaign.run` chose; see there."""

    provenance: Mapping[str, str] | None = None
    durable: bool | None = None
    unrehearsed: bool = False
    dry_run_only: bool = False
    accept_dry_run: bool = False
    accept_torque: tuple[str, ...] = ()
    live: LiveView | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a campaign, on a link (None for the cell's own), as its caller chose."""

    campaign: Campaign
    link: MotionLink | None
    watch: RunWatch
    reporter: Reporter
    choices: Choices

    @property
    def simulated(self) -> bool:
        """Whether only a simulated arm can move."""
        return (self.campaign.cell if self.link is None else self.link).only_simulated

    @cached_property
    def plan_hash(self) -> str:
        """Hash of this cell, URDF and plan, in memory and on the disk."""
        return self.campaign.folder.hash_of(self.campaign.cell, self.campaign.plan)

    @cached_property
    def archives(self) -> RunArchives:
        """Its archives."""
        return RunArchives(self)

    @cached_property
    def dry_run(self) -> DryRunStage:
        """Its slow motions; made by the gates, before anything moves."""
        return DryRunStage(self)

    @cached_property
    def warm_up(self) -> WarmUpStage:
        """Its motions before the repetitions."""
        return WarmUpStage(self)


def execute(run: Run) -> RunResult:
    """Run the missing motions; a controller is connected only where some are missing."""
    require_gates(run)
    run.archives.adopt(run.dry_run.intervals)
    slow, full = run.dry_run.missing(), [] if run.choices.dry_run_only else run.campaign.missing()
    if not slow:
        run.dry_run.accept()
    if slow or full:
        with _connected(run, slow, full) as runner:
            run.dry_run.run(runner)
            if full:
                run.warm_up.run(runner)
                # Later repetitions may show that the first one was disturbed.
                for kind in ("standstill", "excitation", "excitation", "validation"):
                    _run_missing(runner, kind)
            runner.go_back(OVERRIDE if run.choices.dry_run_only else 1.0)
    return _result(run)


@contextmanager
def _connected(run: Run, slow: Sequence[Interval], full: Sequence[Interval]) -> Iterator[Runner]:
    """Connect the controller, check all motions with its limits, and close the link after."""
    cell, reporter, stop = run.campaign.cell, run.reporter, run.watch.stop
    checks = MotionChecks.of(cell)
    if checks.not_checked is not None:
        reporter.say(checks.not_checked)
    sent = [*slow, *full, *(run.warm_up.next_motion() if full else ())]
    # What is wrong with a motion itself is reported before anything is connected.
    require_allowed(sent, checks)
    own = cell_link(cell, live=run.choices.live) if run.link is None else nullcontext(run.link)
    with own as link:
        link.connection.report = reporter.say
        if isinstance(link, LiveLink):
            for note in link.notes():
                reporter.say(f"note: {note}")
            if link.live is not None:
                reporter.say(link.live.notice)
        start = link.connect(stop)
        require_as_rehearsed(run, link.connection)
        narrowed = active_checks(cell, link.connection, checks)
        if narrowed is not checks:  # the controller's own limits are known only now
            require_allowed(sent, narrowed)
        if below := narrower_limits(cell, link.connection, "current_limit"):
            run.archives.notes.append(
                f"the controller's own current limits counted ({'; '.join(below)})"
            )
        # Dry run and warm-up use the moves of the motions that they are made of.
        straight = StraightMoves(cell, narrowed)
        joined = straight.joining([*slow, *full], start)
        runner, before = Runner(run, link, straight, start), link.cycles
        times = runner.times(joined, len(slow))
        if any(one.kind != "standstill" for one in full):
            times += run.warm_up.expected()
        run.watch.expect(times)
        with reporter.task("running the campaign (s of motion)", sum(times)) as runner.task:
            yield runner
        link.close()
    run.archives.cycles = link.cycles - before


def _run_missing(runner: Runner, kind: str) -> None:
    """Run the missing motions of a kind; repetitions only while the joints are warm."""
    run = runner.run
    _, total = run.campaign.progress(kind)
    for interval in run.campaign.missing(kind):
        runner.run_until_accepted(interval, interval.index + 1, total)
        if kind == "validation":
            run.warm_up.motion_ended()


def _result(run: Run) -> RunResult:
    campaign, archives, found = run.campaign, run.archives, run.dry_run.found()
    return RunResult(
        campaign=str(campaign.folder.root),
        plan_hash=run.plan_hash,
        simulated=run.simulated,
        archives=tuple(archives.names),
        rejected=tuple(archives.review.rejected),
        adopted=tuple(archives.review.adopted),
        dry_run=run.dry_run.state,
        against_gravity=() if found is None else found.against_gravity,
        warm_up=run.warm_up.outcome,
        repetitions=campaign.progress("excitation"),
        validations=campaign.progress("validation"),
        complete=not campaign.missing(),
        cycles=archives.cycles,
        notes=(
            *archives.notes,
            *(f"dry run: {text}" for text in (() if found is None else found.warnings)),
            *run.warm_up.notes,
            *archives.review.notes,
            *run.watch.problems,
        ),
    )


class RunArchives:
    """Archives of one run: what each contains, and the check before it is entered.

    Attributes:
        names: file names so far, whatever their outcome.
        notes: what a reader must know.
        cycles: archived so far.
        provenance: metadata of every archive; a date only in real time.
        review: judges archives and enters them in the manifest.
    """

    def __init__(self, run: Run) -> None:
        campaign, given = run.campaign, run.choices.provenance
        self._run = run
        self.names, self.notes, self.cycles = list[str](), list[str](), 0
        in_file = run.link is None and campaign.cell.controller.transport == "simulated"
        virtual = in_file or isinstance(run.link, VirtualLink)
        self._durable = not virtual if run.choices.durable is None else run.choices.durable
        # The caller knows what a link simulates; the link decides whether a real arm can move.
        own: Mapping[str, str] = {}
        if not virtual:
            own = origin_of(campaign.cell, only_simulated=run.simulated, virtual=False)
        elif given is None:
            own = simulated_provenance(campaign.cell, effects=False)
        self.provenance = {**own, **(given or {}), SIMULATED: yes_or_no(run.simulated)}
        trajectory = campaign.plan.excitation.trajectory
        self.review = ArchiveReview(campaign.folder, campaign.cell, trajectory)

    def adopt(self, slow: Sequence[Interval]) -> None:
        """Enter archives of an earlier run of the plan, and of its `slow` motions, see `review`."""
        arm, plan_hash = self.provenance.get(SIMULATED), self._run.plan_hash

        def made(header: ArchiveHeader) -> bool:
            return header.plan_hash == plan_hash and header.simulated == arm

        self.review.adopt([*self._run.campaign.motions, *slow], made)

    def spec(self, interval: Interval) -> ArchiveSpec:
        """Return the archive of the next attempt at an interval."""
        campaign = self._run.campaign
        name = campaign.folder.next_name(interval.kind, interval.index)
        # One seed gives one campaign to the byte, whatever the name of its folder.
        simulated = self.provenance.get(SIMULATED) == yes_or_no(True)
        metadata = {
            **({} if simulated else {"campaign": campaign.folder.root.resolve().name}),
            "plan_hash": self._run.plan_hash,
            **{f"software.{package}": version for package, version in software().items()},
            **with_present_date(self.provenance),
        }
        plan = {"trajectory": interval.trajectory.to_dict()}
        if interval.kind in REPEATED:  # with how it was found
            plan = {"excitation": campaign.plan.excitation.to_dict()}
        return archive_spec(
            campaign.cell,
            campaign.folder.archives / name,
            metadata,
            plan | moves_to_dict(interval.moves),
            durable=self._durable,
        )


class Runner:
    """Runs motions of a run on a connected link, and the straight moves to them.

    The arm returns to its first position `start` (n,) [rad]; `task` receives the seconds of motion.
    """

    task: Task

    def __init__(self, run: Run, link: MotionLink, straight: StraightMoves, start: Array) -> None:
        self.run, self._link, self._straight, self._start = run, link, straight, start
        self._position, self._moves = start, 0
        self._seen = None if run.choices.unrehearsed else seen_in_dry_run(run.campaign.folder)

    def times(self, joined: Sequence[Interval], slow: int) -> list[float]:
        """Return the seconds of each motion and way; the first `slow` motions are run slowly."""
        times, watched = [], slow > 0
        for one in joined:
            share = OVERRIDE if slow else 1.0
            if one.kind == "move":
                unseen = one.from_arm if watched else self._unseen(one)
                share = self._approach(OVERRIDE) if slow or unseen else 1.0
            else:
                slow = max(0, slow - 1)
            times.append(one.trajectory.duration / share)
        return times

    def run_motion(self, interval: Interval, number: int, total: int, most: float = 1.0) -> str:
        """Move to the start of a motion, run it, and return its archive, not yet in the manifest.

        Raises:
            MotionFailedError: it ended otherwise than planned, or was not begun after a stop.
            ControllerFault: it was not accepted, or the link broke.
        """
        start, end = interval.places(self.run.campaign.cell.home)
        self._go(start, most)
        name = self._execute(interval, number, total, most)
        self._position = end
        return name

    def run_until_accepted(self, interval: Interval, number: int, total: int) -> str:
        """Run motion `number` (from 1) of `total` until it passes its check; return its archive.

        An arm that has cooled down is warmed up before a repetition; one begun cold is rejected.

        Raises:
            RepetitionsRejectedError: it failed too often.
        """
        run, reasons = self.run, list[str]()
        warm_up = run.warm_up if interval.kind == "excitation" else None
        while len(reasons) <= run.campaign.cell.campaign.bad_repetitions:
            if warm_up is not None:
                warm_up.rewarm(self)
            name = self.run_motion(interval, number, total)
            cold = None if warm_up is None else warm_up.cold_start(run.watch.began)
            problem = run.archives.review.enter(interval, name, cold)
            if warm_up is not None and cold is None:
                warm_up.motion_ended()
            if problem is None:
                return name
            run.watch.expect([interval.trajectory.duration])
            run.reporter.say(
                f"{interval} ({name}) is rejected: {problem.sentence}; the motion is run again"
            )
            reasons.append(problem.sentence)
        raise RepetitionsRejectedError(str(interval), reasons)

    def go_back(self, most: float = 1.0) -> None:
        """Go home, and from there to the first position; `most` is the largest override."""
        self._go(self.run.campaign.cell.home, most)
        self._go(self._start, most)

    def _go(self, target: Array, most: float) -> None:
        """Move on a straight way; one not seen in the dry run is no faster than a dry run."""
        way = self._straight.between(self._position, target, self._moves)
        if way is not None:
            self._moves += 1
            slow = self._approach(min(most, OVERRIDE) if self._unseen(way) else most)
            name = self._execute(way, way.index + 1, way.index + 1, slow)
            self.run.campaign.folder.add(name, "completed")
            if self._seen is not None and most <= OVERRIDE:
                self._seen.append(way.ends)
        self._position = target

    def _approach(self, share: float) -> float:
        """Return the override of a way, planned at `approach_speed`, for a share of full speed."""
        return min(1.0, share / self.run.campaign.cell.campaign.approach_speed)

    def _unseen(self, way: Interval) -> bool:
        """Return whether the operator should have seen this move in the dry run, and has not.

        A move from or to the first position of the arm counts as unseen: the arm was jogged there.
        """
        if self._seen is None:
            return False
        return way.from_arm or not any(way.leads(*ends) for ends in self._seen)

    def _execute(self, interval: Interval, number: int, total: int, most: float) -> str:
        run = self.run
        if run.watch.stop.requested:
            raise MotionFailedError(str(interval), "stopped", NOT_STARTED)
        spec, duration = run.archives.spec(interval), interval.trajectory.duration
        run.watch.begin(interval.kind, number, total, duration, most)
        player = player_of(run.campaign.cell, interval.trajectory)
        ended = self._link.run(player, spec, run.watch.stop, override=most, watch=run.watch)
        archived = spec.path.name if ended.outcome == "completed" or spec.path.exists() else None
        if archived is not None:  # else it was stopped before
            run.archives.names.append(archived)
        if ended.outcome != "completed":
            if archived is not None:
                run.campaign.folder.add(archived, ended.outcome, ended.reason)
            refused = self._link.connection.refused if ended.outcome == "refused" else None
            raise MotionFailedError(str(interval), ended.outcome, ended.reason, archived, refused)
        self.task.advance(duration / most, str(interval))
        return spec.path.name


def seen_in_dry_run(folder: CampaignFolder) -> list[tuple[Array, Array]]:
    """Return start and end (n,) [rad] of the moves of a dry run, by its archives."""
    entries = [one for one in folder.manifest() if one.outcome == "completed"]
    last = max((k for k, one in enumerate(entries) if one.kind == "dryrun"), default=0)
    found = []
    for entry in entries[:last]:
        if entry.kind == "move":
            with suppress(ArchiveError, ValueError, KeyError, TypeError):  # then it is not seen
                archive = open_archive(folder.archives / entry.name, fields=())
                motion = trajectory_from_dict(parse_json(archive.text("plan.json"))["trajectory"])
                found.append(Interval("move", 0, motion).ends)
    return found
