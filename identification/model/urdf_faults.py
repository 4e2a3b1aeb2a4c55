"""What is wrong with a robot description that cannot be read, in one sentence.

The reader prints its findings where a user of ours does not look, and raises a general error.
"""

from __future__ import annotations

from collections import Counter
from typing import Final
from xml.etree.ElementTree import Element

from identification.model.urdf_text import XACRO, left_by_xacro
from identification.model.urdf_tree import urdf_tree

_JOINT_TYPES: Final = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_WITH_LIMIT: Final = ("revolute", "prismatic")


def urdf_fault(text: str) -> str | None:
    """Return the first fault of URDF text in words, None if it has none of the known ones.

    Raises:
        ModelError: it is no XML.
    """
    root = urdf_tree(text)
    if any(left_by_xacro(element.tag, element.attrib) for element in root.iter()):
        return XACRO
    if root.tag != "robot":
        return f"its outermost element is <{root.tag}>, not <robot>"
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
    return _tree_fault(links, joints)


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
            return f"has the {end} link {link!r}, which is no link of the description"
    if kind in _WITH_LIMIT and joint.find("limit") is None:
        return f"is {kind} and has no <limit>; add one, or make it continuous"
    return None


def closed_chain(text: str) -> str | None:
    """Return which link two joints move, which readers take for a tree without a word.

    Raises:
        ModelError: it is no XML.
    """
    joints = urdf_tree(text).findall("joint")
    children = Counter(end.get("link", "") for joint in joints for end in joint.findall("child"))
    name, count = children.most_common(1)[0] if children else ("", 0)
    return f"link {name!r} is the child of {count} joints: a closed chain" if count > 1 else None


def _tree_fault(links: list[str], joints: list[Element]) -> str | None:
    children = [end.get("link", "") for joint in joints for end in joint.findall("child")]
    roots = [link for link in links if link not in children]
    if not roots:
        return "every link is the child of a joint: a closed chain"
    if len(roots) > 1:
        return f"links {', '.join(map(repr, roots))} hang on nothing; one alone may be the base"
    return None
