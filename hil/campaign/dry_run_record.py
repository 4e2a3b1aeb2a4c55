"""Record of a dry run: every motion of the plan at 20 % of its speed, accepted by the operator."""

from __future__ import annotations

import getpass
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.archive.campaign_archives import load_record
from hil.base.arrays import Array
from hil.base.errors import ArchiveError
from identification.model.motion import Motion

from .folder import CampaignFolder, save_record
from .state import CampaignState

DryRunState = Literal["accepted", "to be accepted", "left out"]

SIMULATED: Final = "simulated"
"""Metadata key: whether only a simulated arm can have moved, "yes" or "no", by the link."""
MAX_DRY_RUN_OVERRIDE: Final = 0.2  # Largest share of the planned speed
FORMAT_VERSION: Final = 2  # 1 had no check of torques
_FIELDS: Final = (
    *("cycle", "gap", "position", "target_position", "target_current", "torque"),
    "commanded_position",
)
# Magnitude of a correlation of torque and gravity that is significant
MIN_GRAVITY_CORRELATION: Final = 0.5
# Gravity as a share of the rms torque below which it is not compared
_MIN_GRAVITY_SHARE: Final = 0.05
_MIN_SAMPLES: Final = 100
_SAMPLE_PERIOD: Final = 0.01  # Period of the samples whose torque is compared, s


def yes_or_no(only_simulated: bool) -> str:
    """Return the metadata value of `SIMULATED`."""
    return "yes" if only_simulated else "no"


def is_from(path: Path, only_simulated: bool) -> bool:
    """Return whether an archive is from this kind of arm; False for a damaged one."""
    try:
        return open_archive(path, fields=()).header.simulated == yes_or_no(only_simulated)
    except ArchiveError:
        return False


def agreement(gravity: Array, torque: Array, velocity: Array, moving: NDArray[np.bool_]) -> Array:
    """Return the correlation of gravity and torque without friction, -1 to 1, per joint (n,).

    At 20 % of full speed inertial torques are negligible. Coulomb and viscous friction are removed
    from both by regression, without a constant: the sign of a constant load counts as well. A
    wrong sign of torque, joint or zero position makes the correlation negative.

    Args:
        gravity: by the model (m, n) [N·m].
        torque: measured (m, n) [N·m].
        velocity: (m, n) [rad/s].
        moving: rows (m, n) in which a joint moves, so that the sign of its friction is known.

    Returns:
        NaN for a joint that moves too little, or with too little gravity.
    """
    correlation = np.full(gravity.shape[1], np.nan)
    for joint in range(len(correlation)):
        rows = moving[:, joint]
        if rows.sum() < _MIN_SAMPLES:
            continue
        speed = velocity[rows, joint]
        both = np.column_stack([gravity[rows, joint], torque[rows, joint]])
        rms = np.sqrt(np.mean(both[:, 1] ** 2))
        friction = np.column_stack([np.sign(speed), speed])
        residual = both - friction @ np.linalg.lstsq(friction, both, rcond=None)[0]
        weight, measured = np.linalg.norm(residual, axis=0)
        if weight > _MIN_GRAVITY_SHARE * rms * np.sqrt(rows.sum()) and measured > 0.0:
            correlation[joint] = residual[:, 0] @ residual[:, 1] / (weight * measured)
    return correlation


@dataclass(frozen=True)
class Acceptance:
    """Acceptance of a dry run: name of the user on this computer, and time, ISO 8601."""

    by: str
    at: str


@dataclass(frozen=True)
class DryRunRecord:
    """A completed dry run; `dry_run.json`.

    Attributes:
        override: largest share of the planned speed.
        archives: file names, one for each motion of the plan.
        duration: of the motions [s].
        simulated: whether only a simulated arm can have moved.
        current_share: (n) largest current as a share of its limit.
        following_error: (n) largest [rad].
        missed, late: packets that never arrived, and whose reply was late.
        accepted: None until it is.
        against_gravity: joints whose torque has the opposite sign of the model's gravity.
        gravity_not_seen: joints with too little gravity to be compared.
        assumed_payload: whether the model had a payload whose mass and centre are assumed.
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
    assumed_payload: bool = False

    def __post_init__(self) -> None:
        if not len(self.joint_names) == len(self.current_share) == len(self.following_error):
            raise ValueError("there is not one current and one following error for each joint")

    @classmethod
    def load(cls, folder: CampaignFolder, plan_hash: str | None = None) -> Self | None:
        """Return the dry run of a plan (by default the folder's) from its file; None without one.

        Raises:
            CampaignFolderError: the file cannot be read, or is of another version.
        """
        remedy = "remove it; its archives are evaluated again, or the dry run is repeated"
        record = load_record(cls, folder.dry_run, remedy, version=FORMAT_VERSION)
        present = folder.plan_hash if plan_hash is None and record is not None else plan_hash
        return record if record is not None and record.plan_hash == present else None

    @classmethod
    def load_valid(
        cls, folder: CampaignFolder, *, plan_hash: str, motions: int, simulated: bool
    ) -> Self | None:
        """Return the dry run of a plan on this kind of arm whose archives are all there, or None.

        A dry run of a simulated arm does not cover the surroundings of a real one.

        Args:
            folder: of the campaign.
            plan_hash: of the plan.
            motions: their number.
            simulated: whether the arm is.
        """
        record = cls.load(folder, plan_hash)
        if record is None or record.simulated is not simulated:
            return None
        paths = folder.completed("dryrun")[:motions]
        if len(paths) < motions or [path.name for path in paths] != [*record.archives]:
            return None
        return record if all(is_from(path, simulated) for path in paths) else None

    @classmethod
    def of(
        cls, campaign: CampaignState, names: Sequence[str], *, plan_hash: str, simulated: bool
    ) -> Self:
        """Return the dry run from its archives.

        Args:
            campaign: state of its folder.
            names: of the archives.
            plan_hash: of the plan.
            simulated: whether the arm is.
        """
        folder = campaign.folder
        cell = campaign.cell
        limit = cell.drive_train.current_limit
        step = max(1, round(_SAMPLE_PERIOD / cell.period))
        current = np.zeros(len(limit))
        following = np.zeros(len(limit))
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
            rest = Motion.at_rest(q)
            model = cell.model
            rigid = np.where(model.friction_columns, 0.0, cell.nominal_values())
            gravity = model.torque(rigid, rest) + model.load_torque(rest)
            correlation = agreement(gravity, torque, qd, model.moving(qd))
        joints = np.array(cell.joint_names)
        return cls(
            plan_hash=plan_hash,
            override=MAX_DRY_RUN_OVERRIDE,
            archives=tuple(names),
            duration=cycles * cell.period,
            simulated=simulated,
            joint_names=cell.joint_names,
            current_share=tuple(current.tolist()),
            following_error=tuple(following.tolist()),
            missed=missed,
            late=late,
            against_gravity=tuple(joints[correlation < -MIN_GRAVITY_CORRELATION].tolist()),
            gravity_not_seen=tuple(
                joints[~(np.abs(correlation) >= MIN_GRAVITY_CORRELATION)].tolist()
            ),
            assumed_payload=cell.assumes_payload,
        )

    def save(self, path: Path) -> None:
        """Write the file (OutputError if the disk refuses)."""
        save_record(path, self, FORMAT_VERSION)

    def accepted_now(self) -> DryRunRecord:
        """Return this dry run, accepted by the user of this program."""
        try:
            user = getpass.getuser()
        except (OSError, KeyError):  # a user without a name
            user = "unknown"
        at = datetime.now(UTC).isoformat(timespec="seconds")
        return replace(self, accepted=Acceptance(user, at))
