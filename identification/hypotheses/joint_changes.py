"""What a recording may be other than stated, as changes that undo it.

Signs, orders, units, zeros and coupled angles of joints are changes of what was recorded; delay,
drift of a zero, friction by the load, springs, a load, and scale or friction of joints, throughout
or in a part, are linear in columns of torque (:mod:`identification.hypotheses.torque_columns`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Samples

Sign = Literal["torque sign", "position sign", "axis sign"]
Order = Literal["torque order", "position order", "joint order"]
CoupledAngle = Literal["angle sum", "angle difference"]
CoupledDrive = Literal["drive sum", "drive difference"]
Coupled = Literal[CoupledAngle, CoupledDrive]
Meaning = Literal[
    Sign,
    Order,
    Coupled,
    "degrees",
    "radians",
    "zero",
    "scale",
    "no gravity",
    "mounting",
    "delay",
    "drift",
    "load friction",
    "payload",
    "friction",
    "friction drift",
    "spring",
    "arm",
    "unmodelled",
]
DEGREE: Final = np.pi / 180.0
SIGNS: Final[tuple[Sign, ...]] = get_args(Sign)
ORDERS: Final[tuple[Order, ...]] = get_args(Order)
SIZED: Final[tuple[Meaning, ...]] = ("zero", "scale")
UNITS: Final[tuple[Meaning, ...]] = ("degrees", "radians")
GRAVITIES: Final[tuple[Meaning, ...]] = ("mounting", "no gravity")
COUPLED_ANGLES: Final[tuple[CoupledAngle, ...]] = get_args(CoupledAngle)
"""The recorded angle of the first joint contains the second's, added or subtracted."""
COUPLED_DRIVES: Final[tuple[CoupledDrive, ...]] = get_args(CoupledDrive)
"""So does the angle of its motor, as with rods that drive a joint from the base of the second: the
recorded torque of the second does not carry the first's."""
COUPLED: Final[tuple[Coupled, ...]] = (*COUPLED_ANGLES, *COUPLED_DRIVES)
DISCRETE_MEANINGS: Final[tuple[Meaning, ...]] = (*SIGNS, *ORDERS, *COUPLED)
"""Changes without a size."""
# An angle contains that of one of these joints before it: parallel axes are neighbours, or have one
# across them in between.
_JOINTS_BEFORE: Final = 2


class Part(NamedTuple):
    """Part of the blocks of recordings."""

    name: str  # such as "A.mcap", or "A.mcap from 3 s on"
    blocks: tuple[bool, ...]  # mask over the blocks (B,)
    start: float = 0.0  # time since the recording began, in which it begins [s]
    stop: float | None = None  # the same of its end; None: it lasts


class Change(NamedTuple):
    """One difference between a reading and what was recorded.

    `size` is an angle [rad] to add to a position, or by how much more than once a torque is
    recorded; `name` that of a mounting; `order` the recorded place of each of the joints, by
    default those of a pair exchanged; `part` where it is, if not throughout. All joints are
    concerned if none is named. Of a coupled angle `joints` are its own, and the one it contains.
    """

    meaning: Meaning
    joints: tuple[int, ...] = ()
    size: float = 0.0
    name: str = ""
    order: tuple[int, ...] = ()
    part: Part | None = None

    @property
    def is_discrete(self) -> bool:
        """Whether it has no size, as a sign or an order."""
        return self.meaning in DISCRETE_MEANINGS

    @property
    def is_constant(self) -> bool:
        """Whether it is a torque constant: a scale throughout."""
        return self.meaning == "scale" and self.part is None

    @property
    def places(self) -> tuple[int, ...]:
        """For an order: the joints whose columns the `joints` are read from."""
        return self.order or self.joints[::-1]


AS_READ: Final = Change("position order")
"""No change: an order of no joints."""


def change_of_motion(change: Change) -> Change:
    """Return the change of the motion that is part of a change, or of a mounting."""
    if change.meaning in ("torque sign", "torque order", "scale"):
        return AS_READ
    if change.meaning == "axis sign":
        return change._replace(meaning="position sign")
    if change.meaning.endswith("order"):
        return Change("position order", change.joints, order=change.places)
    if change.meaning in COUPLED_DRIVES:
        return change._replace(meaning=COUPLED_ANGLES[COUPLED_DRIVES.index(change.meaning)])
    return change


def drive_of(change: Change) -> Change:
    """Return the coupled drive with the angle of a coupled angle."""
    return change._replace(meaning=COUPLED_DRIVES[COUPLED_ANGLES.index(change.meaning)])


def mounted_model(
    model: RobotModel, change: Change, mountings: Mapping[str, RobotModel]
) -> RobotModel:
    """Return the model with the gravity of a change, by the name of its mounting."""
    return mountings[change.name] if change.meaning in GRAVITIES else model


def coupled_pairs(model: RobotModel, moved: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Yield the joints whose angle a controller may state relative to one of the two before it.

    Such as the forearm's to the horizontal: the angle of axis 3 then contains that of axis 2.
    """
    turning = [joint for joint in moved if model.chain.revolute[joint]]
    yield from ((j, k) for j in turning for k in turning if 0 < j - k <= _JOINTS_BEFORE)


def changed_samples(model: RobotModel, samples: Samples, change: Change) -> Samples:
    """Return samples with signs, orders, unit, zero, scale or coupling of the joints changed.

    Rows of filtered samples are changed before their filter.
    """
    if change.meaning in GRAVITIES:
        return samples
    axes = Axes.of([change], model.n_joints)
    result = replace(samples, torque=axes.read_torque(samples.torque))
    if samples.parent is not None:
        parent, part = samples.parent
        result = replace(result, parent=(changed_samples(model, parent, change), part))
    if change_of_motion(change) == AS_READ:
        return result
    order = axes.position_order
    read = axes.factor * np.eye(model.n_joints)[order] * axes.position_sign[:, None]
    uncoupled = np.linalg.inv(axes.coupling) @ read
    motion = samples.motion
    load = None if motion.load is None else motion.load[:, order]
    motion = motion.converted(lambda states: states @ uncoupled.T)
    motion = replace(motion, position=motion.position + axes.zero, direction=None, load=load)
    usable = samples.usable[:, order]
    result = replace(result, motion=motion, usable=usable, mask=None)
    return result.with_friction_direction(model)


def order_change(meaning: Meaning, order: tuple[int, ...]) -> Change:
    """Return the change to a whole order of n joints, with only the moved ones."""
    joints = tuple(joint for joint, place in enumerate(order) if joint != place)
    return Change(meaning, joints, order=tuple(order[joint] for joint in joints))


def whole_order(change: Change, joints: int) -> tuple[int, ...]:
    """Return the places of all n joints under a change of order."""
    order = list(range(joints))
    for joint, place in zip(change.joints, change.places, strict=True):
        order[joint] = place
    return tuple(order)


def differs(change: Change, other: Change) -> bool:
    """Whether two changes are not sizes of one zero or scale."""
    is_zero = change.meaning == other.meaning in SIZED and change.joints == other.joints
    return change != other and not is_zero


def kind_of(change: Change) -> tuple[Meaning, tuple[int, ...]]:
    """Return the meaning of a change, with its joints where each has a sign or a zero of its own.

    All joints are one: an arm that hangs weighs as one that stands, all torques negated.
    """
    return change.meaning, change.joints if change.meaning in (*SIGNS, *SIZED) else ()


def alternatives_to(change: Change) -> Iterator[Change]:
    """Yield the changes that may have the same effect as one that was found."""
    for kinds in (SIGNS[:2], ORDERS):
        if change.meaning in kinds:
            yield from (change._replace(meaning=kind) for kind in kinds if kind != change.meaning)


class Axes(NamedTuple):
    """Where the joints of a recording are in what was recorded, and how to convert them.

    A quantity as read is ``sign * recorded[:, order]``; positions are multiplied by `factor`, and
    `zero` [rad] is added: angles that may each contain that of other joints, ``coupling @ angles``.
    Torques are divided by `torque_scale`, and then added up by `drives` if motors turn with several
    joints: ``torque @ drives``.
    """

    position_order: NDArray[np.intp]
    position_sign: Array
    torque_order: NDArray[np.intp]
    torque_sign: Array
    factor: float
    zero: Array
    coupling: Array  # (n, n)
    torque_scale: Array
    drives: Array  # (n, n)

    @classmethod
    def of(cls, changes: Iterable[Change], joints: int) -> Axes:
        """Return the axes after changes, one after the other."""
        axes = cls(
            np.arange(joints), np.ones(joints), np.arange(joints), np.ones(joints), 1.0,
            np.zeros(joints), np.eye(joints), np.ones(joints), np.eye(joints),
        )  # fmt: skip
        for change in changes:
            axes = axes._after(change)
        return axes

    def _after(self, change: Change) -> Axes:
        meaning = change.meaning
        joints = list(change.joints)
        order = np.arange(len(self.zero))
        sign = np.ones(len(self.zero))
        if meaning.endswith("order"):
            order[joints] = change.places
        elif meaning.endswith("sign"):
            sign[joints] = -1.0
        axes = self
        if meaning in ("position order", "joint order", "position sign", "axis sign"):
            axes = axes._replace(
                position_order=axes.position_order[order],
                position_sign=axes.position_sign[order] * sign,
                zero=axes.zero[order] * sign,
                coupling=axes.coupling[np.ix_(order, order)] * np.outer(sign, sign),
            )
        if meaning in ("torque order", "joint order", "torque sign", "axis sign"):
            axes = axes._replace(
                torque_order=axes.torque_order[order],
                torque_sign=axes.torque_sign[order] * sign,
                torque_scale=axes.torque_scale[order],
                drives=axes.drives[np.ix_(order, order)] * np.outer(sign, sign),
            )
        if meaning in ("degrees", "radians"):
            factor = DEGREE if meaning == "degrees" else 1.0 / DEGREE
            axes = axes._replace(factor=axes.factor * factor, zero=axes.zero * factor)
        if meaning == "zero":
            zero = np.zeros(len(self.zero))
            zero[joints] = change.size
            axes = axes._replace(zero=axes.zero + axes.coupling @ zero)
        if meaning == "scale":
            scale = np.ones(len(self.zero))
            scale[joints] += change.size
            axes = axes._replace(torque_scale=axes.torque_scale * scale)
        if meaning in COUPLED:
            with_other = np.eye(len(self.zero))
            with_other[change.joints] = 1.0 if meaning.endswith("sum") else -1.0
            axes = axes._replace(coupling=axes.coupling @ with_other)
            if meaning in COUPLED_DRIVES:
                axes = axes._replace(drives=axes.drives @ with_other)
        return axes

    def read_torque(self, torque: Array) -> Array:
        """Return recorded torques (m, n) as read."""
        own = torque[:, self.torque_order] * (self.torque_sign / self.torque_scale)
        return np.asarray(own @ self.drives)

    def read(self, recording: Recording) -> Recording:
        """Return a recording as read."""
        scale = self.factor * self.position_sign
        uncoupled = np.linalg.inv(self.coupling).T
        velocity = recording.velocity
        torque = recording.torque
        return replace(
            recording,
            position=(recording.position[:, self.position_order] * scale + self.zero) @ uncoupled,
            velocity=None
            if velocity is None
            else velocity[:, self.position_order] * scale @ uncoupled,
            torque=None if torque is None else self.read_torque(torque),
        )
