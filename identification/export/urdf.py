"""Write identified inertia and friction into a URDF, everything else unchanged.

Moving links get mass, centre of mass and tensor in the axes of their ``rpy``, ``<dynamics>``
viscous friction as ``damping`` and Coulomb friction as ``friction``. The inertia of links fixed to
a moving link is part of that link's and replaced by a comment. Locked joints keep the inertia of
their links, if the rest of the moving link is consistent. The inverse dynamics of the written text
are compared with the regressor before it is returned.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import escape

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import IdentificationError, ModelError
from identification.model.friction import TERMS
from identification.model.kinematics import (
    FROM_PINOCCHIO,
    chain_from_urdf,
    locked_posture,
    pinocchio_model,
)
from identification.model.pseudo_inertia import Body, body, margin
from identification.model.regressor import RegressorPlan
from identification.model.robot import RobotModel
from identification.model.urdf_text import urdf_tree

Array = NDArray[np.float64]

TENSOR: Final = {
    "ixx": (0, 0),
    "ixy": (0, 1),
    "ixz": (0, 2),
    "iyy": (1, 1),
    "iyz": (1, 2),
    "izz": (2, 2),
}
_DYNAMICS: Final = {kind.symbol: kind.urdf for kind in reversed(TERMS) if kind.urdf}
_STATES: Final = 50
_SEED: Final = 20140902
_ROUNDING: Final = 1e-8  # relative to the largest torque of a joint


class NotConsistentError(IdentificationError):
    """Parameters are not physically consistent."""


class WriteBackError(IdentificationError):
    """The description does not fit the model, or reads back with other parameters."""


# Only changed bytes are replaced; writing a parsed tree would lose comments and formatting.


@dataclass(eq=False)
class Element:
    """An element and its position in the UTF-8 text."""

    name: str  # of the tag
    attributes: dict[str, str]  # as parsed
    start: int  # first byte of the opening tag
    inside: int  # first byte after the opening tag
    end: int = -1  # first byte after the element
    children: list[Element] = field(default_factory=list)

    def child(self, name: str) -> Element | None:
        """Return the first child with that tag."""
        return next((child for child in self.children if child.name == name), None)

    def named(self, name: str) -> dict[str, Element]:
        """Return the children with that tag by their attribute `name`."""
        return {e.attributes.get("name", ""): e for e in self.children if e.name == name}


class Edit(NamedTuple):
    """Replacement of the bytes from `start` to `end`, which may be equal, with `text`."""

    start: int
    end: int
    text: str


class XmlSource:
    """An XML text for editing in place, with its root element `root`.

    Raises:
        ModelError: the text is not well-formed XML.
    """

    def __init__(self, text: str) -> None:
        self._bytes = data = text.encode("utf-8")
        self._newline = "\r\n" if b"\r\n" in data else "\n"
        parser = expat.ParserCreate("utf-8")
        tag = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")  # values may contain '>'
        open_elements = [Element("", {}, 0, 0)]

        def opened(name: str, attributes: dict[str, str]) -> None:
            start = parser.CurrentByteIndex
            found = tag.match(data, start)
            assert found is not None
            element = Element(name, attributes, start, found.end())
            open_elements[-1].children.append(element)
            open_elements.append(element)

        def closed(_: str) -> None:
            element = open_elements.pop()
            empty = data[element.inside - 2 : element.inside] == b"/>"
            after = data.find(b">", parser.CurrentByteIndex) + 1
            element.end = element.inside if empty else after

        parser.StartElementHandler = opened
        parser.EndElementHandler = closed
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise ModelError(f"the robot description is not XML: {error}") from error
        self.root = open_elements[0].children[0]

    def edited(self, edits: Iterable[Edit]) -> str:
        """Return the text with non-overlapping edits applied."""
        data = self._bytes
        for edit in sorted(edits, reverse=True):
            data = data[: edit.start] + edit.text.encode("utf-8") + data[edit.end :]
        return data.decode("utf-8")

    def with_attributes(self, element: Element, values: Mapping[str, str]) -> Edit:
        """Return the edit that sets attributes of an element."""
        tag = self._bytes[element.start : element.inside].decode("utf-8")
        for name, value in values.items():
            written = f'"{escape(value, {chr(34): "&quot;"})}"'
            pattern = re.compile(rf"(\s{re.escape(name)}\s*=\s*)(\"[^\"]*\"|'[^']*')")
            if found := pattern.search(tag):
                tag = tag[: found.start(2)] + written + tag[found.end() :]
            else:
                head = tag.removesuffix(">").removesuffix("/").rstrip()
                tag = f"{head} {name}={written}{tag[len(head) :]}"
        return Edit(element.start, element.inside, tag)

    def with_first_child(self, element: Element, lines: Iterable[str]) -> Edit:
        """Return the edit that inserts lines of XML after the opening tag."""
        outer = self._indentation(element)
        children = [self._indentation(child) for child in element.children]
        inner = next((indent for indent in children if indent), outer + "  ")
        block = "".join(f"{self._newline}{inner}{line}" for line in lines)
        tag = self._bytes[element.start : element.inside].decode("utf-8")
        if tag.endswith("/>"):
            closing = f"{self._newline}{outer}</{element.name}>"
            return Edit(element.start, element.end, f"{tag[:-2].rstrip()}>{block}{closing}")
        return Edit(element.inside, element.inside, block)

    def with_comment(self, lines: Iterable[str]) -> Edit:
        """Return the edit that inserts a comment before the root element."""
        inside = comment_text(self._newline.join(f"  {line}" for line in lines))
        at = self.root.start
        return Edit(at, at, self._newline.join(["<!--", inside, "-->", ""]))

    def _indentation(self, element: Element) -> str:
        """Return the white space before an element at the start of its line, else nothing."""
        before = self._bytes[: element.start].decode("utf-8")
        line = before[before.rfind("\n") + 1 :]
        return line if not line.strip() else ""


def comment_text(text: str) -> str:
    """Return text for a comment, without consecutive dashes."""
    return re.sub("-(?=-)", "- ", text)


def write_urdf(
    urdf: str,
    model: RobotModel,
    standard: Array,
    friction: Array | None = None,
    remarks: Sequence[str] = (),
) -> str:
    """Return the URDF text with new inertial parameters, and friction if given.

    Args:
        urdf: text that the model was created from.
        model: the robot.
        standard: all standard parameters (s,), see `RobotModel.standard_names`.
        friction: coefficients (k,), see `RobotModel.friction_part`; a NaN leaves its attribute,
            None all of ``<dynamics>`` unchanged.
        remarks: lines of a comment before the robot.

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
        terms = [*model.friction.table(friction)][: model.n_joints]
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
    source = XmlSource(urdf)
    tree = _Tree(source.root, model, removed)
    edits = [source.with_comment(remarks)] if remarks else []
    for joint, parameters, values in zip(model.joint_names, bodies, dynamics, strict=True):
        link = tree.end(tree.joints[joint], "child")
        edits += _inertia_edits(source, link, body(parameters))
        for merged in tree.fixed_to(link):
            if (element := merged.child("inertial")) is not None:
                name = comment_text(link.attributes["name"])
                note = f"<!-- inertia is contained in {name} -->"
                edits.append(Edit(element.start, element.end, note))
        if values:
            figures = {attribute: as_text(value) for attribute, value in values.items()}
            edits += _set(source, tree.joints[joint], {"dynamics": figures})
    text = source.edited(edits)
    _compare(text, model, inertial, dynamics)
    return text


def not_in_urdf(model: RobotModel) -> tuple[str, ...]:
    """Return descriptions of the model's parameters that a URDF cannot represent."""
    absent = {
        "rotor inertias": model.rotor_inertia,
        "coupling inertias": bool(model.layout.pairs),
        **{kind.description: not kind.urdf for kind in model.friction.kinds},
        "friction of coupled motors": bool(model.friction.motors),
        "the payload": model.payload is not None,
        "springs and balancers": bool(model.elements.elements),
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
        parameters = moved.toDynamicParameters()[list(FROM_PINOCCHIO)]
        carried.setdefault(index, {})[name] = parameters
    remaining, removed = inertial.copy(), list(carried.get(-1, {}))
    for index, bodies in carried.items():
        if index >= 0:
            rest = remaining[index] - sum(bodies.values())
            if margin(rest) > 0.0:
                remaining[index] = rest
                removed += bodies
    return remaining, frozenset(removed)


class _Tree:
    """Links and joints of a description by name; locked joints not in `removed` count as fixed."""

    def __init__(self, root: Element, model: RobotModel, removed: Collection[str]) -> None:
        # children only: transmissions have <joint> elements too
        self.links, self.joints = root.named("link"), root.named("joint")
        self._rigid: list[Element] = []
        missing = [name for name in model.joint_names if name not in self.joints]
        if missing:
            raise WriteBackError(f"the description has no joint {missing[0]!r}")
        for name, joint in self.joints.items():
            if joint.attributes.get("type") == "fixed":
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
        named = joint.child(end)
        name = named.attributes.get("link", "") if named else ""
        if name not in self.links:
            raise WriteBackError(
                f"joint {joint.attributes.get('name')!r} has no {end} link in the description"
            )
        return self.links[name]


def _inertia_edits(source: XmlSource, link: Element, of: Body) -> Iterator[Edit]:
    """Set or insert the inertial element of a link."""
    element = link.child("inertial")
    origin = element and element.child("origin")
    rotation = _rotation(origin.attributes.get("rpy", "")) if origin else np.eye(3)
    tensor = rotation.T @ of.inertia @ rotation
    parts = {
        "origin": {"xyz": as_text(of.centre)},
        "mass": {"value": as_text(of.mass)},
        "inertia": {name: as_text(tensor[index]) for name, index in TENSOR.items()},
    }
    if element is not None:
        yield from _set(source, element, parts)
        return
    parts["origin"]["rpy"] = "0 0 0"
    tags = [f"  {_tag(name, values)}" for name, values in parts.items()]
    yield source.with_first_child(link, ["<inertial>", *tags, "</inertial>"])


def _set(
    source: XmlSource, parent: Element, parts: Mapping[str, Mapping[str, str]]
) -> Iterator[Edit]:
    """Set attributes of an element's children, and insert missing children."""
    missing = []
    for name, values in parts.items():
        if (child := parent.child(name)) is None:
            missing.append(_tag(name, values))
        else:
            yield source.with_attributes(child, values)
    if missing:
        yield source.with_first_child(parent, missing)


def _tag(name: str, values: Mapping[str, str]) -> str:
    return f"<{name} " + " ".join(f'{key}="{value}"' for key, value in values.items()) + "/>"


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
        raise NotConsistentError(f"parameter {model.standard_names[index]} is not finite")
    _require_consistent_links(model, inertial, "write the physically consistent estimate")
    rotors = model.layout.rotor_matrix(standard)
    for joint, rotor in zip(model.joint_names, np.diag(rotors), strict=True):
        if not rotor >= 0.0:
            raise NotConsistentError(f"the rotor of joint {joint!r} is negative")
    smallest, directions = np.linalg.eigh(rotors)
    if smallest[0] < -_ROUNDING * np.abs(rotors).max(initial=0.0):
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


def _compare(
    text: str, model: RobotModel, inertial: Array, dynamics: Sequence[Mapping[str, float]]
) -> None:
    """Raise `WriteBackError` unless the text reads back with the written parameters."""
    chain = chain_from_urdf(text, model.locked)
    if chain.joint_names != model.joint_names:
        raise WriteBackError("the description has other joints than the model")
    motion = np.random.default_rng(_SEED).uniform(-2.0, 2.0, (3, _STATES, model.n_joints))
    plan = RegressorPlan.of_bodies(model.chain, model.gravity)
    expected = plan.torque(inertial.reshape(-1), *motion)
    arm = pinocchio_model(text, model.locked)
    arm.gravity.linear = model.gravity
    error = np.abs(rnea(arm, *motion) - expected).max(axis=0)
    allowed = _ROUNDING * max(float(np.abs(expected).max()), 1.0)
    for joint in np.flatnonzero(~(error <= allowed)):
        raise WriteBackError(
            f"the torque of joint {model.joint_names[joint]!r} differs by {error.max():.3g} in the"
            " written description"
        )
    if not np.allclose(chain.inertial, inertial, rtol=0.0, atol=_ROUNDING * np.abs(inertial).max()):
        raise WriteBackError("the written description has other inertial parameters")
    _require_consistent_links(model, chain.inertial, "by rounding in the written text")
    written = {
        joint.get("name"): joint.find("dynamics") for joint in urdf_tree(text).findall("joint")
    }
    for name, values in zip(model.joint_names, dynamics, strict=True):
        for attribute, value in values.items():
            found = written[name]
            if found is None or float(found.get(attribute, "nan")) != value:
                raise WriteBackError(f"{attribute} of joint {name!r} was not written")


def rnea(arm: pin.Model, q: Array, qd: Array, qdd: Array) -> Array:
    """Return pinocchio's torques (m, n) of a model, for motion arrays (m, n)."""
    data = arm.createData()
    neutral = pin.neutral(arm)  # continuous joints have two coordinates
    return np.array(
        [
            pin.rnea(arm, data, pin.integrate(arm, neutral, a), b, c)
            for a, b, c in zip(q, qd, qdd, strict=True)
        ]
    )
