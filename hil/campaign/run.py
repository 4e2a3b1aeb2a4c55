"""One run of a campaign: what every stage of it is given, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from hil.archive import ArchiveHeader, ArchiveSpec
from hil.archive.live import LiveView
from hil.cell import Cell
from hil.progress import Reporter
from hil.recording import archive_spec, dated_anew, origin_of
from hil.version import software

from .dry_run import SIMULATED, DryRunState, said_of
from .folder import CampaignFolder
from .intervals import Interval, wanted
from .link import Link
from .motion_link import MotionLink
from .operator import Operator, RunWatch, Stop
from .plan import CampaignPlan, moves_to_dict
from .quality import Entering, Rejected

if TYPE_CHECKING:
    from .campaign import Campaign

REPEATED = ("excitation", "warmup")
"""Kinds that run the excitation as it was designed."""


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
    """One run of a campaign: what is run, for whom, and how its archives are labelled.

    What is wanted of it is said in `Campaign.run`.

    Attributes:
        campaign: what is run.
        link: the caller's; None for the cell's own.
        stop: brings the arm to rest on its path.
        reporter: receives the progress.
        operator: watches, and accepts the dry run.
        said: of where archives come from, by the caller.
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

    @property
    def folder(self) -> CampaignFolder:
        """Of the campaign."""
        return self.campaign.folder

    @property
    def cell(self) -> Cell:
        """Of the campaign."""
        return self.campaign.cell

    @property
    def plan(self) -> CampaignPlan:
        """Of the campaign."""
        return self.campaign.plan

    @property
    def simulated(self) -> bool:
        """Whether nothing but a simulated arm can move."""
        return self.cell.only_simulated if self.link is None else self.link.only_simulated

    @property
    def virtual(self) -> bool:
        """Whether time is."""
        if self.link is None:
            return self.cell.controller.transport == "simulated"
        return isinstance(self.link, Link)

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Goes into the metadata of every archive."""
        return provenance_of(self)

    @cached_property
    def watch(self) -> RunWatch:
        """Shows each motion to the operator."""
        return RunWatch(self.operator, self.stop)

    @cached_property
    def entering(self) -> Entering:
        """Judges archives and enters them in the manifest."""
        return Entering(self.folder, self.cell, self.plan.excitation.trajectory)

    @cached_property
    def wanted(self) -> list[Interval]:
        """All motions at full speed, without the moves between them."""
        return wanted(self.cell, self.plan, self.repetitions)

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
        named = {} if simulated else {"campaign": self.folder.root.resolve().name}
        metadata = {
            **named,
            "plan_hash": self.plan_hash,
            **{f"software.{package}": version for package, version in software().items()},
            **dated_anew(self.provenance),
        }
        moves = moves_to_dict(interval.moves)
        if interval.kind in REPEATED:  # with how it was found
            plan = {"excitation": self.plan.excitation.to_dict(), **moves}
        else:
            plan = {"trajectory": interval.trajectory.to_dict(), **moves}
        durable = not self.virtual if self.durable is None else self.durable
        path = self.folder.archives / name.filename
        return archive_spec(self.cell, path, metadata, plan, durable=durable)

    def made(self, header: ArchiveHeader) -> bool:
        """Whether an archive with this header was made of exactly this plan, by such an arm."""
        arm = self.provenance.get(SIMULATED)
        return header.plan_hash == self.plan_hash and header.simulated == arm


def provenance_of(run: Run) -> dict[str, str]:
    """What is said of where archives come from; a time of day only in real time.

    The caller alone knows what a link of his simulates, but not whether it leads to a real arm.
    """
    if not run.virtual:
        own = origin_of(run.cell, only_simulated=run.simulated, virtual=False)
    elif run.said is None:
        from hil.simulation import simulated_provenance  # it opens links of ours

        own = simulated_provenance(run.cell, effects=False)
    else:
        own = {}
    return own | dict(run.said or {}) | {SIMULATED: said_of(run.simulated)}
