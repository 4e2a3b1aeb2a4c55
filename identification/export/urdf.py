"""The way back: a URDF with identified inertia and friction, everything else as it was.

- A moving link gets mass, centre of mass and the tensor about it, in the axes of the inertial
  frame it had (its ``rpy`` stays).
- What is fixed to a moving link cannot be distinguished from it. Its inertia is contained in the
  moving link's, so its own ``<inertial>`` is removed, with a comment in its place.
- A locked joint, and what it carries, stays as it was; the moving link gets what is left of the
  identified inertia. Where that is no possible body, the locked links are treated as fixed ones.
- The base and what is fixed to it keep theirs: no torque depends on it.
- ``<dynamics>`` gets viscous friction as ``damping`` and Coulomb friction as ``friction``.
- A payload is known and no part of the arm: it is not written.
- What a URDF has no place for, such as rotor inertias, :func:`not_in_urdf` names; see
  :func:`identification.export.parameters.parameters_json`.

The text is read back and its inverse dynamics, by pinocchio, compared with the regressor's before
it is returned.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
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
from identification.model.regressor import LINK_SYMBOLS, RegressorPlan
from identification.model.robot import RobotModel

Array = NDArray[np.float64]


# An XML library that writes a tree again loses comments, the order and spacing of attributes, and
# line ends. Here only the bytes of what changes are replaced.


def comment_text(text: str) -> str:
    """Return text that may stand inside a comment, which two dashes in a row would end."""
    return re.sub("-(?=-)", "- ", text)


@dataclass(eq=False)
class Element:
    """One element and where it stands in the UTF-8 text.

    Attributes:
        name: of the tag.
        attributes: as parsed.
        start: first byte of the opening tag.
        inside: first byte behind the opening tag.
        end: first byte behind the whole element.
        children: elements directly inside.
    """

    name: str
    attributes: dict[str, str]
    start: int
    inside: int
    end: int = -1
    children: list[Element] = field(default_factory=list)

    def child(self, name: str) -> Element | None:
        """Return the first child of that name."""
        return next((child for child in self.children if child.name == name), None)


class Edit(NamedTuple):
    """Replace the bytes from `start` to `end` (nothing, if equal) with `text`."""

    start: int
    end: int
    text: str


class XmlSource:
    """An XML text that can be edited in place.

    Args:
        text: the whole file.

    Attributes:
        root: its outermost element.

    Raises:
        ModelError: the text is not well-formed XML.
    """

    def __init__(self, text: str) -> None:
        self._bytes = text.encode("utf-8")
        self.root = self._parse()

    def opening(self, element: Element) -> str:
        """Return the opening tag, as written."""
        return self._bytes[element.start : element.inside].decode("utf-8")

    def indentation(self, element: Element) -> str:
        """Return the white space in front of an element that begins its line, else nothing."""
        before = self._bytes[: element.start].decode("utf-8")
        line = before[before.rfind("\n") + 1 :]
        return line if not line.strip() else ""

    @property
    def newline(self) -> str:
        """The text's line end."""
        return "\r\n" if b"\r\n" in self._bytes else "\n"

    def edited(self, edits: Iterable[Edit]) -> str:
        """Return the text with edits applied, which must not overlap."""
        data = self._bytes
        for edit in sorted(edits, reverse=True):
            data = data[: edit.start] + edit.text.encode("utf-8") + data[edit.end :]
        return data.decode("utf-8")

    def with_attributes(self, element: Element, values: dict[str, str]) -> Edit:
        """Return the edit that sets attributes; others, and their order, stay."""
        tag = self.opening(element)
        for name, value in values.items():
            written = f'"{escape(value, {chr(34): "&quot;"})}"'
            pattern = re.compile(rf"(\s{re.escape(name)}\s*=\s*)(\"[^\"]*\"|'[^']*')")
            if found := pattern.search(tag):
                tag = tag[: found.start(2)] + written + tag[found.end() :]
            else:
                at = re.search(r"\s*/?>$", tag)
                assert at is not None, "an opening tag ends so"
                tag = f"{tag[: at.start()]} {name}={written}{tag[at.start() :]}"
        return Edit(element.start, element.inside, tag)

    def with_first_child(self, element: Element, lines: list[str]) -> Edit:
        """Return the edit that puts lines of XML directly behind the opening tag."""
        outer = self.indentation(element)
        children = [self.indentation(child) for child in element.children]
        inner = next((indent for indent in children if indent), outer + "  ")
        block = "".join(f"{self.newline}{inner}{line}" for line in lines)
        tag = self.opening(element)
        if tag.endswith("/>"):
            opened = tag[:-2].rstrip() + ">"
            closing = f"{self.newline}{outer}</{element.name}>"
            return Edit(element.start, element.end, opened + block + closing)
        return Edit(element.inside, element.inside, block)

    def _parse(self) -> Element:
        parser = expat.ParserCreate("utf-8")
        open_elements: list[Element] = []
        roots: list[Element] = []

        def opened(name: str, attributes: dict[str, str]) -> None:
            start = parser.CurrentByteIndex
            element = Element(name, attributes, start, self._behind_tag(start))
            (open_elements[-1].children if open_elements else roots).append(element)
            open_elements.append(element)

        def closed(_: str) -> None:
            element = open_elements.pop()
            if self._bytes[element.inside - 2 : element.inside] == b"/>":
                element.end = element.inside
            else:
                element.end = self._bytes.index(b">", parser.CurrentByteIndex) + 1

        parser.StartElementHandler = opened
        parser.EndElementHandler = closed
        try:
            parser.Parse(self._bytes, True)
        except expat.ExpatError as error:
            raise ModelError(f"the robot description is no XML: {error}") from error
        return roots[0]

    def _behind_tag(self, start: int) -> int:
        """Return the first byte behind the tag that begins at `start`; values may contain '>'."""
        tag = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>").match(self._bytes, start)
        assert tag is not None, "the parser has seen a whole tag here"
        return tag.end()


def with_comment(text: str, lines: Sequence[str]) -> str:
    """Return an XML text with a comment of these lines in front of its first element.

    Raises:
        ModelError: the text is not well-formed XML.
    """
    source = XmlSource(text)
    inside = comment_text(source.newline.join(f"  {line}" for line in lines))
    comment = f"<!--{source.newline}{inside}{source.newline}-->{source.newline}"
    at = source.root.start
    return source.edited([Edit(at, at, comment)])


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
    removed: set[str] = set()
    for carrier in {one.carrier for one in locked}:
        carried = [one for one in locked if one.carrier == carrier]
        if carrier >= 0:
            rest = left[carrier] - sum(one.inertial for one in carried)
            if not margin(rest) > 0.0:
                continue
            left[carrier] = rest
        removed.update(one.joint for one in carried)
    return left, frozenset(removed)


_N_LINK: Final = len(LINK_SYMBOLS)
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
# Of the largest torque of a joint: what going through centre of mass and decimal text may cost.
_ROUNDING: Final = 1e-8


class NotConsistentError(IdentificationError):
    """Parameters that no machine can have are not written into a robot description.

    Attributes:
        joint: whose link, rotor or friction it is.
    """

    def __init__(self, message: str, *, joint: str) -> None:
        super().__init__(message)
        self.joint = joint


class WriteBackError(IdentificationError):
    """The description cannot take the parameters, or does not give them back when read again."""


def write_urdf(urdf: str, model: RobotModel, standard: Array, friction: Array | None = None) -> str:
    """Return the URDF text with other inertial parameters, and friction if given.

    Args:
        urdf: the text of the file that the model was made from.
        model: the robot.
        standard: all standard parameters (s,), as in `model.standard_names`.
        friction: coefficients (k,), see `RobotModel.friction_part`; none leaves
            ``<dynamics>`` as it is, NaN leaves that figure.

    Raises:
        NotConsistentError: a link, a rotor or friction is not physically possible.
        WriteBackError: the text is not of this robot, or reads back as another.
        ModelError: the text is no URDF.
        ShapeError: an array does not have the shape it should have.
    """
    standard = model.layout.checked(standard)
    inertial = standard[model.layout.links]
    coefficients: dict[str, dict[str, float]] = {}
    if friction is not None:
        coefficients = dict(zip(model.joint_names, model.friction.table(friction), strict=False))
    _refuse_impossible(model, standard, inertial, coefficients)
    bodies, removed = without_locked(inertial, locked_bodies(urdf, model))
    source = XmlSource(urdf)
    tree = _Tree(source.root, model, removed)
    edits: list[Edit] = []
    for joint, parameters in zip(model.joint_names, bodies, strict=True):
        link = tree.link_of(joint)
        edits += _inertia_edits(source, link, body(parameters))
        for merged in tree.fixed_to(link):
            if (element := merged.child("inertial")) is not None:
                # Its mass is counted with the link that it is fixed to.
                name = comment_text(link.attributes["name"])
                note = f"<!-- inertia is contained in {name} -->"
                edits.append(Edit(element.start, element.end, note))
        edits += _friction_edits(source, tree.joints[joint], coefficients.get(joint, {}))
    text = source.edited(edits)
    _compare(text, model, inertial, coefficients)
    return text


def not_in_urdf(model: RobotModel) -> tuple[str, ...]:
    """Return in words which of the model's parameters a URDF has no place for."""
    absent = {
        "rotor inertias": model.rotor_inertia,
        "coupling inertias": bool(model.layout.pairs),
        **{kind.words: not kind.urdf for kind in model.friction.kinds},
        "friction of coupled motors": bool(model.friction.motors),
        "the payload": model.payload is not None,
        "springs and balancers": bool(model.elements.elements),
    }
    return tuple(words for words, there in absent.items() if there)


class _Tree:
    """Links and joints of a description by name; locked joints not in `removed` count as fixed."""

    def __init__(self, root: Element, model: RobotModel, removed: Collection[str]) -> None:
        self.links = {e.attributes.get("name", ""): e for e in root.children if e.name == "link"}
        # Not every <joint> is one: a transmission has elements of that name, deeper down.
        self.joints = {e.attributes.get("name", ""): e for e in root.children if e.name == "joint"}
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
                    f"joint {name!r} moves in the description but not in the model: the inertia"
                    " of its payload is not known by itself"
                )

    def link_of(self, joint: str) -> Element:
        """Return the link that a joint moves."""
        return self._end(self.joints[joint], "child")

    def fixed_to(self, link: Element) -> Iterator[Element]:
        """Yield the links that fixed joints carry on from a link, all the way."""
        for joint in self._rigid:
            if self._end(joint, "parent") is link:
                carried = self._end(joint, "child")
                yield carried
                yield from self.fixed_to(carried)

    def _end(self, joint: Element, end: str) -> Element:
        named = joint.child(end)
        name = named.attributes.get("link", "") if named else ""
        if name not in self.links:
            raise WriteBackError(
                f"joint {joint.attributes.get('name')!r} has no {end} link in the description"
            )
        return self.links[name]


def _inertia_edits(source: XmlSource, link: Element, of: Body) -> Iterator[Edit]:
    """Set, or put in, the inertial element of a link."""
    element = link.child("inertial")
    if element is None:
        parts = {
            "origin": {"xyz": as_text(of.centre), "rpy": "0 0 0"},
            "mass": {"value": as_text(of.mass)},
            "inertia": _tensor_attributes(of.inertia),
        }
        tags = [f"  {_tag(name, values)}" for name, values in parts.items()]
        lines = ["<inertial>", *tags, "</inertial>"]
        yield source.with_first_child(link, lines)
        return
    origin, mass, tensor = (element.child(name) for name in ("origin", "mass", "inertia"))
    turn = _rotation(origin.attributes.get("rpy", "")) if origin else np.eye(3)
    turned = turn.T @ of.inertia @ turn
    missing = []
    for name, child, values in (
        ("origin", origin, {"xyz": as_text(of.centre)}),
        ("mass", mass, {"value": as_text(of.mass)}),
        ("inertia", tensor, _tensor_attributes(turned)),
    ):
        if child is None:
            missing.append(_tag(name, values))
        else:
            yield source.with_attributes(child, values)
    if missing:
        yield source.with_first_child(element, missing)


def _friction_edits(
    source: XmlSource, joint: Element, coefficients: dict[str, float]
) -> Iterator[Edit]:
    """Set, or put in, damping and dry friction of a joint."""
    values = {
        attribute: as_text(coefficients[symbol])
        for symbol, attribute in _DYNAMICS.items()
        if math.isfinite(coefficients.get(symbol, math.nan))
    }
    if not values:
        return
    element = joint.child("dynamics")
    if element is None:
        yield source.with_first_child(joint, [_tag("dynamics", values)])
    else:
        yield source.with_attributes(element, values)


def _tag(name: str, values: dict[str, str]) -> str:
    return f"<{name} " + " ".join(f'{key}="{value}"' for key, value in values.items()) + "/>"


def _tensor_attributes(tensor: Array) -> dict[str, str]:
    return {name: as_text(tensor[place]) for name, place in TENSOR.items()}


def as_text(values: float | Sequence[float] | Array) -> str:
    """Return numbers as the shortest text that is read back as the same ones."""
    # No minus in front of zero.
    return " ".join(repr(float(value) + 0.0) for value in np.atleast_1d(values))


def _rotation(rpy: str) -> Array:
    """Return the rotation of a URDF's roll, pitch and yaw, about fixed axes; none is none."""
    if not rpy.strip():
        return np.eye(3)
    return np.asarray(pin.rpy.rpyToMatrix(np.array([float(angle) for angle in rpy.split()])))


def _refuse_impossible(
    model: RobotModel,
    standard: Array,
    inertial: Array,
    coefficients: dict[str, dict[str, float]],
) -> None:
    """Raise `NotConsistentError` for what no machine can have."""
    joint_values, n = model.layout.width, model.n_joints
    for place, (name, value) in enumerate(zip(model.standard_names, standard, strict=True)):
        if not math.isfinite(value):
            between = place - n * joint_values
            own = place // joint_values if between < 0 else model.layout.pairs[between][0]
            joint = model.joint_names[own]
            raise NotConsistentError(
                f"parameter {name} of joint {joint!r} is no number", joint=joint
            )
    for joint, smallest in zip(model.joint_names, margin(inertial), strict=True):
        if not smallest > 0.0:
            raise NotConsistentError(
                f"the link of joint {joint!r} is no possible body: its pseudo-inertia has the"
                f" eigenvalue {smallest:.3g}; write the physically consistent estimate",
                joint=joint,
            )
    rotors = model.layout.rotor_matrix(standard)
    for joint, rotor in zip(model.joint_names, np.diag(rotors), strict=True):
        if not rotor >= 0.0:
            raise NotConsistentError(f"the rotor of joint {joint!r} is negative", joint=joint)
    smallest, directions = np.linalg.eigh(rotors)
    if smallest[0] < -_ROUNDING * np.abs(rotors).max(initial=0.0):
        joint = model.joint_names[int(np.argmax(np.abs(directions[:, 0])))]
        raise NotConsistentError(
            f"the coupling inertias of joint {joint!r} are too large for its rotors", joint=joint
        )
    for joint, terms in coefficients.items():
        for symbol, attribute in _DYNAMICS.items():
            if terms.get(symbol, 0.0) < 0.0:
                raise NotConsistentError(
                    f"{attribute} of joint {joint!r} is {terms[symbol]:.3g}; friction takes"
                    " energy, it is never negative",
                    joint=joint,
                )


def _compare(
    text: str, model: RobotModel, inertial: Array, coefficients: dict[str, dict[str, float]]
) -> None:
    """Raise `WriteBackError` unless the text is read back as the robot that was meant."""
    chain = chain_from_urdf(text, model.locked)
    if chain.joint_names != model.joint_names:
        raise WriteBackError("the description is of another robot: its joints are not the model's")
    n = model.n_joints
    q, qd, qdd = np.random.default_rng(_SEED).uniform(-2.0, 2.0, (3, _STATES, n))
    plan = RegressorPlan.of_bodies(model.chain, model.gravity)
    expected = plan.torque(inertial.reshape(-1), q, qd, qdd)
    arm = pinocchio_model(text, model.locked)
    arm.gravity.linear = model.gravity
    error = np.abs(rnea(arm, q, qd, qdd) - expected).max(axis=0)
    # Links of very different mass share the rounding of the largest.
    allowed = _ROUNDING * max(float(np.abs(expected).max()), 1.0)
    wrong = np.flatnonzero(~(error <= allowed))
    if len(wrong):
        joint = model.joint_names[int(wrong[0])]
        raise WriteBackError(
            f"the written description gives other torques: joint {joint!r} by {error.max():.3g}"
        )
    if not np.allclose(chain.inertial, inertial, rtol=0.0, atol=_ROUNDING * np.abs(inertial).max()):
        raise WriteBackError("the written description gives other inertial parameters")
    for joint, smallest in zip(model.joint_names, margin(chain.inertial), strict=True):
        if not smallest > 0.0:
            raise NotConsistentError(
                f"the link of joint {joint!r} is so close to the edge of what is possible that"
                " rounding takes it beyond",
                joint=joint,
            )
    elements = XmlSource(text).root.children
    joints = {e.attributes.get("name"): e for e in elements if e.name == "joint"}
    for joint, values in coefficients.items():
        dynamics = joints[joint].child("dynamics")
        for symbol, attribute in _DYNAMICS.items():
            wanted = values.get(symbol, math.nan)
            if math.isfinite(wanted) and (
                dynamics is None or float(dynamics.attributes[attribute]) != wanted
            ):
                raise WriteBackError(f"{attribute} of joint {joint!r} was not written")


def rnea(arm: pin.Model, q: Array, qd: Array, qdd: Array) -> Array:
    """Return pinocchio's torques (m, n) of a model, for motion arrays (m, n)."""
    data = arm.createData()
    still = pin.neutral(arm)  # joints that turn on and on have two coordinates
    return np.array(
        [
            pin.rnea(arm, data, pin.integrate(arm, still, a), b, c)
            for a, b, c in zip(q, qd, qdd, strict=True)
        ]
    )
