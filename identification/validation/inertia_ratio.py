"""The controller's own diagonal of the inertia matrix against that of the identified model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.model.robot import RobotModel
from identification.validation.findings.finding import Finding, joined

Array = NDArray[np.float64]

_OFF: Final = 0.2  # a maker's figures are good to ten per cent; twice that is worth a word


@dataclass(frozen=True, eq=False)
class InertiaRatio:
    """Controller's over identified inertia of each joint, rotors included, on the joint side.

    Attributes:
        joint_names: (n,).
        ratio: median over the postures (n,); NaN where the controller sends zero, or where the
            data leave the model's own inertia open.
        spread: standard deviation over the postures of the ratio (n,), NaN likewise.
    """

    joint_names: tuple[str, ...]
    ratio: Array
    spread: Array

    def findings(self) -> list[Finding]:
        """What a verdict says; nothing where there is nothing to compare."""
        known = np.flatnonzero(np.isfinite(self.ratio)).tolist()
        if not known:
            return []
        off = [j for j in known if not 1.0 / (1.0 + _OFF) <= self.ratio[j] <= 1.0 + _OFF]

        def words(joints: Sequence[int]) -> str:
            return joined([f"{self.joint_names[j]} {self.ratio[j]:.2f}" for j in joints])

        if not off:
            text = "the controller's own inertia of each joint is about the identified one, times "
            return [Finding("against the controller's inertia", "good", text + words(known))]
        names = joined([self.joint_names[j] for j in off])
        return [
            Finding(
                "against the controller's inertia",
                "doubtful",
                "the controller's own inertia (joint side, rotors included) is not the identified"
                f" one, but times {words(off)}",
                f"check torque constant and gear ratio of {names}, and what the arm carries",
            )
        ]


def diagonal_inertia(model: RobotModel, values: Array, position: Array) -> Array:
    """Diagonal of the inertia matrix, rotors included, at positions (m, n): (m, n) [kg·m² or kg].

    From the base parameters (p,): the torque that one joint's acceleration alone takes, which is
    the same for all standard parameters behind them.
    """
    n = model.n_joints
    if position.ndim != 2 or position.shape[1] != n:
        raise ShapeError("position", position.shape, f"(m, {n})")
    rigid = values.copy()
    rigid[model.base.rank :] = 0.0
    still = np.zeros_like(position)
    rest = model.torque(rigid, position, still, still)
    result = np.empty_like(position)
    for joint in range(n):
        acceleration = still.copy()
        acceleration[:, joint] = 1.0
        result[:, joint] = (model.torque(rigid, position, still, acceleration) - rest)[:, joint]
    return result


def inertia_ratio(
    model: RobotModel, values: Array, position: Array, theirs: Array
) -> InertiaRatio | None:
    """Compare the controller's diagonal inertia (m, n) at positions (m, n) with the model's.

    Args:
        model: the robot.
        values: parameters (p,).
        position: of the joints [rad or m].
        theirs: joint side [kg·m² or kg]; zero where the controller sends nothing.

    Returns:
        None where there is nothing to compare.
    """
    if not np.any(theirs):
        return None
    ours = diagonal_inertia(model, values, position)
    known = (ours > 0.0) & (theirs > 0.0)
    ratio = np.where(known, theirs, np.nan) / np.where(known, ours, 1.0)
    whole = known.mean(axis=0) > 0.9
    median, spread = np.full(model.n_joints, np.nan), np.full(model.n_joints, np.nan)
    median[whole] = np.nanmedian(ratio[:, whole], axis=0)
    spread[whole] = np.nanstd(ratio[:, whole], axis=0)
    return InertiaRatio(model.joint_names, median, spread)
