"""A copy of a URDF in which some joints are fixed where they were held."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from identification.urdf_tree import urdf_tree

_OF_MOVING_JOINTS: Final = (
    "axis", "limit", "mimic", "dynamics", "safety_controller", "calibration"
)  # fmt: skip


@dataclass(frozen=True)
class Mimic:
    """What a joint follows.

    Attributes:
        joint: the one that leads it.
        offset: its own position [rad or m] where that stands at zero.
    """

    joint: str
    offset: float


def mimics(urdf: str) -> dict[str, Mimic]:
    """Joints that follow another one, by name; an offset that is no number counts as 0."""
    found = {}
    for joint in urdf_tree(urdf).findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            try:
                offset = float(mimic.get("offset", "0"))
            except ValueError:
                offset = 0.0
            found[joint.get("name", "")] = Mimic(mimic.get("joint", "?"), offset)
    return found


def with_fixed(urdf: str, positions: Mapping[str, float]) -> str:
    """The URDF with joints held at positions [rad or m], by name; comments stay.

    Raises:
        KeyError: no joint has such a name.
    """
    root = urdf_tree(urdf, comments=True)
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for name, position in positions.items():
        _fix(joints[name], position)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _fix(joint: ET.Element, position: float) -> None:
    axis = joint.find("axis")
    along = _three(None if axis is None else axis.get("xyz"), "1 0 0")
    along /= np.linalg.norm(along)
    if position:
        origin = joint.find("origin")
        if origin is None:
            origin = ET.SubElement(joint, "origin")
        place, turn = _three(origin.get("xyz"), "0 0 0"), _three(origin.get("rpy"), "0 0 0")
        rotation = Rotation.from_euler("xyz", turn)  # URDF: roll, pitch, yaw about fixed axes
        if joint.get("type") == "prismatic":
            place = place + rotation.apply(along * position)
        else:
            rotation = rotation * Rotation.from_rotvec(along * position)
        origin.set("xyz", _text(place))
        origin.set("rpy", _text(rotation.as_euler("xyz")))
    joint.set("type", "fixed")
    for tag in _OF_MOVING_JOINTS:
        for element in joint.findall(tag):
            joint.remove(element)


def _three(text: str | None, default: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([float(part) for part in (text or default).split()])


def _text(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    return " ".join(repr(float(value)) for value in values)
