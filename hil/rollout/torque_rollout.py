"""Rollouts: held-out motions simulated forward with identified, nominal and drawn arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import write_files
from hil.base.progress import Reporter
from hil.cell import Cell
from hil.cell.nominal import nominal_of
from hil.pipeline.identified_model import (
    IdentifiedModel,
    ensemble_of,
    impossible_bodies,
    remarks_of,
)
from hil.pipeline.prepared import Prepared
from hil.pipeline.sources import Source
from hil.report.output_files import REPORT, is_of_report, rewrite_report
from hil.results.provenance import RESULTS
from hil.results.rollout_result import (
    JUDGED_HORIZON,
    ROLLOUT,
    ArmErrors,
    PolishResult,
    RolloutResult,
)
from hil.results.servo_result import is_servo_result
from hil.rollout.polishing import polish
from identification import IdentificationError, Samples
from identification.estimators.ensemble import Ensemble
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import FORMATS, read_back
from identification.model.flange import flange_name
from identification.rollout.mujoco_simulation import MAX_POSITION_ERROR, Feedback
from identification.rollout.polish import Driven
from identification.rollout.position_errors import (
    HORIZONS,
    RecordedMotion,
    ResidualTorque,
    RolloutErrors,
    continued,
    coverage,
    errors_of,
    horizon_rows,
    leading_joint,
    light_feedback,
    recorded_stretches,
    simulate,
    variants,
)
from identification.rollout.servo_by_torque import (
    NoServoError,
    PositionServo,
    identify_servo,
    lead_of,
)
from identification.rollout.windows import STEP_SECONDS, WINDOW_STRIDE, Stretch, windows_of
from identification.text import number

PICTURE = "rollout.png"
POLISHED = "polished.xml"
MAX_WINDOWS: Final = 1000
"""Windows that are simulated at most."""
_FEW_WINDOWS: Final = 200  # of which the error of each sample is computed
POLISHED_WINDOWS: Final = 60  # of the fitted motion
# share of the mean square error that mending an effect has to remove
_MIN_ERROR_REDUCTION: Final = 0.1


@dataclass(frozen=True)
class RolloutOptions:
    """Options of a rollout."""

    samples: int = 50  #: arms drawn from the posterior
    seed: int = 1
    feedback: float = 1.0  #: natural frequency of the feedback that keeps the arm near [Hz]
    #: in place of the recorded torque; "identified" from the log
    servo: PositionServo | str | None = None
    polish: bool = False  #: fit friction, rotors, servo and delay to windows of the fitted motion


class Rollout(NamedTuple):
    """A rollout, and the arm that was polished on the way."""

    result: RolloutResult
    polished: ExportedArm | None  #: if it predicts held-out windows better
    remarks: tuple[str, ...]  #: for its file


def roll_out(model: IdentifiedModel, options: RolloutOptions, reporter: Reporter) -> Rollout:
    """Simulate the held-out motion of an identification.

    Raises:
        InputError: there are no consistent parameters, no window, or not the requested servo.
        NotSimulatedError: MuJoCo does not accept the identified arm.
    """
    arm = model.arm
    prepared = model.prepared
    motion, feedback, drive = _motion_of(model, options)
    windows = motion.windows
    chain = arm.model.chain
    measured = windows.reached[:, horizon_rows(windows)]
    positions = simulate(arm, motion, feedback)
    nominal, reason, notes = _nominal(model.cell, arm, motion, feedback, measured)
    ensemble, simulated = _simulated_ensemble(model, motion, feedback, options, reporter)
    few = windows.some(_FEW_WINDOWS)
    measured_few = few.reached[:, horizon_rows(few)]
    identified = errors_of(positions, measured, chain)
    joint = leading_joint(positions[:, JUDGED_HORIZON], measured[:, JUDGED_HORIZON], chain)
    if 2 * identified.unstable_joints.max() > len(windows):
        joint = int(np.argmax(identified.unstable_joints))
    polished = None
    if options.polish:
        driven = Driven(arm, motion, feedback)
        polished = _polish(model, driven, identified, reporter)
    result = RolloutResult(
        cell=model.name,
        simulated=prepared.sources.header.only_simulated,
        joint_names=list(arm.model.joint_names),
        units=[*arm.model.chain.position_units],
        parameters=model.parameters_digest,
        drive=drive,
        tool=flange_name(chain),
        windows=len(windows),
        step=windows.step,
        horizons=list(HORIZONS),
        identified=ArmErrors.of(identified),
        nominal=nominal,
        no_nominal=reason,
        continued=root_mean_squares(continued(windows) - measured),
        samples=len(ensemble),
        seed=options.seed,
        sample_errors=[
            ArmErrors.of(errors_of(rollout, measured_few, chain)) for rollout in simulated[0]
        ],
        widened=ensemble.widened,
        inside=coverage(simulated[1], measured).tolist(),
        leading_joint=arm.model.joint_names[joint],
        leading_effect=leading_effect(arm, motion, feedback, positions, measured, joint),
        polish=None if polished is None else polished[0],
        notes=[*([] if model.good else [model.verdict]), *notes, *_about(motion, prepared)],
    )
    accepted = polished is not None and polished[0].accepted
    return Rollout(
        result, polished[1] if polished is not None and accepted else None, remarks_of(model)
    )


def _motion_of(
    model: IdentifiedModel, options: RolloutOptions
) -> tuple[RecordedMotion, Feedback, str]:
    """Return the windows of the held-out motion, the feedback, and what drives the arm."""
    arm = model.arm
    prepared = model.prepared
    sources = model.prepared.sources
    try:
        servo, drive = _servo_of(model, options)
        stretches, owners = _stretches(model, sources.held_out, prepared.held_out, servo)
        if servo is not None and any(stretch.commanded is None for stretch in stretches):
            raise NoServoError("the held-out recordings have no commanded positions")
        windows = windows_of(stretches, STEP_SECONDS, HORIZONS[-1], WINDOW_STRIDE, lead_of(servo))
        windows = windows.some(MAX_WINDOWS)
    except NoServoError as error:
        remedy = "omit --servo: the recorded torque drives the arm then"
        raise InputError(model.paths[0], str(error), field="--servo", remedy=remedy) from error
    except IdentificationError as error:
        remedy = f"hold out a longer recording (--predict), or fit less; {HORIZONS[-1]:g} s"
        raise InputError(model.paths[-1], str(error), remedy=f"{remedy} are needed") from error
    feedback = light_feedback(arm, STEP_SECONDS, options.feedback)
    if servo is not None:
        feedback = Feedback(servo.kp, servo.kd)
    else:
        drive = f"the recorded torque and a feedback of {options.feedback:g} Hz"
    return RecordedMotion(windows, tuple(owners), servo), feedback, drive


def _servo_of(model: IdentifiedModel, options: RolloutOptions) -> tuple[PositionServo | None, str]:
    arm = model.arm
    prepared = model.prepared
    if options.servo is None:
        return None, ""
    if isinstance(options.servo, PositionServo):
        n = arm.model.n_joints
        stated = options.servo
        servo = PositionServo(
            np.broadcast_to(stated.kp, n), np.broadcast_to(stated.kd, n), stated.delay
        )
        return servo, f"a servo as stated, delay {number(1e3 * servo.delay)} ms"
    fitted = with_commands(prepared.sources.training, prepared.fitted)
    stretches, _ = recorded_stretches(arm.model, fitted, STEP_SECONDS)
    servo = identify_servo(stretches, STEP_SECONDS, arm.model.joint_names)
    gains = "; ".join(
        f"{joint} {number(kp)} {'N·m/rad' if turns else 'N/m'}"
        for joint, kp, turns in zip(
            arm.model.joint_names, servo.kp, arm.model.chain.revolute, strict=True
        )
    )
    return servo, (
        f"a servo identified from the fitted motion (gains {gains}; delay"
        f" {number(1e3 * servo.delay)} ms)"
    )


def _stretches(
    model: IdentifiedModel,
    sources: Sequence[Source],
    samples: Sequence[Samples],
    servo: PositionServo | None,
) -> tuple[list[Stretch], list[Samples]]:
    """Return stretches and their samples; on a servo only with known command."""
    recordings: list[tuple[Samples, Array | None]] = [(part, None) for part in samples]
    if servo is not None:
        recordings = with_commands(sources, samples)
    return recorded_stretches(model.arm.model, recordings, STEP_SECONDS)


def root_mean_squares(errors: Array) -> list[float]:
    """Return the root mean square of errors (w, h, n) at each horizon, over windows and joints."""
    squares: list[float] = np.sqrt(np.mean(errors**2, axis=(0, 2))).tolist()
    return squares


def with_commands(
    sources: Sequence[Source], samples: Sequence[Samples]
) -> list[tuple[Samples, Array | None]]:
    """Return samples with the commanded positions of their recordings."""
    return [
        (recording_samples, source.recording.commanded_position)
        for source, recording_samples in zip(sources, samples, strict=True)
    ]


def _nominal(
    cell: Cell,
    arm: ExportedArm,
    motion: RecordedMotion,
    feedback: Feedback,
    measured: Array,
) -> tuple[ArmErrors | None, str, list[str]]:
    """Return the errors of the nominal arm, why there is none, and notes."""
    described = nominal_arm(cell, arm)
    if described is None:
        return None, "the URDF has no masses", []
    notes = []
    if described.balanced:
        names = ", ".join(impossible_bodies(described.model, described.standard))
        notes.append(
            f"the nominal bodies of {names} are not physically consistent; MuJoCo balances their"
            " inertias"
        )
    try:
        positions = simulate(described, motion, feedback)
    except IdentificationError as error:
        return None, str(error), []
    return ArmErrors.of(errors_of(positions, measured, arm.model.chain)), "", notes


def nominal_arm(cell: Cell, arm: ExportedArm) -> ExportedArm | None:
    """Return an arm with the URDF's bodies and what the cell states; None without masses."""
    nominal = nominal_of(cell)
    if nominal is None:
        return None
    model = cell.model
    standard = model.nominal
    if cell.file.nominal is not None and model.layout.rotor_inertia:
        standard[model.layout.rotors] = cell.nominal.rotor_inertia
    described = replace(arm, standard=standard, values=nominal.values, load=None)
    impossible = impossible_bodies(model, described.standard)
    return replace(described, balanced=bool(impossible))


def _simulated_ensemble(
    model: IdentifiedModel,
    motion: RecordedMotion,
    feedback: Feedback,
    options: RolloutOptions,
    reporter: Reporter,
) -> tuple[Ensemble, tuple[Array, Array]]:
    """Return the drawn arms, and their positions (N, w, h, n) without and with residual torque."""
    ensemble = ensemble_of(model, options.samples, options.seed)
    random = np.random.default_rng(options.seed)
    few = replace(motion, windows=motion.windows.some(_FEW_WINDOWS))
    fitted = model.prepared.fitted
    residuals = model.predicted_residuals(HORIZONS[-1])
    residual = ResidualTorque.of(residuals, fitted, motion.windows)
    alone = []
    disturbed = []
    with reporter.task("simulating", len(ensemble)) as task:
        for standard, parameters in zip(ensemble.standard, ensemble.values, strict=True):
            sample = replace(model.arm, standard=standard, values=parameters)
            alone.append(simulate(sample, few, feedback))
            torque = residual.draw(len(motion.windows), random)
            disturbed.append(simulate(sample, motion, feedback, -1.0 * torque))
            task.advance(1)
    return ensemble, (np.stack(alone), np.stack(disturbed))


def _polish(
    model: IdentifiedModel, driven: Driven, identified: RolloutErrors, reporter: Reporter
) -> tuple[PolishResult, ExportedArm]:
    """Fit to windows of the fitted motion, and judge on the held-out ones."""
    sources = model.prepared.sources
    servo = driven.motion.servo
    fitted = model.prepared.fitted
    stretches, owners = _stretches(model, sources.training, fitted, servo)
    windows = windows_of(stretches, STEP_SECONDS, HORIZONS[-1], WINDOW_STRIDE, lead_of(servo))
    windows = windows.some(POLISHED_WINDOWS)
    motion = replace(driven.motion, windows=windows, samples=tuple(owners))
    return polish(
        replace(driven, motion=motion), driven, identified, reporter, in_sample=sources.in_sample
    )


def leading_effect(
    arm: ExportedArm,
    motion: RecordedMotion,
    feedback: Feedback,
    positions: Array,
    measured: Array,
    joint: int,
) -> str:
    """Return the effect whose adjustment reduces the joint's error most, or "".

    Args:
        arm: that was simulated.
        motion: that was recorded.
        feedback: to the measured positions.
        positions: simulated (w, h, n).
        measured: positions (w, h, n).
        joint: from 0.
    """

    def square(positions: Array) -> float:
        at = positions[:, JUDGED_HORIZON, joint]
        error = np.where(
            np.isfinite(at), at - measured[:, JUDGED_HORIZON, joint], MAX_POSITION_ERROR
        )
        return float(np.mean(error**2))

    before = square(positions)
    effect = ""
    least = (1.0 - _MIN_ERROR_REDUCTION) * before
    for name, change in variants(joint):
        after = square(simulate(*change(arm, motion), feedback))
        if after < least:
            least = after
            effect = name
    return effect


def _about(motion: RecordedMotion, prepared: Prepared) -> list[str]:
    """Return notes on the windows."""
    notes = []
    if prepared.sources.in_sample:
        notes.append("the windows are of the fitted motion: nothing was held out")
    if any(samples.torque_bandwidth is not None for samples in motion.samples):
        notes.append("each arm's model adds the torque that the recording's low-pass removed")
    return notes


def write_rollout(folder: Path, rollout: Rollout) -> str:
    """Write `rollout.json`, a better polished arm as `polished.xml`, and a section of the report.

    Returns:
        why the report of the folder has no section; empty if it has.

    Raises:
        WriteBackError: MuJoCo reads the polished arm otherwise.
    """
    result = rollout.result
    text = None
    if rollout.polished is not None:
        form = FORMATS["mjcf"]
        remarks = ("Polished on simulated windows by hil rollout.", *rollout.remarks)
        text = form.write(rollout.polished, result.cell, remarks)
        read_back(text, form, rollout.polished)
    write_files(folder, {ROLLOUT: result.to_json(), POLISHED: text})
    if is_servo_result(folder / RESULTS):
        return f"{REPORT} has no section about it: it shows the motions from first to last sample"
    if not result.parameters:
        return f"{REPORT} has no section about it: the arm was identified for this rollout alone"
    if not is_of_report(folder, result):
        return f"no report has a section about it: {folder} has no report of these parameters"
    rewrite_report(folder)
    return ""
