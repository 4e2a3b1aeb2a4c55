"""Motions of one run of a campaign: each is moved to, run, archived and checked.

Each motion is archived, judged and entered in the manifest before the next one begins: a killed run
is resumed with the first motion that is missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from hil.archive import ArchiveHeader, ArchiveSpec, open_archive
from hil.archive.live import LiveView
from hil.base.arrays import Array
from hil.base.errors import ArchiveError
from hil.base.progress import Reporter, Task
from hil.base.safe_input import parse_json
from hil.base.version import software
from hil.cell import Cell
from hil.control.errors import MotionFailedError, SlippedError
from hil.control.link import NOT_STARTED, MotionLink
from hil.control.motions import REPEATED, CampaignMotion, CheckedMoves, moves_to_dict, player_of
from hil.control.record import archive_spec, origin_of, with_present_date
from hil.control.simulated_cell import simulated_provenance
from hil.control.slips import CHECKED_OUTCOMES, require_no_slip
from hil.precision.requirements import Requirement
from identification.excitation.excitation import trajectory_from_dict

from .dry_run_record import MAX_DRY_RUN_OVERRIDE, SIMULATED, yes_or_no
from .errors import RepetitionsRejectedError
from .folder import CampaignFolder
from .operator import ExpectedMotion, RunWatch
from .quality import ArchiveReview
from .quality_messages import problem_words
from .quality_problems import QualityProblem
from .run_notes import RunNote
from .state import CampaignState


@dataclass(frozen=True)
class RunOptions:
    """What the caller of `Campaign.run` chose; see there.

    Attributes:
        only: kind and index of the motions to run; None for all that are missing.
        first_move: index of the first move between motions.
    """

    provenance: Mapping[str, str] | None = None
    durable: bool | None = None
    unrehearsed: bool = False
    dry_run_only: bool = False
    accept_dry_run: bool = False
    accept_torque: tuple[str, ...] = ()
    live: LiveView | None = None
    until_precise: tuple[Requirement, ...] = ()
    repetitions: int | None = None
    say_unchecked: bool = True
    only: frozenset[tuple[str, int]] | None = None
    first_move: int = 0


class RunArchives:
    """Archives of one run: what each contains, and the check before it is entered.

    Args:
        campaign: that is run.
        link: to the controller; None without one.
        options: of this run.
        plan_hash: of cell, URDF and plan.

    Attributes:
        names: file names so far, whatever their outcome.
        notes: what a reader must know.
        cycles: archived so far.
        provenance: metadata of every archive; a date only in real time.
        plan_hash: of this cell, URDF and plan, in memory and on the disk.
        simulated: whether only a simulated arm can move.
        review: judges archives and enters them in the manifest.
    """

    def __init__(
        self, campaign: CampaignState, link: MotionLink | None, options: RunOptions, plan_hash: str
    ) -> None:
        given = options.provenance
        self._campaign = campaign
        self.plan_hash = plan_hash
        self.simulated = (campaign.cell if link is None else link).only_simulated
        self.names = list[str]()
        self.notes = list[RunNote]()
        self.cycles = 0
        in_file = link is None and campaign.cell.controller.transport == "simulated"
        virtual = in_file or (link is not None and link.is_virtual)
        self._durable = not virtual if options.durable is None else options.durable
        # The caller knows what a link simulates; the link decides whether a real arm can move.
        origin: Mapping[str, str] = {}
        if not virtual:
            origin = origin_of(campaign.cell, only_simulated=self.simulated, virtual=False)
        elif given is None:
            origin = simulated_provenance(campaign.cell, effects=False)
        self.provenance = {**origin, **(given or {}), SIMULATED: yes_or_no(self.simulated)}
        trajectory = campaign.plan.excitation.trajectory
        self.review = ArchiveReview(campaign.folder, campaign.cell, trajectory)

    def adopt(self, slow: Sequence[CampaignMotion]) -> None:
        """Enter archives of an earlier run of the plan, and of its `slow` motions, see `review`."""
        arm = self.provenance.get(SIMULATED)
        plan_hash = self.plan_hash

        def made(header: ArchiveHeader) -> bool:
            return header.plan_hash == plan_hash and header.simulated == arm

        self.review.adopt([*self._campaign.motions, *slow], made)

    def spec(self, motion: CampaignMotion) -> ArchiveSpec:
        """Return the archive of the next attempt at a motion."""
        campaign = self._campaign
        name = campaign.folder.next_name(motion.kind, motion.index)
        # One seed gives one campaign to the byte, whatever the name of its folder.
        simulated = self.provenance.get(SIMULATED) == yes_or_no(True)
        metadata = {
            **({} if simulated else {"campaign": campaign.folder.root.resolve().name}),
            "plan_hash": self.plan_hash,
            **_payload_entry(campaign.cell),
            **{f"software.{package}": version for package, version in software().items()},
            **with_present_date(self.provenance),
        }
        plan = {"trajectory": motion.trajectory.to_dict()}
        if motion.kind in REPEATED:  # with how it was found
            plan = {"excitation": campaign.plan.excitation.to_dict()}
        return archive_spec(
            campaign.cell,
            campaign.folder.archives / name,
            metadata,
            plan | moves_to_dict(motion.moves),
            durable=self._durable,
        )


def _payload_entry(cell: Cell) -> dict[str, str]:
    """Return the name of the payload of a cell as metadata, {} without one."""
    payload = cell.file.robot.payload
    return {"payload": payload.name} if payload is not None and payload.name else {}


class Warmth(Protocol):
    """Whether the joints are warm enough for a repetition."""

    def rewarm(self, runner: Runner) -> None:
        """Warm up again if the joints have cooled down."""

    def cold_start(self, began: float) -> QualityProblem | None:
        """Return the problem of a repetition that began cold [s since 1970]."""

    def motion_ended(self) -> None:
        """Record that a motion that warms the joints has ended."""


class Runner:
    """Runs motions of a campaign on a connected link, and the straight moves to them.

    Args:
        campaign: its state.
        link: connected.
        archives: of this run.
        watch: operator and stop.
        reporter: receives messages.
        warmth: of the joints.
        straight: moves between motions.
        start: (n,) [rad], the first position of the arm, to which it returns.
        options: of the run; in one without rehearsal, no move is slow for not having been seen in
            a dry run.

    Attributes:
        task: receives the seconds of motion.
    """

    task: Task

    def __init__(
        self,
        campaign: CampaignState,
        link: MotionLink,
        archives: RunArchives,
        watch: RunWatch,
        reporter: Reporter,
        *,
        warmth: Warmth,
        straight: CheckedMoves,
        start: Array,
        options: RunOptions,
    ) -> None:
        self.campaign = campaign
        self._link = link
        self._straight = straight
        self._start = start
        self._archives = archives
        self._watch = watch
        self._reporter = reporter
        self._warmth = warmth
        self._position = start
        self._moves = options.first_move
        self._seen = None if options.unrehearsed else seen_in_dry_run(campaign.folder)

    def expected(self, joined: Sequence[CampaignMotion], slow: int) -> list[ExpectedMotion]:
        """Return motions and ways as they will be run, the first `slow` motions slowly."""
        expected = []
        watched = slow > 0
        for motion in joined:
            dry_run = slow > 0
            share = MAX_DRY_RUN_OVERRIDE if dry_run else 1.0
            if motion.kind == "move":
                unseen = motion.from_arm if watched else self._unseen(motion)
                share = self._approach(MAX_DRY_RUN_OVERRIDE) if dry_run or unseen else 1.0
            else:
                slow = max(0, slow - 1)
            expected.append(ExpectedMotion(motion.trajectory.duration, share, dry_run))
        return expected

    def run_motion(self, motion: CampaignMotion, number: int, total: int, most: float = 1.0) -> str:
        """Move to the start of a motion, run it, and return its archive, not yet in the manifest.

        Args:
            motion: of the campaign.
            number: of the motion, from 1.
            total: of the motions.
            most: largest override.

        Raises:
            MotionFailedError: it ended otherwise than planned, or was not begun after a stop.
            SlippedError: a measured position slipped.
            ControllerError: it was not accepted, or the link broke.
        """
        start, end = motion.endpoints(self.campaign.cell.home)
        self._go(start, most)
        name = self._execute(motion, number, total, most)
        self._position = end
        return name

    def run_until_accepted(self, motion: CampaignMotion, number: int, total: int) -> str:
        """Run motion `number` (from 1) of `total` until it passes its check; return its archive.

        An arm that has cooled down is warmed up before a repetition; one begun cold is rejected.

        Raises:
            RepetitionsRejectedError: it failed too often.
        """
        reasons = list[str]()
        warm_up = self._warmth if motion.kind == "excitation" else None
        while len(reasons) <= self.campaign.cell.campaign.bad_repetitions:
            if warm_up is not None:
                warm_up.rewarm(self)
            name = self.run_motion(motion, number, total)
            cold = None if warm_up is None else warm_up.cold_start(self._watch.began)
            problem = self._archives.review.enter(motion, name, cold)
            if warm_up is not None and cold is None:
                warm_up.motion_ended()
            if problem is None:
                return name
            self._watch.expect([ExpectedMotion(motion.trajectory.duration)])
            reasons.append(problem_words(problem))
            self._reporter.say(
                f"{motion} ({name}) is rejected: {reasons[-1]}; the motion is run again"
            )
        raise RepetitionsRejectedError(str(motion), reasons)

    def go_back(self, most: float = 1.0) -> None:
        """Go home, and from there to the first position; `most` is the largest override."""
        self._go(self.campaign.cell.home, most)
        self._go(self._start, most)

    def _go(self, target: Array, most: float) -> None:
        """Move on a straight way; one not seen in the dry run is no faster than a dry run."""
        way = self._straight.between(self._position, target, self._moves)
        if way is not None:
            self._moves += 1
            slow = self._approach(min(most, MAX_DRY_RUN_OVERRIDE) if self._unseen(way) else most)
            name = self._execute(way, way.index + 1, way.index + 1, slow)
            self.campaign.folder.add(name, "completed")
            if self._seen is not None and most <= MAX_DRY_RUN_OVERRIDE:
                self._seen.append(way.ends)
        self._position = target

    def _approach(self, share: float) -> float:
        """Return the override of a way, planned at `approach_speed`, for a share of full speed."""
        return min(1.0, share / self.campaign.cell.campaign.approach_speed)

    def _unseen(self, way: CampaignMotion) -> bool:
        """Return whether the operator should have seen this move in the dry run, and has not.

        A move from or to the first position of the arm counts as unseen: the arm was jogged there.
        """
        if self._seen is None:
            return False
        return way.from_arm or not any(way.connects(*ends) for ends in self._seen)

    def _execute(self, motion: CampaignMotion, number: int, total: int, most: float) -> str:
        if self._watch.stop.requested:
            raise MotionFailedError(str(motion), "stopped", NOT_STARTED)
        spec = self._archives.spec(motion)
        duration = motion.trajectory.duration
        self._watch.begin(motion.kind, number, total, duration, most)
        player = player_of(self.campaign.cell, motion.trajectory)
        ended = self._link.run(player, spec, self._watch.stop, override=most, watch=self._watch)
        self._watch.end()
        archived = spec.path.name if ended.outcome == "completed" or spec.path.exists() else None
        if archived is not None:  # else it was stopped before
            self._archives.names.append(archived)
        if archived is not None and ended.outcome in CHECKED_OUTCOMES:
            self._require_no_slip(motion, spec.path)
        if ended.outcome != "completed":
            if archived is not None:
                self.campaign.folder.add(archived, ended.outcome, ended.reason)
            refused = self._link.connection.refused if ended.outcome == "refused" else None
            raise MotionFailedError(str(motion), ended.outcome, ended.reason, archived, refused)
        self.task.advance(duration / most, str(motion))
        return spec.path.name

    def _require_no_slip(self, motion: CampaignMotion, path: Path) -> None:
        """Reject a motion in which a measured position slipped, and move nothing any more."""
        try:
            require_no_slip(str(motion), path)
        except SlippedError as slip:
            self.campaign.folder.add(path.name, slip.outcome, slip.reason)
            raise


def seen_in_dry_run(folder: CampaignFolder) -> list[tuple[Array, Array]]:
    """Return start and end (n,) [rad] of the moves of a dry run, by its archives."""
    entries = [entry for entry in folder.manifest() if entry.outcome == "completed"]
    last = max((k for k, entry in enumerate(entries) if entry.kind == "dryrun"), default=0)
    ends = []
    for entry in entries[:last]:
        if entry.kind == "move":
            with suppress(ArchiveError, ValueError, KeyError, TypeError):  # then it is not seen
                archive = open_archive(folder.archives / entry.name, fields=())
                motion = trajectory_from_dict(parse_json(archive.text("plan.json"))["trajectory"])
                ends.append(CampaignMotion("move", 0, motion).ends)
    return ends
