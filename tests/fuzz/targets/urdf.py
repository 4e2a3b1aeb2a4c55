"""Robot descriptions: refused as documented, or a model made of finite numbers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from hil.base.errors import InputError
from hil.importers.imported_robot import Robot
from hil.new import cell_of_urdf
from identification.errors import ModelError
from identification.excitation import Workspace
from identification.excitation.collision import CollisionChecker
from identification.excitation.errors import CollisionModelError
from identification.model.kinematics import chain_from_urdf
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from tests.fuzz.draw import mutate_text
from tests.fuzz.targets import Target, place_of
from tests.hil.fast_cell import URDF

TREE = URDF.replace(
    "</robot>",
    """<link name="hand"><inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3"
 ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><geometry><cylinder radius="0.05" length="0.1"/></geometry></collision>
 <collision><geometry><sphere radius="0.05"/></geometry></collision>
 <collision><geometry><mesh filename="package://other/hand.stl" scale="1 1 1"/></geometry>
 </collision></link>
<joint name="wrist" type="fixed"><parent link="fore"/><child link="hand"/>
 <origin xyz="0.3 0 0" rpy="0 0.1 0"/></joint>
<link name="finger"/>
<joint name="slide" type="prismatic"><parent link="hand"/><child link="finger"/><axis xyz="0 1 0"/>
 <limit lower="0" upper="0.05" effort="10" velocity="0.1"/><mimic joint="elbow"/></joint>
<transmission name="t"><joint name="elbow"/></transmission></robot>""",
)
TURNING = URDF.replace('type="revolute"', 'type="continuous"')
DRAKES = '<?xml version="1.0" encoding="GB2312"?>' + TURNING.replace(
    "<robot ", '<robot xmlns="http://drake.mit.edu" '
)


folder = lru_cache(partial(place_of, "urdf"))


def run(data: bytes) -> bool:
    """Read it as all commands do; return whether all accept it."""
    path = folder() / "robot.urdf"
    path.write_bytes(data)
    accepted = [new_cell(path), import_robot(path)]
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return False
    accepted.append(model_of(text))
    return all(accepted)


def new_cell(path: Path) -> bool:
    """`hil new`."""
    try:
        made = cell_of_urdf(path, {})
        text, unknown = made.text(path.with_name("cell.toml"))
    except InputError as error:
        assert error.remedy, error
        return False
    assert made.joint_names
    assert unknown, "a new cell has entries to complete"
    assert text
    return True


def import_robot(path: Path) -> bool:
    """`hil import`."""
    try:
        Robot.from_urdf(path)
    except InputError as error:
        assert error.path is not None
        return False
    return True


def model_of(text: str) -> bool:
    """Chain, model and collisions."""
    try:
        chain = chain_from_urdf(text)
    except ModelError:
        assert refuses(RobotModel.from_urdf, text)
        return False
    n = chain.n_joints
    for values in (chain.rotation, chain.translation, chain.axis, chain.inertial):
        assert np.isfinite(values).all(), "numbers that are not finite"
    assert np.allclose(np.linalg.norm(chain.axis, axis=1), 1.0)
    if n > 12:  # only slower
        return True
    try:
        model = RobotModel.from_urdf(text)
    except ModelError:
        model = None
    if model is not None:
        states = np.linspace(-1.0, 1.0, 3 * n).reshape(3, n)
        motion = Motion.of_states(states, states, states)
        assert np.isfinite(model.regressor(motion).dense(model.n_parameters)).all()
    with suppress(CollisionModelError, ModelError):
        CollisionChecker(text, Workspace(floor=0.0))
    return model is not None


def refuses(read: Callable[[str], object], text: str) -> bool:
    try:
        read(text)
    except ModelError:
        return True
    return False


def seeds() -> list[bytes]:
    """Two joints, a tree with a gripper, joints without limits, and one in a namespace."""
    return [text.encode() for text in (URDF, TREE, TURNING, DRAKES)]


TARGET = Target(run, seeds, mutate_text, most=8000, replayed=60)
