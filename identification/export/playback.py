"""Motions played back in MuJoCo: positions of an MJCF whose actuators follow commands."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from identification.arrays import Array
from identification.export.simulators import load_mujoco
from identification.export.urdf import WriteBackError


def played_back(
    text: str,
    joint_names: Sequence[str],
    time: Array,
    command: Array,
    start: Array,
    folder: Path | None = None,
) -> Array:
    """Return positions (m, n) of an MJCF at the times (m,) [s] of commands (m, n).

    Args:
        text: MJCF with a position actuator of each joint.
        joint_names: (n,).
        time: even, increasing [s].
        command: commanded positions, with the offset of the servo.
        start: positions at the start (n,).
        folder: that files in the MJCF are relative to, if it has any.

    Raises:
        WriteBackError: MuJoCo does not read the text, or an actuator is missing.
        MissingMujocoError: it is not installed.
    """
    mujoco = load_mujoco()
    try:
        model = _model(mujoco, text, folder)
    except ValueError as error:
        raise WriteBackError(f"MuJoCo does not read the text: {error}") from error
    data = mujoco.MjData(model)
    joints = [model.joint(name).id for name in joint_names]
    places = [int(model.jnt_qposadr[joint]) for joint in joints]
    driven = [int(row[0]) for row in model.actuator_trnid]
    if missing := [name for name, j in zip(joint_names, joints, strict=True) if j not in driven]:
        raise WriteBackError(f"MuJoCo finds no actuator of joint {missing[0]}")
    controls = [driven.index(joint) for joint in joints]
    step = float(model.opt.timestep)
    grid = np.arange(time[0], time[-1] + 0.5 * step, step)
    targets = np.column_stack([np.interp(grid, time, column) for column in command.T])
    data.qpos[places] = start
    for control, first in zip(controls, targets[0], strict=True):
        samples = int(model.actuator_history[control][0])
        if samples:  # the first command acts before the motion as well
            times = step * np.arange(-samples, 0.0)
            mujoco.mj_initCtrlHistory(model, data, control, times, np.full((samples, 1), first))
    positions = np.empty_like(targets)
    for k, row in enumerate(targets):
        positions[k] = data.qpos[places]
        data.ctrl[controls] = row
        mujoco.mj_step(model, data)
    return np.column_stack([np.interp(time, grid, column) for column in positions.T])


def _model(mujoco: Any, text: str, folder: Path | None) -> Any:
    if folder is None:
        return mujoco.MjModel.from_xml_string(text)
    with tempfile.NamedTemporaryFile("w", suffix=".xml", dir=folder) as file:
        file.write(text)
        file.flush()
        return mujoco.MjModel.from_xml_path(file.name)
