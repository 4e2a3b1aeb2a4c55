"""What a logger has written of an arm, to be cut, spoilt and imported again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from benchmarks.plain_fit import Measured, robot_from_urdf
from hil.archive import open_archive
from hil.cell import Cell
from hil.importers.column_map import ColumnMap, Quantity, TimeColumn
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log

Array = NDArray[np.float64]

_MAP = ColumnMap(
    time=TimeColumn(column="time"),
    position=Quantity(columns="position", joints_along="columns"),
    torque=Quantity(columns="torque", joints_along="columns"),
)
_MAP_WITH_VELOCITY = _MAP.model_copy(
    update={"velocity": Quantity(columns="velocity", joints_along="columns")}
)


@dataclass(frozen=True, eq=False)
class JointLog:
    """m rows of n joints, joint side, SI units, joints in the order of the robot's model.

    Attributes:
        robot: whose log it is.
        time: (m,) [s].
        position: (m, n) [rad or m].
        velocity: likewise, None where it was not measured.
        torque: (m, n) [N·m or N].
        rated_payload: of the robot [kg].
    """

    robot: Robot
    time: Array
    position: Array
    velocity: Array | None
    torque: Array
    rated_payload: float

    @classmethod
    def read(cls, path: Path, rated_payload: float) -> Self:
        """Everything in an imported archive, as it was recorded."""
        archive = open_archive(path)
        columns = archive.columns
        return cls(
            robot=Robot(archive.text("cell.toml"), archive.text("robot.urdf"), archive.joint_names),
            time=(columns["stamp"] - columns["stamp"][0]) * 1e-9,
            position=np.array(columns["position"]),
            velocity=np.array(columns["velocity"]) if "velocity" in columns else None,
            torque=np.array(columns["torque"]),
            rated_payload=rated_payload,
        )

    @property
    def n_rows(self) -> int:
        """Number m of rows."""
        return len(self.time)

    @property
    def measured(self) -> Measured:
        """Return these rows for an ordinary fit."""
        return Measured(self.time, self.position, self.velocity, self.torque)

    def pinocchio_model(self) -> Any:
        """A new model of the robot, by pinocchio."""
        robot = Cell.from_texts(self.robot.cell, self.robot.urdf, Path("cell.toml")).file.robot
        return robot_from_urdf(self.robot.urdf, robot.gravity, robot.locked)

    def rows(self, wanted: slice | NDArray[np.bool_]) -> Self:
        """Some of the rows."""
        velocity = None if self.velocity is None else self.velocity[wanted]
        return replace(
            self,
            time=self.time[wanted],
            position=self.position[wanted],
            velocity=velocity,
            torque=self.torque[wanted],
        )

    def imported(self, output: Path) -> Path:
        """Write the log as a file of arrays, and import that."""
        arrays = {"time": self.time, "position": self.position, "torque": self.torque}
        columns = _MAP
        if self.velocity is not None:
            arrays["velocity"] = self.velocity
            columns = _MAP_WITH_VELOCITY
        source = output.with_suffix(".npz")
        np.savez(source, allow_pickle=False, **arrays)
        return import_log(source, output, robot=self.robot, columns=columns)
