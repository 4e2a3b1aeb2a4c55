"""Simulated cells of other makers' arms, from their URDF and what a data sheet states."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.arms import ARMS, urdf
from hil.campaign.twin import Twin
from hil.cell import Cell
from hil.cell.toml_edits import with_values
from hil.cli import new

_FULL_SPEED_TIME: Final = 0.6  # s, in which a joint reaches its largest speed
_FULL_ACCELERATION_TIME: Final = 0.1  # s
_GEAR: Final = 100.0
_TORQUE_CONSTANT: Final = 0.1  # N·m/A
_LAG: Final = 0.3  # ms, of the simulated current loop


@dataclass(frozen=True)
class DataSheet:
    """What the URDF of an arm does not have.

    Attributes:
        urdf: a file of ours, or its path in example-robot-data.
        rotor: inertias (n,) at the joints [kg·m²].
        coulomb: (n,) [N·m].
        viscous: (n,) [N·m·s/rad].
        home: posture (n,) [degrees].
        cycle: of the controller [ms].
    """

    urdf: str | Path
    rotor: tuple[float, ...]
    coulomb: tuple[float, ...]
    viscous: tuple[float, ...]
    home: tuple[float, ...]
    cycle: int


DATA_SHEETS: Final = {
    "ur5": DataSheet(
        urdf="ur_description/urdf/ur5_robot.urdf",
        rotor=(1.2, 1.2, 1.2, 0.25, 0.25, 0.25),
        coulomb=(9.0, 9.0, 9.0, 2.0, 2.0, 2.0),
        viscous=(3.0, 3.0, 3.0, 0.65, 0.65, 0.65),
        home=(0.0, -90.0, 90.0, -90.0, -90.0, 0.0),
        cycle=2,
    ),
    "panda": DataSheet(
        urdf=ARMS["panda"],
        rotor=(0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2),
        coulomb=(0.8, 0.9, 0.7, 0.8, 0.6, 0.4, 0.5),
        viscous=(1.2, 1.4, 1.0, 1.1, 0.6, 0.5, 0.4),
        home=(0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0),
        cycle=1,
    ),
}


def simulated_cell(name: str, folder: Path, seed: int = 1) -> Cell:
    """Return the cell of an arm of `DATA_SHEETS`, with the simulated arm of its rehearsal.

    Its file is written to a folder. The arm differs from URDF and data sheet by up to 10 %.
    """
    sheet = DATA_SHEETS[name]
    path = folder / name / "cell.toml"
    new.new(urdf(sheet.urdf), output=path, json=True)
    n = len(sheet.rotor)
    limits = _limits(path)
    speed = limits["velocity_deg"]
    values: dict[str, Any] = {
        "nominal.rotor_inertia": sheet.rotor,
        "nominal.coulomb": sheet.coulomb,
        "nominal.viscous": sheet.viscous,
        "robot.friction.third": "none",
        "limits.acceleration_deg": [each / _FULL_SPEED_TIME for each in speed],
        "limits.jerk_deg": [each / (_FULL_SPEED_TIME * _FULL_ACCELERATION_TIME) for each in speed],
        "drive_train.gear_ratio": [_GEAR] * n,
        "drive_train.calibration": [0.0] * n,
        "drive_train.k54": 0.0,
        "drive_train.k64": 0.0,
        "drive_train.k65": 0.0,
        "drive_train.joint_sign": [1] * n,
        "drive_train.joint_offset_deg": [0.0] * n,
        "drive_train.torque_constant": [_TORQUE_CONSTANT] * n,
        "drive_train.current_limit": [
            each / (_GEAR * _TORQUE_CONSTANT) for each in limits["torque"]
        ],
        "drive_train.following_error": [1.0] * n,
        "drive_train.encoder_counts_per_revolution": 65536,
        "controller.transport": "simulated",
        "controller.cycle_ms": sheet.cycle,
        "controller.host": "127.0.0.1",
        "controller.current_delay_cycles": 0.5 - _LAG / sheet.cycle,
        "workspace.floor": "none",
        "workspace.walls": [],
        "workspace.margin": 0.02,
        "campaign.home_deg": sheet.home,
        "campaign.approach_speed": 1.0,
    }
    path.write_text(with_values(path.read_text(), values))
    return Twin.of(Cell.load(path), seed=seed, repetitions=30).cell


def _limits(path: Path) -> dict[str, list[float]]:
    limits: dict[str, list[float]] = tomllib.loads(path.read_text())["limits"]
    return limits
