"""Warm-up: the excitation is repeated until friction hardly changes from motion to motion.

The measure is the mean friction torque of a joint along a motion that begins and ends at rest:

    F_j = (∫ tau_j qd_j dt - ∫ tau_rigid,j qd_j dt) / ∫ |qd_j| dt.

The rigid part is that of the nominal model on the planned motion, the same in each repetition: its
error cancels in every change. The change per motion is the Theil-Sen slope of the last motions (the
median of all slopes between two of them), as a share of the friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np

from hil.archive import open_archive
from hil.archive.campaign_archives import load_record
from hil.base.arrays import Array
from hil.cell import Cell
from identification.arrays import root_mean_square
from identification.model.motion import Motion
from planner import FourierSeries, PiecewiseCubic

from .folder import save_record

DEFAULT_DRIFT: Final = 0.002
"""Change per motion below which a real arm is warm. Thirty repetitions then change friction by some
per cent at most; with half a minute each and the usual time constant of 20 min the slope falls to
it from 1 % within about 40 motions."""
DRIFT_WINDOW_MOTIONS: Final = 4  # Motions of which the slope is computed
COLD_AFTER_SECONDS: Final = 600.0  # s without motion after which the joints are assumed to be cold
FORMAT_VERSION: Final = 2  # 1 had no time of the last motion
_FIELDS: Final = ("torque", "commanded_position", "position")
_MIN_FRICTION_SHARE: Final = 0.02
"""Share of a joint's rms torque below which its friction cannot be measured."""
_MIN_TRAVEL: Final = 1e-2  # rad of travel below which the friction of a joint cannot be measured


def drift_wanted(cell: Cell, *, only_simulated: bool | None = None) -> float:
    """Return the change per motion below which the arm is warm; 0 for no warm-up.

    It depends on whether only a simulated arm can move, by default as the cell's own link.
    """
    wanted = cell.campaign.warmup_drift
    if wanted is not None:
        return wanted
    simulated = cell.only_simulated if only_simulated is None else only_simulated
    return 0.0 if simulated else DEFAULT_DRIFT


@dataclass(frozen=True)
class WarmMotion:
    """Archive of a motion of a warm-up, and friction of each joint (n) [N·m], None if unknown."""

    archive: str
    friction: tuple[float | None, ...]


@dataclass(frozen=True)
class WarmUpRecord:
    """Warm-up of a campaign; `warmup.json`.

    Attributes:
        threshold: change per motion below which the arm is warm.
        motions: of the present warm-up, in order.
        outcome: "going on", "warm", or "not warm" after the largest number of motions.
        earlier: motions of earlier warm-ups, before the arm cooled down in a pause; oldest first.
        moved_at: end of the last motion that warms the joints [s since 1970]; None if unknown.
    """

    plan_hash: str
    joint_names: tuple[str, ...]
    threshold: float
    motions: tuple[WarmMotion, ...] = ()
    outcome: Literal["going on", "warm", "not warm"] = "going on"
    earlier: tuple[WarmMotion, ...] = ()
    moved_at: float | None = None

    def __post_init__(self) -> None:
        if any(len(motion.friction) != len(self.joint_names) for motion in self.motions):
            raise ValueError("a motion has not one friction for each joint")

    @classmethod
    def load(cls, path: Path, plan_hash: str) -> Self | None:
        """Read the file; return None without one for this plan (CampaignFolderError if damaged)."""
        record = load_record(cls, path, "remove that file")
        return record if record is not None and record.plan_hash == plan_hash else None

    def save(self, path: Path) -> None:
        """Write the file (OutputError if the disk refuses)."""
        save_record(path, self, FORMAT_VERSION)

    def cold(self, now: float) -> bool:
        """Return whether the joints have cooled down by `now` [s since 1970].

        They have if the last motion has no time, or one in the future (a clock was reset).
        """
        return self.moved_at is None or not 0.0 <= now - self.moved_at <= COLD_AFTER_SECONDS

    @property
    def changes(self) -> list[float]:
        """Largest change of any joint's friction up to each motion, as a share; NaN if unknown."""
        friction = np.array([motion.friction for motion in self.motions], dtype=np.float64)
        friction = friction.reshape(len(self.motions), len(self.joint_names))
        return [change_per_motion(friction[: k + 1]) for k in range(len(friction))]

    def with_motion(self, archive: str, friction: Array, least: int, most: int) -> WarmUpRecord:
        """Return this warm-up after another motion, with its new outcome.

        Args:
            archive: of the motion.
            friction: during it (n,) [N·m].
            least: motions.
            most: motions.
        """
        joint_friction = tuple(float(f) if np.isfinite(f) else None for f in friction)
        longer = replace(self, motions=(*self.motions, WarmMotion(archive, joint_friction)))
        done = len(longer.motions)
        change = longer.changes[-1]
        if done >= max(least, DRIFT_WINDOW_MOTIONS) and change <= self.threshold:
            return replace(longer, outcome="warm")
        unknown = done >= least and np.isnan(change)  # and would be after more motions
        return replace(longer, outcome="not warm") if unknown or done >= most else longer

    def cooled(self) -> WarmUpRecord:
        """Return a new warm-up after the arm cooled down."""
        earlier = (*self.earlier, *self.motions)
        return replace(self, motions=(), outcome="going on", earlier=earlier)

    def rest_before(self, now: float) -> float | None:
        """Return how long the arm has rested [s]; None if that is unknown."""
        if self.moved_at is None or now < self.moved_at:
            return None
        return now - self.moved_at


def change_per_motion(friction: Sequence[Array] | Array) -> float:
    """Return the largest change of friction (k, n) [N·m] per motion of any joint, as a share.

    NaN for fewer than two motions, or if no joint moves.
    """
    last = np.asarray(friction, dtype=np.float64)[-DRIFT_WINDOW_MOTIONS:]
    moves = np.isfinite(last).all(axis=0) if len(last) else np.zeros(0, bool)
    if len(last) < 2 or not moves.any():
        return float("nan")
    # Theil-Sen slope: one disturbed motion does not change it.
    first, second = np.triu_indices(len(last), k=1)
    moving_joints = last[:, moves]
    slopes = np.median(
        (moving_joints[second] - moving_joints[first]) / (second - first)[:, None], axis=0
    )
    return float(np.max(np.abs(slopes) / np.abs(np.median(moving_joints, axis=0))))


class FrictionMeter:
    """Measures the friction of archived repetitions of one motion."""

    def __init__(self, cell: Cell, trajectory: PiecewiseCubic | FourierSeries) -> None:
        self._period = cell.period
        self._trajectory = trajectory
        model = cell.model
        values = cell.nominal_values()
        rigid = np.where(model.friction_columns, 0.0, values)
        times = np.arange(0.0, trajectory.duration, cell.period)
        motion = Motion(times, *trajectory.sample(times))
        torque = model.torque(rigid, motion) + model.load_torque(motion)
        self._rigid_work = (torque * motion.velocity).sum(axis=0) * cell.period
        self._way = np.abs(motion.velocity).sum(axis=0) * cell.period

    def measure(self, path: Path) -> Array:
        """Return the mean friction torque of each joint (n,) [N·m]; NaN where it is unknown."""
        columns = open_archive(path, fields=_FIELDS).recorded(*_FIELDS)
        rows = ~np.isnan(columns["commanded_position"]).any(axis=1)
        torque = columns["torque"][rows]
        # Measured, not commanded: with a lag, inertial torque does work on the commanded motion.
        work = (torque * np.gradient(columns["position"][rows], axis=0)).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            friction = (work - self._rigid_work) / self._way
        rms = root_mean_square(torque)
        measurable = (self._way > _MIN_TRAVEL) & (np.abs(friction) > _MIN_FRICTION_SHARE * rms)
        return np.where(measurable, friction, np.nan)
