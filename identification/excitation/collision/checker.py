"""Where along a motion the arm comes too close to itself or to what stands around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.bodies import Workspace
from identification.excitation.collision.gaps import (
    Near,
    Touch,
    bulges_of,
    touch_between,
    what_is_near,
)
from identification.excitation.collision.poses import joint_poses
from identification.excitation.collision.scene import BuiltIn, Path, Scene, exceptions
from identification.excitation.collision.separation import Indices
from identification.excitation.joint_limits import rate_bounds
from identification.model.motion import Motion
from planner import FourierSeries, JointLimits, PiecewiseCubic

__all__ = ["CollisionChecker", "Contact", "PathContact", "joint_poses"]

Array = NDArray[np.float64]

# How much deeper [m] than the contact that is reported another one may be.
_DEPTH_RESOLUTION: Final = 0.005
# Of the samples of a motion every so manieth is looked at, if no point of the arm leaves the
# straight line between two such by more than _BULGE [m].
_BULGE: Final = 0.02
_LONGEST_STRIDE: Final = 4
# Samples that are looked at together; longer motions are looked at part by part.
_PART: Final = 4000
# Distances that are computed at most to find the deepest contact of a part.
_MOST_DISTANCES: Final = 10_000


@dataclass(frozen=True)
class Contact:
    """The arm closer to something than the margin.

    Attributes:
        first, second: the two links, or a link and an obstacle ("floor", "wall 0", "box 1").
        sample: index of the posture.
        distance: between them [m], negative where they overlap: how far they would have to be
            moved to part.
    """

    first: str
    second: str
    sample: int
    distance: float


class PathContact(NamedTuple):
    """A contact along a motion.

    Attributes:
        first, second: as in :class:`Contact`.
        time: when [s]; None on a way that has no times yet.
        posture: joint positions there [rad].
        distance: as in :class:`Contact`.
    """

    first: str
    second: str
    time: float | None
    posture: tuple[float, ...]
    distance: float


class CollisionChecker:
    """Distances between the collision shapes of a URDF, the floor, walls and boxes.

    Links that share a joint are never checked against each other, nor is the base against what
    it stands among. Two shapes of the arm, two joints apart at most, that are too close in every
    one of 200 random postures, and closer than 5 cm, are assumed to be built that way (a wrist) and
    left out too, as is a shape of the first link that is as close to an obstacle in all of them
    (a foot that turns in the floor). `built_in` lists both. One of the two links next to the
    mounting that never keeps the margin of a floor or wall, but does not always touch it, keeps
    the largest distance that it can have; `exceptions` says of both. Every other pair is checked,
    even if it always touches.

    Args:
        urdf: text of the robot description; meshes are replaced by their convex hulls.
        workspace: obstacles and margin.
        limits: joint limits in use, which random postures keep; None for those of the URDF, and
            half a turn where it has none.
        mesh_folders: where `package://` paths of meshes begin.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is no open chain.
    """

    def __init__(
        self,
        urdf: str,
        workspace: Workspace,
        *,
        limits: JointLimits | None = None,
        mesh_folders: Sequence[str] = (),
    ) -> None:
        self.workspace = workspace
        self._arguments = urdf, workspace, limits, tuple(mesh_folders)
        self._scene = Scene(urdf, workspace, mesh_folders, limits)

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuilt, self._arguments

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of what is checked against what, without repetitions."""
        numbers = range(len(self._scene.separation.first))
        return tuple(dict.fromkeys(map(self._scene.names, numbers)))

    @property
    def built_in(self) -> tuple[BuiltIn, ...]:
        """Shapes that are not checked against each other, always too close as the arm is built."""
        return self._scene.built_in

    @property
    def exceptions(self) -> str | None:
        """What is not checked, or with less than the margin, in a sentence; None for nothing."""
        return exceptions(self._scene.built_in, self._scene.narrowed)

    def spread(self, first: str, second: str) -> tuple[float, float]:
        """Return the least and largest distance [m] of a pair (see `pairs`) in random postures.

        Raises:
            ValueError: they are no pair.
        """
        return self._scene.spread(first, second)

    @property
    def arm_length(self) -> float:
        """Way along the arm from the base to its last joint [m]; 1 where there is none."""
        return self._scene.arm_length

    def deepest_contact(self, q: Array) -> Contact | None:
        """Return the deepest contact along postures (m, n); None if all are clear.

        No posture is left out, though not all are looked at one by one: bodies that are far
        apart cannot meet before they have gone the distance. Another contact may be deeper by
        5 mm.

        Raises:
            ShapeError: postures of another arm.
            PostureError: a position that is no finite number.
        """
        path = self._scene.path(q)
        if len(q) == 0:
            return None
        touch = _deepest(self._scene, path, what_is_near(self._scene, path, np.zeros((2, 1, 1))))
        if touch is None:
            return None
        return Contact(*self._scene.names(touch.pair), touch.sample, touch.distance)

    def deepest_along(
        self,
        trajectory: PiecewiseCubic | FourierSeries,
        motion: Motion,
        *,
        between: bool = True,
    ) -> PathContact | None:
        """Return the deepest contact along a motion; None if all of it is clear.

        Where all samples are clear, the motion is looked at between them too, without a gap: no
        point of a body leaves the straight line between two of its places by more than its
        acceleration allows. What even fine division cannot tell from a contact counts as one, and
        so does what would take too long to tell: a motion far too violent for an arm.
        Where samples touch, another contact may be deeper by 5 mm, and by what the arm bulges
        out between two samples, 2 cm at most in the fastest motions and often far less.

        Args:
            trajectory: the motion.
            motion: samples of it, both ends included.
            between: whether to look between the samples; what is refused for its rates already
                need not be.

        Raises:
            ShapeError: a motion of another arm.
            PostureError: a position that is no finite number.
        """
        motion = motion.rows(_looked_at(self._scene, trajectory, motion))
        deepest: PathContact | None = None
        for start in range(0, max(motion.n_samples - 1, 1), _PART):
            part = motion.rows(slice(start, start + _PART + 1))
            contact = self._deepest_in(trajectory, part, between)
            if deepest is None or (contact is not None and contact.distance < deepest.distance):
                deepest = contact
        return deepest

    def _deepest_in(
        self, trajectory: PiecewiseCubic | FourierSeries, motion: Motion, between: bool
    ) -> PathContact | None:
        scene = self._scene
        path = scene.path(motion.position)
        bulges = bulges_of(scene, trajectory, motion) if between else np.zeros((2, 1, 1))
        near = what_is_near(scene, path, bulges)
        touch = _deepest(scene, path, near)
        if touch is None:
            found = touch_between(scene, trajectory, motion, path, near) if between else None
            if found is None:
                return None
            touch, motion = found
        time, posture = motion.time[touch.sample], motion.position[touch.sample]
        names = scene.names(touch.pair)
        return PathContact(*names, float(time), tuple(posture.tolist()), touch.distance)

    def clear(self, q: Array) -> NDArray[np.bool_]:
        """Return which of the unrelated postures (m, n) keep the margin, (m,).

        Raises:
            ShapeError: postures of another arm.
            PostureError: a position that is no finite number.
        """
        scene = self._scene
        path = scene.path(q)
        pairs, samples = np.indices((len(scene.separation.first), len(q))).reshape(2, -1)
        lower, _ = scene.separation.bound(path.bodies, pairs, samples)
        blocked = np.zeros(len(q), dtype=np.bool_)
        near = np.flatnonzero(~(lower >= scene.margin))
        for k in near[np.argsort(lower[near], kind="stable")].tolist():
            pair, sample = int(pairs[k]), int(samples[k])
            if not blocked[sample]:
                blocked[sample] = not scene.distance(pair, path, sample) >= scene.margin
        clear: NDArray[np.bool_] = ~blocked
        return clear


def _rebuilt(
    urdf: str, workspace: Workspace, limits: JointLimits | None, mesh_folders: tuple[str, ...]
) -> CollisionChecker:
    return CollisionChecker(urdf, workspace, limits=limits, mesh_folders=mesh_folders)


def _looked_at(scene: Scene, trajectory: PiecewiseCubic | FourierSeries, motion: Motion) -> Indices:
    """Return which samples of a motion are looked at, both ends among them."""
    last = motion.n_samples - 1
    velocity, acceleration, _ = rate_bounds(trajectory, motion.time[:1], motion.time[-1:])
    step = float(np.max(np.diff(motion.time), initial=0.0))
    bulges = scene.from_base.bulge(velocity, acceleration, motion.position, step)
    share = np.sqrt(_BULGE / np.max(bulges, initial=1e-9))
    stride = 1 if np.isnan(share) else int(np.clip(share, 1, _LONGEST_STRIDE))
    return np.append(np.arange(0, max(last, 1), stride), last)


def _deepest(scene: Scene, path: Path, near: Near) -> Touch | None:
    """Return the deepest contact at the samples by branch and bound.

    A signed distance of convex bodies changes no faster than they travel.
    """
    candidates = np.flatnonzero(~(near.lower >= scene.margin))
    if len(candidates) == 0:
        return None
    pair, sample, lower = (column[candidates] for column in near[:3])
    exact = scene.separation.exact[pair]
    best, found = scene.margin, -1
    if np.any(exact):
        found = int(np.argmin(np.where(exact, lower, np.inf)))
        best = float(lower[found])
        lower[exact] = np.inf
    separation = scene.separation
    gone = path.gone[separation.first[pair], sample]
    gone += path.gone[separation.second[pair], sample]
    for _ in range(_MOST_DISTANCES):
        k = int(np.argmin(lower))
        if not lower[k] < best - (0.0 if found < 0 else _DEPTH_RESOLUTION):
            break
        distance = scene.distance(int(pair[k]), path, int(sample[k]))
        if distance < best:
            best, found = distance, k
        start, stop = np.searchsorted(pair, (pair[k], pair[k] + 1))
        reached = distance - np.abs(gone[start:stop] - gone[k])
        np.maximum(lower[start:stop], reached, out=lower[start:stop])
        lower[k] = np.inf
    else:
        if found < 0:  # nothing was found, and not all was looked at: not clear
            best, found = float(np.nextafter(scene.margin, -1.0)), k
    if found < 0:
        return None
    return Touch(int(pair[found]), int(sample[found]), best)
