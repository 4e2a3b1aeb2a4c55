"""Torques that are never negative: by the weight that joints hold, or without their sign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.base.errors import SourceError
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions, read_recording
from hil.look.before_identification import Concluded, concluded
from identification.model.motion import Motion
from tests.identification.three_axes import model, urdf

Floats = NDArray[np.float64]


def motion(leaning: float) -> tuple[Floats, Floats, Floats]:
    """Times, positions about a posture that leans to one side, and their torques."""
    time = np.arange(0.0, 12.0, 0.01)
    rate = np.array([[1.1, 2.3], [1.7, 2.9], [1.3, 3.1]])
    angle = rate * time[:, None, None] + np.arange(6.0).reshape(3, 2)
    position = np.array([1.0, 0.3, 0.2]) * leaning + 0.12 * np.sin(angle).sum(axis=2)
    velocity = 0.12 * (rate * np.cos(angle)).sum(axis=2)
    acceleration = -0.12 * (rate**2 * np.sin(angle)).sum(axis=2)
    robot = model()
    values = np.zeros(robot.n_parameters)
    values[: robot.base.rank] = robot.base.grouping @ robot.nominal
    torque = robot.torque(values, Motion.of_states(position, velocity, acceleration))
    torque += 0.1 * np.sign(velocity) + 0.05 * velocity
    return time, position, torque + np.random.default_rng(0).normal(0.0, 0.01, torque.shape)


def asked(folder: Path, time: Floats, position: Floats, torque: Floats) -> Concluded:
    """What an identification concludes of a log."""
    path = folder / "log.csv"
    table = np.column_stack([time, position, torque])
    header = "t,q_1,q_2,q_3,tau_1,tau_2,tau_3"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.10g")
    description = folder / "arm.urdf"
    description.write_text(urdf())
    robot = Robot.from_urdf(description)
    options = ImportOptions()
    recording = read_recording(path, lambda _: robot, options)
    return concluded(recording, path, lambda _: robot, options)


def test_torques_that_the_weight_keeps_positive_are_read(tmp_path: Path) -> None:
    time, position, torque = motion(-1.0)
    assert (torque > 0.0).all()
    read = asked(tmp_path, time, position, torque).recording.archive.columns["torque"]
    assert read == pytest.approx(torque)


def test_torques_without_their_sign_are_refused(tmp_path: Path) -> None:
    time, position, torque = motion(0.0)
    with pytest.raises(SourceError, match="its sign was not recorded"):
        asked(tmp_path, time, position, np.abs(torque))
