"""Joints of a gripper or hand in a URDF, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from identification.model.urdf_text import urdf_tree

_GRIPPER: Final = re.compile(
    r"finger|gripper|hand_|_hand|thumb|knuckle|claw|jaw|pinky|palm"
    r"|(?:^|_)(?:index|middle|ring|little)(?:_|$)",
    re.IGNORECASE,
)


def links_of(text: str) -> dict[str, tuple[str, str]]:
    """Return the links that each joint connects, parent and child."""
    return {
        joint.get("name", ""): (parent.get("link", ""), child.get("link", ""))
        for joint in urdf_tree(text).findall("joint")
        for parent in joint.findall("parent")
        for child in joint.findall("child")
    }


def gripper_joints(text: str, joint_names: Sequence[str]) -> list[str]:
    """Return the joints of a gripper or hand, by their names or the names of both links."""
    links = links_of(text)
    return [
        name
        for name in joint_names
        if _GRIPPER.search(name) or all(_GRIPPER.search(link) for link in links[name])
    ]
