"""The slow dry run: every motion of the plan at a fifth of its speed, and a person's word on it."""

from __future__ import annotations

import getpass
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.cell import Cell
from hil.errors import ArchiveError, OperatorStopError

from .errors import AgainstGravityError, DryRunError
from .folder import CampaignFolder, load_record, save_record
from .intervals import Interval

if TYPE_CHECKING:
    from .run import Run, Runner

Array = NDArray[np.float64]
DryRunState = Literal["accepted", "to be accepted", "left out"]

SIMULATED: Final = "simulated"
"""Metadata: whether nothing but a simulated arm can have moved, "yes" or "no". The link says so,
whatever the caller of a run says."""
OVERRIDE: Final = 0.2
"""Largest share of the planned speed."""
FORMAT_VERSION: Final = 2
"""1 did not look at torques."""
_FIELDS: Final = (
    *("cycle", "gap", "position", "target_position", "target_current", "torque"),
    "commanded_position",
)
AGAINST: Final = (
    "measured torque runs against the model's gravity: joint_sign, URDF or torque sign may be wrong"
)
CLEAR: Final = 0.5
"""Correlation from which torque and gravity belong together, or against each other."""
_LEAST_SHARE: Final = 0.05
"""Gravity as a share of the rms torque below which the joint has none to speak of."""
_LEAST_SAMPLES: Final = 100
_STEP: Final = 0.01
"""s between samples whose torque is looked at."""


def said_of(only_simulated: bool) -> str:
    """The kind of arm as archives name it under `SIMULATED`."""
    return "yes" if only_simulated else "no"


def made_by(path: Path, only_simulated: bool) -> bool:
    """Whether an archive says that this kind of arm made it; a damaged one does not."""
    try:
        return open_archive(path, fields=()).header.simulated == said_of(only_simulated)
    except ArchiveError:
        return False


def agreement(gravity: Array, torque: Array, velocity: Array, moving: NDArray[np.bool_]) -> Array:
    """Correlation of gravity and torque beside friction, -1 to 1, for each joint (n,).

    At a fifth of full speed inertia is next to nothing: what a joint's torque is beside friction is
    gravity. Both are regressed on Coulomb and viscous friction, and what that leaves of them is
    compared. A torque of the wrong sign, a `joint_sign` or zero position that mirrors the arm, or
    masses that are not there make the correlation negative. There is no constant beside them: the
    sign of a weight that hardly changes counts as well.

    Args:
        gravity: by the model (m, n) [N·m].
        torque: measured (m, n) [N·m].
        velocity: (m, n) [rad/s].
        moving: rows of each joint that count (m, n): friction is known in direction there.

    Returns:
        NaN for a joint that hardly moves, or that gravity hardly loads.
    """
    found = np.full(gravity.shape[1], np.nan)
    for joint in range(len(found)):
        rows = moving[:, joint]
        if rows.sum() < _LEAST_SAMPLES:
            continue
        speed = velocity[rows, joint]
        both = np.column_stack([gravity[rows, joint], torque[rows, joint]])
        size = np.sqrt(np.mean(both[:, 1] ** 2))
        friction = np.column_stack([np.sign(speed), speed])
        rest = both - friction @ np.linalg.lstsq(friction, both, rcond=None)[0]
        weight, measured = np.linalg.norm(rest, axis=0)
        if weight > _LEAST_SHARE * size * np.sqrt(rows.sum()) and measured > 0.0:
            found[joint] = rest[:, 0] @ rest[:, 1] / (weight * measured)
    return found


@dataclass(frozen=True)
class Acceptance:
    """Who accepted a dry run: name of the user on this computer, and time of day, ISO 8601."""

    by: str
    at: str

    @classmethod
    def now(cls) -> Self:
        """That of whoever runs this program."""
        try:
            user = getpass.getuser()
        except (OSError, KeyError):  # a user without a name
            user = "unknown"
        return cls(user, datetime.now(UTC).isoformat(timespec="seconds"))


@dataclass(frozen=True)
class DryRun:
    """A whole dry run; `dry_run.json`.

    Attributes:
        plan_hash: of exactly the plan that was run.
        override: largest share of the planned speed.
        archives: file names, one for each motion of the plan.
        duration: of the motions [s].
        simulated: whether nothing but a simulated arm can have moved.
        joint_names: of the n joints.
        current_share: (n) largest current as a share of its limit.
        following_error: (n) largest [rad].
        missed: packets that never arrived.
        late: packets whose answer was late.
        accepted: by whom; None as long as nobody has.
        against_gravity: joints whose torque runs against the model's gravity.
        gravity_not_seen: joints with too little gravity to tell.
    """

    plan_hash: str
    override: float
    archives: tuple[str, ...]
    duration: float
    simulated: bool
    joint_names: tuple[str, ...]
    current_share: tuple[float, ...]
    following_error: tuple[float, ...]
    missed: int
    late: int
    accepted: Acceptance | None = None
    against_gravity: tuple[str, ...] = ()
    gravity_not_seen: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.joint_names) == len(self.current_share) == len(self.following_error):
            raise ValueError("there is not one current and one following error for each joint")

    @classmethod
    def load(cls, folder: CampaignFolder, plan_hash: str | None = None) -> Self | None:
        """That of a plan (of the folder, if left out), as it was written down; None without one.

        Raises:
            CampaignFolderError: the file is damaged, or of another version.
        """
        found = load_record(
            cls,
            folder.dry_run,
            "is damaged, or of another version",
            "remove it; its archives are looked at again, or the dry run is done again",
            version=FORMAT_VERSION,
        )
        now = folder.plan_hash if plan_hash is None and found is not None else plan_hash
        return found if found is not None and found.plan_hash == now else None

    @classmethod
    def that_counts(
        cls, folder: CampaignFolder, *, plan_hash: str, motions: int, simulated: bool
    ) -> Self | None:
        """That of a plan, where everything it says was seen can still be seen.

        What a simulated arm did says nothing of the room around a real one, and a file that was
        copied, or whose archives are gone, says nothing at all.

        Raises:
            CampaignFolderError: the file is damaged, or of another version.
        """
        found = cls.load(folder, plan_hash)
        if found is None or found.simulated is not simulated:
            return None
        paths = folder.completed("dryrun")[:motions]
        if len(paths) < motions or [path.name for path in paths] != [*found.archives]:
            return None
        return found if all(made_by(path, simulated) for path in paths) else None

    @classmethod
    def of(
        cls,
        folder: CampaignFolder,
        cell: Cell,
        names: Sequence[str],
        *,
        plan_hash: str,
        simulated: bool,
    ) -> Self:
        """What the archives of a dry run say.

        Raises:
            ArchiveError: one of them cannot be read.
        """
        limit, step = cell.drive_train.current_limit, max(1, round(_STEP / cell.period))
        current, following = np.zeros(len(limit)), np.zeros(len(limit))
        missed = late = cycles = 0
        slow: list[tuple[Array, Array, Array]] = []
        for name in names:
            archive = open_archive(folder.archives / name, fields=_FIELDS)
            columns = archive.recorded(*_FIELDS)
            current = np.maximum(current, np.abs(columns["target_current"]).max(axis=0) / limit)
            behind = np.abs(columns["target_position"] - columns["position"])
            following = np.maximum(following, np.nanmax(behind, axis=0))
            missed += int(columns["gap"].sum())
            if archive.outcome is not None:
                late += archive.outcome.late_replies or 0
            cycles += archive.n_samples
            commanded = columns["commanded_position"]
            rows = np.flatnonzero(~np.isnan(commanded).any(axis=1))[::step]
            if len(rows) > 1:
                velocity = np.gradient(commanded[rows], step * cell.period, axis=0)
                slow.append((columns["position"][rows], velocity, columns["torque"][rows]))
        correlation = np.full(len(limit), np.nan)
        if slow:
            q, qd, torque = (np.concatenate(parts) for parts in zip(*slow, strict=True))
            still, model = np.zeros_like(q), cell.model
            rigid = np.where(model.friction_columns, 0.0, cell.nominal_values())
            gravity = model.torque(rigid, q, still, still) + model.load_torque(q, still, still)
            correlation = agreement(gravity, torque, qd, model.moving(qd))
        joints = np.array(cell.joint_names)
        return cls(
            plan_hash=plan_hash,
            override=OVERRIDE,
            archives=tuple(names),
            duration=cycles * cell.period,
            simulated=simulated,
            joint_names=cell.joint_names,
            current_share=tuple(current.tolist()),
            following_error=tuple(following.tolist()),
            missed=missed,
            late=late,
            against_gravity=tuple(joints[correlation < -CLEAR].tolist()),
            gravity_not_seen=tuple(joints[~(np.abs(correlation) >= CLEAR)].tolist()),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What speaks against it, in sentences."""
        return tuple(f"{joint}: {AGAINST}" for joint in self.against_gravity)

    def save(self, path: Path) -> None:
        """Write it.

        Raises:
            OutputError: the disk refuses.
        """
        save_record(path, self, FORMAT_VERSION)

    def accepted_now(self) -> DryRun:
        """This dry run, accepted by whoever runs the program."""
        return replace(self, accepted=Acceptance.now())


class DryRunStage:
    """Every motion that will be sent at full speed, once and slowly.

    Attributes:
        intervals: the motions under the names of their slow runs.
        state: whether a person has accepted what was done; "left out" where the caller did without.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self.state: DryRunState = "left out" if run.unrehearsed else "to be accepted"
        motions = [
            one for one in run.wanted
            if one.kind == "validation" or (one.kind, one.index) == ("excitation", 0)
        ]  # fmt: skip
        self.intervals = [replace(one, kind="dryrun", index=k) for k, one in enumerate(motions)]
        # Nobody knows beforehand what will contradict: only what an earlier run saw is accepted.
        self._known = run.accept_torque if run.accept_torque and self.found() else ()

    def found(self) -> DryRun | None:
        """The dry run of exactly this plan and kind of arm; None where none counts."""
        run = self._run
        if run.unrehearsed:
            return None
        return DryRun.that_counts(
            run.folder,
            plan_hash=run.plan_hash,
            motions=len(self.intervals),
            simulated=run.simulated,
        )

    def missing(self) -> list[Interval]:
        """Each motion that was not run slowly yet."""
        intervals = [] if self._run.unrehearsed else self.intervals
        return [one for one in intervals if self._whole(one) is None]

    def run(self, runner: Runner) -> None:
        """Run what is missing, slowly, and have it accepted.

        Raises:
            DryRunError, OperatorStopError: see `settle`.
        """
        missing = self.missing()
        for slow in missing:
            name = runner.play(slow, slow.index + 1, len(self.intervals), OVERRIDE)
            self._run.entering.enter(slow, name)
        if missing:
            self.settle()

    def settle(self) -> None:
        """Write down what was done, once all of it is, and have it accepted.

        Raises:
            DryRunError: it must be accepted now and is not.
            OperatorStopError: a stop was asked for instead of an answer.
        """
        run, found = self._run, self.found()
        if run.unrehearsed:
            return
        if found is None:
            names = [name for slow in self.intervals if (name := self._whole(slow)) is not None]
            if len(names) < len(self.intervals):
                return
            found = DryRun.of(
                run.folder, run.cell, names, plan_hash=run.plan_hash, simulated=run.simulated
            )
            found.save(run.folder.dry_run)
        if found.accepted is None:
            unknown = [joint for joint in found.against_gravity if joint not in self._known]
            if not self._agreed(found, unknown):
                if not run.dry_run_only:
                    raise not_accepted(run.folder, unknown)
                return
            found.accepted_now().save(run.folder.dry_run)
        self.state = "accepted"

    def _agreed(self, found: DryRun, unknown: Sequence[str]) -> bool:
        """Whether the caller accepts, or the operator; unknown joints only the operator."""
        run = self._run
        if run.accept_dry_run and not unknown:
            return True
        agreed = run.operator.can_answer and run.operator.accept_dry_run(found)
        if run.operator.can_answer and not agreed and run.stop.requested:
            raise OperatorStopError(
                f"{run.folder.root}: stopped instead of an answer; its slow dry run was done, and "
                "is not accepted."
            )
        return agreed

    def _whole(self, slow: Interval) -> str | None:
        """Name of its whole archive, if this kind of arm made it."""
        name = self._run.folder.whole(slow.kind, slow.index)
        made = name is not None and made_by(self._run.folder.archives / name, self._run.simulated)
        return name if made else None


def not_accepted(folder: CampaignFolder, against: Sequence[str] = ()) -> DryRunError:
    """What is raised where a dry run is not accepted, or torques of joints that nobody named."""
    if against:
        return AgainstGravityError(folder.root, against, AGAINST)
    how = f"if the motions looked right, run `hil run {folder.root} --accept-dry-run`"
    return DryRunError(folder.root, "was done, but is not accepted", how)
