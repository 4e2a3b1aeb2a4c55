"""Motion of the links of a chain, vectorised over a block of samples of fixed size."""

from __future__ import annotations

import numpy as np

from identification.arrays import Array
from identification.model.kinematics import Chain, skew
from identification.model.motion import Motion

_COSINE_ROUNDING = 1e-15  # of direction cosines

_OTHER_AXES = (slice(1, 3), slice(0, 3, 2), slice(0, 2))  # the other two axes of each axis


class LinkMotion:
    r"""Motion of every link of a chain, vectorised over a block of samples of fixed size.

    All vectors of link i are spatial (angular, then linear at the origin of joint frame i, in
    its axes), with one linear map from link to link:

    .. math:: v_i = X v_p + s_i \dot q_i, \qquad
              a_i = X a_p + s_i \ddot q_i + v_i \times s_i \dot q_i

    with the twist s_i of joint i per unit speed, and the *spatial* acceleration a_i, minus gravity
    at the base. `motion` is velocity and acceleration of the links (n, 2, 2, 3, size), `twists`
    per link those of the a joints that move it, base first (a, 2, 3, size), `velocity` and
    `acceleration` qd and qdd of the joints (n, size).
    """

    def __init__(self, chain: Chain, gravity: Array, size: int) -> None:
        n = chain.n_joints
        # Slots of a link: velocity, acceleration, then twists, as many as the longest path needs.
        slots = np.zeros((n, 2 + n, 2, 3, size))
        self.motion = slots[:, :2]
        self.twists = tuple(slots[i, 2 : 2 + len(chain.ancestors(i))] for i in range(n))
        self._joints = np.zeros((3, n, size))
        self._position, self.velocity, self.acceleration = self._joints
        self._basis = np.ones((n, 3, size))
        self._rotation = np.empty((n, 9, size))
        base = np.zeros((2, 2, 3, size))
        base[1, 1] = -gravity[:, None]
        self._steps = []
        for joint in range(n):
            parent = int(chain.parents[joint])
            carried = len(self.twists[joint]) + 1  # all slots but the joint's own twist
            before = base if parent < 0 else slots[parent, :carried]
            rotation = self._rotation[joint].reshape(3, 3, size)
            after = slots[joint, : carried + 1]
            self._steps.append(_Step(chain, joint, before, rotation, after, self._joints[:, joint]))
        self._blend = np.array([step.blend for step in self._steps])

    def set_joints(self, motion: Motion) -> None:
        """Set the joint motion of k <= size samples; the other samples are at rest."""
        k = motion.n_samples
        states = motion.position, motion.velocity, motion.acceleration
        for target, given in zip(self._joints, states, strict=True):
            target[:, :k] = given.T
            target[:, k:] = 0.0

    def update(self) -> None:
        """Compute all links for the joint motion that is set."""
        _cos_sin(self._position, self._basis[:, 1], self._basis[:, 2])
        np.matmul(self._blend, self._basis, out=self._rotation)
        for step in self._steps:
            step.carry()
            step.move()


class _Step:
    """Recursion over one joint, from slots of its parent (c, 2, 3, size) to its own, one more.

    All views are created once: a view costs as much as the arithmetic on a few hundred samples.
    `rotation` (3, 3, size) is into the child's axes, `motion` q, qd and qdd of the joint (3, size).
    """

    def __init__(
        self, chain: Chain, joint: int, before: Array, rotation: Array, after: Array, motion: Array
    ) -> None:
        axis = _clean(chain.axis[joint])
        revolute = bool(chain.revolute[joint])
        part = 0 if revolute else 1  # angular or linear
        after[-1, part] = axis[:, None]
        # The rotation's nine entries as sums of 1, cos q and sin q (9, 3).
        self.blend = _blend(axis, chain.rotation[joint].T, revolute)
        self._position, self._speed, self._rate_of_speed = motion
        self._revolute = revolute
        self._axis = [(a, float(axis[a])) for a in range(3) if axis[a] != 0.0]
        self._carried = after[:-1]
        self._velocity = after[0]
        self._acceleration = after[1]
        self._along = [
            (after[0, part, a], after[1, part, a], float(axis[a])) for a, _ in self._axis
        ]
        # Shift of the reference point p: linear part l + w x p = l - [p]x w.
        self._before = before
        matrix = -skew(chain.translation[joint])
        self._shifted = np.empty_like(before) if np.any(matrix) else before
        self._shifts = [
            (before[:, 0, column], float(matrix[row, column]), self._shifted[:, 1, row])
            for row, column in np.argwhere(matrix != 0.0)
        ]
        self._scratch = np.empty_like(before[:, 0, 0])
        # Rotation of the axes: as a whole, or one axis fixed and two in a plane.
        rows = columns = slice(0, 3)
        self._fixed_axis: tuple[Array, float, Array] | None = None
        if (fixed_axis := _find_fixed_axis(self.blend)) is not None:
            row, column, sign = fixed_axis
            self._fixed_axis = (self._shifted[:, :, column], sign, self._carried[:, :, row])
            rows = _OTHER_AXES[row]
            columns = _OTHER_AXES[column]
        self._turn = (
            rotation[rows, columns],
            self._shifted[:, :, columns],
            self._carried[:, :, rows],
        )

    def carry(self) -> None:
        """Express the parent's vectors in the child's frame."""
        if self._shifts:
            np.copyto(self._shifted, self._before)
            for angular, lever, linear in self._shifts:
                np.multiply(angular, lever, out=self._scratch)
                linear += self._scratch
        if self._fixed_axis is not None:
            source, sign, target = self._fixed_axis
            np.multiply(source, sign, out=target)
        rotation, source, target = self._turn
        np.einsum("abt,cxbt->cxat", rotation, source, out=target)

    def move(self) -> None:
        """Add the joint's own motion in the child's frame."""
        velocity = self._velocity
        acceleration = self._acceleration
        speed = self._speed
        for a, component in self._axis:
            rate = speed if component == 1.0 else component * speed
            if self._revolute:
                _add_cross(acceleration, velocity, a, rate)
            else:
                _add_cross(self._carried[:, 1], self._carried[:, 0], a, component * self._position)
                _add_cross(acceleration[1], velocity[0], a, rate)
        for own_velocity, own_acceleration, component in self._along:
            own_velocity += component * speed
            own_acceleration += component * self._rate_of_speed


def _cos_sin(angle: Array, cosine: Array, sine: Array) -> None:
    """Write cos = r - 1 and sin = r t with t = tan(angle / 2), r = 2 / (1 + t^2).

    Several times faster than numpy's functions, exact to a few units of rounding, also at pi.
    """
    half = np.tan(0.5 * angle)
    np.multiply(half, half, out=cosine)
    cosine += 1.0
    np.divide(2.0, cosine, out=cosine)
    np.multiply(half, cosine, out=sine)
    cosine -= 1.0


def _blend(axis: Array, fixed: Array, revolute: bool) -> Array:
    """Return the rotation into the child's axes as sums of 1, cos q and sin q, shape (9, 3)."""
    if not revolute:
        parts = [np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))]
    else:
        along = np.outer(axis, axis)
        parts = [along, np.eye(3) - along, -skew(axis)]
    return np.stack([_clean(part @ fixed).reshape(9) for part in parts], axis=1)


def _find_fixed_axis(blend: Array) -> tuple[int, int, float] | None:
    """Return (row, column, +1 or -1) of a constant rotation entry that is alone in both."""
    constant = blend[:, 0].reshape(3, 3)
    nonzero = np.any(blend, axis=1).reshape(3, 3)
    for row, column in np.argwhere(np.abs(constant) == 1.0):
        alone = nonzero[row].sum() == 1 and nonzero[:, column].sum() == 1
        if alone and not np.any(blend[3 * row + column, 1:]):
            return int(row), int(column), float(constant[row, column])
    return None


def _add_cross(out: Array, left: Array, axis: int, size: Array) -> None:
    """Add ``left x (size e_axis)`` to `out`; vectors along the last axis but one."""
    a = (axis + 1) % 3
    b = (axis + 2) % 3
    out[..., a, :] += left[..., b, :] * size
    out[..., b, :] -= left[..., a, :] * size


def _clean(values: Array) -> Array:
    """Return `values` with rounding errors of zero removed."""
    return np.where(np.abs(values) < _COSINE_ROUNDING, 0.0, values)
