"""Rollouts of recordings without torque: servo, friction and rotors identified from positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hil.archive import open_archive
from hil.base.errors import InputError, RefusedRecordingError
from hil.base.progress import Reporter
from hil.base.terminal_text import typed
from hil.cell import Cell
from hil.pipeline.identified_model import arm_with
from hil.pipeline.options import Options, friction_from
from hil.pipeline.prepared import samples_of, stated_settings
from hil.pipeline.sources import Source, Sources, archives_in, gather_sources
from hil.pipeline.stored_servo import actuators_of, servo_arm, servo_folder, servo_sources
from hil.results.provenance import RESULTS
from hil.results.rollout_result import (
    JUDGED_HORIZON,
    ArmErrors,
    RolloutResult,
    ServoParameter,
    ServoResult,
)
from hil.results.servo_result import ServoResults, SimulatorServo
from hil.rollout.polishing import polish
from hil.rollout.torque_rollout import (
    MAX_WINDOWS,
    POLISHED_WINDOWS,
    Rollout,
    leading_effect,
    nominal_arm,
    root_mean_squares,
    with_commands,
)
from identification import IdentificationError, Samples
from identification.distributions import NORMAL_95
from identification.export.exported_arm import ExportedArm
from identification.model.flange import flange_name
from identification.rollout.mujoco_simulation import Feedback
from identification.rollout.polish import Driven
from identification.rollout.position_errors import (
    HORIZONS,
    RecordedMotion,
    RolloutErrors,
    continued,
    errors_of,
    horizon_rows,
    leading_joint,
    recorded_stretches,
    simulate,
)
from identification.rollout.servo_by_positions import NAMES, EncoderFit, fit_servo
from identification.rollout.servo_by_torque import PositionServo, UndeterminedGainError, lead_of
from identification.rollout.windows import STEP_SECONDS, WINDOW_STRIDE, windows_of

_FRICTION = "coulomb,viscous"
_UNITS = ("N·m/rad", "N·m·s/rad", "kg·m²", "N·m", "N·m·s/rad")
_UNITS_ALONG = ("N/m", "N·s/m", "kg", "N", "N·s/m")
"""Units of `NAMES`, of joints that turn and that slide."""
_STORED_TERMS = {"kp": "kp", "Im": "armature", "f0": "coulomb", "f1": "viscous"}
"""Terms of stored servos by `NAMES`; MuJoCo's joint damping has the servo's as well."""


def without_torque(paths: Sequence[Path]) -> bool:
    """Return whether archives have positions and commands, and neither torque nor current."""
    for path in archives_in(paths):
        columns = open_archive(path, fields=("torque", "target_current", "motor_current")).columns
        torque = columns.get("torque")
        known = torque is not None and bool(np.isfinite(torque).any())
        if known or columns.keys() & {"target_current", "motor_current"}:
            return False
    return True


class _ServoArm(NamedTuple):
    """An arm on its servo, with the recordings that it is simulated along."""

    sources: Sources
    cell: Cell
    fitted: list[Samples]
    arm: ExportedArm  #: with friction and rotors
    servo: PositionServo
    result: ServoResult
    drive: str  #: what acts on the joints
    remark: str  #: for the file of a polished arm
    notes: tuple[str, ...] = ()
    good: bool = True  #: whether the model may be used


def roll_out_servo(
    paths: Sequence[Path],
    predict: Sequence[Path],
    split: float,
    reporter: Reporter,
    *,
    reuse: bool,
) -> tuple[Rollout, bool]:
    """Simulate held-out positions on a servo; also return whether its model is good.

    The bodies are the URDF's. The servo comes from a folder's results, with the terms that MuJoCo
    has, or is identified from the fitted positions.

    Args:
        paths: archives that are fitted, or folders with them.
        predict: archives that are held out.
        split: part of a single recording that is held out.
        reporter: of progress.
        reuse: whether to read the results of a folder.

    Raises:
        RefusedRecordingError: the recordings do not determine the gain of a joint.
        InputError: there are no masses, no commanded positions, no servo or no window.
    """
    folder = servo_folder(paths) if reuse else None
    on_servo = _identified(paths, predict, split) if folder is None else _stored(folder, predict)
    sources = on_servo.sources
    held_out = _samples(sources.held_out, on_servo.cell)
    bodies = _bodies(paths[0], on_servo.cell, on_servo.arm)
    try:
        training = _driven(on_servo, sources.training, on_servo.fitted, POLISHED_WINDOWS)
        unseen = _driven(on_servo, sources.held_out, held_out, MAX_WINDOWS)
    except IdentificationError as error:
        raise _refused(paths[0], error) from error
    identified = _errors(unseen)
    polished, best = polish(training, unseen, identified, reporter, in_sample=sources.in_sample)
    result = _result(on_servo, unseen, bodies)
    result = result.model_copy(update={"polish": polished})
    remarks = (on_servo.remark, on_servo.result.message)
    return Rollout(result, best if polished.accepted else None, remarks), on_servo.good


def _identified(paths: Sequence[Path], predict: Sequence[Path], split: float) -> _ServoArm:
    """Return the arm on the servo that is identified from the fitted positions."""
    sources = gather_sources([*archives_in(paths)], split, predict, with_torque=False)
    cell = sources.cell.with_friction(**friction_from(_FRICTION))
    fitted = _samples(sources.training, cell)
    start = arm_with(cell, cell.model.nominal, np.zeros(cell.model.n_parameters), fitted)
    bodies = _bodies(paths[0], cell, start)
    try:
        stretches, _ = recorded_stretches(
            cell.model, with_commands(sources.training, fitted), STEP_SECONDS
        )
        fit = fit_servo(bodies, stretches, STEP_SECONDS)
    except UndeterminedGainError as error:
        remedy = "record a longer motion of this joint, with the commanded positions"
        if (folder := servo_folder(paths)) is not None:
            remedy += f"; `hil rollout {typed(folder)}` simulates the servo of its results"
        raise RefusedRecordingError(paths[0], str(error), field="servo", remedy=remedy) from error
    except IdentificationError as error:
        raise _refused(paths[0], error) from error
    return _ServoArm(
        sources,
        cell,
        fitted,
        fit.arm,
        fit.servo,
        _servo_result(fit),
        "a servo that was identified from commanded and measured positions",
        "Bodies of the URDF; friction and rotor inertias by hil rollout.",
    )


def _stored(folder: Path, predict: Sequence[Path]) -> _ServoArm:
    """Return the arm on the servo of a folder's results, with the terms that MuJoCo has.

    The torque limit is left out: a rollout has none.
    """
    results = ServoResults.load(folder / RESULTS)
    sources = servo_sources(folder, results, predict)
    cell = sources.cell.with_friction(**friction_from(_FRICTION))
    stored = results.simulators["mujoco"]
    actuators = actuators_of(stored, sources.cell, results.windows, 0, 0)
    delays = actuators.value("delay")
    delay = float(delays.mean())
    gains = actuators.value("stiffness")
    servo = PositionServo(
        gains, np.zeros_like(gains), delay, actuators.value("offset"), delays - delay
    )
    notes = [] if results.verdict.good else [results.verdict.line]
    if limited := [
        name
        for name, limit in zip(actuators.joint_names, actuators.value("limit"), strict=True)
        if np.isfinite(limit)
    ]:
        notes.append(f"the torque limit of {', '.join(limited)} is not simulated")
    return _ServoArm(
        sources,
        cell,
        _samples(sources.training, cell),
        servo_arm(sources.cell, actuators),
        servo,
        _stored_result(stored, list(actuators.joint_names), delay),
        "the servo of the results, with the terms that MuJoCo has",
        "Bodies of the URDF; servo, friction and rotor inertias by hil identify.",
        tuple(notes),
        results.verdict.good,
    )


def _bodies(path: Path, cell: Cell, arm: ExportedArm) -> ExportedArm:
    """Return the arm with the URDF's bodies alone; InputError if it has no masses."""
    bodies = nominal_arm(cell, arm)
    if bodies is None:
        remedy = "give a URDF with masses, or record the torque"
        raise InputError(
            path, "has no torque, and the URDF no masses", field="torque", remedy=remedy
        )
    return bodies


def _refused(path: Path, error: IdentificationError) -> InputError:
    remedy = "record the torque, or a longer motion with the commanded positions"
    return InputError(path, str(error), field="servo", remedy=remedy)


def _samples(sources: Sequence[Source], cell: Cell) -> list[Samples]:
    """Return the smoothed motion of recordings, with a torque of zero."""
    samples = []
    settings = stated_settings(cell, Options())
    for source in sources:
        whole = replace(source.whole, torque=np.zeros_like(source.whole.position))
        first = 0 if source.context is None else source.context[1]
        samples.append(samples_of(replace(source, context=(whole, first)), cell, settings))
    return samples


def _driven(
    on_servo: _ServoArm, sources: Sequence[Source], samples: Sequence[Samples], most: int
) -> Driven:
    """Return the arm on its servo, in windows of recordings with the model's torque."""
    model = on_servo.arm.model
    with_torque = [
        replace(recording, torque=recording.predicted_torque(model, on_servo.arm.values))
        for recording in samples
    ]
    stretches, owners = recorded_stretches(model, with_commands(sources, with_torque), STEP_SECONDS)
    windows = windows_of(
        stretches, STEP_SECONDS, HORIZONS[-1], WINDOW_STRIDE, lead_of(on_servo.servo)
    ).some(most)
    motion = RecordedMotion(windows, tuple(owners), on_servo.servo)
    return Driven(on_servo.arm, motion, Feedback(on_servo.servo.kp, on_servo.servo.kd))


def _errors(driven: Driven) -> RolloutErrors:
    windows = driven.motion.windows
    measured = windows.reached[:, horizon_rows(windows)]
    return errors_of(driven.positions(), measured, driven.arm.model.chain)


def _result(on_servo: _ServoArm, driven: Driven, bodies: ExportedArm) -> RolloutResult:
    """Return the errors of the arm with its servo and of the bodies alone on the same servo."""
    arm = driven.arm
    motion = driven.motion
    windows = motion.windows
    measured = windows.reached[:, horizon_rows(windows)]
    chain = arm.model.chain
    positions = driven.positions()
    joint = leading_joint(positions[:, JUDGED_HORIZON], measured[:, JUDGED_HORIZON], chain)
    alone = simulate(bodies, motion, driven.feedback)
    names = list(arm.model.joint_names)
    return RolloutResult(
        cell=on_servo.cell.name,
        simulated=on_servo.sources.header.only_simulated,
        joint_names=names,
        units=[*arm.model.chain.position_units],
        parameters="",
        drive=on_servo.drive,
        tool=flange_name(chain),
        windows=len(windows),
        step=windows.step,
        horizons=list(HORIZONS),
        identified=ArmErrors.of(errors_of(positions, measured, chain)),
        nominal=ArmErrors.of(errors_of(alone, measured, chain)),
        no_nominal="",
        continued=root_mean_squares(continued(windows) - measured),
        samples=0,
        seed=0,
        sample_errors=[],
        widened=1.0,
        inside=[],
        leading_joint=names[joint],
        leading_effect=leading_effect(arm, motion, driven.feedback, positions, measured, joint),
        polish=None,
        notes=[
            *on_servo.notes,
            "the recordings have no torque: no arms are drawn, and the nominal arm has this servo",
        ],
        servo=on_servo.result,
    )


def _servo_result(fit: EncoderFit) -> ServoResult:
    model = fit.arm.model
    parameters = []
    for joint in range(model.n_joints):
        units = _UNITS if model.chain.revolute[joint] else _UNITS_ALONG
        for k, (name, unit) in enumerate(zip(NAMES, units, strict=True)):
            parameters.append(
                ServoParameter(
                    name=f"{name}_{joint + 1}",
                    unit=unit,
                    value=float(fit.values[joint, k]),
                    deviation=float(fit.deviations[joint, k]),
                    determined=bool(fit.determined[joint, k]),
                )
            )
    return ServoResult(
        parameters=parameters, delay=fit.servo.delay, delay_deviation=fit.delay_deviation
    )


def _stored_result(servo: SimulatorServo, joint_names: Sequence[str], delay: float) -> ServoResult:
    """Return the parameters of a stored servo by their names in rollouts."""
    rows = {(value.name, value.joint): value for value in servo.servo}
    parameters = []
    for number, joint in enumerate(joint_names, 1):
        for name, term in _STORED_TERMS.items():
            value = rows[term, joint]
            parameters.append(
                ServoParameter(
                    name=f"{name}_{number}",
                    unit=value.unit,
                    value=value.value,
                    deviation=(value.upper - value.lower) / (2.0 * NORMAL_95),
                    determined=value.determined,
                )
            )
    return ServoResult(parameters=parameters, delay=delay, delay_deviation=None)
