"""Archives to measure with: a repeated excitation of the NS 16 as the controller would send it.

The values are those of the wire: motor positions in whole encoder counts, velocities as their
differences, currents of the arm's torque in steps of 5 mA with noise, all rounded to 32 bits before
they become joint values. What compresses, and how well, is therefore that of a recording.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from drivers import DriveTrain
from drivers.cycle_records import cycle_dtype
from hil.archive import ArchiveName, ArchiveWriter
from hil.cell import Cell
from sim_fixtures.ns16 import CELL_PATH

Array = NDArray[np.float64]

PERIOD = 0.001
SECONDS = 16
CYCLES = round(SECONDS / PERIOD)
JOINTS = 6

_COUNTS = 8192  # of the encoder per motor revolution
_CURRENT_STEP = 0.005  # A
_CURRENT_NOISE = 0.02  # A, standard deviation
_COULOMB = np.array([30.0, 40.0, 20.0, 4.0, 4.0, 2.0])  # N·m
_VISCOUS = np.array([20.0, 30.0, 12.0, 2.0, 2.0, 1.0])  # N·m·s
_REVERSAL = 1000.0  # s/rad, so that friction reverses within a step of the encoder
_LAG = 5  # cycles
_BATCH = 100
_FIRST = 3000  # cycle in which an excitation of a campaign begins, about


def repetitions(
    folder: Path, count: int, *, first: int = 0, cycles: int = CYCLES, recorded_at: str = ""
) -> list[Path]:
    """Write archives of `count` repetitions of one excitation into `folder`, if missing.

    Args:
        folder: of the archives.
        count: of them.
        first: number of the first among all repetitions, no two of which have the same noise.
        cycles: of each that are stored.
        recorded_at: time of recording, ISO 8601.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index in range(count):
        name = ArchiveName("excitation", index)
        if not (folder / name).exists():
            _write(folder, name, records(first + index)[:cycles], recorded_at)
        paths.append(folder / name)
    return paths


def records(repetition: int) -> NDArray[np.void]:
    """16 s of cycle records at 1 kHz; repetitions differ in their noise."""
    random = np.random.default_rng(repetition)
    drive = drive_train()
    position, velocity, acceleration = _motion()
    period = PERIOD
    revolutions = drive.motor_revolutions(position)
    measured = _behind_targets(revolutions)
    noise = random.normal(scale=0.5, size=measured.shape)
    measured = np.rint(measured * _COUNTS + noise) / _COUNTS
    steps = np.diff(measured, axis=0, prepend=measured[:1])

    rows = np.zeros(CYCLES, cycle_dtype(JOINTS))
    cycle = np.arange(CYCLES)
    rows["cycle"] = _FIRST + cycle
    rows["number"] = (10 + _FIRST + cycle) % 0x8000
    rows["arrival"] = (_FIRST + cycle) * period + random.gamma(2.0, 2e-5, CYCLES)
    rows["interval"], rows["state"], rows["status"], rows["mode"] = 2, 6, 5, 4
    rows["commanded_position"], rows["commanded_velocity"] = position, velocity
    rows["target_position"] = drive.joint_position(_wire(revolutions))
    per_cycle = drive.motor_revolutions_per_cycle(velocity, period)
    rows["target_velocity"] = drive.joint_velocity(_wire(per_cycle), period)
    rows["position"] = drive.joint_position(_wire(measured))
    rows["velocity"] = drive.joint_velocity(_wire(steps), period)
    current = _behind_targets(drive.motor_current(_torque(position, velocity, acceleration)))
    rows["model_current"] = _wire(current)
    demanded = current + random.normal(scale=_CURRENT_NOISE, size=current.shape)
    rows["target_current"] = _wire(np.rint(demanded / _CURRENT_STEP) * _CURRENT_STEP)
    rows["diagonal_inertia"] = _wire([40.0, 80.0, 18.0, 0.3, 0.35, 0.13] + 0.1 * np.cos(position))
    return rows


def _behind_targets(values: Array) -> Array:
    """Return values (m, n) of an arm that lags a few cycles behind its targets."""
    late = np.roll(values, _LAG, axis=0)
    late[:_LAG] = values[0]
    return late


def drive_train() -> DriveTrain:
    """That of the NS 16."""
    return Cell.load(CELL_PATH).drive_train


def _motion() -> tuple[Array, Array, Array]:
    """A sum of sines per joint that begins and ends at rest."""
    random = np.random.default_rng(16)
    t = np.arange(CYCLES)[:, None, None] * PERIOD
    frequency = 2.0 * np.pi * np.arange(1, 6)[:, None] / SECONDS * random.integers(1, 3, JOINTS)
    amplitude = random.uniform(0.05, 0.25, (5, JOINTS))
    position = (amplitude * (1.0 - np.cos(frequency * t))).sum(axis=1)
    velocity = (amplitude * frequency * np.sin(frequency * t)).sum(axis=1)
    acceleration = (amplitude * frequency**2 * np.cos(frequency * t)).sum(axis=1)
    return position, velocity, acceleration


def _torque(position: Array, velocity: Array, acceleration: Array) -> Array:
    """Torque of the bodies of the URDF, and of friction, the same in all repetitions."""
    model = _bodies()
    data = model.createData()
    rows = zip(position, velocity, acceleration, strict=True)
    torque = np.array([pin.rnea(model, data, *row) for row in rows])
    return np.asarray(torque + _COULOMB * np.tanh(_REVERSAL * velocity) + _VISCOUS * velocity)


@cache
def _bodies() -> pin.Model:
    return pin.buildModelFromXML(Cell.load(CELL_PATH).urdf)


def _wire(values: object) -> Array:
    """As 32 bits on the wire leave it."""
    return np.asarray(values, np.float32).astype(np.float64)


def _write(folder: Path, name: ArchiveName, rows: NDArray[np.void], recorded_at: str) -> None:
    cell = Cell.load(CELL_PATH)
    drive = drive_train()
    attachments = {"cell.toml": cell.text.encode(), "robot.urdf": cell.urdf.encode()}
    partial = folder / "part"
    partial.unlink(missing_ok=True)
    with ArchiveWriter(
        partial,
        joint_names=cell.joint_names,
        period=PERIOD,
        metadata=name.metadata() | ({"recorded_at": recorded_at} if recorded_at else {}),
        attachments=attachments,
        durable=False,
    ) as archive:
        archive.event(_FIRST, "MotionStarted", "the excitation began")
        for start in range(0, len(rows), _BATCH):
            part = rows[start : start + _BATCH]
            archive.write(part, drive.joint_torque(part["target_current"]))
        archive.event(None, "MotionEnded", "the excitation ended")
        archive.close("completed")
    partial.rename(folder / name)
