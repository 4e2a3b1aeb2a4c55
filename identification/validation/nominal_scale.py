"""How large each axis's torque is beside what the nominal inertias ask for.

A torque constant or gear ratio that is wrong by a factor fits as well as ever; only knowledge from
elsewhere can tell. Friction is free in the comparison, and so are unknown rotor inertias.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.errors import IdentificationError
from identification.estimators.prior import NOMINAL_SHARE
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.plausibility import inertia_matrices

Array = NDArray[np.float64]

_BLOCKS: Final = 20  # stretches of the recordings whose scatter gives the standard deviation
# What a friction law does not describe, as a share of the friction (Bittencourt and Gunnarsson
# 2012: some per cent with speed, load and position).
_FRICTION_SHARE: Final = 0.03
_WIDEST: Final = 0.5  # a tolerance, as a share of the scale, above which an axis says nothing
# Links are wrong each in its own way, which counts where friction takes most of the torque. On a
# simulated UR5 whose links were off by up to 10 % each no scale was off by more than 7 %.
_LINKS_APART: Final = 0.05
_SURE: Final = 2.0  # standard deviations
_OTHER_UNIT: Final = 3.0


class NominalScale(NamedTuple):
    """Measured over nominal torque, n axes."""

    scale: Array  # (n,), NaN for an axis on which the nominal torque carries too little
    # what is no wonder in it (n,): half a 95 % interval, and what a wrong nominal torque and a
    # friction that its law does not describe may do; infinite likewise
    tolerance: Array

    @property
    def off(self) -> NDArray[np.bool_]:
        """Whether the scale of each axis is a wonder (n,)."""
        # Of a factor that may as well be zero, the nominal torque is not part of what was measured.
        known = (self.tolerance < _WIDEST) & (np.abs(self.scale) > self.tolerance)
        return known & (np.abs(self.scale - 1.0) > self.tolerance)

    @property
    def common(self) -> float:
        """Factor by which most axes are off alike: 1 where they are not.

        Of a single axis a factor this large may be a nominal torque that is next to nothing beside
        friction; of most axes it is a unit, or torques of the motors mistaken for those of the
        joints.
        """
        known = np.isfinite(self.scale) & (self.scale > 0.0)
        if np.count_nonzero(known) < 2:
            return 1.0
        logs = np.log(self.scale[known])
        sure = np.abs(self.scale[known] - 1.0) > self.tolerance[known]
        alike = sure & (np.abs(logs) > np.log(_OTHER_UNIT)) & (logs * np.median(logs) > 0.0)
        most = np.count_nonzero(alike) > len(logs) / 2
        return float(np.exp(np.median(logs))) if most else 1.0

    @property
    def negated(self) -> bool:
        """Whether the torque of every axis that says something has the other sign."""
        known = np.isfinite(self.scale)
        enough = np.count_nonzero(known) >= min(2, len(known))
        return bool(enough and np.all(self.scale[known] + self.tolerance[known] < 0.0))

    def without(self, joints: Iterable[int]) -> NominalScale:
        """The same with nothing said of some axes."""
        scale = self.scale.copy()
        scale[sorted(set(joints))] = np.nan
        return self._replace(scale=scale)


def nominal_scale(
    model: RobotModel,
    nominal: Array,
    runs: Sequence[Samples],
    *,
    rotors_known: bool = False,
    share: float = NOMINAL_SHARE,
) -> NominalScale:
    """Compare measured torque with that of nominal parameters (p,), axis by axis, without friction.

    `rotors_known`: the nominal parameters hold the rotors' inertias; `share`: standard deviation of
    the nominal torque, as a share of it.

    Raises:
        IdentificationError: no recording.
    """
    if not runs:
        raise IdentificationError("there is no recording to compare with the nominal model")
    found, regressors = [], [run.regressor(model) for run in runs]
    for joint in range(model.n_joints):
        columns, turning = regressors[0].columns[joint], [joint]
        inertial = columns < model.base.rank
        if model.coupling is not None:  # coupled motors feel other joints' accelerations, too
            turns = model.coupling.motor_from_joint
            turning = sorted({joint, *np.flatnonzero((turns.T @ turns)[joint]).tolist()})
        tables, torques = [], []
        for run, (blocks, _) in zip(runs, regressors, strict=True):
            rows, block = run.usable[:, joint], blocks[joint]
            table = [block[:, inertial] @ nominal[columns[inertial]], block[:, ~inertial]]
            if not rotors_known:
                table.append(run.as_measured(joint, run.motion.acceleration[:, turning]))
            tables.append(np.column_stack(table)[rows])
            torques.append(run.torque[rows, joint])
        found.append(_scale(np.concatenate(tables), np.concatenate(torques), share))
    return NominalScale(*np.array(found).T)


def _scale(table: Array, torque: Array, share: float) -> tuple[float, float]:
    """Coefficient of the first column and what is no wonder in it; NaN if it says little."""
    rigid, others = table[:, 0], table[:, 1:]
    if len(torque) < 10 * _BLOCKS or not rigid.any():
        return np.nan, np.inf
    size = np.linalg.norm(others, axis=0)
    basis, _ = np.linalg.qr(others[:, size > 0.0] / size[size > 0.0])
    # What friction does not explain of the nominal torque as well.
    alone = rigid - basis @ (basis.T @ rigid)
    power = float(alone @ alone)
    if not power > 1e-12 * float(rigid @ rigid):
        return np.nan, np.inf
    scale = float(alone @ torque) / power
    friction = basis @ (basis.T @ (torque - scale * rigid))
    left = np.array_split(alone * (torque - scale * rigid - friction), _BLOCKS)
    scatter = np.square([part.sum() for part in left]).sum()
    std = np.sqrt(scatter * _BLOCKS / (_BLOCKS - 1)) / power
    lost = float(rigid @ rigid) / power - 1.0
    misfit = _FRICTION_SHARE * np.linalg.norm(friction) / np.sqrt(power)
    wonder = _SURE * float(np.sqrt(share**2 * (1.0 + _LINKS_APART * lost) + misfit**2))
    tolerance = student_limit(0.025, _BLOCKS - 1) * std + wonder
    # Friction and noise have the unit of the torque, so a tolerance is large where the scale is.
    known = tolerance < _WIDEST * max(1.0, abs(scale))
    return (scale, float(tolerance)) if known else (np.nan, np.inf)


class InertiaRatio(NamedTuple):
    """Controller's over identified inertia of each joint, rotors included, on the joint side."""

    # median over the postures (n,); NaN where the controller sends zero, or where the data leave
    # the model's own inertia open
    ratio: Array
    spread: Array  # standard deviation over the postures of the ratio (n,), NaN likewise


def inertia_ratio(
    model: RobotModel, values: Array, position: Array, theirs: Array
) -> InertiaRatio | None:
    """Compare a diagonal inertia (m, n) at positions (m, n) [rad or m] with that of values (p,).

    The controller's, `theirs`, is on the joint side [kg·m² or kg], zero where it sends nothing;
    None where there is nothing to compare.
    """
    if not np.any(theirs):
        return None
    ours = np.diagonal(inertia_matrices(model, values, position), axis1=1, axis2=2)
    known = (ours > 0.0) & (theirs > 0.0)
    ratio = np.where(known, theirs, np.nan) / np.where(known, ours, 1.0)
    whole = known.mean(axis=0) > 0.9
    median, spread = np.full((2, model.n_joints), np.nan)
    median[whole] = np.nanmedian(ratio[:, whole], axis=0)
    spread[whole] = np.nanstd(ratio[:, whole], axis=0)
    return InertiaRatio(median, spread)
