"""One run of a campaign: the motions that are missing, in order, behind the gates.

Everything is checked before the first motion. Each motion is archived, judged and entered in the
manifest before the next one begins: a killed run is resumed with the first motion that is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveHeader, ArchiveSpec, open_archive
from hil.archive.live import LiveView
from hil.cell import Cell
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
    planned_intervals,
    player_of,
    require_allowed,
)
from .link import NOT_STARTED, MotionLink, VirtualLink, active_checks, narrower_limits
from .live_link import LiveLink
from .operator import Operator, RunWatch, Stop
from .plan import CampaignPlan, moves_to_dict
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


@dataclass(eq=False)
class Run:
    """One run of a campaign, with the arguments of `Campaign.run`.

    Attributes:
        archives: file names so far, whatever their outcome.
        plan_hash: of this cell, URDF and plan, in memory and on the disk; "" at first.
        cycles: archived so far.
    """

    campaign: Campaign
    link: MotionLink | None
    stop: Stop
    reporter: Reporter
    operator: Operator
    given_provenance: Mapping[str, str] | None = None
    durable: bool | None = None
    unrehearsed: bool = False
    dry_run_only: bool = False
    accept_dry_run: bool = False
    accept_torque: tuple[str, ...] = ()
    live: LiveView | None = None
    archives: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    plan_hash: str = ""
    cycles: int = 0

    def __post_init__(self) -> None:
        campaign = self.campaign
        self.folder: CampaignFolder = campaign.folder
        self.cell: Cell = campaign.cell
        self.plan: CampaignPlan = campaign.plan
        self.watch = RunWatch(self.operator, self.stop)
        self.wanted = planned_intervals(self.cell, self.plan)
        self.simulated: bool = (self.cell if self.link is None else self.link).only_simulated
        self.virtual = isinstance(self.link, VirtualLink) or (
            self.link is None and self.cell.controller.transport == "simulated"
        )

    def execute(self) -> RunResult:
        """Run the missing motions; a controller is connected only where some are missing."""
        with self.folder.locked():
            self.folder.require_unchanged()
            self.plan_hash = self.folder.hash_of(self.cell, self.plan)
            dry_run, warm_up = DryRunStage(self), WarmUpStage(self)
            require_gates(self, dry_run)
            self.review.adopt([*self.wanted, *dry_run.intervals], self.made)
            slow, full = dry_run.missing(), [] if self.dry_run_only else self.missing()
            if not slow:
                dry_run.accept()
            if slow or full:
                with self._connected(warm_up, slow, full) as runner:
                    dry_run.run(runner)
                    if full:
                        if self.missing("excitation", "validation"):
                            warm_up.run(runner)
                        self._run_missing("standstill", runner, warm_up)
                        self._run_missing("excitation", runner, warm_up)
                        # Later repetitions may have shown that the first one was disturbed.
                        self._run_missing("excitation", runner, warm_up)
                        self._run_missing("validation", runner, warm_up)
                    runner.go_back(OVERRIDE if self.dry_run_only else 1.0)
            return self._result(dry_run, warm_up)

    def _run_missing(self, kind: str, runner: Runner, warm_up: WarmUpStage) -> None:
        """Run the missing motions of a kind; repetitions only while the joints are warm."""
        total = sum(one.kind == kind for one in self.wanted)
        for interval in self.missing(kind):
            warm = warm_up if kind == "excitation" else None
            runner.run_until_accepted(interval, interval.index + 1, total, warm)
            if kind == "validation":
                warm_up.motion_ended()

    @contextmanager
    def _connected(
        self, warm_up: WarmUpStage, slow: Sequence[Interval], full: Sequence[Interval]
    ) -> Iterator[Runner]:
        """Connect the controller, check all motions with its limits, and close the link after."""
        cell, reporter = self.cell, self.reporter
        checks = MotionChecks.of(cell)
        if checks.not_checked is not None:
            reporter.say(checks.not_checked)
        sent = [*slow, *full, *(warm_up.next_motion() if full else ())]
        # What is wrong with a motion itself is reported before anything is connected.
        require_allowed(sent, checks)
        own = cell_link(cell, live=self.live) if self.link is None else nullcontext(self.link)
        with own as link:
            link.connection.report = reporter.say
            if isinstance(link, LiveLink):
                for note in link.notes():
                    reporter.say(f"note: {note}")
                if link.live is not None:
                    reporter.say(link.live.notice)
            start = link.connect(self.stop)
            require_as_rehearsed(self, link.connection)
            narrowed = active_checks(cell, link.connection, checks)
            if narrowed is not checks:  # the controller's own limits are known only now
                require_allowed(sent, narrowed)
            if below := narrower_limits(cell, link.connection, "current_limit"):
                self.notes.append(
                    f"the controller's own current limits counted ({'; '.join(below)})"
                )
            # Dry run and warm-up use the moves of the motions that they are made of.
            straight = StraightMoves(cell, narrowed)
            joined = straight.joining([*slow, *full], start)
            runner = Runner(self, link, straight, start)
            times = runner.times(joined, len(slow))
            if any(one.kind != "standstill" for one in full):
                times += warm_up.expected()
            self.watch.expect(times)
            with reporter.task("running the campaign (s of motion)", sum(times)) as runner.task:
                yield runner
            link.close()
        self.cycles = runner.cycles

    def missing(self, *kinds: str) -> list[Interval]:
        """Return what is still to be run at full speed, of these kinds or of all."""
        return [
            one
            for one in self.wanted
            if one.kind in (kinds or (one.kind,)) and self.folder.whole(one.kind, one.index) is None
        ]

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Metadata of every archive; a date only in real time.

        The caller knows what a link simulates; the link decides whether a real arm can move.
        """
        own: Mapping[str, str] = {}
        if not self.virtual:
            own = origin_of(self.cell, only_simulated=self.simulated, virtual=False)
        elif self.given_provenance is None:
            own = simulated_provenance(self.cell, effects=False)
        return {**own, **(self.given_provenance or {}), SIMULATED: yes_or_no(self.simulated)}

    @cached_property
    def review(self) -> ArchiveReview:
        """Judges archives and enters them in the manifest."""
        return ArchiveReview(self.folder, self.cell, self.plan.excitation.trajectory)

    def spec(self, interval: Interval) -> ArchiveSpec:
        """Return the archive of the next attempt at an interval."""
        name = self.folder.next_name(interval.kind, interval.index)
        # One seed gives one campaign to the byte, whatever the name of its folder.
        simulated = self.provenance.get(SIMULATED) == yes_or_no(True)
        metadata = {
            **({} if simulated else {"campaign": self.folder.root.resolve().name}),
            "plan_hash": self.plan_hash,
            **{f"software.{package}": version for package, version in software().items()},
            **with_present_date(self.provenance),
        }
        plan = {"trajectory": interval.trajectory.to_dict()}
        if interval.kind in REPEATED:  # with how it was found
            plan = {"excitation": self.plan.excitation.to_dict()}
        durable = not self.virtual if self.durable is None else self.durable
        return archive_spec(
            self.cell,
            self.folder.archives / name,
            metadata,
            plan | moves_to_dict(interval.moves),
            durable=durable,
        )

    def made(self, header: ArchiveHeader) -> bool:
        """Return whether an archive with this header is of this plan and kind of arm."""
        arm = self.provenance.get(SIMULATED)
        return header.plan_hash == self.plan_hash and header.simulated == arm

    def _result(self, dry_run: DryRunStage, warm_up: WarmUpStage) -> RunResult:
        missing, found = self.missing(), dry_run.found()

        def complete(kind: str) -> tuple[int, int]:
            total = sum(one.kind == kind for one in self.wanted)
            return total - sum(one.kind == kind for one in missing), total

        return RunResult(
            campaign=str(self.folder.root),
            plan_hash=self.plan_hash,
            simulated=self.simulated,
            archives=tuple(self.archives),
            rejected=tuple(self.review.rejected),
            adopted=tuple(self.review.adopted),
            dry_run=dry_run.state,
            against_gravity=() if found is None else found.against_gravity,
            warm_up=warm_up.outcome,
            repetitions=complete("excitation"),
            validations=complete("validation"),
            complete=not missing,
            cycles=self.cycles,
            notes=(
                *self.notes,
                *(f"dry run: {text}" for text in (() if found is None else found.warnings)),
                *warm_up.notes,
                *self.review.notes,
                *self.watch.problems,
            ),
        )


class Runner:
    """Runs motions of a run on a connected link, and the straight moves to them.

    The arm returns to its first position `start` (n,) [rad]; `task` receives the seconds of motion.
    """

    task: Task

    def __init__(self, run: Run, link: MotionLink, straight: StraightMoves, start: Array) -> None:
        self._run, self._link, self._straight, self._start = run, link, straight, start
        self._position, self._before, self._moves = start, link.cycles, 0
        self._seen = None if run.unrehearsed else seen_in_dry_run(run.folder)

    @property
    def cycles(self) -> int:
        """Cycles archived so far."""
        return self._link.cycles - self._before

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
        start, end = interval.places(self._run.cell.home)
        self._go(start, most)
        name = self._execute(interval, number, total, most)
        self._position = end
        return name

    def run_until_accepted(
        self, interval: Interval, number: int, total: int, warm_up: WarmUpStage | None = None
    ) -> str:
        """Run motion `number` (from 1) of `total` until it passes its check; return its archive.

        `warm_up` warms the arm up before each attempt, and judges whether it was warm at its start.

        Raises:
            RepetitionsRejectedError: it failed too often.
        """
        run, reasons = self._run, list[str]()
        while len(reasons) <= run.cell.campaign.bad_repetitions:
            if warm_up is not None:
                warm_up.rewarm(self)
            name = self.run_motion(interval, number, total)
            cold = None if warm_up is None else warm_up.cold_start(run.watch.began)
            problem = run.review.enter(interval, name, cold)
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
        self._go(self._run.cell.home, most)
        self._go(self._start, most)

    def _go(self, target: Array, most: float) -> None:
        """Move on a straight way; one not seen in the dry run is no faster than a dry run."""
        way = self._straight.between(self._position, target, self._moves)
        if way is not None:
            self._moves += 1
            slow = self._approach(min(most, OVERRIDE) if self._unseen(way) else most)
            name = self._execute(way, way.index + 1, way.index + 1, slow)
            self._run.folder.add(name, "completed")
            if self._seen is not None and most <= OVERRIDE:
                self._seen.append(way.ends)
        self._position = target

    def _approach(self, share: float) -> float:
        """Return the override of a way, planned at `approach_speed`, for a share of full speed."""
        return min(1.0, share / self._run.cell.campaign.approach_speed)

    def _unseen(self, way: Interval) -> bool:
        """Return whether the operator should have seen this move in the dry run, and has not.

        A move from or to the first position of the arm counts as unseen: the arm was jogged there.
        """
        if self._seen is None:
            return False
        return way.from_arm or not any(way.leads(*ends) for ends in self._seen)

    def _execute(self, interval: Interval, number: int, total: int, most: float) -> str:
        run = self._run
        if run.stop.requested:
            raise MotionFailedError(str(interval), "stopped", NOT_STARTED)
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
