"""Faults of recordings, and recordings with one of signs, orders or coupled angles corrected."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, Literal, NamedTuple

import numpy as np

from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Kind = Literal[
    "delay",
    "gain",
    "torque sign",
    "torque order",
    "axis sign",
    "position order",
    "joint order",
    "angle sum",
    "angle difference",
    "payload",
    "load friction",
    "changed gain",
    "changed friction",
    "changed arm",
]
# An angle contains that of one of these joints before it: parallel axes are neighbours, or have one
# across them in between.
_JOINTS_BEFORE: Final = 2
COUPLED: Final[tuple[Literal["angle sum", "angle difference"], ...]] = (
    "angle sum",
    "angle difference",
)
"""The recorded angle of the first joint contains that of the second, added or taken off."""
OF_MOTION: Final[tuple[Kind, ...]] = ("axis sign", "position order", "joint order", *COUPLED)
_OF_TORQUE: Final = ("torque sign", "torque order")


class Part(NamedTuple):
    """Part of the blocks of the fitted recordings."""

    name: str  # such as "A.mcap", or "A.mcap from 3 s on"
    blocks: tuple[bool, ...]  # mask over the blocks (B,)


class Fault(NamedTuple):
    """Possible fault of recordings."""

    kind: Kind  # of fault
    # affected joints; all if empty. Of a coupled angle: its own, and the one that it contains
    joints: tuple[int, ...] = ()
    part: Part | None = None  # affected part of the recordings; None for all

    @property
    def discrete(self) -> bool:
        """Whether the fault has no size, as a sign or an order."""
        return self.kind in (*OF_MOTION, *_OF_TORQUE)


def coupled_pairs(model: RobotModel, moved: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Yield the joints whose angle a controller may state relative to one of the two before it.

    Such as the forearm's to the horizontal: the angle of axis 3 then contains that of axis 2.
    """
    turning = [joint for joint in moved if model.chain.revolute[joint]]
    yield from ((j, k) for j in turning for k in turning if 0 < j - k <= _JOINTS_BEFORE)


def corrected(model: RobotModel, samples: Samples, fault: Fault) -> Samples:
    """Return samples with a wrong sign or order, or a coupled angle, corrected."""
    n = model.n_joints
    sign = np.ones(n)
    order = np.arange(n)
    relative = np.eye(n)
    if fault.kind in COUPLED:
        relative[fault.joints] = -1.0 if fault.kind == "angle sum" else 1.0
    elif fault.kind.endswith("sign"):
        sign[list(fault.joints)] = -1.0
    else:
        order[list(fault.joints)] = fault.joints[::-1]
    motion = samples.motion
    torque = samples.torque
    usable = samples.usable
    if fault.kind in OF_MOTION:
        load = None if motion.load is None else motion.load[:, order]
        read = (relative @ (np.eye(n)[order] * sign[:, None])).T
        motion = motion.converted(lambda states: states @ read)
        motion = replace(motion, direction=None, load=load)
        usable = usable[:, order]
    if fault.kind not in ("position order", *COUPLED):
        torque = torque[:, order] * sign
    result = replace(samples, motion=motion, torque=torque, usable=usable, mask=None)
    if samples.parent is not None:
        parent, part = samples.parent
        result = replace(result, parent=(corrected(model, parent, fault), part))
    return result.with_friction_direction(model)
