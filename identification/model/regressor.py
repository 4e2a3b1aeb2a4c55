r"""Inverse dynamics, linear in the parameters: tau = W(q, qd, qdd) pi, vectorised over samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.model.elements import JointElements, PlacedElement
from identification.model.friction import FrictionLaw, JointFriction, JointTerm
from identification.model.kinematics import Chain
from identification.model.link_motion import LinkForces, LinkMotion
from identification.model.link_wrenches import (
    LINK_SYMBOLS,
    N_INERTIA,
    N_PRIMITIVES,
    ROTATIONAL_COLUMNS,
    WRENCH_MATRICES,
    write_primitives,
)
from identification.model.motion import Motion

Rows = slice | NDArray[np.intp]

# Samples per block, so that the working arrays stay in the processor's cache. For six joints 1000
# to 2000 take the same time, 512 a quarter more, 256 two thirds more.
SAMPLES_PER_CHUNK = 1280

# Number and granularity of the sizes of reused working arrays (some 8 kB per sample): allocation
# costs more than the arithmetic.
_MAX_SPARE_ARRAYS = 8
_SIZE_GRANULARITY = 128


class Regressor(NamedTuple):
    """Regressor of m samples by joint, without the columns that are structurally zero."""

    blocks: tuple[Array, ...]  #: per joint j its columns, shape (m, c_j)
    columns: tuple[NDArray[np.intp], ...]  #: per joint j their parameter indices, shape (c_j,)

    def dense(self, p: int) -> Array:
        """Return all p columns with their zeros, shape (m, n, p)."""
        full = np.zeros((self.blocks[0].shape[0], len(self.blocks), p))
        for joint, (block, columns) in enumerate(zip(self.blocks, self.columns, strict=True)):
            full[:, joint, columns] = block
        return full


class RegressorPlan:
    """Layout and computation of the regressor of a chain.

    The torque of joint j is the power of the wrenches of its links on their twists per unit speed
    of joint j (:class:`LinkMotion`).
    `columns` has the parameter indices of each joint's columns (c_j,); parameters are numbered link
    by link (inertial, rotor), then coupling inertias, friction, springs and balancers.

    Args:
        chain: of n joints.
        gravity: acceleration in base axes (3,) [m/s²].
        links: used :data:`LINK_SYMBOLS` (0..9) of each link, rising.
        rotors: whether the rotor inertia of each joint has a column.
        friction: of the joints, or None.
        couplings: pairs of joints with a column for their coupling inertia.
        elements: springs and balancers, or None.
    """

    def __init__(
        self,
        chain: Chain,
        gravity: Array,
        links: Sequence[Sequence[int]],
        rotors: Sequence[bool],
        friction: JointFriction | None,
        couplings: Sequence[tuple[int, int]] = (),
        elements: JointElements | None = None,
    ) -> None:
        self.chain = chain
        self.gravity = gravity
        self.links = tuple(tuple(symbols) for symbols in links)
        self.rotors = tuple(rotors)
        self.friction = friction
        self.couplings = tuple(couplings)
        self.elements = elements.identified if elements is not None else ()
        # Rows of the working array: columns of the links, then of the joint's drive: friction,
        # motor friction, rotor, coupling inertias, elements, response.
        self.first_drive_row = sum(len(symbols) for symbols in links)
        self.drive_rows = tuple(_DriveRows.of(self, joint) for joint in range(chain.n_joints))
        self.rows: tuple[Rows, ...]
        self.columns: tuple[NDArray[np.intp], ...]
        self.rows, self.columns = _lay_out(self)
        self._spare: list[_Workspace] = []
        self._lock = Lock()

    def __getstate__(self) -> dict[str, object]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_spare", "_lock")}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state, _spare=[], _lock=Lock())

    @classmethod
    def of_bodies(cls, chain: Chain, gravity: Array, joint: int | None = None) -> RegressorPlan:
        """Return a plan with only the ten parameters of the link of one joint, or of all links."""
        n = chain.n_joints
        ten = range(len(LINK_SYMBOLS))
        links = [ten if joint in (None, other) else [] for other in range(n)]
        return cls(chain, gravity, links, [False] * n, None)

    def chunks(
        self, motion: Motion, *, response: Array | None = None
    ) -> Iterator[tuple[slice, list[Array]]]:
        """Yield the regressor in chunks of samples: (slice of samples, rows of each joint).

        Without a load of the motion the columns of load-dependent friction are zero. The rows of
        joint j have shape (c_j, k) for k samples, one more with `response` (m, n) as the last. They
        are views that are valid until the next chunk.
        """
        m, n = motion.position.shape
        rows = self.rows
        if response is not None:
            rows = tuple(_append(r, self.response_row(j)) for j, r in enumerate(rows))
        with self._borrowed(m) as work:
            for start in range(0, m, work.size):
                part = slice(start, min(start + work.size, m))
                k = part.stop - start
                work.update(motion.rows(part))
                if response is not None:
                    for joint in range(n):
                        work.rows[joint, self.response_row(joint), :k] = response[part, joint]
                yield part, [work.rows[joint, rows[joint], :k] for joint in range(n)]

    @contextmanager
    def _borrowed(self, m: int) -> Iterator[_Workspace]:
        """Provide working arrays that divide m samples evenly, to one thread at a time."""
        even = -(-m // max(1, -(-m // SAMPLES_PER_CHUNK)))
        size = min(SAMPLES_PER_CHUNK, -(-max(even, 1) // _SIZE_GRANULARITY) * _SIZE_GRANULARITY)
        with self._lock:
            index = next((i for i, work in enumerate(self._spare) if work.size == size), None)
            work = None if index is None else self._spare.pop(index)
        work = work or _Workspace(self, size)
        try:
            yield work
        finally:
            with self._lock:
                self._spare = [*self._spare, work][-_MAX_SPARE_ARRAYS:]

    def evaluate(self, motion: Motion) -> Regressor:
        """Return the whole regressor of a motion, see :meth:`chunks`."""
        m = motion.n_samples
        full = [np.empty((len(columns), m)) for columns in self.columns]
        for part, rows in self.chunks(motion):
            for target, block in zip(full, rows, strict=True):
                target[:, part] = block
        return Regressor(tuple(block.T for block in full), self.columns)

    def torque(self, values: Array, motion: Motion) -> Array:
        """Return the torques (m, n) of parameters (p,) along a motion, see :meth:`chunks`.

        By the recursion of Newton and Euler, so it takes about half the time of the regressor, and
        hardly any for parameters of the drives alone.
        """
        m, n = motion.position.shape
        torque = np.empty((m, n))
        bodies = self._body_weights(values)
        drives = self._drive_weights(values)
        with self._borrowed(m) as work:
            for start in range(0, m, work.size):
                part = slice(start, min(start + work.size, m))
                rows = motion.rows(part)
                work.set_motion(rows)
                work.update_drives(rows)
                torque[part] = work.torque(bodies, drives)[:, : part.stop - start].T
        return torque

    def _body_weights(self, values: Array) -> list[tuple[int, Array]]:
        """Return links that have parameters, and their wrenches from primitives (6, 12)."""
        weights = []
        first = 0
        for link, (symbols, rotor) in enumerate(zip(self.links, self.rotors, strict=True)):
            used = values[first : first + len(symbols)]
            first += len(symbols) + rotor
            if used.any():
                matrix = used @ WRENCH_MATRICES[list(symbols)].reshape(len(used), -1)
                weights.append((link, matrix.reshape(WRENCH_MATRICES.shape[1:])))
        return weights

    def _drive_weights(self, values: Array) -> list[Array]:
        """Return the values of each joint's columns that are not of links."""
        sizes = [drive.response - self.first_drive_row for drive in self.drive_rows]
        return [
            values[columns[len(columns) - size :]]
            for columns, size in zip(self.columns, sizes, strict=True)
        ]

    def response_row(self, joint: int) -> int:
        """Return the row after all columns of a joint."""
        return self.drive_rows[joint].response


class _DriveRows(NamedTuple):
    """Rows of the drive of one joint in the working array."""

    friction: slice  # terms of its law
    motors: dict[JointTerm, int]  # of coupled motors
    rotor: int | None
    couplings: dict[int, int]  # by the joint that it is coupled to
    elements: slice
    response: int

    @classmethod
    def of(cls, plan: RegressorPlan, joint: int) -> _DriveRows:
        """Assign the rows of a joint."""
        row = plan.first_drive_row
        motors: dict[JointTerm, int] = {}
        if plan.friction is not None:
            row += len(plan.friction.laws[joint].symbols)
            speeds = plan.friction.motor_speeds()[:, joint]
            coupled = {m for m, s in zip(plan.friction.motors, speeds, strict=True) if s != 0.0}
            acting = [t for t in plan.friction.terms if t.motor and t.owner in coupled]
            motors = {term: row + k for k, term in enumerate(acting)}
        friction = slice(plan.first_drive_row, row)
        row += len(motors)
        rotor = row if plan.rotors[joint] else None
        row += plan.rotors[joint]
        others = [sum(pair) - joint for pair in plan.couplings if joint in pair]
        couplings = {other: row + k for k, other in enumerate(others)}
        row += len(others)
        sizes = [len(placed.element.symbols) for placed in plan.elements if placed.joint == joint]
        elements = slice(row, row + sum(sizes))
        return cls(friction, motors, rotor, couplings, elements, elements.stop)


class _Workspace:
    """Working arrays for one block of samples, and views of them."""

    def __init__(self, plan: RegressorPlan, size: int) -> None:
        n = plan.chain.n_joints
        self.rows = np.zeros((n, max(rows.response for rows in plan.drive_rows) + 1, size))
        self.size = size
        # without a reference to the plan, which would be a cycle
        self._drive_rows = plan.drive_rows
        self._joint_friction = plan.friction
        self._first_drive_row = plan.first_drive_row
        self._states = np.zeros((3, n, size))
        _, self._velocity, self._acceleration = self._states
        self._chain = plan.chain
        self._gravity = plan.gravity
        self._motion = LinkMotion(plan.chain, plan.gravity, self._states)
        motors = 0 if plan.friction is None else len(plan.friction.motors)
        self._direction = np.zeros((n + motors, size))
        self._load = np.zeros((n, size))
        self._primitives = np.empty((n, N_PRIMITIVES, size))
        self._friction = self._friction_parts()
        self._drives = self._drive_parts()
        self._elements = self._element_parts(plan)
        self._contractions: list[_Contraction] = []
        first = 0
        for link, used in enumerate(plan.links):
            inertia = [s for s in used if s < N_INERTIA]
            for symbols, moments_only in ((inertia, True), (used[len(inertia) :], False)):
                if symbols:
                    joints = _as_slice(plan.chain.ancestors(link))
                    self._add(link, joints, symbols, moments_only, first)
                    first += len(symbols)

    def _add(
        self, link: int, joints: Rows, symbols: Sequence[int], moments_only: bool, first: int
    ) -> None:
        """Prepare the columns of one link; moments of inertia have no force."""
        size = self.rows.shape[2]
        twists = self._motion.twists[link]
        part = twists[:, 0] if moments_only else twists.reshape(len(twists), 6, size)
        length = part.shape[1]
        used = ROTATIONAL_COLUMNS if moments_only else slice(None)
        primitives = self._primitives[link, used]
        matrix = WRENCH_MATRICES[list(symbols), :length, used].reshape(-1, len(primitives))
        wrenches = np.empty((len(matrix), size))
        columns = slice(first, first + len(symbols))
        contiguous = isinstance(joints, slice)
        self._contractions.append(
            _Contraction(
                matrix,
                primitives,
                wrenches,
                part,
                wrenches.reshape(len(symbols), length, size),
                self.rows[joints, columns] if contiguous else self.rows[:, columns],
                None if isinstance(joints, slice) else joints,
            )
        )

    def _friction_parts(self) -> list[tuple[FrictionLaw, Array, Array, Array, Array]]:
        """Return laws with views of speeds, directions, transmitted torques and target rows."""
        velocity = self._velocity
        direction = self._direction[: len(velocity)]
        if self._joint_friction is None:
            return []
        if (common_law := self._joint_friction.one_law) is not None:
            rows = self.rows[:, self._drive_rows[0].friction]
            return [(common_law, velocity, direction, self._load, rows.transpose(1, 0, 2))]
        return [
            (
                law,
                velocity[j],
                direction[j],
                self._load[j],
                self.rows[j, self._drive_rows[j].friction],
            )
            for j, law in enumerate(self._joint_friction.laws)
        ]

    def _drive_parts(self) -> list[tuple[Array, Array]]:
        """Return views of accelerations and target rows of rotors and coupling inertias."""
        acceleration = self._acceleration
        rotors = {drive.rotor for drive in self._drive_rows}
        parts = []
        if len(rotors) == 1 and None not in rotors:  # one step for all joints
            parts.append((acceleration, self.rows[:, next(iter(rotors))]))
        else:
            for joint, drive in enumerate(self._drive_rows):
                if drive.rotor is not None:
                    parts.append((acceleration[joint], self.rows[joint, drive.rotor]))
        for joint, drive in enumerate(self._drive_rows):
            for other, row in drive.couplings.items():
                parts.append((acceleration[other], self.rows[joint, row]))
        return parts

    def _element_parts(self, plan: RegressorPlan) -> list[tuple[PlacedElement, Array]]:
        """Return springs and balancers with target rows."""
        free = [drive.elements.start for drive in self._drive_rows]
        parts = []
        for placed in plan.elements:
            first = free[placed.joint]
            free[placed.joint] += placed.part.stop - placed.part.start
            parts.append((placed, self.rows[placed.joint, first : free[placed.joint]]))
        return parts

    def _write_motor_friction(self, friction: JointFriction) -> None:
        """Write the friction of coupled motors, on the joints c' f(c qd)."""
        directions = self._direction[friction.n_joints :]
        for motor, share, direction in zip(
            friction.motors, friction.motor_speeds(), directions, strict=True
        ):
            speed = share @ self._velocity
            for joint in np.flatnonzero(share):
                for (_, term, owner, _, _), row in self._drive_rows[joint].motors.items():
                    if owner == motor:
                        column = term.column(speed, direction)
                        np.multiply(share[joint], column, out=self.rows[joint, row])

    def _write_direction(self, friction: JointFriction, motion: Motion) -> None:
        if motion.direction is not None:
            self._direction[:, : motion.n_samples] = motion.direction.T
            return
        velocity = self._velocity
        n = friction.n_joints
        if (common_law := friction.one_law) is not None:
            common_law.sign(velocity, out=self._direction[:n])
        else:
            for law, speed, out in zip(friction.laws, velocity, self._direction, strict=False):
                law.sign(speed, out=out)
        for motor, share, out in zip(
            friction.motors, friction.motor_speeds(), self._direction[n:], strict=True
        ):
            friction.laws[motor].sign(share @ velocity, out=out)

    def update(self, motion: Motion) -> None:
        """Compute all columns for k <= size samples; the others are undefined."""
        self.set_motion(motion)
        self._motion.update()
        write_primitives(self._motion.motion, self._primitives)
        for c in self._contractions:
            np.matmul(c.matrix, c.primitives, out=c.flat_wrenches)
            if c.joints is None:
                np.einsum("jrt,crt->jct", c.twists, c.wrenches, out=c.target)
            else:
                c.target[c.joints] = np.einsum("jrt,crt->jct", c.twists, c.wrenches)
        self.update_drives(motion)

    def set_motion(self, motion: Motion) -> None:
        """Set the joint motion of k <= size samples; the other samples are at rest."""
        k = motion.n_samples
        states = motion.position, motion.velocity, motion.acceleration
        for target, given in zip(self._states, states, strict=True):
            target[:, :k] = given.T
            target[:, k:] = 0.0

    def update_drives(self, motion: Motion) -> None:
        """Compute the columns of drives, friction and elements for the motion that is set."""
        q = motion.position
        k = motion.n_samples
        if self._joint_friction is not None:
            self._write_direction(self._joint_friction, motion)
            if self._joint_friction.has_load:
                self._load[:, :k] = 0.0 if motion.load is None else motion.load.T
        for law, velocity, sign, transmitted, target in self._friction:
            target[...] = law.columns(velocity, sign, transmitted)
        for source, target in self._drives:
            np.copyto(target, source)
        for element, target in self._elements:
            target[:, :k] = element.columns(q).T
        if self._joint_friction is not None and self._joint_friction.motors:
            self._write_motor_friction(self._joint_friction)

    def torque(self, bodies: Sequence[tuple[int, Array]], drives: Sequence[Array]) -> Array:
        """Return the torque (n, size) of links, with their wrenches, and of drives.

        See :meth:`RegressorPlan._body_weights`.
        """
        first = self._first_drive_row
        torque = np.stack(
            [
                weights @ self.rows[joint, first : first + len(weights)]
                for joint, weights in enumerate(drives)
            ]
        )
        if bodies:
            forces = self._forces
            forces.motion.update()
            write_primitives(forces.motion.motion, self._primitives)
            forces.own[:] = 0.0
            for link, matrix in bodies:
                own = forces.own[link].reshape(len(matrix), -1)
                np.matmul(matrix, self._primitives[link], out=own)
            torque += forces.torque()
        return torque

    @cached_property
    def _forces(self) -> LinkForces:
        """Of the links; a regressor alone needs none."""
        return LinkForces(self._chain, self._gravity, self._states)


class _Contraction(NamedTuple):
    """Columns of one link for all a joints that move it: twists times wrenches."""

    matrix: Array  # (columns * r, 12 or 9): wrenches from primitives
    primitives: Array  # (12 or 9, size)
    flat_wrenches: Array  # (columns * r, size)
    twists: Array  # (a, r, size), r = 3 (moments) or 6
    wrenches: Array  # the same memory as flat_wrenches, (columns, r, size)
    target: Array  # (a, columns, size), or of all joints
    joints: NDArray[np.intp] | None  # which of all joints


def _lay_out(plan: RegressorPlan) -> tuple[tuple[Rows, ...], tuple[NDArray[np.intp], ...]]:
    """Return the rows of each joint in the working array, and their parameter indices."""
    chain = plan.chain
    n = plan.chain.n_joints
    sizes = [len(symbols) + rotor for symbols, rotor in zip(plan.links, plan.rotors, strict=True)]
    offsets = np.concatenate([[0], np.cumsum(sizes)]).tolist()
    rows: list[list[int]] = [[] for _ in range(n)]
    columns: list[list[int]] = [[] for _ in range(n)]
    column = 0
    for link, symbols in enumerate(plan.links):
        for position, symbol in enumerate(symbols):
            for joint in chain.ancestors(link):
                # moments do not act on a prismatic joint
                if chain.revolute[joint] or symbol >= N_INERTIA:
                    rows[joint].append(column)
                    columns[joint].append(offsets[link] + position)
            column += 1
    first_friction = offsets[-1] + len(plan.couplings)
    terms = plan.friction.terms if plan.friction is not None else ()
    places = {term: first_friction + k for k, term in enumerate(terms)}
    first_element = first_friction + len(terms)
    for joint, drive in enumerate(plan.drive_rows):
        columns[joint] += [places[t] for t in terms if not t.motor and t.owner == joint]
        columns[joint] += [places[term] for term in drive.motors]
        if drive.rotor is not None:
            columns[joint].append(offsets[joint] + len(plan.links[joint]))
        for other in drive.couplings:
            pair = (min(joint, other), max(joint, other))
            columns[joint].append(offsets[-1] + plan.couplings.index(pair))
        for placed in plan.elements:
            if placed.joint == joint:
                part = placed.part
                columns[joint] += range(first_element + part.start, first_element + part.stop)
        rows[joint] += range(plan.first_drive_row, drive.response)
    return (
        tuple(_as_slice(r) for r in rows),
        tuple(np.array(c, dtype=np.intp) for c in columns),
    )


def _append(rows: Rows, last: int) -> Rows:
    if isinstance(rows, slice):
        return slice(rows.start, last + 1)
    return np.append(rows, last)


def _as_slice(indices: Sequence[int]) -> Rows:
    """Return consecutive indices as a slice, which needs no copy."""
    if len(indices) > 0 and list(indices) == list(range(indices[0], indices[0] + len(indices))):
        return slice(indices[0], indices[0] + len(indices))
    return np.array(indices, dtype=np.intp)
