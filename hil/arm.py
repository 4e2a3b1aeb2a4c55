"""The arm's outer shape, as its collision check sees it, for those who draw it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.excitation.collision.bodies import described_shapes
from identification.excitation.collision.hulls import joint_poses
from identification.model.kinematics import FARTHEST, Chain, chain_from_urdf

Array = NDArray[np.float64]

_AROUND = 24
"""Corners of the polygon that stands for a circle."""
_STICK = 0.02
"""Half the width of a stick, as a share of the arm's length."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body that moves with a joint (-1: base), with corners in its frame (v, 3) [m]."""

    name: str
    joint: int
    vertices: Array


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm made of convex bodies, or of sticks from joint to joint without `has_shapes`.

    `tip` is its displayed end in the frame of the last joint (3,) [m].
    """

    chain: Chain
    solids: tuple[Solid, ...]
    tip: Array
    has_shapes: bool

    @classmethod
    def from_urdf(cls, urdf: str, *, mesh_folders: Sequence[str] = ()) -> Self:
        """Build it from URDF text: its collision shapes, meshes as their convex hulls, else sticks.

        Raises:
            ModelError: the URDF is not that of an open chain.
        """
        chain = chain_from_urdf(urdf)
        model = pin.buildModelFromXML(urdf)
        solids = _described(model, urdf, mesh_folders)
        has_shapes = any(solid.joint >= 0 for solid in solids)
        tip = _tip(model, solids)
        return cls(chain, solids if has_shapes else _sticks(chain, tip), tip, has_shapes)

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return the frames of base and joints at postures (m, n): (1+n, m, 3, 3), (1+n, m, 3)."""
        return joint_poses(self.chain, q)

    def corners(self, q: Array) -> list[Array]:
        """Return where the corners of each body are at postures (m, n), (m, v, 3) each [m]."""
        rotations, translations = self.poses(q)
        return [
            solid.vertices @ rotations[solid.joint + 1].transpose(0, 2, 1)
            + translations[solid.joint + 1][:, None]
            for solid in self.solids
        ]

    def tips(self, q: Array) -> Array:
        """Return where the arm's end is at postures (m, n), (m, 3) [m]."""
        rotations, translations = self.poses(q)
        return np.asarray(translations[-1] + rotations[-1] @ self.tip, dtype=np.float64)

    def bones(self, q: Array) -> Array:
        """Return lines from each joint to the next and the end at postures (m, n): (m, b, 2, 3)."""
        origins = self.poses(q)[1].transpose(1, 0, 2)
        moved = [k for k, parent in enumerate(self.chain.parents) if parent >= 0]
        begin = np.concatenate((origins[:, self.chain.parents[moved] + 1], origins[:, -1:]), axis=1)
        end = np.concatenate((origins[:, np.array(moved) + 1], self.tips(q)[:, None]), axis=1)
        return np.stack((begin, end), axis=2)


def reach(corners: Sequence[Array]) -> tuple[Array, Array]:
    """Return the lowest and highest coordinates (3,) of bodies' corners (m, v, 3) each [m]."""
    low = np.min([points.min(axis=(0, 1)) for points in corners], axis=0)
    high = np.max([points.max(axis=(0, 1)) for points in corners], axis=0)
    return low, high


def _described(model: pin.Model, urdf: str, mesh_folders: Sequence[str]) -> tuple[Solid, ...]:
    try:
        shapes = described_shapes(model, urdf, mesh_folders)
    except (ValueError, RuntimeError):  # a mesh that is not on this computer
        return ()
    solids = []
    for item in shapes.geometryObjects:
        try:
            vertices = surface_points(item.geometry)
        except (ValueError, RuntimeError):  # a mesh that is no body
            continue
        if vertices is not None:
            pose = item.placement
            placed = vertices @ pose.rotation.T + pose.translation
            name = model.frames[item.parentFrame].name
            if np.all(np.abs(placed) <= FARTHEST):  # what the collision check refuses, too
                solids.append(Solid(name, item.parentJoint - 1, placed))
    return tuple(solids)


def surface_points(shape: coal.CollisionGeometry) -> Array | None:
    """Return points (v, 3) whose convex hull is the shape (for round ones: close to it) [m]."""
    if isinstance(shape, coal.Box):
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return np.asarray(signs * shape.halfSide, dtype=np.float64)
    if isinstance(shape, coal.Sphere):
        return float(shape.radius) * _sphere()
    if isinstance(shape, coal.Cylinder):
        return np.concatenate([_ring(shape.radius, end * shape.halfLength) for end in (-1, 1)])
    if isinstance(shape, coal.Capsule):
        ball = shape.radius * _sphere()
        along = np.where(ball[:, 2:] < 0.0, -1.0, 1.0) * shape.halfLength
        return np.asarray(ball + along * [0.0, 0.0, 1.0], dtype=np.float64)
    if isinstance(shape, coal.BVHModelBase):
        shape.buildConvexHull(True, "Qt")
        shape = shape.convex
    if isinstance(shape, coal.ConvexBase):
        return np.array(shape.points(), dtype=np.float64)
    return None


def _ring(radius: float, height: float) -> Array:
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    return np.column_stack(
        (radius * np.cos(angle), radius * np.sin(angle), np.full(_AROUND, height))
    )


def _sphere() -> Array:
    """Return points on the sphere of radius 1 (v, 3), as many of them above z = 0 as below."""
    heights = np.sin((np.arange(10) / 9.0 - 0.5) * np.pi)
    return np.concatenate([_ring(float(np.sqrt(1.0 - z * z)), float(z)) for z in heights])


def _tip(model: pin.Model, solids: Sequence[Solid]) -> Array:
    """Return a flange frame of the last link, else the middle of its farthest corners."""
    last = model.njoints - 1
    points = [f.placement.translation for f in model.frames if f.parentJoint == last]
    farthest = max(points, key=np.linalg.norm, default=np.zeros(3))
    if np.linalg.norm(farthest) > 0.0:
        return np.array(farthest, dtype=np.float64)
    corners = [solid.vertices for solid in solids if solid.joint == last - 1]
    if not corners:
        return np.array(model.inertias[last].lever, dtype=np.float64)
    cloud = np.concatenate(corners)
    reach = np.linalg.norm(cloud, axis=1)
    return np.asarray(cloud[reach >= 0.98 * reach.max()].mean(axis=0), dtype=np.float64)


def _sticks(chain: Chain, tip: Array) -> tuple[Solid, ...]:
    """Return a bar from each joint to the next, and from the last ones to their ends."""
    links = [(int(parent), chain.translation[k]) for k, parent in enumerate(chain.parents)]
    links.append((chain.n_joints - 1, tip))
    width = _STICK * sum(float(np.linalg.norm(way)) for _, way in links)
    return tuple(
        Solid("base" if joint < 0 else chain.joint_names[joint], joint, _bar(way, width))
        for joint, way in links
        if np.linalg.norm(way) > 0.0
    )


def _bar(way: Array, width: float) -> Array:
    """Return the corners of a square bar along `way` from the origin (8, 3) [m]."""
    across = np.linalg.svd(way[None])[2][1:]  # two directions at right angles to it
    square = np.array([(u, v) for u in (-width, width) for v in (-width, width)]) @ across
    return np.asarray(np.concatenate((square, square + way)), dtype=np.float64)
