"""What code of a controller must compute, by pinocchio and the model's own friction law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from identification.arrays import Array
from identification.export.exported_arm import ExportedArm
from identification.export.urdf import rnea
from identification.model.kinematics import PINOCCHIO_ORDER, pinocchio_model
from identification.model.motion import Motion


def pinocchio_bodies(arm: ExportedArm) -> pin.Model:
    """Return pinocchio's model of an arm's bodies and payload, every number as identified."""
    model = pinocchio_model(arm.urdf, arm.model.locked)
    model.gravity.linear = arm.model.gravity
    links = arm.standard[arm.model.layout.links]
    for k, parameters in enumerate(links, start=1):
        ordered = np.empty(len(parameters))
        ordered[list(PINOCCHIO_ORDER)] = parameters
        model.inertias[k] = pin.Inertia.FromDynamicParameters(ordered)
    payload = arm.model.payload
    if payload is not None:
        joint, rotation, translation = arm.model.chain.frame(payload.frame)
        body = pin.Inertia(payload.mass, np.array(payload.centre), payload.tensor)
        model.inertias[joint + 1] += body.se3Action(pin.SE3(rotation, translation))
    return model


def reference_torque(arm: ExportedArm, motion: Motion, *, presliding: bool = False) -> Array:
    """Return the torque (m, n) of an arm along a motion: bodies by pinocchio, and the rest.

    Without `presliding` dry friction has the sign of the speed.
    """
    rigid = rnea(pinocchio_bodies(arm), motion) + motion.acceleration @ arm.rotors
    model = arm.model
    known = model.elements.known_torque(motion.position)
    return rigid + known + _friction_and_elements(arm, motion, presliding=presliding)


def _friction_and_elements(arm: ExportedArm, motion: Motion, *, presliding: bool) -> Array:
    model = arm.model
    load = model.gear_torque(arm.values, motion) if model.friction.has_load else None
    direction = model.friction.direction(motion) if presliding else None
    values = arm.values.copy()
    values[: model.base.rank] = 0.0
    return model.torque(values, replace(motion, direction=direction, load=load))
