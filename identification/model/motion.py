"""Sampled joint motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions and their derivatives at m instants (rad or m, per s, per s²)."""

    time: Array  #: shape (m,), seconds; NaN for states that are no time series
    position: Array  #: q, shape (m, n)
    velocity: Array  #: qd, shape (m, n)
    acceleration: Array  #: qdd, shape (m, n)
    #: of dry friction (:meth:`JointFriction.direction`), shape (m, n + k); None: sign of velocity
    direction: Array | None = None
    #: torque that the gears transmit [N·m, N], shape (m, n), see :meth:`RobotModel.gear_torque`;
    #: None: unknown. Of load-dependent friction only
    load: Array | None = None

    @classmethod
    def of_states(cls, position: Array, velocity: Array, acceleration: Array) -> Self:
        """Return m states (m, n) that are no time series."""
        return cls(np.full(len(position), np.nan), position, velocity, acceleration)

    @classmethod
    def at_rest(cls, position: Array) -> Self:
        """Return m postures (m, n), at rest."""
        still = np.zeros_like(position)
        return cls.of_states(position, still, still)

    @classmethod
    def joined(cls, motions: Sequence[Self]) -> Self:
        """Return the instants of one motion after the other's; None where one of them has None."""
        known = [motion.columns() for motion in motions]
        common = [name for name in known[0] if all(name in columns for columns in known)]
        return cls(
            **{name: np.concatenate([columns[name] for columns in known]) for name in common}
        )

    def columns(self) -> dict[str, Array]:
        """Return the arrays that are known by name, instants along their first axis."""
        return {name: column for name, column in vars(self).items() if column is not None}

    def rows(self, which: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """Return the motion at some of the instants."""
        return type(self)(**{name: column[which] for name, column in self.columns().items()})

    def kinematics(self) -> Self:
        """Return the motion without direction of friction and load of the gears."""
        return replace(self, direction=None, load=None)

    def without_load(self) -> Self:
        """Return the motion without load of the gears."""
        return replace(self, load=None)

    def converted(self, convert: Callable[[Array], Array]) -> Self:
        """Return the motion with positions, velocities and accelerations (m, n) converted alike."""
        return replace(
            self,
            position=convert(self.position),
            velocity=convert(self.velocity),
            acceleration=convert(self.acceleration),
        )

    def states(self) -> Iterator[tuple[Array, Array, Array]]:
        """Yield position, velocity and acceleration (n,) of each instant."""
        return zip(self.position, self.velocity, self.acceleration, strict=True)

    def checked(self, n_joints: int) -> Self:
        """Return the motion with its states as float64 of one shape (m, n_joints).

        Raises:
            ShapeError: an array has another shape.
        """
        position, velocity, acceleration = joint_arrays(
            n_joints,
            position=self.position,
            velocity=self.velocity,
            acceleration=self.acceleration,
        )
        if (
            position is self.position
            and velocity is self.velocity
            and acceleration is self.acceleration
        ):
            return self  # to make another takes as long as some samples
        return replace(self, position=position, velocity=velocity, acceleration=acceleration)

    @property
    def finite(self) -> bool:
        """Whether every number is finite."""
        return all(bool(np.all(np.isfinite(column))) for column in self.columns().values())

    @property
    def n_samples(self) -> int:
        """Number m of instants."""
        return int(self.position.shape[0])

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.position.shape[1])


def joint_arrays(n_joints: int, **arrays: Array) -> tuple[Array, ...]:
    """Return arrays as float64 of one shape (m, n_joints).

    Raises:
        ShapeError: an array has another shape.
    """
    checked = []
    rows: int | None = None
    for name, array in arrays.items():
        values = np.asarray(array, dtype=np.float64)
        m = "m" if rows is None else rows
        if values.ndim != 2 or values.shape[1] != n_joints or rows not in (None, len(values)):
            raise ShapeError(name, values.shape, f"({m}, {n_joints})")
        rows = len(values)
        checked.append(values)
    return tuple(checked)
