"""Requirements as linear functions of an arm's parameters, with the intervals that are wanted."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from identification.excitation.motion_precision import LoadQuantities, Quantities
from identification.model.motion import Motion
from identification.model.robot import RobotModel

from .requirements import Requirement

MIN_TORQUE_SHARE: Final = 0.1
"""Share of a joint's torque below which a parameter counts by that share, not by its value."""
_SPEED_SHARES: Final = (0.25, 0.5, 1.0)  # of each joint's largest one, at which friction is wanted
_INSTANTS_PER_JOINT: Final = 25  # per joint, with the widest bands of torque
_Row = tuple[str, Array, float]  # label, direction (p,), wanted half of the interval


@dataclass(frozen=True, eq=False)
class RequiredQuantities:
    """Quantities of some requirements."""

    requirements: tuple[Requirement, ...]
    quantities: Quantities | LoadQuantities
    labels: tuple[str, ...]  #: of each quantity (k,)
    owners: NDArray[np.intp]  #: index of the requirement of each (k,)

    @property
    def absolute(self) -> NDArray[np.bool_]:
        """Whether the interval of each quantity has the uncertainty of the torque's scale (k,)."""
        return np.array([requirement.absolute for requirement in self.requirements])[self.owners]

    def worst(self, ratios: Array) -> list[tuple[Requirement, str, float]]:
        """Return for each requirement the quantity with the largest ratio (k,), and that ratio."""
        worst = []
        for k, requirement in enumerate(self.requirements):
            index = np.flatnonzero(self.owners == k)
            top = int(index[np.argmax(ratios[index])])
            worst.append((requirement, self.labels[top], float(ratios[top])))
        return worst


class ReferenceMotions:
    """Sampled motions on which torque, friction and the effect of parameters are wanted.

    `names` are the parameters that can be wanted, by default all of the model.
    """

    def __init__(
        self, model: RobotModel, motions: Sequence[Motion], names: Collection[str] | None = None
    ) -> None:
        self.model = model
        self.names = frozenset(model.parameter_names if names is None else names)
        self.motion = Motion.joined(motions).kinematics()
        count = self.motion.n_samples
        p = model.n_parameters
        self.rows = np.zeros((model.n_joints, count, p))
        for part, blocks in model.chunks(self.motion):
            for joint, (block, used) in enumerate(zip(blocks, model.plan.columns, strict=True)):
                self.rows[joint, part, used] = block

    def torque(self, values: Array) -> Array:
        """Return the torque (m, n) of parameters (p,)."""
        return np.asarray(np.einsum("jmp,p->mj", self.rows, values))

    def scatter(self, values: Array) -> Array:
        """Return the standard deviation of each joint's torque (n,)."""
        return np.asarray(np.std(self.torque(values), axis=0))

    def information(self, density: Array, *, has_offsets: bool = False) -> Array:
        """Return the information per second (p, p) for densities of the torque error (n,).

        With `has_offsets` each joint's torque has an unknown offset.
        """
        rows = self.rows
        if has_offsets:
            rows = rows - rows.mean(axis=1, keepdims=True)
        total = np.einsum("jmp,jmq->pq", rows / density[:, None, None], rows)
        return np.asarray(total / self.motion.n_samples)

    def required(
        self, requirements: Sequence[Requirement], values: Array, information: Array
    ) -> RequiredQuantities:
        """Return the quantities of requirements about an arm of parameters (p,).

        `information` (p, p) decides at which instants the bands of torque are the widest.
        """
        rows = []
        owners = []
        for k, requirement in enumerate(requirements):
            quantity_rows = list(self._quantities(requirement, values, information))
            rows += quantity_rows
            owners += [k] * len(quantity_rows)
        labels, directions, allowed = zip(*rows, strict=True)
        quantities = Quantities(np.array(directions), np.array(allowed))
        return RequiredQuantities(
            tuple(requirements), quantities, labels, np.array(owners, dtype=np.intp)
        )

    def _quantities(
        self, requirement: Requirement, values: Array, information: Array
    ) -> Iterator[_Row]:
        model = self.model
        if requirement.kind in ("parameters", "parameter"):
            size = self.parameter_sizes(values)
            for k, name in enumerate(model.parameter_names):
                if requirement.name in ("", name) and name in self.names:
                    yield name, np.eye(len(values))[k], requirement.value * size[k]
            return
        joints = range(model.n_joints)
        if requirement.name:
            joints = range(
                model.joint_names.index(requirement.name),
                model.joint_names.index(requirement.name) + 1,
            )
        for joint in joints:
            label = f"{requirement.kind} of {model.joint_names[joint]}"
            if requirement.kind == "friction":
                yield from self._friction(joint, label, requirement.value, values)
            else:
                rows = self.rows[joint]
                variance = np.einsum("mp,pm->m", rows, np.linalg.solve(information, rows.T))
                for instant in np.argsort(-variance)[:_INSTANTS_PER_JOINT].tolist():
                    yield label, rows[instant], requirement.value

    def parameter_sizes(self, values: Array) -> Array:
        """Return the size (p,) of each parameter, to which per cents refer.

        That is its value, or if that makes less than `MIN_TORQUE_SHARE` of the torque of the joint
        that it moves most, what would make as much.
        """
        scatter = np.maximum(self.scatter(values), np.finfo(np.float64).tiny)
        effect = np.sqrt(np.mean(self.rows**2, axis=1)) / scatter[:, None]
        largest = effect.max(axis=0)
        moved = MIN_TORQUE_SHARE / np.where(largest > 0.0, largest, 1.0)
        return np.asarray(np.maximum(np.abs(values), moved))

    def _friction(self, joint: int, label: str, share: float, values: Array) -> Iterator[_Row]:
        model = self.model
        speed = float(np.abs(self.motion.velocity[:, joint]).max())
        still = Motion.at_rest(np.zeros((2 * len(_SPEED_SHARES), model.n_joints)))
        some = model.friction_columns
        turning = np.zeros_like(still.position)
        turning[:, joint] = np.concatenate((_SPEED_SHARES, np.negative(_SPEED_SHARES))) * speed
        least = MIN_TORQUE_SHARE * float(self.scatter(values)[joint])
        rows = np.zeros((len(turning), len(values)))
        ((_, blocks),) = model.chunks(replace(still, velocity=turning))
        rows[:, model.plan.columns[joint]] = blocks[joint].T
        for row in np.where(some, rows, 0.0):
            yield label, row, share * max(abs(float(row @ values)), least)
