"""Outputs of a controller that are recorded; see the maker's RTDE guide for each of them.

Units are rad, rad/s, A, N·m, °C, kg, m and kg·m², joint side.
"""

from __future__ import annotations

from typing import Final

N_JOINTS: Final = 6
REQUIRED: Final = (
    "timestamp",
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_temperatures",
    "joint_mode",
    "robot_mode",
    "safety_mode",
    "speed_scaling",
    "runtime_state",
    "robot_status_bits",
)
"""Outputs of every version of the software that is supported."""
OPTIONAL: Final = (
    "joint_control_output",
    "target_speed_fraction",
    "safety_status_bits",
    "payload",
    "payload_cog",
    "payload_inertia",
    "joint_position_deviation_ratio",
    "collision_detection_ratio",
    "actual_current_as_torque",
)
"""Outputs that only some versions have."""
ROBOT_MODES: Final = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle",
    6: "backdrive",
    7: "running",
    8: "updating firmware",
}
"""Names of `robot_mode`."""
SAFETY_MODES: Final = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "system emergency stop",
    7: "robot emergency stop",
    8: "violation",
    9: "fault",
    10: "validate joint",
    11: "undefined",
}
"""Names of `safety_mode`."""
RUNTIME_STATES: Final = {
    0: "stopping",
    1: "stopped",
    2: "playing",
    3: "pausing",
    4: "paused",
    5: "resuming",
}
"""Names of `runtime_state`, the program's."""
ROBOT_RUNNING: Final = 7
"""`robot_mode` with power on and brakes released."""
POWER_MODES: Final = (4, 5)
"""`robot_mode` with power on and brakes engaged."""
FREEDRIVE_BIT: Final = 2
"""Of `robot_status_bits`: the button with which a person moves the arm by hand."""
SAFETY_NORMAL: Final = 1
"""`safety_mode` without a stop or a reduced speed."""
GEAR_RATIO: Final = 101.0
"""Motor revolutions per joint revolution, of every joint of every model (strain wave gears)."""
TORQUES: Final = {
    "UR3": (56.0, 56.0, 28.0, 12.0, 12.0, 12.0),
    "UR5": (150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
    "UR10": (330.0, 330.0, 150.0, 56.0, 56.0, 56.0),
    "UR3e": (54.0, 54.0, 28.0, 9.0, 9.0, 9.0),
    "UR5e": (150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
    "UR10e": (330.0, 330.0, 150.0, 54.0, 54.0, 54.0),
    "UR16e": (330.0, 330.0, 150.0, 54.0, 54.0, 54.0),
    "UR20": (738.0, 738.0, 433.0, 107.0, 107.0, 107.0),
    "UR30": (738.0, 738.0, 433.0, 107.0, 107.0, 107.0),
}
"""Largest torque of each joint by model [N·m], of the maker's description for ROS 2."""
