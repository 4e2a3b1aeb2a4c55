"""Servo and friction written into a user's own MJCF or URDF; all else stays as it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final
from xml.etree import ElementTree

from identification.errors import IdentificationError, ModelError
from identification.export.actuators import Actuators
from identification.export.simulators import position_attributes, still_friction
from identification.export.urdf import as_text, joined_text
from identification.model.urdf_text import urdf_tree

Node = ElementTree.Element

_ACTUATORS: Final = ("position", "general", "motor", "velocity", "intvelocity", "pid")
_REPLACED: Final = (
    *("kp", "kv", "ki", "dampratio", "timeconst"),
    *("delay", "nsample", "interp", "gaintype", "gainprm", "biastype", "biasprm"),
)
"""Attributes of an actuator that a position servo determines."""


_TIMESTEP: Final = 2e-3  # s, of MuJoCo where none is stated


class PatchError(IdentificationError):
    """A file cannot be patched: it is no robot description, or lacks a joint."""


def patched(text: str, actuators: Actuators) -> str:
    """Return an MJCF or URDF with the servo and friction of an arm.

    Args:
        text: of the file.
        actuators: of joints; the file must have all of them by name.

    Raises:
        PatchError: it is neither, or a joint is missing.
    """
    try:
        root = urdf_tree(text, comments=True)
    except ModelError as error:
        raise PatchError(str(error)) from error
    if root.tag == "mujoco":
        _patch_mjcf(root, actuators)
    elif root.tag == "robot":
        _patch_urdf(root, actuators)
    else:
        raise PatchError(f"<{root.tag}> is neither an MJCF nor a URDF")
    return joined_text(text, root)


def _patch_mjcf(root: Node, actuators: Actuators) -> None:
    stated = [float(node.attrib["timestep"]) for node in root.findall("option[@timestep]")]
    step = stated[-1] if stated else _TIMESTEP
    joints = {node.attrib["name"]: node for node in root.iter("joint") if "name" in node.attrib}
    drives = {node.attrib["joint"]: node for node in _drives(root)}
    for j, name in enumerate(actuators.joint_names):
        if name not in joints:
            raise PatchError(f"there is no joint {name}")
        joints[name].attrib.update(
            armature=as_text(actuators.value("armature")[j]),
            damping=as_text(actuators.value("viscous")[j]),
            frictionloss=as_text(actuators.value("friction")[j]),
            **still_friction(step),
        )
        if not actuators.is_servo:
            continue
        drive = drives.get(name)
        if drive is None:
            section = root.find("actuator")
            if section is None:
                section = ElementTree.SubElement(root, "actuator")
            drive = ElementTree.SubElement(section, "position", name=name, joint=name)
        _set_servo(drive, position_attributes(actuators, j, step))


def _drives(root: Node) -> Iterator[Node]:
    for section in root.findall("actuator"):
        for node in section:
            if node.tag in _ACTUATORS and "joint" in node.attrib:
                yield node


def _set_servo(drive: Node, attributes: Mapping[str, str]) -> None:
    """Make an actuator a position servo; range of its control, class and name stay.

    The limit of its force stays if the motion did not reach one.
    """
    if drive.tag in ("motor", "velocity"):  # whose controls are no positions
        for name in ("ctrlrange", "ctrllimited", "class"):
            drive.attrib.pop(name, None)
    drive.tag = "position"
    for name in _REPLACED:
        drive.attrib.pop(name, None)
    if "forcerange" in attributes:
        drive.attrib.pop("forcelimited", None)
    drive.attrib.update(attributes)


def _patch_urdf(root: Node, actuators: Actuators) -> None:
    joints = {node.attrib.get("name"): node for node in root.findall("joint")}
    for j, name in enumerate(actuators.joint_names):
        joint = joints.get(name)
        if joint is None:
            raise PatchError(f"there is no joint {name}")
        dynamics = joint.find("dynamics")
        if dynamics is None:
            dynamics = ElementTree.SubElement(joint, "dynamics")
        dynamics.attrib.update(
            damping=as_text(actuators.value("viscous")[j]),
            friction=as_text(actuators.value("friction")[j]),
        )
