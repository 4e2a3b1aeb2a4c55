"""Servos fitted by `mujoco.sysid` and by `hil` to the same windows, judged on another motion.

Run with ``python -m benchmarks.servo_rival [--seeds N] [--so101 FOLDER]``: simulated servo arms of
`benchmarks.servo_coverage`, or 30 s each of chirp_sweep and coupled_joints of a public SO-101 in a
folder as `robot.urdf`, judged on circular_motion. Needs `pip install 'mujoco[sysid]'`.

`mujoco.sysid` fits of each joint the gain of a position actuator, damping, dry friction and
armature. It has no delay: its commands come by the delay that `hil` finds, which is in its favour.
Both start from the same values, those that `hil` starts from.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import mujoco_sysid
from benchmarks import servo_arm as planted
from identification import RobotModel
from identification.servo.choice import fit_servos
from identification.servo.fit import ServoWindows
from identification.servo.intervals import intervals_of
from identification.servo.parameters import PLACE, in_units, natural
from identification.servo.prediction import predicted
from identification.servo.recorded_motion import Grid, ServoMotion, motions_of
from identification.servo.start import prior_of
from identification.signals.recording import Recording

Array = NDArray[np.float64]

# Extensions in C++, without types.
mujoco: Any = import_module("mujoco")
sysid: Any = mujoco_sysid.load()

_FITTED: Final = ("kp", "viscous", "coulomb", "armature")
_MOST: Final = 50.0  # times the start: largest value
_ITERATIONS: Final = 25
_SHORT: Final = 30.0  # s of each fitted motion of the SO-101
_SO101: Final = (
    "shoulder_pan",
    "shoulder_lift",
    "elbow_flex",
    "wrist_flex",
    "wrist_roll",
    "gripper",
)


@dataclass(frozen=True, eq=False)
class Task:
    """An arm, recordings that are fitted, and one that is predicted."""

    name: str
    urdf: str
    joints: tuple[str, ...]
    fitted: Sequence[Recording]
    unseen: Recording
    resolution: float


@dataclass(frozen=True)
class Score:
    """Errors of the unseen motion, root mean square over joints [mrad], and processor time [s]."""

    name: str
    command: float
    hil: float
    sysid: float
    hil_seconds: float
    sysid_seconds: float


def simulated_arm(seed: int) -> Task:
    """Return an arm of `benchmarks.servo_arm` with its motions."""
    rng = np.random.default_rng(seed)
    truth = planted.Planted.drawn(rng)
    recordings = []
    for duration in (40.0, 12.0):
        instants, command = planted.commands(rng, duration)
        position = planted.simulated(truth, instants, command)
        recordings.append(
            Recording(
                time=instants,
                position=position,
                joint_names=planted.NAMES,
                commanded_position=command,
            )
        )
    fitted, unseen = recordings
    return Task(f"seed {seed}", planted.urdf(), planted.NAMES, [fitted], unseen, planted.COUNT)


def so101(folder: Path) -> Task:
    """Return the public SO-101; times are in microseconds, positions lists in cells."""

    def table(path: Path) -> tuple[Array, Array]:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        instants = 1e-6 * np.array([float(row["timestamp"]) for row in rows])
        return instants, np.array([json.loads(row["positions"]) for row in rows])

    def recording(name: str, most: float) -> Recording:
        instants, position = table(folder / name / "state_motor.csv")
        sent, commands = table(folder / name / "control.csv")
        command = np.column_stack([np.interp(instants, sent, each) for each in commands.T])
        rows = instants - instants[0] < most
        return Recording(
            time=instants[rows] - instants[0],
            position=position[rows],
            joint_names=_SO101,
            commanded_position=command[rows],
        )

    fitted = [recording(name, _SHORT) for name in ("chirp_sweep", "coupled_joints")]
    unseen = recording("circular_motion", np.inf)
    urdf = (folder / "robot.urdf").read_text("utf-8")
    return Task("SO-101", urdf, _SO101, fitted, unseen, 2.0 * np.pi / 4096.0)


def scored(task: Task) -> Score:
    """Fit an arm by both, and predict the unseen motion from its commands alone."""
    model = RobotModel.from_urdf(task.urdf)
    standard = model.nominal.copy()
    standard[model.layout.rotors] = 0.0
    bodies = np.zeros(model.n_parameters)
    bodies[: model.base.rank] = model.base.grouping @ standard
    grid = Grid.of(task.fitted[0])

    def motions(recordings: Sequence[Recording], on: Grid) -> list[ServoMotion]:
        return [each for part in recordings for each in motions_of(part, model, bodies, on)]

    fitted = motions(task.fitted, grid)
    (unseen,) = motions([task.unseen], grid)
    resolution = np.full(len(task.joints), task.resolution / np.sqrt(12.0))
    begun = time.process_time()
    found = fit_servos(lambda on: motions(task.fitted, on), grid, resolution)
    own = intervals_of(found).values
    between = time.process_time()
    start = in_units(natural(prior_of(fitted, resolution).mean))
    delay = float(np.median(own[:, PLACE["delay"]]))
    rival = fitted_by_sysid(task, fitted, start, delay)
    ended = time.process_time()
    (by_hil,) = predicted(model, bodies, unseen, [own])
    by_sysid = simulated(rival, task.joints, unseen, delay)

    def error(positions: Array) -> float:
        return 1e3 * float(np.sqrt(np.mean((positions - unseen.position) ** 2)))

    return Score(
        task.name,
        error(unseen.command),
        error(by_hil),
        error(by_sysid),
        between - begun,
        ended - between,
    )


def specification(task: Task, step: float, start: Array) -> Any:
    """Return the arm of the URDF with position actuators, without limits and contacts."""
    spec = mujoco.MjSpec.from_string(without_meshes(task.urdf))
    off = mujoco.mjtDisableBit
    spec.option.disableflags |= off.mjDSBL_LIMIT | off.mjDSBL_CONTACT
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name, row in zip(task.joints, start, strict=True):
        actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        joint = spec.joint(name)
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        for quantity in _FITTED:
            _write(spec, name, quantity, float(row[PLACE[quantity]]))
    return spec


def without_meshes(urdf: str) -> str:
    """Return a URDF without shapes, whose files need not be there."""
    import xml.etree.ElementTree as ET

    root = ET.fromstring(urdf)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    for extension in root.findall("mujoco"):
        root.remove(extension)
    extension = ET.SubElement(root, "mujoco")
    ET.SubElement(extension, "compiler", fusestatic="false", discardvisual="false")
    return ET.tostring(root, encoding="unicode")


def _write(spec: Any, name: str, quantity: str, value: float) -> None:
    joint = spec.joint(name)
    if quantity == "kp":
        actuator = spec.actuator(name)
        actuator.gainprm[0] = value
        actuator.biasprm[1] = -value
    elif quantity == "viscous":
        joint.damping[0] = value
    else:
        setattr(joint, {"coulomb": "frictionloss", "armature": "armature"}[quantity], value)


def _setter(name: str, quantity: str) -> Callable[[Any, Any], None]:
    def write(spec: Any, parameter: Any) -> None:
        _write(spec, name, quantity, float(parameter.value[0]))

    return write


def fitted_by_sysid(task: Task, motions: Sequence[ServoMotion], start: Array, delay: float) -> Any:
    """Return the model of an arm that `mujoco.sysid` fits to the windows that `hil` fits."""
    logging.getLogger("absl").setLevel(logging.ERROR)
    step = motions[0].step
    spec = specification(task, step, start)
    model = spec.compile()
    names = task.joints
    signals = [(f"{name}_qpos", sysid.SignalType.MjStateQPos) for name in names]
    coordinates = {
        "qpos_names": [f"{name}_qpos" for name in names],
        "qvel_names": [f"{name}_qvel" for name in names],
    }
    length = len(ServoWindows.of(motions).measured) * motions[0].every
    states = []
    controls = []
    measured = []
    for motion in motions:
        wanted = delayed(motion, delay)
        for first in range(0, len(motion.position) - length + 1, length):
            rows = slice(first, first + length)
            times = step * np.arange(length)
            states.append(
                sysid.create_initial_state(
                    model, motion.position[first], motion.velocity[first], **coordinates
                )
            )
            controls.append(sysid.TimeSeries.from_control_names(times, wanted[rows], model, names))
            measured.append(
                sysid.TimeSeries.from_names(times, motion.position[rows], model, signals)
            )
    labels = [str(k) for k in range(len(states))]
    sequences = sysid.ModelSequences(
        "arm", spec, labels, states, controls, measured, allow_missing_sensors=True
    )
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], resample_true=False, enabled_observations=signals
    )
    parameters = sysid.ParameterDict()
    for name, row in zip(names, start, strict=True):
        for quantity in _FITTED:
            value = float(row[PLACE[quantity]])
            parameters.add(
                sysid.Parameter(
                    f"{quantity} of {name}", value, 0.0, _MOST * value,
                    modifier=_setter(name, quantity),
                )
            )  # fmt: skip
    with contextlib.redirect_stdout(None):  # the minimiser prints each iteration
        best, _ = sysid.optimize(
            parameters, residual, verbose=False, max_iters=_ITERATIONS, x_scale="jac"
        )
    return sysid.apply_param_modifiers(best, spec)


def delayed(motion: ServoMotion, delay: float) -> Array:
    """Return the commands of a motion (g, n), late by a delay [s]."""
    instants = motion.step * np.arange(len(motion.command))
    late = [np.interp(instants - delay, instants, column) for column in motion.command.T]
    return np.column_stack(late)


def simulated(model: Any, names: Sequence[str], motion: ServoMotion, delay: float) -> Array:
    """Return the positions (g, n) of a model that follows the commands of a whole motion."""
    data = mujoco.MjData(model)
    places = [int(model.joint(name).qposadr[0]) for name in names]
    drives = [int(model.actuator(name).id) for name in names]
    data.qpos[places] = motion.position[0]
    positions = np.empty_like(motion.position)
    for k, row in enumerate(delayed(motion, delay)):
        positions[k] = data.qpos[places]
        data.ctrl[drives] = row
        mujoco.mj_step(model, data)
    return positions


def main() -> None:
    """Print the errors of the unseen motions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--so101", type=Path)
    options = parser.parse_args()
    tasks = (
        [so101(options.so101)] if options.so101 else map(simulated_arm, range(1, 1 + options.seeds))
    )
    print("error of a motion that was not fitted [mrad], and processor time [s]")
    for task in tasks:
        score = scored(task)
        print(
            f"{score.name}: command itself {score.command:.1f}; mujoco.sysid {score.sysid:.2f}"
            f" ({score.sysid_seconds:.0f} s), hil {score.hil:.2f} ({score.hil_seconds:.0f} s)",
            flush=True,
        )


if __name__ == "__main__":
    main()
