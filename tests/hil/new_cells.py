"""Filling in what `hil new` leaves open, as a person would."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import pytest

from hil.cell.toml_edits import with_values

TWO_JOINTS = """<?xml version="1.0"?>
<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><mass value="4"/><origin xyz="0 0 0.2"/>
    <inertia ixx="0.06" iyy="0.06" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><box size="0.08 0.08 0.3"/></geometry></collision>
  </link>
  <link name="lower"><inertial><mass value="2"/><origin xyz="0 0 0.15"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><box size="0.06 0.06 0.2"/></geometry></collision>
  </link>
  <joint name="hip" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="150" velocity="2.5"/></joint>
  <joint name="knee" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.45"/><axis xyz="0 1 0"/><limit effort="60" velocity="0"/></joint>
</robot>
"""


def described_robot(name: str) -> Path:
    """The URDF of a robot of the package example-robot-data."""
    try:
        package = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        pytest.skip("the package example-robot-data, which has the URDFs, is not installed")
    share = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    return share / name


def filled_in(path: Path, n: int, **values: object) -> str:
    """The text of a new cell file with every `"?"` replaced, on a simulated controller.

    Args:
        path: of the cell file.
        n: joints.
        values: figures for fields, by their names with `__` for the dot.
    """
    text = path.read_text("utf-8")
    figures: dict[str, object] = {
        "limits.lower_deg": [-100.0] * n,
        "limits.upper_deg": [100.0] * n,
        "limits.velocity_deg": [90.0] * n,
        "limits.acceleration_deg": [300.0] * n,
        "limits.jerk_deg": [3000.0] * n,
        "campaign.home_deg": [0.0] * n,
        "workspace.floor": "none",
        "workspace.walls": [],
        "nominal.rotor_inertia": [0.5] * n,
        "nominal.coulomb": [4.0] * n,
        "nominal.viscous": [4.0] * n,
        "drive_train.gear_ratio": [100.0] * n,
        "drive_train.calibration": [0.0] * n,
        "drive_train.k54": 0.0,
        "drive_train.k64": 0.0,
        "drive_train.k65": 0.0,
        "drive_train.joint_sign": [1] * n,
        "drive_train.joint_offset_deg": [0.0] * n,
        "drive_train.torque_constant": [0.1] * n,
        "drive_train.current_limit": [60.0] * n,
        "drive_train.following_error": [2.0] * n,
        "drive_train.encoder_counts_per_revolution": 65536,
        "controller.cycle_ms": 2,
        "controller.host": "10.2.12.150",
    }
    figures |= {name.replace("__", "."): value for name, value in values.items()}
    for name, value in figures.items():
        key = name.partition(".")[2]
        there = re.search(rf"(?m)^{key} = .*\"\?\"", text)
        if there or name in {entry.replace("__", ".") for entry in values}:
            text = with_values(text, {name: value})
    text = with_values(text, {"controller.transport": "simulated"})
    planted = {"seed": 1, "initial_deg": figures["campaign.home_deg"], "third": [0.0] * n}
    planted |= {key: figures[f"nominal.{key}"] for key in ("rotor_inertia", "coulomb", "viscous")}
    planted |= {"current_noise": 0.02, "current_resolution": 0.005}
    return with_values(text, {f"simulation.{key}": value for key, value in planted.items()})
