"""Bodies of collision checks: convex shapes on the links of an arm, and obstacles, with hulls."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from identification.arrays import Array
from identification.excitation.errors import CollisionModelError, MissingMeshError
from identification.model.kinematics import MAX_DISTANCE
from identification.model.urdf_text import urdf_tree
from identification.model.workspace import Workspace


def _unread_shapes(urdf: str, links: Iterable[str]) -> str | None:
    """Return a message if not all shapes of a link were read; `links` has the link of each."""
    read = Counter(links)
    for link in urdf_tree(urdf).findall("link"):
        name = link.get("name", "")
        written = sum(
            max(1, len(collision.findall("geometry/*"))) for collision in link.findall("collision")
        )
        if read[name] != written:
            return (
                f"of the {written} collision shapes of link {name!r} {read[name]} could be read; "
                "give each <collision> and <visual> element of the link one box, cylinder, sphere "
                "or mesh, with numbers separated by single spaces, a filename for a mesh, and a "
                "name for a material"
            )
    return None


_MISSING_MESH: Final = re.compile(r"Mesh (.+) could not be found")  # message of pinocchio


class Hull(NamedTuple):
    """Bounding volume of a shape: the Minkowski sum of a cylinder and a ball."""

    centre: Array  # of the cylinder, in the frame of the body's joint (3,) [m]
    axis: Array  # unit vector along it (3,)
    half_length: float  # of the cylinder [m]
    radius: float  # of the cylinder [m]
    ball: float  # radius of the ball [m]
    exact: bool  # whether it is the shape itself


@dataclass(frozen=True, eq=False)
class CollisionBody:
    """A convex shape that moves with a link, or an obstacle."""

    name: str  # of the link or obstacle
    shape_name: str  # of the shape; of an obstacle its name
    joint: int  # the joint that moves it, -1 for fixed bodies
    shape: coal.CollisionGeometry  # its geometry
    pose: coal.Transform3s  # in the frame of that joint
    hull: Hull  # its bounding volume
    normal: Array | None = None  # outward normal of a half-space (3,), else None
    half_sides: Array | None = None  # of a box along the base axes (3,) [m], else None


def described_shapes(model: pin.Model, urdf: str, mesh_folders: Sequence[str]) -> pin.GeometryModel:
    """Return the collision shapes of a robot description as pinocchio reads them.

    Raises:
        ValueError, RuntimeError: a mesh is missing, or a shape cannot be read.
    """
    # pinocchio 4.1 leaks a geometry model that it creates itself
    shapes = pin.GeometryModel()
    pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION, shapes, list(mesh_folders))
    return shapes


def link_bodies(model: pin.Model, urdf: str, mesh_folders: Sequence[str]) -> list[CollisionBody]:
    """Return the collision bodies of a robot description by joint, meshes as convex hulls.

    Raises:
        MissingMeshError: a mesh is missing.
        CollisionModelError: a shape is unreadable or too far away, or no moving link has one.
    """
    try:
        shapes = described_shapes(model, urdf, mesh_folders)
    except (ValueError, RuntimeError) as error:
        missing = _MISSING_MESH.search(str(error))
        if missing:
            raise MissingMeshError(missing[1]) from error
        reason = " ".join(str(error).split())
        raise CollisionModelError(f"collision shapes cannot be loaded: {reason}") from error
    names = [model.frames[item.parentFrame].name for item in shapes.geometryObjects]
    if (unread := _unread_shapes(urdf, names)) is not None:
        raise CollisionModelError(unread)
    bodies = []
    for item, link in zip(shapes.geometryObjects, names, strict=True):
        rotation = item.placement.rotation
        translation = item.placement.translation
        if not np.abs(translation).max() <= MAX_DISTANCE:
            raise CollisionModelError(
                f"collision shape {item.name!r} of the robot description is more than "
                f"{MAX_DISTANCE:g} m away from its parent"
            )
        shape = _convex(item.geometry, link)
        joint = item.parentJoint - 1
        pose = coal.Transform3s(rotation, translation)
        hull = _hull(shape, rotation, translation)
        bodies.append(CollisionBody(link, item.name, joint, shape, pose, hull))
    if not any(body.joint >= 0 for body in bodies):
        raise CollisionModelError("no moving link of the robot description has a collision shape")
    return sorted(bodies, key=lambda body: body.joint)


def _convex(shape: coal.CollisionGeometry, link: str) -> coal.CollisionGeometry:
    """Return the shape itself, or the convex hull of a mesh."""
    if isinstance(shape, coal.BVHModelBase):
        if np.all(np.abs(shape.vertices()) <= MAX_DISTANCE):
            with suppress(ValueError, RuntimeError):
                shape.buildConvexHull(True, "Qt")
                return shape.convex
        raise CollisionModelError(
            f"a collision mesh of link {link!r} has no volume, or vertices beyond"
            f" {MAX_DISTANCE:g} m"
        )
    sides = [getattr(shape, name, 0.0) for name in ("halfSide", "radius", "halfLength")]
    if min(float(np.min(side)) for side in sides) < 0.0:
        raise CollisionModelError(f"a collision shape of link {link!r} has a negative size")
    if not max(float(np.max(side)) for side in sides) <= MAX_DISTANCE:
        raise CollisionModelError(
            f"a collision shape of link {link!r} is larger than {MAX_DISTANCE:g} m"
        )
    return shape


def obstacles(workspace: Workspace) -> list[CollisionBody]:
    """Return floor and boxes as bodies."""
    bodies = []
    if workspace.floor is not None:
        normal = np.array([0.0, 0.0, 1.0])
        hull = Hull(normal * workspace.floor, normal, 0.0, 0.0, 0.0, exact=True)
        shape = coal.Halfspace(normal, workspace.floor)
        pose = coal.Transform3s.Identity()
        bodies.append(CollisionBody("floor", "floor", -1, shape, pose, hull, normal=normal))
    for i, box in enumerate(workspace.boxes):
        lower = np.array(box.lower, dtype=float)
        upper = np.array(box.upper, dtype=float)
        middle = (lower + upper) / 2.0
        half = (upper - lower) / 2.0
        shape = coal.Box(*(upper - lower))
        # separations use the half sides
        hull = Hull(middle, np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0, exact=False)
        pose = coal.Transform3s(np.eye(3), middle)
        bodies.append(CollisionBody(f"box {i}", f"box {i}", -1, shape, pose, hull, half_sides=half))
    return bodies


def _hull(shape: coal.CollisionGeometry, rotation: Array, translation: Array) -> Hull:
    centre = np.zeros(3)
    axis = np.array([0.0, 0.0, 1.0])
    half_length = radius = ball = 0.0
    exact = True
    if isinstance(shape, coal.Sphere):
        ball = shape.radius
    elif isinstance(shape, coal.Capsule):
        half_length = shape.halfLength
        ball = shape.radius
    elif isinstance(shape, coal.Cylinder):
        half_length = shape.halfLength
        radius = shape.radius
    else:
        centre, axis, half_length, radius = _around(_corners(shape))
        exact = False
    return Hull(translation + rotation @ centre, rotation @ axis, half_length, radius, ball, exact)


def _around(corners: Array) -> tuple[Array, Array, float, float]:
    """Return a cylinder around points (k, 3), along their longest extent."""
    lower = corners.min(axis=0)
    upper = corners.max(axis=0)
    centre = (lower + upper) / 2.0
    half = (upper - lower) / 2.0
    longest = int(np.argmax(half))
    across = np.delete(corners - centre, longest, axis=1)
    radius = float(np.max(np.linalg.norm(across, axis=1)))
    return centre, np.eye(3)[longest], float(half[longest]), radius


def _corners(shape: coal.CollisionGeometry) -> Array:
    """Return points (k, 3) whose convex hull contains a shape, in its own frame."""
    if isinstance(shape, coal.ConvexBase):
        return np.asarray(shape.points(), dtype=np.float64).reshape(-1, 3)
    shape.computeLocalAABB()
    box = shape.aabb_local
    return np.array(list(product(*zip(box.min_, box.max_, strict=True))))
