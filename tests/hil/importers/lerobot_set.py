"""A data set of LeRobot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
JOINTS = ("pan", "lift", "gripper")
FPS = 50.0

LOWER, UPPER = -0.2, 1.8  # rad, of the gripper
REACH = 1.9  # rad, of the other joints
URDF = """<robot name="arm"><link name="base"/>
{}</robot>"""
LINK = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>
<origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
<limit lower="{lower}" upper="{upper}" effort="3" velocity="9"/></joint>
<link name="{name}_link"><inertial><origin xyz="0 0 0.05"/><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def write_urdf(folder: Path) -> Path:
    """Write the URDF of the arm, and return its path."""
    path = folder / "arm.urdf"
    parents = ("base", "pan_link", "lift_link")
    ends = ((-REACH, REACH), (-REACH, REACH), (LOWER, UPPER))
    links = [
        LINK.format(name=name, parent=parent, lower=lower, upper=upper)
        for name, parent, (lower, upper) in zip(JOINTS, parents, ends, strict=True)
    ]
    path.write_text(URDF.format("\n".join(links)))
    return path


def motion(duration: float, phase: float) -> Array:
    """Return positions (m, 3) [rad]."""
    time = np.arange(0.0, duration, 1.0 / FPS)
    turns = [1.5 * np.sin(time + phase), 0.8 * np.cos(0.7 * time), 0.8 + 0.5 * np.sin(1.3 * time)]
    return np.column_stack(turns)
