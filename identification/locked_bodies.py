"""What locked joints carry: part of the inertia that is identified for the link before them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.kinematics import FROM_PINOCCHIO, locked_posture
from identification.model import RobotModel
from identification.pseudo_inertia import margin

Array = NDArray[np.float64]


class LockedBody(NamedTuple):
    """Nominal inertia of what one locked joint carries, up to the next moving or locked joint.

    Attributes:
        joint: name of the locked joint.
        carrier: index of the joint of the model that moves it, -1 for the base.
        inertial: the ten parameters about the carrier's frame, in its axes (10,).
    """

    joint: str
    carrier: int
    inertial: Array


def locked_bodies(urdf: str, model: RobotModel) -> tuple[LockedBody, ...]:
    """Return what the locked joints of a model carry, at the positions where they are locked."""
    if not model.locked:
        return ()
    arm = pin.buildModelFromXML(urdf)
    data = arm.createData()
    pin.forwardKinematics(arm, data, locked_posture(arm, model.locked))
    found = []
    for name in model.locked:
        own = arm.getJointId(name)
        before = own
        while before > 0 and arm.names[before] in model.locked:
            before = arm.parents[before]
        body = (data.oMi[before].inverse() * data.oMi[own]).act(arm.inertias[own])
        inertial = body.toDynamicParameters()[list(FROM_PINOCCHIO)]
        carrier = model.joint_names.index(arm.names[before]) if before > 0 else -1
        found.append(LockedBody(name, carrier, inertial))
    return tuple(found)


def without_locked(inertial: Array, locked: tuple[LockedBody, ...]) -> tuple[Array, frozenset[str]]:
    """Take what locked joints carry out of the links (n, 10), where a possible body is left.

    Returns:
        The links (n, 10), and the locked joints that keep what they carry: those of the base too.
    """
    left = inertial.copy()
    kept: set[str] = set()
    for carrier in {body.carrier for body in locked}:
        carried = [body for body in locked if body.carrier == carrier]
        if carrier >= 0:
            rest = left[carrier] - sum(body.inertial for body in carried)
            if not margin(rest) > 0.0:
                continue
            left[carrier] = rest
        kept.update(body.joint for body in carried)
    return left, frozenset(kept)
