"""Write identified inertia and friction into a URDF, everything else unchanged.

The inertia of links fixed to a moving link is part of that link's and replaced by a comment. Locked
joints keep the inertia of their links, if the rest of the moving link is consistent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.export.friction_curve import equivalent_coulomb, load_remarks
from identification.model.elements import PeriodicTorque
from identification.model.friction import TERMS
from identification.model.kinematics import (
    PINOCCHIO_ORDER,
    chain_from_urdf,
    locked_posture,
    pinocchio_model,
)
from identification.model.motion import Motion
from identification.model.pseudo_inertia import Body, body, margin
from identification.model.regressor import RegressorPlan
from identification.model.robot import STANDARD_GRAVITY, RobotModel
from identification.model.urdf_text import urdf_tree

TENSOR: Final = {
    "ixx": (0, 0),
    "ixy": (0, 1),
    "ixz": (0, 2),
    "iyy": (1, 1),
    "iyz": (1, 2),
    "izz": (2, 2),
}
_DYNAMICS: Final = {kind.symbol: kind.urdf for kind in reversed(TERMS) if kind.urdf}
_RANDOM_STATES: Final = 50
_SEED: Final = 20140902
_TORQUE_ROUNDING: Final = 1e-8  # relative to the largest torque of a joint
_PROLOG: Final = re.compile(r"(?:\s+|<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>\[]*(?:\[.*?\])?\s*>)*", re.S)


class NotConsistentError(IdentificationError):
    """Parameters are not physically consistent."""


class WriteBackError(IdentificationError):
    """The description does not fit the model, or reads back with other parameters."""


def comment_text(text: str) -> str:
    """Return text for a comment, without consecutive dashes."""
    return re.sub("-(?=-)", "- ", text)


def write_urdf(
    urdf: str,
    model: RobotModel,
    standard: Array,
    friction: Array | None = None,
    remarks: Sequence[str] = (),
    load: Array | None = None,
) -> str:
    """Return the URDF text of a model with identified parameters.

    Friction that grows with the load is written as Coulomb friction at one load; a remark says so.
    The inverse dynamics of the text are compared with the regressor before it is returned.

    Args:
        urdf: text that is changed.
        model: of it.
        standard: parameters (s,).
        friction: parameters (k,); NaN leaves its attribute unchanged, None all of ``<dynamics>``.
        remarks: lines of a comment before the robot.
        load: of the gears (n,) [N·m or N], such as :func:`median_load`; by default zero.

    Raises:
        NotConsistentError: a link, a rotor or friction is not physically consistent.
        WriteBackError: the text is of another robot, or reads back with other parameters.
        ModelError: the text is not a URDF.
        ShapeError: an array has the wrong shape.
    """
    standard = model.layout.checked(standard)
    inertial = standard[model.layout.links]
    terms: list[dict[str, float]] = [{} for _ in model.joint_names]
    if friction is not None:
        load = np.zeros(model.n_joints) if load is None else load
        terms = [*equivalent_coulomb(model, friction, load)][: model.n_joints]
        remarks = (*remarks, *load_remarks(model, load))
    remarks = (*remarks, *gravity_remarks(model))
    dynamics = [
        {
            attribute: values[symbol]
            for symbol, attribute in _DYNAMICS.items()
            if math.isfinite(values.get(symbol, math.nan))
        }
        for values in terms
    ]
    _require_consistent(model, standard, inertial, dynamics)
    bodies, removed = _without_locked(urdf, model, inertial)
    root = urdf_tree(urdf, comments=True)
    tree = _Tree(root, model, removed)
    for joint, parameters, values in zip(model.joint_names, bodies, dynamics, strict=True):
        link = tree.end(tree.joints[joint], "child")
        _set_inertia(link, body(parameters))
        for merged in tree.fixed_to(link):
            if (element := merged.find("inertial")) is not None:
                name = comment_text(link.attrib["name"])
                note = ElementTree.Comment(f" inertia is contained in {name} ")
                note.tail = element.tail
                merged[list(merged).index(element)] = note
        if values:
            figures = {attribute: as_text(value) for attribute, value in values.items()}
            _child(tree.joints[joint], "dynamics").attrib.update(figures)
    text = joined_text(urdf, root, remarks)
    _compare(text, model, inertial)
    return text


def joined_text(urdf: str, root: Element, remarks: Sequence[str] = ()) -> str:
    """Return a text with another root element, and a comment before it."""
    prolog = _PROLOG.match(urdf)
    assert prolog is not None
    epilog = re.split(rf"</{re.escape(root.tag)}\s*>", urdf)[-1]
    lines = "".join(f"  {comment_text(line)}\n" for line in remarks)
    comment = f"<!--\n{lines}-->\n" if remarks else ""
    text = ElementTree.tostring(root, encoding="unicode")
    if 2 * urdf.count(" />") < urdf.count("/>"):
        text = text.replace(" />", "/>")
    return prolog[0] + comment + text + epilog


def other_gravity(model: RobotModel) -> str:
    """Return a description of a gravity that simulators do not assume, empty if they do."""
    if np.array_equal(model.gravity, STANDARD_GRAVITY):
        return ""
    x, y, z = model.gravity
    return f"gravity of {x:.4g}, {y:.4g}, {z:.4g} m/s² in base axes, which the simulator must have"


def gravity_remarks(model: RobotModel) -> tuple[str, ...]:
    """Return remarks for a file that has no gravity; none if it is the usual one."""
    return (f"Identified with a {gravity}.",) if (gravity := other_gravity(model)) else ()


def not_in_urdf(model: RobotModel) -> tuple[str, ...]:
    """Return descriptions of the model's parameters that a URDF cannot represent."""
    are_periodic = [isinstance(each, PeriodicTorque) for each in model.elements.elements]
    absent = {
        "rotor inertias": model.layout.rotor_inertia,
        "coupling inertias": bool(model.layout.pairs),
        **{kind.description: not kind.urdf for kind in model.friction.kinds},
        "friction of coupled motors": bool(model.friction.motors),
        "the payload": model.payload is not None,
        "springs and balancers": not all(are_periodic),
        "periodic torques of motors and joints": any(are_periodic),
        **({gravity: True} if (gravity := other_gravity(model)) else {}),
    }
    return tuple(description for description, present in absent.items() if present)


def _without_locked(urdf: str, model: RobotModel, inertial: Array) -> tuple[Array, frozenset[str]]:
    """Subtract links of locked joints from moving links (n, 10), if these remain consistent.

    Returns:
        the parameters (n, 10), and the names of joints whose links were subtracted.
    """
    if not model.locked:
        return inertial, frozenset()
    arm = pin.buildModelFromXML(urdf)
    data = arm.createData()
    pin.forwardKinematics(arm, data, locked_posture(arm, model.locked))
    carried: dict[int, dict[str, Array]] = {}  # by the moving joint, -1 for the base
    for name in model.locked:
        joint = parent = arm.getJointId(name)
        while parent > 0 and arm.names[parent] in model.locked:
            parent = arm.parents[parent]
        moved = (data.oMi[parent].inverse() * data.oMi[joint]).act(arm.inertias[joint])
        index = model.joint_names.index(arm.names[parent]) if parent > 0 else -1
        parameters = moved.toDynamicParameters()[list(PINOCCHIO_ORDER)]
        carried.setdefault(index, {})[name] = parameters
    remaining = inertial.copy()
    removed = list(carried.get(-1, {}))
    for index, bodies in carried.items():
        if index >= 0:
            remainder = remaining[index] - sum(bodies.values())
            if margin(remainder) > 0.0:
                remaining[index] = remainder
                removed += bodies
    return remaining, frozenset(removed)


class _Tree:
    """Links and joints of a description by name; locked joints not in `removed` count as fixed."""

    def __init__(self, root: Element, model: RobotModel, removed: Collection[str]) -> None:
        # children only: transmissions have <joint> elements too
        self.links, self.joints = (
            {element.get("name", ""): element for element in root.findall(tag)}
            for tag in ("link", "joint")
        )
        self._rigid: list[Element] = []
        missing = [name for name in model.joint_names if name not in self.joints]
        if missing:
            raise WriteBackError(f"the description has no joint {missing[0]!r}")
        for name, joint in self.joints.items():
            if joint.get("type") == "fixed":
                self._rigid.append(joint)
            elif name in model.locked:
                self._rigid += [] if name in removed else [joint]
            elif name not in model.joint_names:
                raise WriteBackError(
                    f"joint {name!r} moves in the description but not in the model, so that the"
                    " inertia of its link is unknown"
                )

    def fixed_to(self, link: Element) -> Iterator[Element]:
        """Yield the links that are fixed to a link, directly or through others."""
        for joint in self._rigid:
            if self.end(joint, "parent") is link:
                carried = self.end(joint, "child")
                yield carried
                yield from self.fixed_to(carried)

    def end(self, joint: Element, end: str) -> Element:
        """Return the link at an end of a joint, "parent" or "child"."""
        named = joint.find(end)
        name = "" if named is None else named.get("link", "")
        if name not in self.links:
            raise WriteBackError(
                f"joint {joint.get('name')!r} has no {end} link in the description"
            )
        return self.links[name]


def _set_inertia(link: Element, of: Body) -> None:
    """Set or insert the inertial element of a link."""
    element = _child(link, "inertial")
    tags = ["inertia", "mass", "origin"]  # each is inserted before those that are there
    inertia, mass, origin = (_child(element, tag) for tag in tags)
    rotation = _rotation(origin.get("rpy", ""))
    tensor = rotation.T @ of.inertia @ rotation
    origin.set("xyz", as_text(of.centre))
    mass.set("value", as_text(of.mass))
    inertia.attrib.update({name: as_text(tensor[index]) for name, index in TENSOR.items()})


def _child(parent: Element, tag: str) -> Element:
    """Return the first child with that tag, inserted with the layout of the others if missing."""
    child = parent.find(tag)
    if child is None:
        child = Element(tag)
        child.tail = parent.text
        parent.insert(0, child)
    return child


def as_text(values: float | Sequence[float] | Array) -> str:
    """Return numbers as the shortest text that reads back identically."""
    return " ".join(repr(float(value) + 0.0) for value in np.atleast_1d(values))  # no -0.0


def _rotation(rpy: str) -> Array:
    """Return the rotation of a URDF's roll, pitch and yaw, about fixed axes."""
    angles = [float(angle) for angle in rpy.split()] or [0.0] * 3
    return np.asarray(pin.rpy.rpyToMatrix(np.array(angles)))


def _require_consistent(
    model: RobotModel, standard: Array, inertial: Array, dynamics: Sequence[Mapping[str, float]]
) -> None:
    """Raise `NotConsistentError` for inconsistent parameters."""
    for index in np.flatnonzero(~np.isfinite(standard)):
        raise NotConsistentError(f"parameter {model.layout.names[index]} is not finite")
    _require_consistent_links(model, inertial, "write the physically consistent estimate")
    rotors = model.layout.rotor_matrix(standard)
    for joint, rotor in zip(model.joint_names, np.diag(rotors), strict=True):
        if not rotor >= 0.0:
            raise NotConsistentError(f"the rotor of joint {joint!r} is negative")
    smallest, directions = np.linalg.eigh(rotors)
    if smallest[0] < -_TORQUE_ROUNDING * np.abs(rotors).max(initial=0.0):
        joint = model.joint_names[int(np.argmax(np.abs(directions[:, 0])))]
        raise NotConsistentError(
            f"the coupling inertias of joint {joint!r} are too large for its rotors"
        )
    for joint, values in zip(model.joint_names, dynamics, strict=True):
        for attribute, value in values.items():
            if value < 0.0:
                raise NotConsistentError(
                    f"{attribute} of joint {joint!r} is {value:.3g}; it must not be negative"
                )


def _require_consistent_links(model: RobotModel, inertial: Array, remedy: str) -> None:
    for joint, smallest in zip(model.joint_names, margin(inertial), strict=True):
        if not smallest > 0.0:
            raise NotConsistentError(
                f"the link of joint {joint!r} is not physically consistent: its pseudo-inertia has"
                f" the eigenvalue {smallest:.3g}; {remedy}"
            )


def _compare(text: str, model: RobotModel, inertial: Array) -> None:
    """Raise `WriteBackError` unless the text reads back with the written parameters."""
    chain = chain_from_urdf(text, model.locked)
    if chain.joint_names != model.joint_names:
        raise WriteBackError("the description has other joints than the model")
    states = np.random.default_rng(_SEED).uniform(-2.0, 2.0, (3, _RANDOM_STATES, model.n_joints))
    motion = Motion.of_states(*states)
    plan = RegressorPlan.of_bodies(model.chain, model.gravity)
    expected = plan.torque(inertial.reshape(-1), motion)
    arm = pinocchio_model(text, model.locked)
    arm.gravity.linear = model.gravity
    error = np.abs(rnea(arm, motion) - expected).max(axis=0)
    allowed = _TORQUE_ROUNDING * max(float(np.abs(expected).max()), 1.0)
    for joint in np.flatnonzero(~(error <= allowed)):
        raise WriteBackError(
            f"the torque of joint {model.joint_names[joint]!r} differs by {error.max():.3g} in the"
            " written description"
        )
    if not np.allclose(
        chain.inertial, inertial, rtol=0.0, atol=_TORQUE_ROUNDING * np.abs(inertial).max()
    ):
        raise WriteBackError("the written description has other inertial parameters")
    _require_consistent_links(model, chain.inertial, "by rounding in the written text")


def rnea(arm: pin.Model, motion: Motion) -> Array:
    """Return pinocchio's torques (m, n) of a model along a motion."""
    data = arm.createData()
    neutral = pin.neutral(arm)  # continuous joints have two coordinates
    return np.array(
        [pin.rnea(arm, data, pin.integrate(arm, neutral, a), b, c) for a, b, c in motion.states()]
    )
