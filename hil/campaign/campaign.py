"""A campaign: all motions of one plan on one cell, each checked, run once and archived once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.archive import ArchiveSpec
from hil.cell import Cell
from hil.files import make_folder
from hil.motion_checks import MotionChecks
from hil.progress import Reporter
from hil.version import software
from planner import TrajectoryPlayer

from .errors import CampaignFolderError, MotionFailedError, NotRehearsedError
from .folder import CampaignFolder
from .intervals import (
    START_TOLERANCE,
    Interval,
    require_joined,
    require_runnable,
    require_sound,
    wanted,
    with_ways,
)
from .motion_link import MotionLink
from .plan import CampaignPlan, moves_to_dict
from .stop import Stop


@dataclass(frozen=True, eq=False)
class Campaign:
    """One folder: a cell, a plan, and what of it has been done."""

    folder: CampaignFolder
    cell: Cell
    plan: CampaignPlan

    @classmethod
    def create(
        cls, root: Path, cell: Cell, plan: CampaignPlan, checks: MotionChecks | None = None
    ) -> Campaign:
        """A new campaign folder with its own copies of cell, URDF and plan.

        Args:
            root: the folder to make.
            cell: the cell.
            plan: excitation and validation motions.
            checks: those of the cell, where they are at hand.

        Raises:
            CampaignFolderError: the folder holds something already.
            MotionRefusedError: the plan can never run on the cell; no folder was made.
        """
        require_runnable(cell, plan, checks)
        make_folder(root)
        if any(root.iterdir()):
            raise CampaignFolderError(root, "is not empty", "name a new folder")
        folder = CampaignFolder(root)
        make_folder(folder.archives)
        own = cell.with_urdf(folder.cell, folder.urdf.name)
        folder.urdf.write_text(own.urdf, encoding="utf-8")
        folder.cell.write_text(own.text, encoding="utf-8")
        plan.save(folder.plan)
        folder.seal()
        return cls(folder, own, plan)

    @classmethod
    def open(cls, root: Path) -> Campaign:
        """An existing campaign folder.

        Raises:
            CampaignFolderError: it is not one.
            InputError: its cell or plan cannot be read.
        """
        folder = CampaignFolder(root)
        if not folder.plan.exists():
            raise CampaignFolderError(
                root, "is not a campaign folder", "name one that has plan.json"
            )
        return cls(folder, Cell.load(folder.cell), CampaignPlan.load(folder.plan))

    def run(
        self,
        link: MotionLink,
        stop: Stop,
        reporter: Reporter,
        *,
        provenance: Mapping[str, str],
        durable: bool = True,
    ) -> None:
        """Run what is still missing, in order, and return to where the arm was.

        Every motion is checked before the first one is sent.

        Args:
            link: to the controller.
            stop: set from outside to bring the arm to rest on its path.
            reporter: told of the progress.
            provenance: goes into the metadata of every archive, e.g. whether it is simulated.
            durable: wait at each flush until the disk has the data.

        Raises:
            MotionRefusedError: a motion failed its check; nothing was sent.
            MotionFailedError: a motion ended otherwise than planned; it is archived.
            ControllerFault: the controller did not come up.
            CampaignFolderError: the folder was changed, or another run is at work on it.
            NotRehearsedError: the link may lead to a real controller.
        """
        if not link.only_simulated:
            raise NotRehearsedError
        with self.folder.locked():
            self.folder.require_unchanged()
            intervals = self._missing()
            checks = MotionChecks.of(self.cell)
            if checks.not_checked is not None:
                reporter.say(checks.not_checked)
            # What is wrong with a motion itself is told before anything is connected.
            require_sound(intervals, checks)
            where = link.connect(stop)
            if intervals:
                intervals = with_ways(self.cell, intervals, where)
                require_sound([way for way in intervals if way.kind == "move"], checks)
                require_joined(intervals)
            total = sum(interval.trajectory.duration for interval in intervals)
            with reporter.task("running the campaign (s of motion)", total) as task:
                for interval in intervals:
                    if stop.requested:
                        raise MotionFailedError(str(interval), "stopped", "it had not begun")
                    self._run_one(interval, link, stop, provenance, durable=durable)
                    task.advance(interval.trajectory.duration, str(interval))
            link.close()

    def _missing(self) -> list[Interval]:
        """What is still to be run."""
        return [
            interval
            for interval in wanted(self.cell, self.plan)
            if self.folder.whole(interval.kind, interval.index) is None
        ]

    def _run_one(
        self,
        interval: Interval,
        link: MotionLink,
        stop: Stop,
        provenance: Mapping[str, str],
        *,
        durable: bool,
    ) -> None:
        cell, bounds = self.cell, self.cell.file.bounds
        player = TrajectoryPlayer(
            interval.trajectory,
            cell.period,
            cell.joint_limits,
            override_acceleration=bounds.override.acceleration,
            override_jerk=bounds.override.jerk,
            stop_acceleration=bounds.stop.acceleration,
            stop_jerk=bounds.stop.jerk,
            start_tolerance=START_TOLERANCE,
        )
        name = self.folder.next_name(interval.kind, interval.index)
        spec = ArchiveSpec(
            self.folder.archives / name.filename,
            joint_names=cell.joint_names,
            period=cell.period,
            metadata=self._metadata() | dict(provenance),
            attachments=self._attachments(interval),
            durable=durable,
        )
        ended = link.run(player, spec, stop)
        self.folder.add(name.filename, ended.outcome)
        if ended.outcome != "completed":
            refused = link.connection.refused if ended.outcome == "refused" else None
            recorder = None if refused is None else refused.flight_recorder
            raise MotionFailedError(str(interval), ended.outcome, ended.reason, recorder)

    def _attachments(self, interval: Interval) -> dict[str, bytes]:
        cell = self.cell
        return {
            "cell.toml": cell.text.encode(),
            "robot.urdf": cell.urdf.encode(),
            "drive_train.json": cell.drive_table.model_dump_json().encode(),
            "plan.json": json.dumps(self._plan_of(interval)).encode(),
        }

    def _plan_of(self, interval: Interval) -> dict[str, Any]:
        """The trajectory of an interval, its moves, and how an excitation was found."""
        moves = moves_to_dict(interval.moves)
        if interval.kind == "excitation":
            return {"excitation": self.plan.excitation.to_dict(), **moves}
        return {"trajectory": interval.trajectory.to_dict(), **moves}

    def _metadata(self) -> dict[str, str]:
        return {
            "campaign": self.folder.root.resolve().name,
            "cell": self.cell.name,
            **{f"software.{name}": version for name, version in software().items()},
        }
