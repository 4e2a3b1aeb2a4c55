r"""Friction, rotor inertia, servo and delay fitted to simulated windows, from a regression on.

.. math:: \hat x = \arg\min \sum_{w,h,j} (e_{whj}(x) / s_{hj})^2 + N_w \lambda^2 \lVert x \rVert^2

over position errors e at the horizons; s is their root mean square before, so that every joint and
horizon counts alike, and x are changes in units of what they may be wrong by. The minimiser is that
of MuJoCo's system identification, `mujoco.minimize`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, root_mean_square
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import load_mujoco
from identification.rollout.mujoco_simulation import MAX_POSITION_ERROR, Feedback
from identification.rollout.position_errors import (
    RecordedMotion,
    horizon_rows,
    joint_inertia,
    simulate,
)
from identification.rollout.servo_by_torque import MAX_SERVO_DELAY

_CHANGE_WEIGHT: Final = 0.03  # lambda: of a change by one unit, beside an error that stays as it is
_LOG_UNIT: Final = 0.3  # of the logarithm of friction and gains
_DELAY_UNIT: Final = 5e-3  # s
_ROTOR_UNIT: Final = 0.3  # of the logarithm of the inertia that the joint turns, rotor included
_DIFFERENCE_STEP: Final = 0.02  # of finite differences: dry friction makes the error rough
_MAX_CHANGE: Final = 5.0  # change of a quantity, in its units
_MAX_ROTOR_CHANGE: Final = 10.0  # likewise: twenty times the inertia
_MAX_ITERATIONS: Final = 8
_RELATIVE_TOLERANCE: Final = 1e-3  # relative change
_DRY = ("f0", "fl")
_VISCOUS = ("f1", "f2")


@dataclass(frozen=True, eq=False)
class Driven:
    """An arm and what drives it along a motion."""

    arm: ExportedArm
    motion: RecordedMotion
    feedback: Feedback

    def on(self, motion: RecordedMotion) -> Driven:
        """Return the arm, its servo and its delay on the windows of another motion."""
        driven_motion = self.motion
        return replace(
            self, motion=replace(motion, servo=driven_motion.servo, delay=driven_motion.delay)
        )

    def positions(self) -> Array:
        """Return the simulated positions at the horizons (w, h, n)."""
        return simulate(self.arm, self.motion, self.feedback)

    def residuals(self) -> Array:
        """Return position errors at the horizons (w, h, n), `MAX_POSITION_ERROR` where unstable."""
        windows = self.motion.windows
        simulated = self.positions()
        measured = windows.reached[:, horizon_rows(windows)]
        return np.where(np.isfinite(simulated), simulated - measured, MAX_POSITION_ERROR)


class PolishedQuantity(NamedTuple):
    """What a polish changes, by a number in its unit."""

    change: Callable[[Driven, float], Driven]
    lower: float = -_MAX_CHANGE
    upper: float = _MAX_CHANGE


def polished(start: Driven) -> Driven:
    """Return the arm with friction, rotors, servo and delay of least error on its windows.

    Raises:
        NotSimulatedError: MuJoCo does not accept the arm.
        MissingMujocoError: MuJoCo is not installed.
    """
    load_mujoco()
    from mujoco import minimize  # optional dependency

    quantities = _quantities(start)
    size = root_mean_square(start.residuals())
    scale = np.where(size > 0.0, size, 1.0) * np.sqrt(len(start.motion.windows))

    def residuals(columns: Array) -> Array:
        columns_of_errors = []
        for changes in np.atleast_2d(columns.T):
            errors = _changed(start, quantities, changes).residuals() / scale
            columns_of_errors.append(np.concatenate([errors.ravel(), _CHANGE_WEIGHT * changes]))
        return np.column_stack(columns_of_errors)

    best, _ = minimize.least_squares(
        np.zeros(len(quantities)),
        residuals,
        bounds=[
            np.array([getattr(quantity, end) for quantity in quantities])
            for end in ("lower", "upper")
        ],
        eps=_DIFFERENCE_STEP,
        xtol=_RELATIVE_TOLERANCE,
        max_iter=_MAX_ITERATIONS,
        verbose=minimize.Verbosity.SILENT,
    )
    return _changed(start, quantities, np.asarray(best).ravel())


def _changed(start: Driven, quantities: list[PolishedQuantity], changes: Array) -> Driven:
    driven = start
    for quantity, change in zip(quantities, changes.tolist(), strict=True):
        driven = quantity.change(driven, change)
    return driven


def _quantities(start: Driven) -> list[PolishedQuantity]:
    """Return what a polish changes; friction that was identified as none stays so."""
    arm = start.arm
    servo = start.motion.servo
    model = arm.model
    quantities = list[PolishedQuantity]()
    for joint in range(model.n_joints):
        for symbols in (_DRY, _VISCOUS):
            chosen = [
                friction_term.owner == joint and friction_term.symbol in symbols
                for friction_term in model.friction.terms
            ]
            rows = model.friction_part.start + np.flatnonzero(chosen)
            if arm.values[rows].any():
                quantities.append(PolishedQuantity(partial(_with_friction, rows)))
    if model.layout.rotor_inertia:
        rotors = arm.standard[model.layout.rotors].tolist()
        inertias = joint_inertia(arm, start.motion.windows.step).tolist()
        for joint, (rotor, inertia) in enumerate(zip(rotors, inertias, strict=True)):
            # A rotor of a wrist, seen through its gear, is heavier than what it moves.
            others = max((inertia - rotor) / inertia, np.exp(-_MAX_ROTOR_CHANGE * _ROTOR_UNIT))
            change = partial(_with_rotor, joint, inertia)
            least = float(np.log(others)) / _ROTOR_UNIT
            quantities.append(PolishedQuantity(change, least, _MAX_ROTOR_CHANGE))
    if servo is None:
        return [*quantities, PolishedQuantity(_with_delay)]
    for joint in range(model.n_joints):
        quantities += [PolishedQuantity(partial(_with_gain, name, joint)) for name in ("kp", "kd")]
    ends = (np.array([0.0, MAX_SERVO_DELAY]) - servo.delay) / _DELAY_UNIT
    return [*quantities, PolishedQuantity(_with_delay, *ends.tolist())]


def _with_friction(rows: NDArray[np.intp], driven: Driven, change: float) -> Driven:
    values = driven.arm.values.copy()
    values[rows] *= np.exp(_LOG_UNIT * change)
    return replace(driven, arm=replace(driven.arm, values=values))


def _with_rotor(joint: int, inertia: float, driven: Driven, change: float) -> Driven:
    arm = driven.arm
    model = driven.arm.model
    standard = arm.standard.copy()
    values = arm.values.copy()
    rotors = standard[model.layout.rotors]
    rotors[joint] = max(0.0, rotors[joint] + inertia * np.expm1(_ROTOR_UNIT * change))
    standard[model.layout.rotors] = rotors
    values[: model.base.rank] = model.base.grouping @ standard
    return replace(driven, arm=replace(arm, standard=standard, values=values))


def _with_gain(name: str, joint: int, driven: Driven, change: float) -> Driven:
    servo = driven.motion.servo
    assert servo is not None
    gains = getattr(servo, name).copy()
    gains[joint] *= np.exp(_LOG_UNIT * change)
    servo = servo._replace(**{name: gains})
    motion = replace(driven.motion, servo=servo)
    return replace(driven, motion=motion, feedback=Feedback(servo.kp, servo.kd))


def _with_delay(driven: Driven, change: float) -> Driven:
    motion = driven.motion
    later = _DELAY_UNIT * change
    if motion.servo is None:
        motion = replace(motion, delay=motion.delay + later)
    else:
        motion = replace(motion, servo=motion.servo._replace(delay=motion.servo.delay + later))
    return replace(driven, motion=motion)
