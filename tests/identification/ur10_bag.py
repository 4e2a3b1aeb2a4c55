"""The recording of a real UR10 that lies beside the project, and the model of its arm."""

from __future__ import annotations

import sqlite3
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.recording import Recording

ALL_TERMS = FrictionLaw(offset=True)


def ur10(folder: Path, friction: FrictionLaw = ALL_TERMS) -> tuple[RobotModel, Recording]:
    """Model with this friction, and 27.5 s at 125 Hz; skips where either is missing."""
    typesys = pytest.importorskip("rosbags.typesys")
    files = metadata.files("example-robot-data") or ()
    urdf = next((f.locate() for f in files if f.name == "ur10_robot.urdf"), None)
    if urdf is None:
        pytest.skip("the package example-robot-data, which has the UR10's URDF, is not installed")
    bag = folder / "ur10_unisa" / "ur10_exciting_trajectory.db3"
    if not bag.is_file():
        pytest.skip(f"no {bag.name} beside this checkout")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    database = sqlite3.connect(f"file:{bag}?mode=ro&immutable=1", uri=True)
    rows = database.execute("select data from messages order by timestamp").fetchall()
    database.close()
    states = [store.deserialize_cdr(data, "sensor_msgs/msg/JointState") for (data,) in rows]
    model = RobotModel.from_urdf(Path(str(urdf)).read_text(), friction=friction)
    order = [states[0].name.index(name) for name in model.joint_names]
    stamps = [s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in states]
    return model, Recording(
        time=np.array(stamps) - stamps[0],
        position=np.array([s.position for s in states])[:, order],
        joint_names=model.joint_names,
        torque=np.array([s.effort for s in states])[:, order],
    )
