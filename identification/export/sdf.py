"""The identified arm as SDF, the format of Gazebo and Drake."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.export.exported_arm import ExportedArm
from identification.export.friction_curve import load_remarks
from identification.export.urdf import (
    TENSOR,
    WriteBackError,
    as_text,
    comment_text,
    gravity_remarks,
)
from identification.model.motion import Motion
from identification.model.pseudo_inertia import body

Node = ElementTree.Element

_BASE = "base"
_TIMESTEP = 1e-3  # s, of Drake's plant, which is not simulated


class MissingDrakeError(IdentificationError):
    """Drake is needed and not installed."""


def sdf(arm: ExportedArm, name: str, remarks: Sequence[str] = ()) -> str:
    """Return the arm as SDF 1.9: links in the frames of their joints, fixed to the world."""
    model = arm.model
    ranges = arm.ranges
    root = Node("sdf", version="1.9")
    lines = [*remarks, *load_remarks(model, arm.written_load), *gravity_remarks(model)]
    if lines:
        text = "".join(f"  {comment_text(line)}\n" for line in lines)
        root.append(ElementTree.Comment(f"\n{text}"))
    robot = ElementTree.SubElement(root, "model", name=name)
    _base(robot)
    names = [_BASE if parent < 0 else arm.link(int(parent)) for parent in model.chain.parents]
    for j, joint_name in enumerate(model.joint_names):
        link = ElementTree.SubElement(robot, "link", name=arm.link(j))
        pose = [*model.chain.translation[j], *pin.rpy.matrixToRpy(model.chain.rotation[j])]
        _add(link, "pose", as_text(pose), relative_to=names[j])
        _inertial(link, arm.standard[model.layout.links[j]])
        kind = "revolute" if model.chain.revolute[j] else "prismatic"
        joint = ElementTree.SubElement(robot, "joint", name=joint_name, type=kind)
        _add(joint, "parent", names[j])
        _add(joint, "child", arm.link(j))
        axis = ElementTree.SubElement(joint, "axis")
        _add(axis, "xyz", as_text(model.chain.axis[j]))
        limit = ElementTree.SubElement(axis, "limit")
        lower = ranges.lower[j]
        upper = ranges.upper[j]
        if math.isfinite(lower) and math.isfinite(upper) and lower < upper:
            _add(limit, "lower", as_text(lower))
            _add(limit, "upper", as_text(upper))
        if math.isfinite(ranges.effort[j]):
            _add(limit, "effort", as_text(ranges.effort[j]))
        if math.isfinite(ranges.velocity[j]):
            _add(limit, "velocity", as_text(ranges.velocity[j]))
        dynamics = ElementTree.SubElement(axis, "dynamics")
        _add(dynamics, "damping", as_text(arm.friction[j].get("f1", 0.0)))
        _add(dynamics, "friction", as_text(max(0.0, arm.friction[j].get("f0", 0.0))))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def drake_torque(text: str, arm: ExportedArm, motion: Motion) -> Array:
    """Return the torques (m, n) of the bodies and damping of an SDF, by Drake.

    Raises:
        WriteBackError: Drake does not read the text.
        MissingDrakeError: Drake is not installed.
    """
    parsing, tree, plants = _drake()
    plant = plants.MultibodyPlant(_TIMESTEP)
    try:
        parsing.Parser(plant).AddModelsFromString(text, "sdf")
    except RuntimeError as error:
        raise WriteBackError(f"Drake does not read the text: {error}") from error
    plant.mutable_gravity_field().set_gravity_vector(arm.model.gravity)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    joints = [plant.GetJointByName(name) for name in arm.model.joint_names]
    order = [joint.velocity_start() for joint in joints]
    torque = np.empty(motion.position.shape)
    for k, (q, qd, qdd) in enumerate(motion.states()):
        position, velocity, acceleration = (np.zeros(len(order)) for _ in range(3))
        position[order] = q
        velocity[order] = qd
        acceleration[order] = qdd
        plant.SetPositions(context, position)
        plant.SetVelocities(context, velocity)
        forces = tree.MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        torque[k] = plant.CalcInverseDynamics(context, acceleration, forces)[order]
    return torque


def _drake() -> tuple[Any, Any, Any]:
    try:
        from pydrake.multibody import parsing, plant, tree  # optional dependency
    except ImportError as error:
        raise MissingDrakeError("Drake is not installed: pip install drake") from error
    return parsing, tree, plant


def _base(robot: Node) -> None:
    """Add the base link, fixed to the world."""
    ElementTree.SubElement(robot, "link", name=_BASE)
    joint = ElementTree.SubElement(robot, "joint", name="world_to_base", type="fixed")
    _add(joint, "parent", "world")
    _add(joint, "child", _BASE)


def _inertial(link: Node, parameters: Array) -> None:
    mass = body(parameters)
    inertial = ElementTree.SubElement(link, "inertial")
    _add(inertial, "pose", as_text([*mass.centre, 0.0, 0.0, 0.0]))
    _add(inertial, "mass", as_text(mass.mass))
    inertia = ElementTree.SubElement(inertial, "inertia")
    for name, index in TENSOR.items():
        _add(inertia, name, as_text(mass.inertia[index]))


def _add(parent: Node, tag: str, text: str, **attributes: str) -> None:
    ElementTree.SubElement(parent, tag, attributes).text = text
