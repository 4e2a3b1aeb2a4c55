"""Postures of an arm checked by the shapes that were found, and by heights of its links."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element, tostring

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from identification.excitation import (
    CollisionChecker,
    CollisionModelError,
    MissingMeshError,
    Workspace,
)
from identification.excitation.collision import PairExceptions
from identification.excitation.separation import frames
from identification.model.kinematics import chain_from_urdf
from identification.model.urdf_text import urdf_tree
from planner import JointLimits

MIN_FRAME_HEIGHT: Final = 0.05
"""Height over a floor [m] of the frames of links, which are thicker at most places."""


class PartialCheck(NamedTuple):
    """Postures that are clear of all known shapes."""

    clear: NDArray[np.bool_]  #: (m,)
    exceptions: PairExceptions
    links: tuple[str, ...]  #: without shapes, or with a mesh that was not found


def check_by_found_shapes(
    urdf: str,
    postures: Array,
    workspace: Workspace,
    limits: JointLimits,
    mesh_folders: Sequence[str],
) -> PartialCheck:
    """Return which postures are clear; links without shapes are checked for the floor only.

    Args:
        urdf: text.
        postures: (m, n) [rad or m].
        workspace: around the arm.
        limits: of the joints.
        mesh_folders: in which meshes are searched for.

    Raises:
        CollisionModelError: a shape that is there cannot be read.
    """
    root = urdf_tree(urdf)
    links: list[str] = []
    if root.find("link/collision") is None:
        links = [link.get("name", "") for link in root.findall("link")]
    while root.find("link/collision") is not None:
        try:
            checker = CollisionChecker(tostring(root, "unicode"), workspace, limits, mesh_folders)
        except MissingMeshError as error:
            links += _without(root, error.mesh)
            continue
        except CollisionModelError:
            if not links:
                raise
            break  # the base alone has shapes
        clear = checker.clear(postures)
        if links:
            clear &= _above_floor(urdf, postures, workspace)
        return PartialCheck(clear, checker.exceptions, tuple(links))
    return PartialCheck(_above_floor(urdf, postures, workspace), PairExceptions(), tuple(links))


def _without(root: Element, mesh: str) -> list[str]:
    """Remove the shapes of links that have a mesh; return these links."""
    changed = []
    for link in root.findall("link"):
        if mesh in [each.get("filename") for each in link.findall("collision/geometry/mesh")]:
            for shape in link.findall("collision"):
                link.remove(shape)
            changed.append(link.get("name", ""))
    if not changed:
        raise MissingMeshError(mesh)
    return changed


def _above_floor(urdf: str, postures: Array, workspace: Workspace) -> NDArray[np.bool_]:
    """Return the postures (m,) in which no frame of a link is near the floor.

    Those of which no posture changes the height, as of a rotating foot, do not count.
    """
    if workspace.floor is None:
        return np.ones(len(postures), np.bool_)
    chain = chain_from_urdf(urdf)
    at = frames(chain, postures)
    links = [frame for frame in chain.frames.values() if frame.joint >= 0]
    heights = np.array(
        [
            at.translation[link.joint + 1, 2] + link.translation @ at.rotation[link.joint + 1, 2]
            for link in links
        ]
    )
    rises = np.ptp(heights, axis=1) > workspace.margin
    least = workspace.floor + workspace.margin + MIN_FRAME_HEIGHT
    return np.asarray((heights[rises] >= least).all(axis=0))
