"""Packing of RTDE, of the primary interface and of the dashboard, on the controller's side.

Written apart from the PC's end: nothing here knows how `drivers.ur` unpacks it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim_fixtures.arrays import Array

TYPES: Final[Mapping[str, str]] = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "target_qd": "VECTOR6D",
    "target_qdd": "VECTOR6D",
    "target_current": "VECTOR6D",
    "target_moment": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_current": "VECTOR6D",
    "actual_current_window": "VECTOR6D",
    "actual_current_as_torque": "VECTOR6D",
    "joint_control_output": "VECTOR6D",
    "joint_temperatures": "VECTOR6D",
    "joint_mode": "VECTOR6INT32",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "safety_status": "INT32",
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "payload": "DOUBLE",
    "payload_cog": "VECTOR3D",
    "payload_inertia": "VECTOR6D",
    "joint_position_deviation_ratio": "DOUBLE",
    "collision_detection_ratio": "DOUBLE",
    # Outputs of which the simulation has no value: they are sent as zero.
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "target_TCP_pose": "VECTOR6D",
    "target_TCP_speed": "VECTOR6D",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "actual_execution_time": "DOUBLE",
    "actual_tool_accelerometer": "VECTOR3D",
    "actual_momentum": "DOUBLE",
    "actual_main_voltage": "DOUBLE",
    "actual_robot_voltage": "DOUBLE",
    "actual_robot_current": "DOUBLE",
    "actual_joint_voltage": "VECTOR6D",
    "ft_raw_wrench": "VECTOR6D",
    "standard_analog_input0": "DOUBLE",
    "standard_analog_input1": "DOUBLE",
    "standard_analog_output0": "DOUBLE",
    "standard_analog_output1": "DOUBLE",
    **{f"output_int_register_{k}": "INT32" for k in range(48)},
    **{f"output_double_register_{k}": "DOUBLE" for k in range(48)},
    "output_bit_registers0_to_31": "UINT32",
    "output_bit_registers32_to_63": "UINT32",
}
"""Type of each output by its name."""
_FORMATS: Final = {
    "UINT8": "B", "UINT32": "I", "INT32": "i", "UINT64": "Q", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i",
}  # fmt: skip
_SIZES: Final = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}


INPUT_TYPES: Final[Mapping[str, str]] = {
    **{f"input_int_register_{k}": "INT32" for k in range(48)},
    **{f"input_double_register_{k}": "DOUBLE" for k in range(48)},
    "speed_slider_mask": "UINT32", "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8", "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8", "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8", "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8", "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE", "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
}  # fmt: skip
"""Type of each input by its name."""


@dataclass(frozen=True)
class InputRecipe:
    """Inputs that a client writes, in the order of their values."""

    number: int
    names: tuple[str, ...]

    def values(self, payload: bytes) -> Mapping[str, float]:
        """Return the values of a data package by name; none of one of another length."""
        packed = struct.Struct(">B" + "".join(_FORMATS[INPUT_TYPES[name]] for name in self.names))
        if packed.size != len(payload):
            return {}
        flat = iter(packed.unpack(payload)[1:])
        values: dict[str, float] = {}
        for name in self.names:
            count = _SIZES.get(INPUT_TYPES[name], 1)
            values[name], *_ = (next(flat) for _ in range(count))
        return values


def package(kind: str, payload: bytes = b"") -> bytes:
    """Return a package of RTDE; its length counts the three bytes before the payload."""
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


def packages(data: bytearray) -> Iterator[tuple[str, bytes]]:
    """Take complete packages out of what a client has sent."""
    while len(data) >= 3:
        size = data[0] << 8 | data[1]
        if len(data) < max(3, size):
            return
        whole = bytes(data[:size])
        del data[:size]
        yield chr(whole[2]), whole[3:]


class DataPackages:
    """Data packages of the outputs that a client has requested."""

    def __init__(self, recipe: int, names: Sequence[str]) -> None:
        self._recipe = recipe
        self._names = tuple(names)
        self._struct = struct.Struct(">B" + "".join(_FORMATS[TYPES[name]] for name in names))

    def package(self, outputs: Mapping[str, float | int | Array]) -> bytes:
        """Return the data package of these outputs."""
        flat: list[float | int] = [self._recipe]
        for name in self._names:
            value = outputs.get(name, 0)
            if isinstance(value, np.ndarray):
                flat += value.tolist()
            else:
                flat += [value] * _SIZES.get(TYPES[name], 1)
        return package("U", self._struct.pack(*flat))


_INFO: Final = 3  # level of a text


def text_package(text: str) -> bytes:
    """Return a package with a line of text."""
    words = (text.encode()[:255], b"controller")
    return package("M", b"".join(bytes([len(word)]) + word for word in words) + bytes([_INFO]))


def state_package(
    kind: int,
    limits: Sequence[tuple[float, float]],
    rates: Sequence[tuple[float, float]],
    dh: Sequence[Sequence[float]],
    checksums: Sequence[int],
) -> bytes:
    """Return a robot state of the primary interface, with kinematics and configuration.

    Args:
        kind: number of the robot type.
        limits: lowest and highest position of each joint [rad].
        rates: largest velocity and acceleration of each joint [rad/s, rad/s²].
        dh: a, d, alpha and theta of six joints, each a row.
        checksums: six, of the calibration.
    """
    a, d, alpha, theta = dh
    kinematics = struct.pack(">6I", *checksums) + struct.pack(">24d", *theta, *a, *d, *alpha)
    kinematics += struct.pack(">I", 0)
    configuration = b"".join(struct.pack(">2d", *pair) for pair in (*limits, *rates))
    configuration += struct.pack(">5d", 1.05, 1.4, 0.25, 1.2, 0.3)
    configuration += struct.pack(">24d", *a, *d, *alpha, *theta)
    configuration += struct.pack(">4i", 60, 3, kind, 0)
    parts = b"".join(
        struct.pack(">IB", 5 + len(part), number) + part
        for number, part in ((5, kinematics), (6, configuration))
    )
    return struct.pack(">IB", 5 + len(parts), 16) + parts


def message_package(text: str) -> bytes:
    """Return a message of the primary interface, which comes before states and between them."""
    content = bytes(8) + bytes([254, 3, len(text)]) + text.encode() + bytes(2)
    return struct.pack(">IB", 5 + len(content), 20) + content


def error_package(words: str, code: int, argument: int) -> bytes:
    """Return an error of the primary interface: one with a code, or one of a program without."""
    if code:
        body = struct.pack(">QbB", 0, -2, 6) + struct.pack(">iiiiI", code, argument, 3, 0, 0)
    else:
        body = struct.pack(">QbB", 0, -2, 10) + struct.pack(">ii", 1, 1)
    content = body + words.encode()
    return struct.pack(">IB", 5 + len(content), 20) + content
