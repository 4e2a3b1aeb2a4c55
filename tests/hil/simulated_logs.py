"""Motions of other people's robots with torques made by pinocchio, to be written as logs."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.importers.column_map import ColumnMap
from hil.importers.imported_robot import Robot
from hil.importers.log import import_log
from hil.importers.recording_content import Use
from identification import FrictionLaw, RobotModel

Array = NDArray[np.float64]

POSITION_NOISE = 2e-5  # rad
TORQUE_NOISE = 0.02  # of a joint's own scatter


@dataclass(frozen=True, eq=False)
class Simulated:
    """What a log is written from; joints in the order of the URDF, joint side.

    Attributes:
        urdf: path of the description.
        joint_names: that move.
        time: (m,) [s].
        position, velocity, torque: (m, n), measured: with noise.
        clean: the torque without noise (m, n).
        size: of each joint (n,); friction is 0.15 of it in N·m, 0.1 in N·m·s/rad, the rotor's
            inertia 0.02 in kg·m².
    """

    urdf: Path
    joint_names: tuple[str, ...]
    time: Array
    position: Array
    velocity: Array
    torque: Array
    clean: Array
    size: Array


def urdf_path(name: str) -> Path:
    """A description from the package example-robot-data."""
    for file in importlib.metadata.files("example-robot-data") or ():
        if file.name == name:
            return Path(str(file.locate()))
    raise FileNotFoundError(name)


def simulate(
    name: str | Path,
    time: Array,
    *,
    locked: tuple[str, ...] = (),
    seed: int = 0,
    noise: float = 1.0,
    pace: float = 1.0,
    load: pin.Inertia | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
) -> Simulated:
    """A motion of sines within the joint limits, torques by recursive Newton-Euler and friction.

    The name is of a description of example-robot-data, or the path of another. The load is fixed
    to the last joint, in its frame; friction is that of the robot without it.
    """
    path = name if isinstance(name, Path) else urdf_path(name)
    model = pin.buildModelFromUrdf(str(path))
    model = pin.buildReducedModel(model, [model.getJointId(j) for j in locked], pin.neutral(model))
    model.gravity.linear = np.array(gravity)
    n = model.nv
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.1, 0.3, (5, n)) / np.arange(1, 6)[:, None] ** 0.5
    hertz = 0.08 + 0.13 * np.arange(5)[:, None] + rng.uniform(0.0, 0.04, (5, n))
    rate = pace * 2.0 * np.pi * hertz
    phase = rng.uniform(0.0, 2.0 * np.pi, (5, n))
    lower = np.where(np.isfinite(model.lowerPositionLimit), model.lowerPositionLimit, -np.pi)[-n:]
    upper = np.where(np.isfinite(model.upperPositionLimit), model.upperPositionLimit, np.pi)[-n:]
    middle = np.clip(0.5 * (lower + upper), -1.0, 1.0)
    room = np.minimum(np.minimum(middle - lower, upper - middle), 1.5)
    amplitude *= room / amplitude.sum(axis=0) * 0.95
    angle = rate * (time[:, None, None] - time[0]) + phase
    q = middle + np.einsum("kn,mkn->mn", amplitude, np.sin(angle))
    qd = np.einsum("kn,mkn->mn", amplitude * rate, np.cos(angle))
    qdd = np.einsum("kn,mkn->mn", -amplitude * rate**2, np.sin(angle))
    data = model.createData()
    rigid = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
    size = rigid.std(axis=0) + 0.1
    if load is not None:
        model.inertias[model.njoints - 1] += load
        data = model.createData()
        rigid = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
    clean = rigid + 0.15 * size * np.sign(qd) + 0.1 * size * qd + 0.02 * size * qdd
    return Simulated(
        urdf=path,
        joint_names=tuple(name for name in model.names if name != "universe"),
        time=time,
        position=q + noise * POSITION_NOISE * rng.standard_normal(q.shape),
        velocity=qd + noise * 1e-3 * rng.standard_normal(q.shape),
        torque=clean + noise * TORQUE_NOISE * clean.std(axis=0) * rng.standard_normal(q.shape),
        clean=clean,
        size=size,
    )


def write_log(path: Path, names: Sequence[str], *columns: Array) -> Path:
    """Write a CSV file; a name with {} is that of a column for each joint, from 1."""
    header = []
    for name, values in zip(names, columns, strict=True):
        count = 1 if values.ndim == 1 else values.shape[1]
        header += [name.replace("{}", str(number)) for number in range(1, count + 1)]
    table = np.column_stack(columns)
    rows = [",".join(f"{value:.9g}" for value in row) for row in table.tolist()]
    path.write_text("\n".join([",".join(header), *rows]) + "\n")
    return path


def write_moving_log(path: Path, urdf: str, *, seed: int = 0, duration: float = 8.0) -> Path:
    """Write the log of a simulated motion, its torques those of the URDF's masses and friction."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.01)
    rate = rng.uniform(2.0, 8.0, (3, model.nv))
    angle = rate * time[:, None, None] + rng.uniform(0.0, 6.0, rate.shape)
    q = 0.3 * np.sin(angle).sum(axis=1)
    v = 0.3 * (rate * np.cos(angle)).sum(axis=1)
    a = -0.3 * (rate**2 * np.sin(angle)).sum(axis=1)
    torque = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    torque += 0.4 * np.sign(v) + 0.2 * v + rng.normal(0.0, 0.02, v.shape)
    return write_log(path, ["t", "q{}", "v{}", "tau{}"], time, q, v, torque)


def planted(robot: RobotModel, simulated: Simulated) -> Array:
    """Parameters (p,) of a model with Coulomb, viscous and offset friction."""
    standard = robot.nominal.copy()
    for joint, size in enumerate(simulated.size, 1):
        standard[robot.layout.names.index(f"I{joint}m")] = 0.02 * size
    friction = [0.15 * simulated.size, 0.1 * simulated.size, np.zeros(robot.n_joints)]
    return np.concatenate([robot.base.grouping @ standard, *friction])


JOINTS = ("hip", "knee", "ankle")


def three_joint_robot(folder: Path) -> Robot:
    """Its URDF is written into the folder."""
    parts = ["<robot name='three'><link name='l0'/>"]
    for number, name in enumerate(JOINTS):
        parts.append(
            f"<link name='l{number + 1}'><inertial><mass value='1'/><origin xyz='0 0 0.2'/>"
            "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
            f"<joint name='{name}' type='revolute'><parent link='l{number}'/>"
            f"<child link='l{number + 1}'/><axis xyz='0 1 0'/><origin xyz='0 0 0.4'/>"
            "<limit lower='-3' upper='3' effort='9' velocity='9'/></joint>"
        )
    path = folder / "three.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    return Robot.from_urdf(path)


def column_map(**entries: object) -> ColumnMap:
    """Of positions called q1, q2 ... at 100 Hz, unless the entries say else."""
    rate = {} if "time" in entries else {"sample_rate": 100.0}
    return ColumnMap.model_validate({"position": {"columns": "q{}"}, **rate, **entries})


def archive_of(
    path: Path,
    urdf: Path,
    entries: Mapping[str, object] | None = None,
    law: FrictionLaw | None = None,
    use: Use = "excitation",
    **arrays: Array,
) -> Path:
    """Import arrays into an archive, by default time t, positions q and torques tau."""
    table = path.with_suffix(".npz")
    np.savez(table, **arrays)  # type: ignore[arg-type]
    usual = {"time": {"column": "t"}, "position": {"columns": "q"}, "torque": {"columns": "tau"}}
    columns = ColumnMap.model_validate(entries or usual)
    robot = Robot.from_urdf(urdf, friction=law)
    return import_log(table, path, robot=robot, columns=columns, use=use)


def imported(source: Path, robot: Robot, **entries: object) -> dict[str, Any]:
    """The columns of a log's archive, which lies beside it; entries as of `column_map`."""
    path = source.with_suffix(".mcap")
    path.unlink(missing_ok=True)
    import_log(source, path, robot=robot, columns=column_map(**entries))
    return dict(open_archive(path).columns)
