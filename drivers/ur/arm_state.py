"""What a controller sends in each cycle that others do not: modes, temperatures, its own model."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from drivers.arrays import Array
from drivers.cycle_records import RowColumns
from drivers.ur.outputs import N_JOINTS

UNKNOWN: Final = -1
"""Of integers that the controller does not send; other numbers are NaN."""
_JOINT: Final = (N_JOINTS,)
STATE_DTYPE: Final = np.dtype(
    [
        ("controller_time", "f8"),
        ("target_acceleration", "f8", _JOINT),
        ("target_moment", "f8", _JOINT),
        ("control_current", "f8", _JOINT),
        ("current_as_torque", "f8", _JOINT),
        ("joint_temperature", "f8", _JOINT),
        ("speed_scaling", "f8"),
        ("speed_fraction", "f8"),
        ("position_deviation_ratio", "f8"),
        ("collision_ratio", "f8"),
        ("payload_mass", "f8"),
        ("payload_centre", "f8", (3,)),
        ("payload_inertia", "f8", (6,)),
        ("robot_mode", "i4"),
        ("safety_mode", "i4"),
        ("runtime_state", "i4"),
        ("robot_status", "i4"),
        ("safety_status", "i4"),
    ]
)
"""State of a controller in one cycle.

``controller_time`` s since its start; joint arrays in the sense of the URDF, ``target_moment`` N·m
of its rigid-body model (payload and gravity included, no friction), currents A; temperatures °C;
``payload_*`` as set at the controller, in the frame of its flange, inertia xx, xy, xz, yy, yz, zz;
``*_status`` are bits.
"""
_OUTPUT_OF: Final = {
    "controller_time": "timestamp",
    "target_acceleration": "target_qdd",
    "target_moment": "target_moment",
    "control_current": "joint_control_output",
    "current_as_torque": "actual_current_as_torque",
    "joint_temperature": "joint_temperatures",
    "speed_scaling": "speed_scaling",
    "speed_fraction": "target_speed_fraction",
    "position_deviation_ratio": "joint_position_deviation_ratio",
    "collision_ratio": "collision_detection_ratio",
    "payload_mass": "payload",
    "payload_centre": "payload_cog",
    "payload_inertia": "payload_inertia",
    "robot_mode": "robot_mode",
    "safety_mode": "safety_mode",
    "runtime_state": "runtime_state",
    "robot_status": "robot_status_bits",
    "safety_status": "safety_status_bits",
}
_SIGNED: Final = ("target_acceleration", "target_moment", "control_current", "current_as_torque")
_INERTIA_ORDER: Final = [0, 3, 4, 1, 5, 2]
"""xx, xy, xz, yy, yz, zz in the controller's xx, yy, zz, xy, xz, yz."""


def state_columns(outputs: np.dtype[np.void], joint_sign: Array) -> RowColumns:
    """Return how outputs of this layout are written into states of `STATE_DTYPE`.

    Args:
        outputs: in their order.
        joint_sign: of the drive train (6,).
    """
    names = outputs.names or ()
    counts = [math.prod(outputs[name].shape) for name in names]
    begins = dict(zip(names, np.cumsum([0, *counts]).tolist(), strict=False))
    places: list[int] = []
    factors: list[float] = []
    for name in STATE_DTYPE.names or ():
        size = math.prod(STATE_DTYPE[name].shape)
        begin = begins.get(_OUTPUT_OF[name])
        order = _INERTIA_ORDER if name == "payload_inertia" else range(size)
        places += [-1 if begin is None else begin + index for index in order]
        factors += joint_sign.tolist() if name in _SIGNED else [1.0] * size
    return RowColumns(STATE_DTYPE, places, factors, sum(counts), UNKNOWN)
