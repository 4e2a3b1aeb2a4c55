"""What a viewer draws the arm with: its description, and where links are that never move."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final
from xml.etree.ElementTree import Element, ParseError, fromstring

from hil.archive.cdr import LayoutBuilder, LayoutError
from hil.archive.schema import DESCRIPTION_CHANNEL, TRANSFORM_CHANNEL, Channel

WORLD: Final = "world"
"""Frame that the base stands in, where the description has no link of that name."""


def description_messages(urdf: bytes) -> dict[Channel, bytes]:
    """The messages that describe an arm, by channel; none of what is no URDF, or is too long."""
    builder = LayoutBuilder()
    try:
        text = urdf.decode()
        builder.string(text)
        return {
            DESCRIPTION_CHANNEL: builder.build().template,
            TRANSFORM_CHANNEL: _encoded([*_transforms(text)]),
        }
    except (LayoutError, LookupError, ParseError, ValueError):
        return {}


_Transform = tuple[str, str, list[float]]


def _transforms(urdf: str) -> Iterator[_Transform]:
    """Parent, child, and the child's origin [m] and quaternion (x, y, z, w) in the parent.

    Raises:
        ParseError: the text is no XML.
        ValueError: a number is none, or there is no link.
    """
    root = fromstring(urdf)
    links = [link.get("name", "") for link in root.findall("link")]
    if not links:
        raise ValueError("it has no link")
    joints = root.findall("joint")
    children = {_link(joint, "child") for joint in joints}
    for base in links:
        if WORLD not in links and base not in children:
            yield WORLD, base, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    for joint in joints:
        if joint.get("type") == "fixed":
            origin = joint.find("origin")
            stated = {} if origin is None else origin.attrib
            xyz, (roll, pitch, yaw) = (
                [float(x) for x in stated.get(key, "0 0 0").split()] for key in ("xyz", "rpy")
            )
            yield (
                _link(joint, "parent"),
                _link(joint, "child"),
                [*xyz, *_quaternion(roll, pitch, yaw)],
            )


def _link(joint: Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else found.get("link", "")


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Turns about the fixed axes x, y and z in that order, as (x, y, z, w)."""
    (a, p), (b, q), (c, r) = ((math.sin(t / 2.0), math.cos(t / 2.0)) for t in (roll, pitch, yaw))
    return (
        a * q * r - p * b * c,
        p * b * r + a * q * c,
        p * q * c - a * b * r,
        p * q * r + a * b * c,
    )


def _encoded(transforms: list[_Transform]) -> bytes:
    builder = LayoutBuilder()
    builder.count(len(transforms))
    for k, (parent, child, _) in enumerate(transforms):
        builder.variable(f"stamp{k}", "uint32", 2)  # zero: at all times
        builder.string(parent)
        builder.string(child)
        builder.variable(f"pose{k}", "float64", 7)
    row = builder.build().rows(1)
    for k, (_, _, pose) in enumerate(transforms):
        row[f"pose{k}"] = pose
    return row.tobytes()
