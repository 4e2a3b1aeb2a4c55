"""Rollouts of recordings without torque: servo, friction and rotors identified from positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

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
from hil.results.provenance import RESULTS
from hil.results.rollout_result import (
    JUDGED_HORIZON,
    ArmErrors,
    RolloutResult,
    ServoParameter,
    ServoResult,
)
from hil.results.servo_result import is_servo_result
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
from identification.rollout.servo_by_torque import UndeterminedGainError, lead_of
from identification.rollout.windows import STEP_SECONDS, WINDOW_STRIDE, windows_of

_FRICTION = "coulomb,viscous"
_UNITS = ("N·m/rad", "N·m·s/rad", "kg·m²", "N·m", "N·m·s/rad")
_UNITS_ALONG = ("N/m", "N·s/m", "kg", "N", "N·s/m")
"""Units of `NAMES`, of joints that turn and that slide."""


def without_torque(paths: Sequence[Path]) -> bool:
    """Return whether archives have positions and commands, and neither torque nor current."""
    for path in archives_in(paths):
        columns = open_archive(path, fields=("torque", "target_current", "motor_current")).columns
        torque = columns.get("torque")
        known = torque is not None and bool(np.isfinite(torque).any())
        if known or columns.keys() & {"target_current", "motor_current"}:
            return False
    return True


def roll_out_servo(
    paths: Sequence[Path], predict: Sequence[Path], split: float, reporter: Reporter
) -> Rollout:
    """Identify the servo from the fitted positions, and simulate the held-out ones with it.

    The bodies are the URDF's.

    Args:
        paths: archives that are fitted, or folders with them.
        predict: archives that are held out.
        split: part of a single recording that is held out.
        reporter: of progress.

    Raises:
        RefusedRecordingError: the recordings do not determine the gain of a joint.
        InputError: there are no masses, no commanded positions, no servo or no window.
    """
    sources = gather_sources([*archives_in(paths)], split, predict, with_torque=False)
    cell = sources.cell.with_friction(**friction_from(_FRICTION))
    fitted = _samples(sources.training, cell)
    held_out = _samples(sources.held_out, cell)
    start = arm_with(cell, cell.model.nominal, np.zeros(cell.model.n_parameters), fitted)
    bodies = nominal_arm(cell, start)
    if bodies is None:
        remedy = "give a URDF with masses, or record the torque"
        raise InputError(
            paths[0], "has no torque, and the URDF no masses", field="torque", remedy=remedy
        )
    try:
        stretches, _ = recorded_stretches(
            cell.model, with_commands(sources.training, fitted), STEP_SECONDS
        )
        fit = fit_servo(bodies, stretches, STEP_SECONDS)
        training = _driven(fit, sources.training, fitted, POLISHED_WINDOWS)
        unseen = _driven(fit, sources.held_out, held_out, MAX_WINDOWS)
    except UndeterminedGainError as error:
        remedy = "record a longer motion of this joint, with the commanded positions"
        if len(paths) == 1 and is_servo_result(paths[0] / RESULTS):
            remedy += (
                f"; `hil export {typed(paths[0])} --to mjcf` plays the held-out motion back in"
                " MuJoCo without it"
            )
        raise RefusedRecordingError(paths[0], str(error), field="servo", remedy=remedy) from error
    except IdentificationError as error:
        remedy = "record the torque, or a longer motion with the commanded positions"
        raise InputError(paths[0], str(error), field="servo", remedy=remedy) from error
    identified = _errors(unseen)
    polished, best = polish(training, unseen, identified, reporter, in_sample=False)
    result = _result(sources, cell, fit, unseen, bodies)
    result = result.model_copy(update={"polish": polished})
    return Rollout(result, best if polished.accepted else None, _remarks(result))


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
    fit: EncoderFit, sources: Sequence[Source], samples: Sequence[Samples], most: int
) -> Driven:
    """Return the arm on its servo, in windows of recordings with the model's torque."""
    model = fit.arm.model
    with_torque = [
        replace(recording, torque=recording.predicted_torque(model, fit.arm.values))
        for recording in samples
    ]
    stretches, owners = recorded_stretches(model, with_commands(sources, with_torque), STEP_SECONDS)
    windows = windows_of(
        stretches, STEP_SECONDS, HORIZONS[-1], WINDOW_STRIDE, lead_of(fit.servo)
    ).some(most)
    motion = RecordedMotion(windows, tuple(owners), fit.servo)
    return Driven(fit.arm, motion, Feedback(fit.servo.kp, fit.servo.kd))


def _errors(driven: Driven) -> RolloutErrors:
    windows = driven.motion.windows
    measured = windows.reached[:, horizon_rows(windows)]
    return errors_of(driven.positions(), measured, driven.arm.model.chain)


def _result(
    sources: Sources, cell: Cell, fit: EncoderFit, driven: Driven, bodies: ExportedArm
) -> RolloutResult:
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
        cell=cell.name,
        simulated=sources.header.only_simulated,
        joint_names=names,
        units=[*arm.model.chain.position_units],
        parameters="",
        drive="a servo that was identified from commanded and measured positions",
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
            "the recordings have no torque: no arms are drawn, and the nominal arm has this servo"
        ],
        servo=_servo_result(fit),
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


def _remarks(result: RolloutResult) -> tuple[str, ...]:
    assert result.servo is not None
    return ("Bodies of the URDF; friction and rotor inertias by hil rollout.", result.servo.message)
