"""Motion of the links of a chain, vectorised over a block of samples of fixed size."""

from __future__ import annotations

import numpy as np

from identification.arrays import Array
from identification.model.kinematics import Chain, skew

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
    per link the twists of the a joints that move it, base first (a, 2, 3, size).

    Args:
        chain: of n joints.
        gravity: in base axes (3,) [m/s²].
        states: q, qd and qdd of the joints (3, n, size).
        all_twists: whether `twists` contains all joints that move a link, not only the link's
            own joint.
    """

    def __init__(
        self, chain: Chain, gravity: Array, states: Array, *, all_twists: bool = True
    ) -> None:
        n, size = states.shape[1:]
        paths = [len(chain.ancestors(i)) if all_twists else 1 for i in range(n)]
        # Slots of a link: velocity, acceleration, then twists, as many as the longest path needs.
        slots = np.zeros((n, 2 + max(paths), 2, 3, size))
        self.motion = slots[:, :2]
        self.twists = tuple(slots[i, 2 : 2 + path] for i, path in enumerate(paths))
        self._position = states[0]
        self._basis = np.ones((n, 3, size))
        self._rotation = np.empty((n, 9, size))
        base = np.zeros((2, 2, 3, size))
        base[1, 1] = -gravity[:, None]
        steps = []
        for joint in range(n):
            parent = int(chain.parents[joint])
            carried = paths[joint] + 1  # all slots but the joint's own twist
            before = base if parent < 0 else slots[parent, :carried]
            rotation = self._rotation[joint].reshape(3, 3, size)
            after = slots[joint, : carried + 1]
            steps.append(LinkStep(chain, joint, before, rotation, after, states[:, joint]))
        self.steps = tuple(steps)
        self._blend = np.array([step.blend for step in steps])

    def update(self) -> None:
        """Compute all links for the joint motion that is set."""
        _cos_sin(self._position, self._basis[:, 1], self._basis[:, 2])
        np.matmul(self._blend, self._basis, out=self._rotation)
        for step in self.steps:
            step.carry()
            step.move()


class LinkForces:
    r"""Torques of the joints from the wrenches of the links, as Newton and Euler add them up.

    From the last link to the first, the wrench of link i about the origin of its frame, in its
    axes, is the sum of its own and of what the links that it carries pass on:

    .. math:: f_i = m_i + \sum_c X_c^T f_c, \qquad \tau_i = s_i^T f_i

    `own` are the wrenches m_i (n, 2, 3, size), moment and force; `motion` that of the links.
    """

    def __init__(self, chain: Chain, gravity: Array, states: Array) -> None:
        n, size = states.shape[1:]
        self.motion = LinkMotion(chain, gravity, states, all_twists=False)
        self.own = np.zeros((n, 2, 3, size))
        self._carried = np.zeros((2, 3, size))
        self._parents = chain.parents.tolist()

    def torque(self) -> Array:
        """Return the torques (n, size); `own` then includes what each link carries."""
        torque = np.empty((len(self.own), self.own.shape[-1]))
        for joint in reversed(range(len(torque))):
            step = self.motion.steps[joint]
            torque[joint] = step.along_axis(self.own[joint])
            if self._parents[joint] >= 0:
                step.carry_back(self.own[joint], self._carried)
                self.own[self._parents[joint]] += self._carried
        return torque


class LinkStep:
    """Recursion over one joint, from slots of its parent (c, 2, 3, size) to its own, one more.

    All views are created once: a view costs as much as the arithmetic on a few hundred samples.

    Args:
        chain: of n joints.
        joint: index from 0.
        before: slots of the parent (c, 2, 3, size).
        rotation: into the child's axes (3, 3, size).
        after: slots of the child (c + 1, 2, 3, size).
        motion: q, qd and qdd of the joint (3, size).
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
        self._part = part
        self._axis = [(a, float(axis[a])) for a in range(3) if axis[a] != 0.0]
        self._carried = after[:-1]
        self._velocity = after[0]
        self._acceleration = after[1]
        self._along = [
            (after[0, part, a], after[1, part, a], float(axis[a])) for a, _ in self._axis
        ]
        # Shift of the reference point p: linear part l + w x p = l - [p]x w.
        self._before = before
        lever = skew(chain.translation[joint])
        places = np.argwhere(lever != 0.0).tolist()
        self._lever = [(row, column, float(lever[row, column])) for row, column in places]
        self._shifted = np.empty_like(before) if self._lever else before
        self._shifts = [
            (before[:, 0, column], -arm, self._shifted[:, 1, row])
            for row, column, arm in self._lever
        ]
        self._scratch = np.empty_like(before[:, 0, 0])
        # Rotation of the axes: as a whole, or one axis fixed and two in a plane.
        self._rows = self._columns = slice(0, 3)
        self._fixed = _find_fixed_axis(self.blend)
        self._fixed_axis: tuple[Array, float, Array] | None = None
        if self._fixed is not None:
            row, column, sign = self._fixed
            self._fixed_axis = (self._shifted[:, :, column], sign, self._carried[:, :, row])
            self._rows = _OTHER_AXES[row]
            self._columns = _OTHER_AXES[column]
        self._turn = (
            rotation[self._rows, self._columns],
            self._shifted[:, :, self._columns],
            self._carried[:, :, self._rows],
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

    def along_axis(self, wrench: Array) -> Array:
        """Return the torque or force (size,) that a wrench (2, 3, size) exerts on the joint."""
        (first, component), *others = self._axis
        torque = component * wrench[self._part, first]
        for a, component in others:
            torque += component * wrench[self._part, a]
        return np.asarray(torque)

    def carry_back(self, wrench: Array, out: Array) -> None:
        """Express a wrench (2, 3, size) of the child in the parent's frame; the wrench is lost."""
        if not self._revolute:
            for a, component in self._axis:
                _add_cross(wrench[0], wrench[1], a, -component * self._position)
        if self._fixed is not None:
            fixed_row, fixed_column, sign = self._fixed
            np.multiply(wrench[:, fixed_row], sign, out=out[:, fixed_column])
        rotation, *_ = self._turn
        np.einsum("abt,xat->xbt", rotation, wrench[:, self._rows], out=out[:, self._columns])
        moment, force = out
        for row, column, arm in self._lever:
            np.multiply(force[column], arm, out=self._scratch[0])
            moment[row] += self._scratch[0]


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
