"""MuJoCo's side of `benchmarks.rollout --sysid`: an arm fitted to windows by `mujoco.sysid`.

It starts from the nominal arm and fits, of each joint, the body (pseudo-inertia, 10 numbers within
the default bounds of `mujoco.sysid`), dry friction, damping and armature, by the minimiser of
`mujoco.sysid`. Windows, start states, torque and feedback are those that `hil rollout` simulates.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import mujoco_sysid
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import mjcf
from identification.rollout.mujoco_simulation import Feedback, RolloutArm
from identification.rollout.position_errors import RecordedMotion, horizon_rows

Array = NDArray[np.float64]

# Extensions in C++, without types.
mujoco: Any = import_module("mujoco")
sysid: Any = mujoco_sysid.load()
pi_from_theta: Any = import_module("mujoco.sysid._src.model_modifier").pi_from_theta

_SHARE: Final = 0.05
"""Start of friction as a share of a joint's torque, of armature as a share of its inertia."""
_MOST: Final = 20.0  # times the start: largest friction, damping and armature


class Fitted(NamedTuple):
    """A model by `mujoco.sysid`."""

    model: Any  #: `mujoco.MjModel`
    parameters: int  #: number of fitted ones
    simulations: int  #: of all windows


def fit_by_sysid(
    arm: ExportedArm, motion: RecordedMotion, feedback: Feedback, iterations: int
) -> Fitted:
    """Fit a nominal arm to the positions in windows."""
    logging.getLogger("absl").setLevel(logging.ERROR)
    spec = _specification(arm, motion.windows.step, feedback)
    names = arm.model.joint_names
    residual = sysid.build_residual_fn(
        models_sequences=[_sequences(spec, arm, motion, feedback)],
        resample_true=False,
        enabled_observations=[(f"{name}_qpos", sysid.SignalType.MjStateQPos) for name in names],
    )
    simulations = 0

    def counted(x: Array, parameters: Any) -> Any:
        nonlocal simulations
        simulations += x.shape[1] if x.ndim > 1 else 1
        return residual(x, parameters)

    start = _parameters(spec, arm, motion, feedback)
    with contextlib.redirect_stdout(None):  # the minimiser prints each iteration
        parameters, _ = sysid.optimize(
            start, counted, verbose=False, max_iters=iterations, x_scale="jac"
        )
    return Fitted(sysid.apply_param_modifiers(parameters, spec), parameters.size, simulations)


def positions_of(
    fitted: Fitted, arm: ExportedArm, motion: RecordedMotion, feedback: Feedback
) -> Array:
    """Return the positions of a fitted model at the horizons (w, h, n)."""
    windows = motion.windows
    bare = RolloutArm.of(arm, windows.step, feedback)
    model = fitted.model
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_ACTUATION | off.mjDSBL_AUTORESET
    viscous = model.dof_damping[bare.order] - feedback.damping
    simulated = replace(bare, model=model, viscous=viscous)
    force = _force(simulated, motion)
    positions = simulated.simulate(windows.position[:, 0], windows.start, force, windows.position)
    return positions[:, horizon_rows(windows)]


def _specification(arm: ExportedArm, step: float, feedback: Feedback) -> Any:
    """Return the arm without limits and contacts, with the springs of the feedback."""
    spec = mujoco.MjSpec.from_string(mjcf(arm, "arm", step=step))
    off = mujoco.mjtDisableBit
    spec.option.disableflags |= off.mjDSBL_LIMIT | off.mjDSBL_CONTACT
    for j, name in enumerate(arm.model.joint_names):
        joint = spec.joint(name)
        joint.stiffness[0] += feedback.stiffness[j]
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        spec.actuator(name).ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    return spec


def _parameters(spec: Any, arm: ExportedArm, motion: RecordedMotion, feedback: Feedback) -> Any:
    """Return what is fitted, with where it starts and its bounds."""
    parameters = sysid.ParameterDict()
    model = spec.compile()
    names = arm.model.joint_names
    windows = motion.windows
    velocity = np.concatenate([stretch.motion.velocity for stretch in windows.stretches])
    torque = np.sqrt(np.mean(windows.torque**2, axis=(0, 1)))
    speed = np.sqrt(np.mean(velocity**2, axis=0))
    inertia = model.dof_M0[[int(model.joint(name).dofadr[0]) for name in names]]
    constants = {"damping": feedback.damping, "armature": feedback.inertia(windows.step)}
    for j, name in enumerate(names):
        body = arm.link(j)
        parameters.add(
            sysid.body_inertia_param(
                spec, model, body, sysid.InertiaType.Pseudo, modifier=_body_setter(body)
            )
        )
        starts = {
            "frictionloss": _SHARE * torque[j],
            "damping": _SHARE * torque[j] / max(speed[j], 1e-6),
            "armature": max(float(arm.rotors[j, j]), _SHARE * inertia[j]),
        }
        for field, start in starts.items():
            constant = float(constants[field][j]) if field in constants else 0.0
            setter = _joint_setter(name, field, constant)
            parameters.add(
                sysid.Parameter(f"{field} of {name}", start, 0.0, _MOST * start, modifier=setter)
            )
    return parameters


def _body_setter(body: str) -> Callable[[Any, Any], None]:
    """Return what writes a pseudo-inertia into a specification.

    That of `mujoco.sysid` 4.0 leaves a diagonal of zeros beside the full inertia, which the
    compiler refuses; here the principal inertias are written.
    """

    def write(spec: Any, parameter: Any) -> None:
        values = pi_from_theta(np.asarray(parameter.value))
        mass = values[0]
        about_origin = values[4:].reshape(3, 3)
        centre = values[1:4] / mass
        about_centre = about_origin - mass * (
            centre @ centre * np.eye(3) - np.outer(centre, centre)
        )
        principal, axes = np.linalg.eigh(about_centre)
        axes[:, 2] *= np.linalg.det(axes)
        link = spec.body(body)
        link.mass = mass
        link.ipos = centre
        link.inertia = principal
        mujoco.mju_mat2Quat(link.iquat, axes.ravel())
        link.fullinertia = np.full((6, 1), np.nan)

    return write


def _joint_setter(joint: str, field: str, constant: float) -> Callable[[Any, Any], None]:
    """Return what writes a parameter of a joint into a specification, beside a constant."""

    def write(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0]) + constant
        if field == "damping":
            spec.joint(joint).damping[0] = value
        else:
            setattr(spec.joint(joint), field, value)

    return write


def _force(simulated: RolloutArm, motion: RecordedMotion) -> Array:
    """Return what acts on the joints beside friction and springs (w, K, n)."""
    return motion.windows.cut(
        [
            simulated.force(
                stretch.torque,
                stretch.motion.position,
                stretch.after,
                stretch.after - stretch.motion.velocity,
            )
            for stretch in motion.windows.stretches
        ]
    )


def _sequences(spec: Any, arm: ExportedArm, motion: RecordedMotion, feedback: Feedback) -> Any:
    """Return the windows for `mujoco.sysid`: torque by motors, and measured positions."""
    windows = motion.windows
    model = spec.compile()
    names = arm.model.joint_names
    bare = RolloutArm.of(arm, windows.step, feedback)
    force = _force(replace(bare, viscous=0.0 * bare.viscous), motion)
    times = windows.step * np.arange(windows.steps + 1)
    signals = [(f"{name}_qpos", sysid.SignalType.MjStateQPos) for name in names]
    coordinates = {
        "qpos_names": [f"{name}_qpos" for name in names],
        "qvel_names": [f"{name}_qvel" for name in names],
    }
    states = []
    controls = []
    measured = []
    for k in range(len(windows)):
        position = np.concatenate([windows.position[k, :1], windows.reached[k]])
        states.append(
            sysid.create_initial_state(model, position[0], windows.start[k], **coordinates)
        )
        control = np.concatenate([force[k], force[k, -1:]])  # the last one does not act
        controls.append(sysid.TimeSeries.from_control_names(times, control, model, names))
        measured.append(sysid.TimeSeries.from_names(times, position, model, signals))
    labels = [str(k) for k in range(len(windows))]
    return sysid.ModelSequences(
        "arm", spec, labels, states, controls, measured, allow_missing_sensors=True
    )
