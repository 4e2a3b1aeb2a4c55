"""Whether the torques of slow motion carry the weight that the nominal model gives the arm.

At a fifth of full speed inertia is next to nothing: what a joint's torque is beside friction is
gravity. The measured torque is regressed on the nominal model's gravity with Coulomb and viscous
friction beside it; the correlation of what friction leaves of both tells whether they agree. A
torque of the wrong sign, a `joint_sign` or zero position that mirrors the arm, or masses that are
not there make it negative. There is no constant beside them: the sign of a weight that hardly
changes counts as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.cell import Cell

Array = NDArray[np.float64]

AGAINST: Final = (
    "measured torque runs against the model's gravity: joint_sign, URDF or torque sign may be wrong"
)
CLEAR: Final = 0.5
"""Correlation from which torque and gravity belong together, or against each other."""
_LEAST_SHARE: Final = 0.05
"""Gravity as a share of the rms torque below which the joint has none to speak of."""
_LEAST_SAMPLES: Final = 100
_STEP: Final = 0.01
"""s between samples that are looked at."""
_FIELDS: Final = ("position", "commanded_position", "torque")


@dataclass(frozen=True)
class GravityCheck:
    """What slow motion says of the sign of each joint's torque.

    Attributes:
        against: joints whose torque runs against the model's gravity.
        not_seen: joints with too little gravity, beside friction, to tell.
    """

    against: tuple[str, ...]
    not_seen: tuple[str, ...]

    @classmethod
    def of(cls, cell: Cell, paths: Sequence[Path]) -> GravityCheck:
        """What the archives of a dry run say.

        Raises:
            ArchiveError: one of them cannot be read.
        """
        parts = [_slow_motion(path, cell.period) for path in paths]
        q, qd, torque = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        still, model = np.zeros_like(q), cell.model
        rigid = np.where(model.friction_columns, 0.0, cell.nominal_values())
        gravity = model.torque(rigid, q, still, still) + model.load_torque(q, still, still)
        found = agreement(gravity, torque, qd, model.moving(qd))
        names = np.array(cell.joint_names)
        return cls(
            against=tuple(names[found < -CLEAR].tolist()),
            not_seen=tuple(names[~(np.abs(found) >= CLEAR)].tolist()),
        )


def agreement(gravity: Array, torque: Array, velocity: Array, moving: NDArray[np.bool_]) -> Array:
    """Correlation of gravity and torque beside friction, -1 to 1, for each joint (n,).

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


def _slow_motion(path: Path, period: float) -> tuple[Array, Array, Array]:
    """Position, planned velocity and torque (m, n) of one archive, each every `_STEP`."""
    columns = open_archive(path, fields=_FIELDS).recorded(*_FIELDS)
    commanded = columns["commanded_position"]
    step = max(1, round(_STEP / period))
    rows = np.flatnonzero(~np.isnan(commanded).any(axis=1))[::step]
    if len(rows) < 2:
        empty = np.zeros((0, commanded.shape[1]))
        return empty, empty, empty
    velocity = np.gradient(commanded[rows], step * period, axis=0)
    return columns["position"][rows], velocity, columns["torque"][rows]
