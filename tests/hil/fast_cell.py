"""A small arm of two joints in a cycle of 2 ms whose whole campaign runs in a few seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive
from hil.base.progress import Silent
from hil.campaign import Campaign
from hil.campaign.folder import CampaignFolder
from hil.campaign.plan import design
from hil.campaign.rehearsal_record import CRITERIA, Rehearsal, RehearsalCriterion
from hil.cell import Cell
from hil.cell.toml_edits import with_values
from planner import PiecewiseCubic

QUICK = """\
method = "b"
[search]
population = 8
generations = 3
[via_points]
n_via = 3
fly = 0.5
slowest = 0.8
"""

QUICK_GRADIENT = """\
method = "gradient"
[search]
population = 8
generations = 1
gradient = 2
[via_points]
n_via = 4
"""
"""Settings of a search of some seconds."""

URDF = """<robot name="fast">
<link name="base"/>
<link name="upper">
  <inertial><mass value="6"/><origin xyz="0.2 0 0"/>
    <inertia ixx="0.02" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.2 0 0"/><geometry><box size="0.3 0.08 0.08"/></geometry></collision>
</link>
<link name="fore">
  <inertial><mass value="3"/><origin xyz="0.15 0 0"/>
    <inertia ixx="0.01" iyy="0.04" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.2 0 0"/><geometry><box size="0.25 0.06 0.06"/></geometry></collision>
</link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <origin xyz="0 0 1.2"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="200" velocity="8"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
  <origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="100" velocity="8"/></joint>
</robot>
"""
CELL = """[cell]
name = "fast"
urdf = "fast.urdf"

[robot.friction]
third = "none"
standstill = 0.1

[nominal]
rotor_inertia = [0.5, 0.2]
coulomb = [6.0, 3.0]
viscous = [3.0, 1.5]

[limits]
frame = "urdf"
lower_deg = [-80.0, -80.0]
upper_deg = [80.0, 80.0]
velocity_deg = [400.0, 400.0]
acceleration_deg = [5000.0, 6000.0]
jerk_deg = [150000.0, 200000.0]

[drive_train]
gear_ratio = [100.0, -80.0]
calibration = [0.5, -1.25]
joint_sign = [1, -1]
joint_offset_deg = [0.0, 10.0]
torque_constant = [0.5, 0.4]
current_limit = [20.0, 12.0]
following_error = [1.0, 1.0]
encoder_counts_per_revolution = 65536

[controller]
transport = "simulated"
cycle_ms = 2
current_delay_cycles = 0.35

[campaign]
repetitions = 4
validation_runs = 1
home_deg = [0.0, 20.0]
approach_speed = 1.0
standstill_s = 0.3
n_via = 3
candidates = 20

[simulation]
seed = 3
initial_deg = [10.0, -10.0]
rotor_inertia = [0.5, 0.2]
coulomb = [6.0, 3.0]
viscous = [3.0, 1.5]
third = [0.0, 0.0]
current_noise = 0.01
current_resolution = 0.002
friction_drift = 0.9
"""


def fast_cell(folder: Path, **campaign: float) -> Cell:
    """The cell as a file in a folder, with some of its `[campaign]` replaced."""
    (folder / "fast.urdf").write_text(URDF)
    text = with_values(CELL, {f"campaign.{key}": value for key, value in campaign.items()})
    path = folder / "cell.toml"
    path.write_text(text)
    return Cell.load(path)


def mirrored(cell: Cell, joint_sign: str) -> Cell:
    """One repetition, and joint signs in the cell file that the simulated arm does not have."""
    text = cell.text.replace("joint_sign = [1, -1]", f"joint_sign = {joint_sign}")
    text += "\n[simulation.drive_train]\njoint_sign = [1, -1]\n"
    return Cell.from_texts(text, cell.urdf, cell.path).with_campaign(repetitions=1)


def fast_campaign(folder: Path, cell: Cell, *, rehearsed: bool = True) -> Campaign:
    """A campaign of it; its rehearsal is written as passed unless that is not wanted."""
    campaign = Campaign.create(folder, cell, design(cell, Silent()))
    if rehearsed:
        pass_rehearsal(campaign.folder)
    return campaign


def pass_rehearsal(folder: CampaignFolder, *, passed: bool = True) -> None:
    """Leave what a rehearsal of the folder's plan leaves."""
    Rehearsal(
        plan_hash=folder.plan_hash,
        seed=1,
        passed=passed,
        criteria=[
            RehearsalCriterion(name=name, value=0.0, bound=1.0, passed=passed, sentence=name)
            for name in CRITERIA
        ],
        assumed=[],
        not_seen=[],
        repetitions=2,
        motion_seconds=1.0,
        software={},
    ).save(folder.rehearsal)


def set_points(archive: Archive) -> NDArray[np.float64]:
    """Set-points (k, n) [rad] that were sent in an archive."""
    commanded = archive.columns["commanded_position"]
    return np.asarray(commanded[np.isfinite(commanded).all(axis=1)])


def on_path(archive: Archive, motion: PiecewiseCubic) -> NDArray[np.float64]:
    """Set-points (k, n) [rad] of an archive, some 40 of which must be on a path [2e-4 rad]."""
    points = set_points(archive)
    planned = motion.sample(np.linspace(0.0, motion.duration, 40_000))[0]
    for point in points[:: len(points) // 40 + 1]:
        assert np.abs(planned - point).max(axis=1).min() < 2e-4
    return points
