"""Servo parameters that a MuJoCo file (MJCF) states: of its joints, position actuators, defaults.

Read as XML: the meshes and includes of the file need not be there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.safe_input import read_input
from identification.servo.parameters import ABSENT, PLACE, TERMS

_MAIN: Final = "main"
_REMEDY: Final = "give the MJCF of this arm, with joints of the same names and position actuators"
Attributes = dict[str, str]


def maker_parameters(path: Path, joints: Sequence[str]) -> Array:
    """Return the parameters (n, P) that a file states for joints, in SI units.

    A file with defaults alone states them for all joints.

    Raises:
        InputError: it is no MJCF, or states no stiffness of a joint.
    """
    try:
        root = ElementTree.fromstring(read_input(path, _REMEDY))
    except ElementTree.ParseError as error:
        raise InputError(
            path, f"is not XML ({error})", field="--compare", remedy=_REMEDY
        ) from error
    defaults = _defaults(root)
    elements = dict(_joints(root, defaults))
    actuators = _actuators(root, defaults)
    if not elements and not actuators:
        stating = [part for part in defaults.values() if "kp" in part.get("position", {})]
        if len(stating) == 1:
            elements = dict.fromkeys(joints, stating[0].get("joint", {}))
            actuators = dict.fromkeys(joints, stating[0]["position"])
    missing = [name for name in joints if name not in actuators or name not in elements]
    if missing:
        problem = f"states no position actuator of joint {missing[0]}"
        raise InputError(path, problem, field="--compare", remedy=_REMEDY)
    return np.array([_values(path, elements[name], actuators[name]) for name in joints])


def _values(path: Path, joint: Mapping[str, str], actuator: Mapping[str, str]) -> Array:
    """Return the parameters of a joint (P,)."""
    values = np.array([ABSENT.get(term.name, 0.0) for term in TERMS])
    kp, kv, limit = _gains(path, actuator)
    if not kp > 0.0:
        problem = f"states a stiffness of {kp:g}"
        raise InputError(path, problem, field="--compare", remedy=_REMEDY)
    values[PLACE["kp"]] = kp
    values[PLACE["armature"]] = _number(path, joint, "armature")
    # MuJoCo's kv brakes the joint, whatever its command.
    values[PLACE["viscous"]] = _number(path, joint, "damping") + kv
    values[PLACE["coulomb"]] = _number(path, joint, "frictionloss")
    values[PLACE["limit"]] = limit
    return values


def _gains(path: Path, actuator: Mapping[str, str]) -> tuple[float, float, float]:
    """Return stiffness, damping and force limit of an actuator."""
    limit = np.inf
    if "forcerange" in actuator:
        limit = max(map(abs, _numbers(path, actuator, "forcerange")))
    if "gainprm" in actuator and "kp" not in actuator:
        bias = _numbers(path, actuator, "biasprm") if "biasprm" in actuator else [0.0] * 3
        kv = -bias[2] if len(bias) > 2 else 0.0
        return _numbers(path, actuator, "gainprm")[0], kv, limit
    kp = _number(path, actuator, "kp", 1.0)
    return kp, _number(path, actuator, "kv"), limit


def _number(path: Path, element: Mapping[str, str], name: str, default: float = 0.0) -> float:
    return _numbers(path, element, name)[0] if name in element else default


def _numbers(path: Path, element: Mapping[str, str], name: str) -> list[float]:
    try:
        numbers = [float(part) for part in element[name].split()]
        numbers[0]
    except (ValueError, IndexError) as error:
        problem = f"{name} is {element[name]!r}, no number"
        raise InputError(path, problem, field="--compare", remedy=_REMEDY) from error
    return numbers


def _defaults(root: ElementTree.Element) -> dict[str, dict[str, Attributes]]:
    """Return the attributes of joint and position by default class, including inherited ones."""
    classes: dict[str, dict[str, Attributes]] = {_MAIN: {}}

    def visit(element: ElementTree.Element, inherited: Mapping[str, Attributes]) -> None:
        name = element.get("class", _MAIN)
        own = {kind: dict(attributes) for kind, attributes in inherited.items()}
        for child in element:
            if child.tag != "default":
                own.setdefault(_kind(child.tag), {}).update(child.attrib)
        classes[name] = own
        for child in element:
            if child.tag == "default":
                visit(child, own)

    for element in [root] if root.tag == "default" else root.findall("default"):
        visit(element, classes[_MAIN])
    return classes


def _kind(tag: str) -> str:
    return "position" if tag in ("position", "general") else tag


def _joints(
    root: ElementTree.Element, defaults: Mapping[str, Mapping[str, Attributes]]
) -> list[tuple[str, Attributes]]:
    """Return names and attributes of the joints, including attributes of their classes."""
    found = []

    def visit(element: ElementTree.Element, inherited: str) -> None:
        for child in element:
            if child.tag == "joint" and "name" in child.attrib:
                kind = defaults.get(child.get("class", inherited), {}).get("joint", {})
                found.append((child.attrib["name"], {**kind, **child.attrib}))
            elif child.tag in ("body", "worldbody", "frame"):
                visit(child, child.get("childclass", inherited))

    visit(root, _MAIN)
    return found


def _actuators(
    root: ElementTree.Element, defaults: Mapping[str, Mapping[str, Attributes]]
) -> dict[str, Attributes]:
    """Return the attributes of the position actuators by joint."""
    return {
        element.attrib["joint"]: {
            **defaults.get(element.get("class", _MAIN), {}).get("position", {}),
            **element.attrib,
        }
        for section in root.findall("actuator")
        for element in section
        if element.tag in ("position", "general") and "joint" in element.attrib
    }
