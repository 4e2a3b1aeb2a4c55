"""The chain of joints of a URDF; links in the frame of their joint, parents first."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import ModelError
from identification.model.urdf_text import XACRO, left_by_xacro, refusal, urdf_tree

_JOINT_TYPES: Final = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_WITH_LIMIT: Final = ("revolute", "prismatic")


def urdf_fault(text: str) -> str | None:
    """Return a message about the first fault of a URDF that pinocchio cannot read, if found.

    Raises:
        ModelError: it is not XML.
    """
    root = urdf_tree(text)
    if any(left_by_xacro(element.tag, element.attrib) for element in root.iter()):
        return XACRO
    if root.tag != "robot":
        return f"its root element is <{root.tag}>, not <robot>"
    if "name" not in root.attrib:
        return 'its <robot> has no name; write <robot name="...">'
    links = [link.get("name", "") for link in root.findall("link")]
    joints = root.findall("joint")
    if not links:
        return "it has no <link>"
    for kind, names in (("link", links), ("joint", [joint.get("name", "") for joint in joints])):
        name, count = Counter(names).most_common(1)[0] if names else ("", 0)
        if count > 1:
            return f"{count} of its {kind}s are called {name!r}"
    for joint in joints:
        if (fault := _joint_fault(joint, links)) is not None:
            return f"joint {joint.get('name', '')!r} {fault}"
    children = [end.get("link", "") for joint in joints for end in joint.findall("child")]
    roots = [link for link in links if link not in children]
    if not roots:
        return "every link is the child of a joint: a closed chain"
    if len(roots) > 1:
        return f"links {', '.join(map(repr, roots))} have no parent joint; only the base may not"
    return None


def _joint_fault(joint: Element, links: list[str]) -> str | None:
    kind = joint.get("type")
    if kind not in _JOINT_TYPES:
        return f"is of type {kind!r}; known are {', '.join(_JOINT_TYPES)}"
    for end in ("parent", "child"):
        named = joint.find(end)
        link = None if named is None else named.get("link")
        if link is None:
            return f"has no <{end} link=...>"
        if link not in links:
            return f"has the {end} link {link!r}, which the description does not have"
    if kind in _WITH_LIMIT and joint.find("limit") is None:
        return f"is {kind} and has no <limit>; add one, or make it continuous"
    return None


def closed_chain(text: str) -> str | None:
    """Return a message about a link that is the child of two joints, which pinocchio accepts.

    Raises:
        ModelError: it is not XML.
    """
    joints = urdf_tree(text).findall("joint")
    children = Counter(end.get("link", "") for joint in joints for end in joint.findall("child"))
    name, count = children.most_common(1)[0] if children else ("", 0)
    return f"link {name!r} is the child of {count} joints: a closed chain" if count > 1 else None


# Indices of `LINK_SYMBOLS` in pinocchio's order m, mcx, mcy, mcz, Ixx, Ixy, Iyy, Ixz, ...
PINOCCHIO_ORDER = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)

MAX_MOVING_JOINTS: Final = 64
"""Largest number of joints; a model of 100 takes a minute and 1.5 GB."""

MAX_DISTANCE: Final = 1e6
"""Largest coordinate of joints and shapes, m."""

_LINK = "link "
_UNIT_LENGTH_TOLERANCE: Final = 1e-6  # tolerance of the length of a unit axis


class LinkFrame(NamedTuple):
    """Frame of a link of the description."""

    joint: int  # that moves it, -1: none
    rotation: Array  # axes in the frame of that joint (3, 3)
    translation: Array  # origin in that frame (3,) [m]


@dataclass(frozen=True, eq=False)
class Chain:
    """A tree of n revolute and prismatic joints on a fixed base."""

    joint_names: tuple[str, ...]  # n names, depth first
    parents: NDArray[np.intp]  # index of the parent joint, -1 for the base, shape (n,)
    rotation: Array  # axes of joint frame i at q = 0 in its parent's frame, shape (n, 3, 3)
    translation: Array  # origin of joint frame i in its parent's frame [m], shape (n, 3)
    axis: Array  # unit joint axis in the joint's own frame, shape (n, 3)
    revolute: NDArray[np.bool_]  # False for prismatic joints, shape (n,)
    # nominal parameters of each link (:data:`identification.model.link_wrenches.LINK_SYMBOLS`) in
    # the joint frame, shape (n, 10)
    inertial: Array
    # of all links of the description by name, fixed ones included
    frames: dict[str, LinkFrame] = field(default_factory=dict, repr=False)

    @property
    def position_units(self) -> tuple[str, ...]:
        """Unit of each joint's position (n,): rad, or m of prismatic joints."""
        return tuple("rad" if turns else "m" for turns in self.revolute)

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.joint_names)

    @property
    def last_joint(self) -> int:
        """Index of the joint that carries flange and payload: the last one of the longest arm.

        Wheels and heads of a mobile robot hang on fewer joints than its flange. Of arms of equal
        length, it is the last joint of the last arm.
        """
        return max(range(self.n_joints), key=lambda joint: (len(self.ancestors(joint)), joint))

    def frame(self, name: str | None) -> LinkFrame:
        """Return the frame of a moving link, by default the last joint's.

        Raises:
            ModelError: the description has no such link, or it is fixed to the base.
        """
        if name is None:
            return LinkFrame(self.last_joint, np.eye(3), np.zeros(3))
        if name not in self.frames:
            raise ModelError(
                f"the payload's frame {name!r} is not a link of the robot description; its links"
                f" are {', '.join(self.frames)}"
            )
        if self.frames[name].joint < 0:
            raise ModelError(f"the payload's frame {name!r} is fixed to the base")
        return self.frames[name]

    def link(self, joint: int) -> str:
        """Return the name of the link that a joint moves, "" without frames."""
        return next((name for name, frame in self.frames.items() if frame.joint == joint), "")

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the joints that move link `joint`, from the base to the joint itself."""
        path = [joint]
        while (parent := int(self.parents[path[-1]])) >= 0:
            path.append(parent)
        return tuple(reversed(path))


def chain_from_urdf(urdf: str, locked: Mapping[str, float] | None = None) -> Chain:
    """Read a chain from URDF text; links of fixed joints are merged with their parents.

    Raises:
        ModelError: the text is not a URDF, has no moving joint or more than `MAX_MOVING_JOINTS`, a
            joint of another type than revolute, continuous, prismatic or fixed, or no joint of a
            name in `locked` (positions [rad or m]).
    """
    return _chain(urdf, tuple((locked or {}).items()))


@lru_cache(maxsize=8)  # models of one arm differ in drives and friction
def _chain(urdf: str, locked: tuple[tuple[str, float], ...]) -> Chain:
    model = pinocchio_model(urdf, dict(locked))
    if model.njoints < 2:
        raise ModelError("the robot description has no revolute or prismatic joint")
    if model.njoints > 1 + MAX_MOVING_JOINTS:
        raise ModelError(
            f"the robot description has {model.njoints - 1} moving joints; at most "
            f"{MAX_MOVING_JOINTS} can be identified together; lock the others"
        )
    indices = range(1, model.njoints)
    axes, revolute = zip(*(_axis(model, i) for i in indices), strict=True)
    return Chain(
        joint_names=tuple(model.names[i] for i in indices),
        parents=np.array([model.parents[i] - 1 for i in indices], dtype=np.intp),
        rotation=np.array([model.jointPlacements[i].rotation for i in indices]),
        translation=np.array([model.jointPlacements[i].translation for i in indices]),
        axis=np.array(axes),
        revolute=np.array(revolute, dtype=np.bool_),
        inertial=np.array(
            [model.inertias[i].toDynamicParameters()[list(PINOCCHIO_ORDER)] for i in indices]
        ),
        frames={
            frame.name: LinkFrame(
                int(frame.parentJoint) - 1,
                frame.placement.rotation.copy(),
                frame.placement.translation.copy(),
            )
            for frame in model.frames
            if frame.type == pin.FrameType.BODY
        },
    )


def pinocchio_model(urdf: str, locked: Mapping[str, float] | None = None) -> pin.Model:
    """Return pinocchio's model of URDF text with locked joints fixed.

    Raises:
        ModelError: the text is not a valid URDF of an open chain
            (:func:`identification.model.urdf_text.refusal`), has an axis of length zero or a
            coordinate beyond `MAX_DISTANCE`, or no joint of a name in `locked`.
    """
    if (refused := refusal(urdf)) is not None:
        raise ModelError(f"the robot description is not a readable URDF: {refused}")
    try:
        model = pin.buildModelFromXML(urdf)
    except (ValueError, RuntimeError) as error:
        raise ModelError(
            f"the robot description is not a readable URDF: {urdf_fault(urdf) or error}"
        ) from error
    if (closed := closed_chain(urdf)) is not None:
        raise ModelError(f"the robot description is not an open chain: {closed}")
    for index in range(1, model.njoints):
        if model.joints[index].nv == 1 and not (
            abs(float(np.linalg.norm(_subspace(model, index))) - 1.0) < _UNIT_LENGTH_TOLERANCE
        ):
            name = model.names[index]
            raise ModelError(
                f'joint {name!r} has an <axis> of length zero; write one such as xyz="0 0 1"',
                joint=name,
            )
    if not locked:
        _require_near(model)
        return model
    posture = locked_posture(model, locked)
    # the reduction confuses joints and links of the same name
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            frame.name = _LINK + frame.name
    reduced = pin.buildReducedModel(model, [model.getJointId(name) for name in locked], posture)
    for frame in reduced.frames:
        frame.name = frame.name.removeprefix(_LINK)
    _require_near(reduced)
    return reduced


def locked_posture(model: pin.Model, locked: Mapping[str, float]) -> Array:
    """Return the configuration with joints at locked positions [rad or m], others at zero.

    Raises:
        ModelError: no joint has such a name, or a position is not finite.
    """
    posture = pin.neutral(model)
    names = list(model.names)[1:]
    for name, position in locked.items():
        if name not in names:
            moving_joints = ", ".join(names) or "none"
            raise ModelError(
                f"there is no moving joint {name!r} to lock; there are {moving_joints}"
            )
        if not math.isfinite(position):
            raise ModelError(
                f"joint {name!r} is locked at {position!r}; give a finite number", joint=name
            )
        joint = model.joints[model.getJointId(name)]
        if joint.nv == 1:
            step = np.zeros(model.nv)
            step[joint.idx_v] = position
            posture = pin.integrate(model, posture, step)
        elif position != 0.0:
            raise ModelError(
                f"joint {name!r} has {joint.nv} degrees of freedom; it can only be locked at 0",
                joint=name,
            )
    return np.asarray(posture)


def _axis(model: pin.Model, index: int) -> tuple[Array, bool]:
    """Return the joint axis in the joint frame, and whether the joint is revolute."""
    joint = model.joints[index]
    kind = joint.shortname()
    name = model.names[index]
    if joint.nv != 1 or not kind.startswith(("JointModelR", "JointModelP")):
        raise ModelError(
            f"joint {name!r} is of type {kind.removeprefix('JointModel')}; "
            "only revolute, continuous, prismatic and fixed joints can be identified",
            joint=name,
        )
    subspace = _subspace(model, index)
    linear = subspace[:3]
    angular = subspace[3:]
    revolute = bool(np.any(angular))
    return (angular if revolute else linear).copy(), revolute


def _require_near(model: pin.Model) -> None:
    """Check that all joints and links are within `MAX_DISTANCE` of their parents."""
    places = [*zip(model.names, model.jointPlacements, strict=True)]
    places += [(frame.name, frame.placement) for frame in model.frames]
    for name, place in places:
        if not np.abs(place.translation).max() <= MAX_DISTANCE:
            raise ModelError(
                f"{name!r} of the robot description is more than {MAX_DISTANCE:g} m away from its "
                "parent"
            )


def _subspace(model: pin.Model, index: int) -> Array:
    """Return the velocity of a joint with one degree of freedom at unit speed (6,)."""
    joint = model.joints[index]
    data = joint.createData()
    joint.calc(data, pin.neutral(model))
    return np.asarray(data.S, dtype=np.float64).reshape(6)


def skew(vector: Array) -> Array:
    """Return the (3, 3) matrix of ``vector x``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
