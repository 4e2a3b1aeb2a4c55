"""What a controller sends in each cycle that others do not: modes, temperatures, its own model."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.arrays import Array
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


_FLOATS: Final = tuple(name for name in STATE_DTYPE.names or () if STATE_DTYPE[name].kind != "i")
_INTEGERS: Final = tuple(name for name in STATE_DTYPE.names or () if name not in _FLOATS)


def _size(name: str) -> int:
    return math.prod(STATE_DTYPE[name].shape)


_BLOCKS: Final = np.dtype(
    [("floats", "f8", (sum(map(_size, _FLOATS)),)), ("integers", "i4", (len(_INTEGERS),))]
)
"""A state as numbers in two rows: its floats come before its integers."""


class StateColumns:
    """Makes states of outputs.

    Args:
        outputs: layout of the outputs, in their order.
        joint_sign: of the drive train (6,).
    """

    def __init__(self, outputs: np.dtype[np.void], joint_sign: Array) -> None:
        names = outputs.names or ()
        counts = [math.prod(outputs[name].shape) for name in names]
        self._count = sum(counts)
        begins = dict(zip(names, np.cumsum([0, *counts]).tolist(), strict=False))

        def columns(name: str) -> list[int]:
            begin = begins.get(_OUTPUT_OF[name])
            if begin is None:  # behind the outputs is what is unknown
                return [self._count] * _size(name)
            order = _INERTIA_ORDER if name == "payload_inertia" else range(_size(name))
            return [begin + index for index in order]

        self._floats = np.concatenate([columns(name) for name in _FLOATS])
        self._integers = np.concatenate([columns(name) for name in _INTEGERS])
        signs = {name: joint_sign if name in _SIGNED else np.ones(_size(name)) for name in _FLOATS}
        self._signs = np.concatenate([*signs.values()])

    def write(self, outputs: ArrayLike, states: NDArray[np.void]) -> None:
        """Write states (k,) of `STATE_DTYPE`, of outputs (k, m) as numbers in a row."""
        known = np.empty((len(states), self._count + 1))
        known[:, :-1] = outputs
        blocks = states.view(_BLOCKS)
        known[:, -1] = np.nan
        np.multiply(known[:, self._floats], self._signs, out=blocks["floats"])
        known[:, -1] = UNKNOWN
        # Bits may be above the range of integers with a sign.
        blocks["integers"][:] = known[:, self._integers].astype(np.int64)
