"""A simulated arm of two joints with its controller."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.control.own_moves import InterpolatedMoves
from planner import JointLimits
from sim_fixtures import ControllerSettings, PlantTruth, SimulatedController, SimulatedDrive

N = 2
HOME = (0.3, -0.4)
SPEED = (2.0, 2.5)  # rad/s, the velocity limits in the URDF

_LINK = """
  <link name="link_{i}">
    <inertial>
      <origin xyz="0 0 -0.15"/><mass value="{mass}"/>
      <inertia ixx="0.05" iyy="0.05" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="joint_{i}" type="revolute">
    <parent link="{parent}"/><child link="link_{i}"/>
    <origin xyz="0 0 {z}"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="{speed}" effort="200"/>
  </joint>"""

URDF = (
    '<robot name="two"><link name="base_link"/>'
    + _LINK.format(i=1, mass=8.0, parent="base_link", z=0.0, speed=SPEED[0])
    + _LINK.format(i=2, mass=4.0, parent="link_1", z=-0.3, speed=SPEED[1])
    + "</robot>"
)

TABLE: dict[str, Any] = {
    "gear_ratio": (-100.0, 80.0),
    "calibration": (0.5, -1.25),
    "joint_sign": (-1.0, 1.0),
    "joint_offset": (0.1, 0.0),
    "torque_constant": (0.5, 0.4),
    "current_limit": (4.0, 3.0),
}
FOLLOWING_ERROR = 2.0


def drive(following_error: float = FOLLOWING_ERROR) -> SimulatedDrive:
    return SimulatedDrive(**TABLE, following_error=(following_error,) * N, encoder_counts=65536)


def truth() -> PlantTruth:
    return PlantTruth(
        rotor_inertia=np.array([1.0, 0.5]),
        coulomb=np.array([4.0, 2.0]),
        viscous=np.array([2.0, 1.0]),
        third=np.zeros(N),
    )


QUICK: dict[str, Any] = {
    "substeps": 1,
    "encoder_noise": 0.0,
    "drive_off_cycles": 4,
    "driving_on_cycles": 4,
    "closed_cycles": 4,
    "closing_cycles": 3,
    "opening_stagger": 4,
}


def limits() -> JointLimits:
    """Of the URDF, and accelerations that the motors have."""
    speed = np.array(SPEED)
    return JointLimits(np.full(N, -2.0), np.full(N, 2.0), speed, 4.0 * speed, 40.0 * speed)


def controller(**changes: Any) -> SimulatedController:
    """A controller with short phases; `changes` are settings, or arguments of the controller.

    Moves of its own program, if there is one, run at the share `own_speed` of full speed.
    """
    options: dict[str, Any] = {"seed": 1, "initial_position": HOME}
    options |= {name: changes.pop(name) for name in ("faults", "seed") if name in changes}
    physical = changes.pop("drive", None) or drive()
    own_speed = changes.pop("own_speed", 0.3)
    settings = ControllerSettings(**(QUICK | changes))
    moves = InterpolatedMoves(limits(), settings.period, own_speed)
    return SimulatedController(URDF, physical, truth(), settings, moves=moves, **options)
