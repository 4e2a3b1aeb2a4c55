"""Position errors and time of `hil identify` and of MuJoCo's system identification.

    python -m benchmarks.sysid_rival [ARCHIVE] [--predict ARCHIVE] [--iterations N] [--json]

`mujoco.sysid` (extra `sysid` of mujoco) fits bodies (pseudo-inertias), friction, damping and
armature to simulated windows of one second that cover the recording which `hil identify` fits, from
the URDF's bodies on. Both arms are then simulated in the same held-out windows, under the recorded
torque and a feedback of 1 Hz. Without an archive the recording is a simulated NS 16.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.board import simulated_logs
from hil.identified_model import IdentifiedModel, model_of
from hil.identify import identify_paths
from hil.identify.cell_context import nominal_of
from hil.progress import Silent
from identification.export.arm import Arm
from identification.export.simulators import mjcf
from identification.rollout.comparison import (
    HORIZONS,
    RecordedMotion,
    horizon_rows,
    light_feedback,
    recorded_stretches,
    simulate,
)
from identification.rollout.simulation import LARGEST_ERROR, Feedback, SimulatedArm
from identification.rollout.windows import STEP, windows_of
from identification.signals.samples import Samples

Array = NDArray[np.float64]

_FEEDBACK: Final = 1.0  # Hz
_SHARE: Final = 0.05  # of a joint's torque: friction from which sysid starts
_MOST: Final = 20.0  # of these, its upper bound


class Fitted(NamedTuple):
    """A model by `mujoco.sysid`."""

    model: Any  #: `mujoco.MjModel`
    parameters: int
    evaluations: int  #: of its residual


def windows_in(samples: Sequence[Samples], arm: Arm, stride: float) -> RecordedMotion:
    """Return windows of one second of samples."""
    recordings = [(one, None) for one in samples]
    stretches, owners = recorded_stretches(arm.model, recordings, STEP)
    return RecordedMotion(windows_of(stretches, STEP, HORIZONS[-1], stride), tuple(owners))


def nominal_arm(model: IdentifiedModel) -> Arm:
    """Return the URDF's bodies, with the rotors that the cell states."""
    arm, cell = model.arm, model.cell
    standard, nominal = arm.model.nominal, nominal_of(cell)
    if nominal is None:
        raise SystemExit(f"the URDF of {cell.name} has no masses to start from")
    if cell.file.nominal is not None and arm.model.layout.rotor_inertia:
        standard[arm.model.layout.rotors] = cell.nominal.rotor_inertia
    return replace(arm, standard=standard, values=nominal.values, load=None)


def fit_by_sysid(arm: Arm, motion: RecordedMotion, feedback: Feedback, iterations: int) -> Fitted:
    """Fit a nominal arm to windows by `mujoco.sysid`."""
    import mujoco
    from mujoco import sysid

    logging.getLogger("absl").setLevel(logging.ERROR)
    spec = mujoco.MjSpec.from_string(mjcf(arm, "arm", step=STEP))
    off = mujoco.mjtDisableBit
    spec.option.disableflags |= off.mjDSBL_LIMIT | off.mjDSBL_CONTACT
    names, parameters = arm.model.joint_names, sysid.ParameterDict()
    torque = np.sqrt(np.mean(motion.windows.torque**2, axis=(0, 1)))
    speed = np.sqrt(
        np.mean(np.concatenate([s.motion.velocity for s in motion.windows.stretches]) ** 2, axis=0)
    )
    for j, name in enumerate(names):
        joint, actuator = spec.joint(name), spec.actuator(name)
        joint.stiffness[0] += feedback.stiffness[j]
        joint.actfrclimited = actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    model = spec.compile()
    inertia = model.dof_M0[[int(model.joint(name).dofadr[0]) for name in names]]
    for j, name in enumerate(names):
        parameters.add(sysid.body_inertia_param(spec, model, arm.link(j), sysid.InertiaType.Pseudo))
        for what, start in (
            ("frictionloss", _SHARE * torque[j]),
            ("damping", _SHARE * torque[j] / max(speed[j], 1e-6)),
            ("armature", max(float(arm.rotors[j, j]), _SHARE * inertia[j])),
        ):
            added = float(feedback.damping[j]) if what == "damping" else 0.0
            modifier = _setter(name, what, added)
            parameters.add(
                sysid.Parameter(f"{what} of {name}", start, 0.0, _MOST * start, modifier=modifier)
            )
    residual = sysid.build_residual_fn(
        models_sequences=[_sequences(spec, arm, motion, feedback)],
        resample_true=False,
        enabled_observations=[(f"{name}_qpos", sysid.SignalType.MjStateQPos) for name in names],
    )
    evaluations = 0

    def counted(x: Array, params: Any) -> Any:
        nonlocal evaluations
        evaluations += x.shape[1] if x.ndim > 1 else 1
        return residual(x, params)

    found, _ = sysid.optimize(
        parameters, counted, verbose=False, max_iters=iterations, x_scale="jac"
    )
    return Fitted(sysid.apply_param_modifiers(found, spec), found.size, evaluations)


def _setter(joint: str, what: str, added: float) -> Any:
    """Return what writes a parameter into a specification."""

    def write(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0]) + added
        if what == "damping":
            spec.joint(joint).damping[0] = value
        else:
            setattr(spec.joint(joint), what, value)

    return write


def _sequences(spec: Any, arm: Arm, motion: RecordedMotion, feedback: Feedback) -> Any:
    """Return the windows as those of `mujoco.sysid`: torque by motors, measured positions."""
    from mujoco import sysid

    windows, model, names = motion.windows, spec.compile(), arm.model.joint_names
    bare = SimulatedArm.of(arm, STEP, feedback)
    force = windows.cut(
        [bare.force(s.torque, s.motion.position, s.after, 0.0 * s.after) for s in windows.stretches]
    )
    times = STEP * np.arange(windows.steps + 1)
    signals = [(f"{name}_qpos", sysid.SignalType.MjStateQPos) for name in names]
    coordinates = {
        "qpos_names": [f"{name}_qpos" for name in names],
        "qvel_names": [f"{name}_qvel" for name in names],
    }
    states, controls, measured = [], [], []
    for k in range(len(windows)):
        position = np.concatenate([windows.position[k, :1], windows.reached[k]])
        states.append(
            sysid.create_initial_state(model, position[0], windows.start[k], **coordinates)
        )
        # The last control is not applied.
        control = np.concatenate([force[k], force[k, -1:]])
        controls.append(sysid.TimeSeries.from_control_names(times, control, model, names))
        measured.append(sysid.TimeSeries.from_names(times, position, model, signals))
    labels = [str(k) for k in range(len(windows))]
    return sysid.ModelSequences(
        "arm", spec, labels, states, controls, measured, allow_missing_sensors=True
    )


def positions_of(fitted: Fitted, arm: Arm, motion: RecordedMotion, feedback: Feedback) -> Array:
    """Return positions of a fitted model at the horizons (w, h, n)."""
    import mujoco

    bare, model, windows = SimulatedArm.of(arm, STEP, feedback), fitted.model, motion.windows
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    )
    viscous = model.dof_damping[bare.order] - feedback.damping
    simulated = replace(bare, model=model, viscous=viscous)
    force = windows.cut(
        [
            simulated.force(s.torque, s.motion.position, s.after, s.after - s.motion.velocity)
            for s in windows.stretches
        ]
    )
    found = simulated.simulate(windows.position[:, 0], windows.start, force, windows.position)
    return found[:, horizon_rows(windows)]


def errors_at_horizons(positions: Array, motion: RecordedMotion) -> Array:
    """Return root mean square errors (h, n)."""
    measured = motion.windows.reached[:, horizon_rows(motion.windows)]
    error = np.where(np.isfinite(positions), positions - measured, LARGEST_ERROR)
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def compare(fitted: Path, predict: Sequence[Path], iterations: int) -> dict[str, Any]:
    """Return errors of both arms in held-out windows, and the seconds of both."""
    start = time.perf_counter()
    model = model_of(identify_paths([fitted], Silent(), predict=predict))
    hil_seconds = time.perf_counter() - start
    arm, nominal = model.arm, nominal_arm(model)
    training = windows_in(model.prepared.fitted, arm, HORIZONS[-1])
    held_out = windows_in(model.prepared.held_out, arm, 0.1)
    feedback = light_feedback(arm, STEP, _FEEDBACK)
    start = time.perf_counter()
    rival = fit_by_sysid(nominal, training, feedback, iterations)
    seconds = time.perf_counter() - start
    ours = errors_at_horizons(simulate(arm, held_out, feedback), held_out)
    theirs = errors_at_horizons(positions_of(rival, nominal, held_out, feedback), held_out)
    return {
        "arm": model.name,
        "windows": {"fitted": len(training.windows), "held out": len(held_out.windows)},
        "seconds": {"hil": hil_seconds, "sysid": seconds},
        "sysid": {"parameters": rival.parameters, "evaluations": rival.evaluations},
        "horizons": list(HORIZONS),
        "hil": ours.tolist(),
        "mujoco.sysid": theirs.tolist(),
        "ratio": float(np.exp(np.mean(np.log(ours / theirs)))),
        "ratio of seconds": hil_seconds / seconds,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print errors and times."""
    parser = parser_of(__doc__)
    parser.add_argument("archive", type=Path, nargs="?")
    parser.add_argument("--predict", type=Path, action="append", default=[])
    parser.add_argument("--iterations", type=int, default=15, help="of mujoco.sysid, at most")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        fitted, predict = options.archive, options.predict
        if fitted is None:
            _, logs = simulated_logs()
            places = {name: Path(scratch) / f"{name}.mcap" for name in logs}
            fitted, *predict = [logs[name].imported(path) for name, path in places.items()]
        figures = compare(fitted, predict, options.iterations)
    if not options.json:
        _print(figures)
    show(figures, only_json=True)


def _print(figures: dict[str, Any]) -> None:
    seconds, windows = figures["seconds"], figures["windows"]
    print(
        f"{figures['arm']}: {windows['fitted']} fitted and {windows['held out']} held-out windows"
        f" of {HORIZONS[-1]:g} s"
    )
    for name in ("hil", "mujoco.sysid"):
        rms = [float(np.sqrt(np.mean(np.square(at)))) for at in figures[name]]
        shown = ", ".join(
            f"{1e3 * one:.3g} at {h:g} s" for one, h in zip(rms, HORIZONS, strict=True)
        )
        print(f"{name:13} {seconds[name.split('.')[-1]]:8.1f} s   rms error [mrad]: {shown}")
    print(
        f"hil over mujoco.sysid: {figures['ratio']:.3f} of the error (geometric mean over joints"
        f" and horizons), {figures['ratio of seconds']:.3f} of the time"
    )


if __name__ == "__main__":
    main()
