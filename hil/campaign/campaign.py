"""A campaign: all motions of one plan on one cell, each checked, run once and archived once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import ArchiveSpec
from hil.cell import Cell
from hil.files import make_folder
from hil.motion_checks import MotionChecks
from hil.progress import Reporter
from hil.version import software
from planner import (
    FourierSeries,
    Move,
    PiecewiseCubic,
    PlanFile,
    TrajectoryPlayer,
    in_child,
    plan_moves,
)

from .errors import (
    CampaignFolderError,
    MotionFailedError,
    MotionRefusedError,
    NotRehearsedError,
)
from .folder import CampaignFolder
from .motion_link import MotionLink
from .plan import CampaignPlan, moves_to_dict
from .stop import Stop

Array = NDArray[np.float64]

AT_REST_TOLERANCE = 1e-6
"""rad; a move shorter than this is not worth an interval."""
START_TOLERANCE = 1e-3
"""rad by which a motion may begin elsewhere than where the arm is."""


@dataclass(frozen=True, eq=False)
class Interval:
    """One interval of motion: what kind it is, the trajectory to run, and the moves behind it."""

    kind: str
    index: int
    trajectory: PiecewiseCubic | FourierSeries
    moves: PlanFile | None = None

    def __str__(self) -> str:
        return f"{self.kind} {self.index}"


@dataclass(frozen=True, eq=False)
class Campaign:
    """One folder: a cell, a plan, and what of it has been done."""

    folder: CampaignFolder
    cell: Cell
    plan: CampaignPlan

    @classmethod
    def create(cls, root: Path, cell: Cell, plan: CampaignPlan) -> Campaign:
        """A new campaign folder with its own copies of cell, URDF and plan.

        Raises:
            CampaignFolderError: the folder holds something already.
        """
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
            intervals = self._missing(link.connect(stop))
            self._check(intervals)
            total = sum(interval.trajectory.duration for interval in intervals)
            with reporter.task("running the campaign (s of motion)", total) as task:
                for interval in intervals:
                    if stop.requested:
                        raise MotionFailedError(str(interval), "stopped", "it had not begun")
                    self._run_one(interval, link, stop, provenance, durable=durable)
                    task.advance(interval.trajectory.duration, str(interval))
            link.close()

    def _check(self, intervals: list[Interval]) -> None:
        """Refuse the campaign if one of its motions must not be sent.

        Each motion is checked once, and that each begins where the one before ends.
        """
        checks = MotionChecks.of(self.cell)
        checked: set[int] = set()
        before: Interval | None = None
        for interval in intervals:
            problem = None
            if id(interval.trajectory) not in checked:
                problem = checks.refusal(interval.trajectory)
                checked.add(id(interval.trajectory))
            if problem is None and before is not None:
                problem = _jump(before, interval)
            if problem is not None:
                raise MotionRefusedError(
                    str(interval), problem, "jog the arm or design another motion"
                )
            before = interval

    def _missing(self, where: Array) -> list[Interval]:
        """What is still to be run with the arm at `where` (n,), there and back in the end."""
        settings, home, archived = self.cell.campaign, self.cell.home, self.folder
        excitation, moves = self.plan.excitation.trajectory, self.plan.moves
        wanted = [
            Interval("standstill", 0, hold(home, settings.standstill_s)),
            *(Interval("excitation", i, excitation, moves) for i in range(settings.repetitions)),
            *(
                Interval("validation", i, motion.trajectory, motion.moves)
                for i, motion in enumerate(self.plan.validation)
            ),
        ]
        missing = [w for w in wanted if archived.whole(w.kind, w.index) is None]
        return self._with_ways(missing, where) if missing else []

    def _with_ways(self, intervals: list[Interval], where: Array) -> list[Interval]:
        """Put moves between: from `where` (n,) to home, from home to an excitation, and back.

        An excitation may begin and end elsewhere than at home; whatever else does is not met.
        """
        home, at = self.cell.home, where
        joined: list[Interval] = []
        ways: dict[bytes, Interval] = {}

        def go(target: Array) -> None:
            nonlocal at
            if np.max(np.abs(target - at)) > AT_REST_TOLERANCE:
                key = at.tobytes() + target.tobytes()
                if key not in ways:
                    ways[key] = self._way(at, target)
                index = sum(interval.kind == "move" for interval in joined)
                joined.append(replace(ways[key], index=index))
            at = target

        for interval in intervals:
            start, end = _ends(interval) if interval.kind == "excitation" else (home, home)
            go(start)
            joined.append(interval)
            at = end
        go(home)
        go(where)
        return joined

    def _way(self, start: Array, end: Array) -> Interval:
        """The straight way between two postures; planned where a crash does not end us."""
        move = Move(end, speed=self.cell.campaign.approach_speed)
        motion = in_child(plan_moves, start, (move,), self.cell.joint_limits)
        return Interval("move", 0, motion.trajectory, PlanFile.of(motion, self.cell.joint_names))

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


def _jump(before: Interval, after: Interval) -> str | None:
    """Why `after` cannot follow `before`, or None if it begins where that ends."""
    (_, end), (start, _) = _ends(before), _ends(after)
    distance = np.abs(start - end)
    if np.max(distance) <= START_TOLERANCE:
        return None
    joint = int(np.argmax(distance))
    return (
        f"it begins with joint {joint + 1} at {start[joint]:.6g} rad, but {before} ends at "
        f"{end[joint]:.6g} rad"
    )


def _ends(interval: Interval) -> tuple[Array, Array]:
    """Where a motion begins and where it ends, (n,) [rad] each."""
    start, end = interval.trajectory.sample(np.array([0.0, interval.trajectory.duration]))[0]
    return start, end


def hold(position: Array, duration: float) -> PiecewiseCubic:
    """Rest at `position` (n,) [rad] for `duration` [s]."""
    return PiecewiseCubic(
        knots=tuple(np.array([0.0, duration]) for _ in position),
        coefficients=tuple(np.array([[q, 0.0, 0.0, 0.0]]) for q in position),
    )
