"""Rollouts: held-out motions simulated forward with identified, nominal and drawn arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from hil.cell import Cell
from hil.errors import InputError
from hil.files import write_files
from hil.identified_model import IdentifiedModel, ensemble_of
from hil.identify.cell_context import nominal_of
from hil.identify.prepared import Prepared
from hil.identify.sources import Source
from hil.progress import Reporter
from hil.reading import read_text
from hil.results import Frozen, Known
from identification import IdentificationError, Samples
from identification.estimators.ensemble import Ensemble
from identification.export.arm import Arm
from identification.model.pseudo_inertia import margin
from identification.rollout.comparison import (
    HORIZONS,
    Errors,
    RecordedMotion,
    ResidualTorque,
    ToolFrame,
    coverage,
    errors_of,
    horizon_rows,
    leading_joint,
    light_feedback,
    recorded_stretches,
    simulate,
    variants,
)
from identification.rollout.servo import NoServoError, Servo, identify_servo
from identification.rollout.simulation import Feedback
from identification.rollout.windows import STEP, windows_of
from identification.text import percentage

Array = NDArray[np.float64]

ROLLOUT, PICTURE = "rollout.json", "rollout.png"
MOST_WINDOWS: Final = 1000
"""Windows that are simulated at most."""
_FEW_WINDOWS: Final = 200  # of which the error of each sample is computed
_STRIDE: Final = 0.1  # s between the starts of windows
_LEADS: Final = 0.1  # share of the mean square error that mending an effect has to remove
_JUDGED: Final = 2  # index of the horizon at which joint and effect are named: 0.5 s
_BAND: Final = 1  # index of the horizon of the band: 0.2 s
_WANTED: Final = (0.88, 0.99)  # share of measured positions in a 95 % band


@dataclass(frozen=True)
class RolloutOptions:
    """Options of a rollout."""

    samples: int = 50  #: arms drawn from the posterior
    seed: int = 1
    feedback: float = 1.0  #: natural frequency of the feedback that keeps the arm near [Hz]
    servo: Servo | str | None = None  #: in place of the recorded torque; "identified" from the log


class ArmErrors(Frozen):
    """Errors of an arm; lists over the horizons."""

    joints: list[list[float]]  #: root mean square position error per joint, rad or m
    tool: list[Known]  #: that of the tool in stable windows, m; null without any
    unstable: int  #: windows in which the simulation became unstable

    @classmethod
    def of_errors(cls, errors: Errors) -> ArmErrors:
        """Return the section of computed errors."""
        return cls(
            joints=errors.joints.tolist(),
            tool=errors.tool.tolist(),
            unstable=errors.unstable,
        )

    def overall(self, horizon: int) -> float:
        """Return the root mean square over all joints at a horizon, rad or m."""
        return float(np.sqrt(np.mean(np.square(self.joints[horizon]))))


class RolloutResult(Frozen):
    """Result of a rollout, `rollout.json`."""

    cell: str
    simulated: bool
    joint_names: list[str]
    drive: str  #: what acts on the joints
    tool: str  #: link whose origin is the tool
    windows: int
    step: float = Field(gt=0.0)  #: s
    horizons: list[float]  #: s
    identified: ArmErrors
    nominal: ArmErrors | None
    no_nominal: str  #: why there is no nominal arm; empty
    samples: int
    seed: int
    sample_errors: list[ArmErrors]
    widened: float  #: factor of the deviations of the drawn arms
    inside: list[
        list[float]
    ]  #: share of measured positions in the 95 % band, per horizon and joint
    leading_joint: str
    leading_effect: str  #: empty if no single one
    notes: list[str]

    @property
    def ratio(self) -> list[float] | None:
        """Error of the identified over that of the nominal arm at the horizons."""
        if self.nominal is None:
            return None
        return [
            self.identified.overall(k) / max(self.nominal.overall(k), 1e-300)
            for k in range(len(self.horizons))
        ]

    @property
    def band(self) -> float:
        """Share of measured positions in the 95 % band at 0.2 s."""
        return float(np.mean(self.inside[_BAND]))

    @property
    def message(self) -> str:
        """The result in two sentences."""
        return f"{self._against_nominal} {self._leading}"

    @property
    def _against_nominal(self) -> str:
        if self.ratio is None:
            return f"There is no nominal arm to compare with: {self.no_nominal}."
        worse = [h for h, ratio in zip(self.horizons, self.ratio, strict=True) if ratio >= 1.0]
        if worse:
            return f"From {worse[0]:g} s on the identified arm is no better than the nominal one."
        return (
            f"The identified arm is better than the nominal one up to {self.horizons[-1]:g} s:"
            f" {self.ratio[_JUDGED]:.2f} of its position error at {self.horizons[_JUDGED]:g} s."
        )

    @property
    def _leading(self) -> str:
        effect = self.leading_effect or "neither dry nor viscous friction nor delay alone"
        return (
            f"{self.leading_joint} leads the error of the tool; what leads its error is {effect}."
        )

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        columns = "".join(f"{f'{h:g} s':>10}" for h in self.horizons)
        lines = [
            f"{self.windows} windows of {self.cell}, driven by {self.drive}",
            *self.notes,
            f"{'position error (rms)':42}{columns}",
        ]
        arms = {"identified": self.identified, "nominal": self.nominal}
        for name, arm in arms.items():
            if arm is None:
                continue
            for joint, label in enumerate(self.joint_names):
                row = "".join(f"{_milli(at[joint]):>10}" for at in arm.joints)
                lines.append(_row(f"{name:10} {label[:17]:17} [mrad or mm]", row))
            tool = "".join(f"{_milli(at):>10}" for at in arm.tool)
            lines.append(_row(f"{name:10} {self.tool[:17]:17} [mm]", tool))
            if arm.unstable:
                lines.append(
                    f"{name}: unstable in {arm.unstable} of {self.windows} windows, which count"
                    " with an error of pi"
                )
        if self.sample_errors:
            spread = [
                [arm.overall(k) for arm in self.sample_errors] for k in range(len(self.horizons))
            ]
            row = "".join(f"{_milli(float(np.median(errors))):>10}" for errors in spread)
            lines.append(_row(f"{self.samples} samples, median [mrad or mm]", row))
            unstable = sum(arm.unstable for arm in self.sample_errors)
            if unstable:
                lines.append(f"samples: {unstable} of their windows are unstable")
            shares = "".join(f"{percentage(float(np.mean(at)), 1):>10}" for at in self.inside)
            lines.append(_row("measured positions in their 95 % band", shares))
            if not _WANTED[0] <= self.band <= _WANTED[1]:
                lines.append(
                    f"warning: {percentage(self.band, 1)} at {self.horizons[_BAND]:g} s is not"
                    f" {percentage(_WANTED[0])} to {percentage(_WANTED[1])}: do not rely on this "
                    "band"
                )
        return [*lines, self.message]

    @classmethod
    def load(cls, path: Path) -> RolloutResult:
        """Read a `rollout.json`; InputError if it is none."""
        try:
            return cls.model_validate_json(read_text(path))
        except (OSError, ValueError, ValidationError) as error:
            problem = f"cannot be read as a rollout ({str(error).splitlines()[0]})"
            raise InputError(path, problem, remedy="run `hil rollout` again") from error


def _row(head: str, figures: str) -> str:
    return f"{head:42}{figures}"


def _milli(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.3g}"


def roll_out(model: IdentifiedModel, options: RolloutOptions, reporter: Reporter) -> RolloutResult:
    """Simulate the held-out motion of an identification.

    Raises:
        InputError: there are no consistent parameters, no window, or no servo where one is asked.
        NotSimulatedError: MuJoCo does not accept the identified arm.
    """
    arm, prepared = model.arm, model.prepared
    motion, feedback, drive = _motion_of(model, options)
    windows, tool = motion.windows, ToolFrame(arm)
    measured = windows.reached[:, horizon_rows(windows)]
    positions = simulate(arm, motion, feedback)
    nominal, reason, notes = _nominal(model.cell, arm, motion, feedback, measured, tool)
    ensemble, simulated = _simulated_ensemble(model, motion, feedback, options, reporter)
    few = windows.some(_FEW_WINDOWS)
    measured_few = few.reached[:, horizon_rows(few)]
    joint = leading_joint(positions[:, _JUDGED], measured[:, _JUDGED], tool)
    return RolloutResult(
        cell=model.name,
        simulated=prepared.sources.header.only_simulated,
        joint_names=list(arm.model.joint_names),
        drive=drive,
        tool=tool.name,
        windows=len(windows),
        step=windows.step,
        horizons=list(HORIZONS),
        identified=ArmErrors.of_errors(errors_of(positions, measured, tool)),
        nominal=nominal,
        no_nominal=reason,
        samples=len(ensemble),
        seed=options.seed,
        sample_errors=[
            ArmErrors.of_errors(errors_of(one, measured_few, tool)) for one in simulated[0]
        ],
        widened=ensemble.widened,
        inside=coverage(simulated[1], measured).tolist(),
        leading_joint=arm.model.joint_names[joint],
        leading_effect=_leading_effect(arm, motion, feedback, positions, measured, joint),
        notes=[*notes, *_about(motion, prepared)],
    )


def _motion_of(
    model: IdentifiedModel, options: RolloutOptions
) -> tuple[RecordedMotion, Feedback, str]:
    """Return the windows of the held-out motion, the feedback, and what drives the arm."""
    arm, prepared, sources = model.arm, model.prepared, model.prepared.sources
    recordings = _with_commands(sources.held_out, prepared.held_out)
    stretches, owners = recorded_stretches(arm.model, recordings, STEP)
    try:
        servo, drive = _servo_of(model, options)
        if servo is not None and any(one.commanded is None for one in stretches):
            raise NoServoError("the held-out recordings have no commanded positions")
        windows = windows_of(stretches, STEP, HORIZONS[-1], _STRIDE).some(MOST_WINDOWS)
    except NoServoError as error:
        remedy = "omit --servo: the recorded torque drives the arm then"
        raise InputError(model.paths[0], str(error), field="--servo", remedy=remedy) from error
    except IdentificationError as error:
        remedy = f"hold out a longer recording (--predict), or fit less of it; {HORIZONS[-1]:g} s"
        raise InputError(model.paths[-1], str(error), remedy=f"{remedy} are needed") from error
    feedback = light_feedback(arm, STEP, options.feedback)
    if servo is not None:
        feedback = Feedback(servo.kp, servo.kd)
    else:
        drive = f"the recorded torque and a feedback of {options.feedback:g} Hz"
    return RecordedMotion(windows, tuple(owners), servo), feedback, drive


def _servo_of(model: IdentifiedModel, options: RolloutOptions) -> tuple[Servo | None, str]:
    arm, prepared = model.arm, model.prepared
    if options.servo is None:
        return None, ""
    if isinstance(options.servo, Servo):
        n, stated = arm.model.n_joints, options.servo
        servo = Servo(np.broadcast_to(stated.kp, n), np.broadcast_to(stated.kd, n), stated.delay)
        return servo, f"a servo as stated, delay {1e3 * servo.delay:.3g} ms"
    fitted = _with_commands(prepared.sources.training, prepared.fitted)
    stretches, _ = recorded_stretches(arm.model, fitted, STEP)
    servo = identify_servo(stretches, STEP)
    gains = ", ".join(f"{kp:.3g}" for kp in servo.kp)
    return servo, (
        f"a servo identified from the fitted motion (kp {gains}; delay {1e3 * servo.delay:.3g} ms)"
    )


def _with_commands(
    sources: Sequence[Source], samples: Sequence[Samples]
) -> list[tuple[Samples, Array | None]]:
    return [
        (one, source.recording.commanded_position)
        for source, one in zip(sources, samples, strict=True)
    ]


def _nominal(
    cell: Cell,
    arm: Arm,
    motion: RecordedMotion,
    feedback: Feedback,
    measured: Array,
    tool: ToolFrame,
) -> tuple[ArmErrors | None, str, list[str]]:
    """Return the errors of the nominal arm, why there is none, and notes."""
    nominal, model = nominal_of(cell), cell.model
    if nominal is None:
        return None, "the URDF has no masses", []
    standard = model.nominal
    if cell.file.nominal is not None and model.layout.rotor_inertia:
        standard[model.layout.rotors] = cell.nominal.rotor_inertia
    notes = []
    links = standard[model.layout.links]
    impossible = [
        name for name, least in zip(model.joint_names, margin(links), strict=True) if least <= 0.0
    ]
    if impossible:
        notes.append(
            f"the nominal bodies of {', '.join(impossible)} are not physically consistent; MuJoCo"
            " balances their inertias"
        )
    described = replace(
        arm, standard=standard, values=nominal.values, load=None, balanced=bool(impossible)
    )
    try:
        positions = simulate(described, motion, feedback)
    except IdentificationError as error:
        return None, str(error), []
    return ArmErrors.of_errors(errors_of(positions, measured, tool)), "", notes


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
    residual = ResidualTorque.of(
        model.cell.model, model.estimate.values, model.prepared.fitted, motion.windows
    )
    alone, disturbed = [], []
    with reporter.task("simulating", len(ensemble)) as task:
        for standard, parameters in zip(ensemble.standard, ensemble.values, strict=True):
            sample = replace(model.arm, standard=standard, values=parameters)
            alone.append(simulate(sample, few, feedback))
            torque = residual.draw(len(motion.windows), random)
            disturbed.append(simulate(sample, motion, feedback, -1.0 * torque))
            task.advance(1)
    return ensemble, (np.stack(alone), np.stack(disturbed))


def _leading_effect(
    arm: Arm,
    motion: RecordedMotion,
    feedback: Feedback,
    positions: Array,
    measured: Array,
    joint: int,
) -> str:
    """Return the effect of which a change lessens the error of a joint most; empty if none does."""

    def square(found: Array) -> float:
        error = np.nan_to_num((found - measured)[:, _JUDGED, joint], nan=np.pi)
        return float(np.mean(error**2))

    before, effect = square(positions), ""
    least = (1.0 - _LEADS) * before
    for name, change in variants(joint):
        after = square(simulate(*change(arm, motion), feedback))
        if after < least:
            least, effect = after, name
    return effect


def _about(motion: RecordedMotion, prepared: Prepared) -> list[str]:
    """Return notes on the windows."""
    notes = []
    if prepared.sources.in_sample:
        notes.append("the windows are of the fitted motion: nothing was held out")
    if any(samples.torque_bandwidth is not None for samples in motion.samples):
        notes.append("the torque that the record's low-pass removed is added, by each arm's model")
    return notes


def write_rollout(folder: Path, result: RolloutResult) -> None:
    """Write `rollout.json`."""
    write_files(folder, {ROLLOUT: result.to_json()})
