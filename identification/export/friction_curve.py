"""The identified friction: over speed, in the recorded torque, and as Coulomb friction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.model.friction import COULOMB, LOAD
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

CURVE_SPEEDS: Final = 120
"""Points of a curve in each direction."""


class FrictionCurve(NamedTuple):
    """Friction of one joint, with offset, without presliding and coupled motors."""

    speed: Array  # (2 CURVE_SPEEDS,) [rad/s or m/s], densest around zero
    torque: Array  # at these speeds (2 CURVE_SPEEDS,) [N·m or N]


def friction_curve(
    model: RobotModel, values: Array, joint: int, low: float, high: float, load: float = 0.0
) -> FrictionCurve:
    """Return the friction of a joint over its speed.

    Args:
        model: of the arm.
        values: parameters (p,).
        joint: from 0.
        low: lowest speed, at most zero [rad/s or m/s].
        high: highest speed, at least zero [rad/s or m/s].
        load: torque that the gear transmits [N·m or N], see :func:`median_load`.
    """
    law = model.friction.laws[joint]
    table = model.friction.table(values[model.friction_part])
    steps = np.linspace(0.0, 1.0, CURVE_SPEEDS) ** 2
    steps[0] = 1e-6 * steps[1]  # both sides of the jump at zero
    speed = np.concatenate([low * steps[::-1], high * steps])
    columns = law.columns(speed, law.sign(speed), np.full_like(speed, load))
    return FrictionCurve(speed, np.array([*table[joint].values()]) @ columns)


def friction_torque(model: RobotModel, values: Array, samples: Samples) -> Array:
    """Return measured minus predicted torque (m, n) of parameters (p,) without joint friction."""
    joints = np.zeros(model.n_parameters, dtype=np.bool_)
    joints[model.friction_part] = [not term.motor for term in model.friction.terms]
    friction = samples.predicted_torque(model, values, joints)
    return samples.torque - samples.predicted_torque(model, values) + friction


def median_load(model: RobotModel, values: Array, recordings: Sequence[Samples]) -> Array:
    """Return the median size of the torque that each gear transmits (n,) [N·m or N].

    Of parameters (p,), in the usable rows, or in all rows of a joint without any; zero if no
    friction grows with it.
    """
    if not model.friction.has_load:
        return np.zeros(model.n_joints)
    sizes = [np.abs(model.gear_torque(values, recording.motion)) for recording in recordings]
    magnitude = np.concatenate(sizes)
    usable = np.concatenate([recording.usable for recording in recordings])
    return np.array(
        [
            np.median(column[rows] if rows.any() else column)
            for column, rows in zip(magnitude.T, usable.T, strict=True)
        ]
    )


def equivalent_coulomb(
    model: RobotModel, friction: Array, load: Array
) -> tuple[dict[str, float], ...]:
    """Return the coefficients (k,) by symbol, with Coulomb friction at a load (n,) of each gear.

    Coulomb friction f0 + fl load takes the place of the share fl, none if it is NaN. As
    :meth:`JointFriction.table`.

    Raises:
        ShapeError: the coefficients are not (k,).
    """
    rows = model.friction.table(friction)
    # coupled motors have no share
    for row, size in zip(rows, np.abs(load).tolist(), strict=False):
        if LOAD.symbol in row:
            added = np.nan_to_num(row.pop(LOAD.symbol) * size).item()
            row[COULOMB.symbol] = row.get(COULOMB.symbol, 0.0) + added
    return rows


def load_remarks(model: RobotModel, load: Array) -> tuple[str, ...]:
    """Return remarks for a file that has :func:`equivalent_coulomb`; none without shares."""
    if not model.friction.has_load:
        return ()
    loads = [
        f"{name} {size:.3g} {'N·m' if turns else 'N'}"
        for name, size, law, turns in zip(
            model.joint_names, load.tolist(), model.friction.laws, model.chain.revolute, strict=True
        )
        if law.load
    ]
    return (
        "Friction that grows with the load of a gear cannot be represented: Coulomb friction is"
        f" that at a load of {', '.join(loads)}.",
    )
