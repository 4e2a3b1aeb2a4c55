"""Measured torque over the torque of nominal inertias.

A torque constant or gear ratio wrong by a factor fits equally well: only independent knowledge
shows it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import student_limit
from identification.estimators.prior import nominal_deviations
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_MAX_ROWS: Final = 5_000  # that are compared with the nominal torque
_BLOCKS: Final = 20  # parts of the recordings whose scatter gives the standard deviation
# Model error of friction laws relative to the friction (Bittencourt and Gunnarsson 2012).
_FRICTION_ERROR_SHARE: Final = 0.03
# relative tolerance for noise and friction above which a scale is unknown
_MAX_TOLERANCE: Final = 0.5
# Weight of independent errors of links, where friction dominates the torque. On a simulated UR5
# with link errors up to 10 % all scales were within 7 %.
_LINK_ERROR_WEIGHT: Final = 0.05
_SIGMAS_OF_SCALE: Final = 2.0  # standard deviations
_OTHER_UNIT_RATIO: Final = 3.0


class NominalScale(NamedTuple):
    """Ratio of measured to nominal torque of n axes."""

    scale: Array  # (n,), NaN where the nominal torque is too small
    # half a 95 % interval with errors of nominal torque and friction law (n,); infinite likewise
    tolerance: Array
    noise: Array  # the same with errors of noise and friction law alone (n,)

    @property
    def nonzero(self) -> NDArray[np.bool_]:
        """Whether each axis shows any torque of the nominal bodies, whatever its unit (n,)."""
        return np.asarray(np.abs(self.scale) > self.noise)

    @property
    def off(self) -> NDArray[np.bool_]:
        """Whether the scale of each axis differs significantly from 1 (n,)."""
        # A factor that may be zero does not determine the nominal torque.
        determined = np.abs(self.scale) > self.tolerance
        return determined & (np.abs(self.scale - 1.0) > self.tolerance)

    @property
    def common(self) -> float:
        """Factor common to most axes, such as a wrong unit or motor torques; 1 if there is none."""
        positive = np.isfinite(self.scale) & (self.scale > 0.0)
        if np.count_nonzero(positive) < 2:
            return 1.0
        logs = np.log(self.scale[positive])
        sure = np.abs(self.scale[positive] - 1.0) > self.tolerance[positive]
        alike = sure & (np.abs(logs) > np.log(_OTHER_UNIT_RATIO)) & (logs * np.median(logs) > 0.0)
        most = np.count_nonzero(alike) > len(logs) / 2
        return float(np.exp(np.median(logs))) if most else 1.0

    @property
    def negated(self) -> bool:
        """Whether all known scales are negative, at least two, or one joint significantly."""
        finite_scale = self.scale[np.isfinite(self.scale)]
        sure = np.count_nonzero(self.scale + self.tolerance < 0.0)
        return bool(sure >= min(2, len(self.scale)) and np.all(finite_scale < 0.0))

    def without(self, joints: Iterable[int]) -> NominalScale:
        """Return the scales with some axes unknown."""
        scale = self.scale.copy()
        scale[sorted(set(joints))] = np.nan
        return self._replace(scale=scale)


def nominal_scale(
    model: RobotModel,
    nominal: Array,
    runs: Sequence[Samples],
    *,
    rotors_known: bool = False,
    share: float | None = None,
) -> NominalScale:
    """Compare measured torque with nominal parameters per axis, without friction.

    Args:
        model: of the arm.
        nominal: parameters (p,).
        runs: prepared recordings.
        rotors_known: whether the nominal parameters include rotor inertias.
        share: relative standard deviation of the nominal torque, by default that of bodies as
            uncertain as in :func:`identification.estimators.prior.body_prior`.
    """
    bodies = nominal_deviations(model) if share is None else np.zeros((model.base.rank, 0))
    if all(run.torque_bandwidth is None for run in runs):
        step = max(1, sum(len(run.torque) for run in runs) // _MAX_ROWS)
        runs = [run.thinned(step) for run in runs]
    scales = []
    regressors = [run.regressor(model) for run in runs]
    for joint in range(model.n_joints):
        columns = regressors[0].columns[joint]
        turning = [joint]
        inertial = columns < model.base.rank
        if model.coupling is not None:
            turns = model.coupling.motor_from_joint
            turning = sorted({joint, *np.flatnonzero((turns.T @ turns)[joint]).tolist()})
        tables = []
        torques = []
        deviations = []
        for run, (blocks, _) in zip(runs, regressors, strict=True):
            rows = run.usable[:, joint]
            block = blocks[joint]
            table = [block[:, inertial] @ nominal[columns[inertial]], block[:, ~inertial]]
            if not rotors_known:
                table.append(run.as_measured(joint, run.motion.acceleration[:, turning]))
            tables.append(np.column_stack(table)[rows])
            torques.append(run.torque[rows, joint])
            deviations.append((block[:, inertial] @ bodies[columns[inertial]])[rows])
        whole = (np.concatenate(parts) for parts in (tables, torques, deviations))
        scales.append(_scale(*whole, share=share or 0.0))
    return NominalScale(*np.array(scales).T)


def _scale(
    table: Array, torque: Array, deviations: Array, *, share: float
) -> tuple[float, float, float]:
    """Return the coefficient of the first column, tolerance and noise; NaN if uncertain.

    The first column deviates by a share of itself and by each of `deviations`.
    """
    rigid = table[:, 0]
    others = table[:, 1:]
    if len(torque) < 10 * _BLOCKS or not rigid.any():
        return np.nan, np.inf, np.inf
    length = np.linalg.norm(others, axis=0)
    basis, _ = np.linalg.qr(others[:, length > 0.0] / length[length > 0.0])
    # Part of the nominal torque that friction does not explain.
    alone = rigid - basis @ (basis.T @ rigid)
    power = float(alone @ alone)
    if not power > 1e-12 * float(rigid @ rigid):
        return np.nan, np.inf, np.inf
    scale = float(alone @ torque) / power
    friction = basis @ (basis.T @ (torque - scale * rigid))
    residuals = np.array_split(alone * (torque - scale * rigid - friction), _BLOCKS)
    scatter = np.square([part.sum() for part in residuals]).sum()
    std = np.sqrt(scatter * _BLOCKS / (_BLOCKS - 1)) / power
    lost = float(rigid @ rigid) / power - 1.0
    misfit = _FRICTION_ERROR_SHARE * np.linalg.norm(friction) / np.sqrt(power)
    bodies = float(np.linalg.norm(alone @ deviations)) / power
    of_torque = share**2 * (1.0 + _LINK_ERROR_WEIGHT * lost)
    model_error = _SIGMAS_OF_SCALE * float(np.sqrt(of_torque + bodies**2 + misfit**2))
    noise = student_limit(0.025, _BLOCKS - 1) * std
    of_friction = noise + _SIGMAS_OF_SCALE * misfit
    tolerance = noise + model_error
    # Tolerances scale with the unit of the torque. Uncertain bodies alone leave a scale known.
    unit = max(1.0, abs(scale))
    if not (of_friction < _MAX_TOLERANCE * unit and tolerance < unit):
        return np.nan, np.inf, np.inf
    return scale, float(tolerance), float(of_friction)
