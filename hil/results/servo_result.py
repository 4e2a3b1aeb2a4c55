"""Schema of `results.json` of an arm without torque: servo and friction of each joint.

Numbers are in SI units, errors of positions in mrad, or mm of joints that slide; infinite numbers
are the string "Infinity". Lists per joint are in the order of `joint_names`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from pydantic import Field, ValidationError

from hil.base.errors import InputError
from hil.base.safe_input import parse_json, read_text
from hil.results.results import Frozen, Known, RecordingResult

KIND: Final = "servo"
SERVO_SCHEMA_VERSION: Final = 2


class ServoValue(Frozen):
    """A parameter of one joint."""

    name: str  #: as in `identification.servo.parameters.TERMS`
    joint: str
    unit: str
    value: float
    lower: float  #: ends of the 95 % interval
    upper: float
    determined: bool  #: by the motion; otherwise the interval is mostly what was assumed before
    present: bool  #: whether the model has this term


class ServoPush(Frozen):
    """A joint that moved while its command rested and the model stood."""

    joint: str
    time: float  #: from the start of the motion [s]
    change_mrad: float


class ServoContact(Frozen):
    """A joint that something held: it stood though its servo exceeded all friction."""

    joint: str
    start: float  #: from the start of the motion [s]
    end: float
    torque: float  #: beyond the friction [N·m or N]; as uncertain as `kp` of the joint


class ServoSpan(Frozen):
    """A stretch of a motion."""

    start: float  #: from the start of the motion [s]
    end: float


class ServoFree(Frozen):
    """Errors of a motion without the stretches in which something held a joint."""

    share: float  #: of the samples
    position_error_mrad: float
    joint_errors_mrad: list[float]
    command_error_mrad: float
    compared_error_mrad: Known = None


class ServoPrediction(Frozen):
    """Error of a motion that was simulated from its commands alone."""

    archive: str
    duration: float  #: s
    position_error_mrad: float  #: root mean square over all samples and joints
    joint_errors_mrad: list[float]
    command_error_mrad: float  #: of the commanded position itself
    command_joint_errors_mrad: list[float]
    motion_mrad: float | None = None  #: root mean square of the motion about its mean
    compared_error_mrad: Known = None  #: of the parameters of the file to compare with
    compared_joint_errors_mrad: list[float] | None = None
    pushed: tuple[ServoPush, ...] = ()  #: joints that something pushed
    contacts: tuple[ServoContact, ...] = ()  #: joints that something held; in the errors above
    free: ServoFree | None = None  #: the errors without these; null if there are none


class ServoTermChoice(Frozen):
    """Whether other windows are predicted better with some terms of a joint."""

    terms: list[str]
    joint: str
    present: bool
    gain: float  #: decrease of the root mean square error of windows that were not fitted, a share


class ServoVerdict(Frozen):
    """Whether the model may be used."""

    good: bool
    line: str
    warnings: list[str]
    next_steps: list[str]


class ServoPosterior(Frozen):
    """Logarithms of values in position errors of the servo, for draws."""

    coordinates: list[list[float]]
    present: list[list[bool]]
    covariance: list[list[float]]  #: of them by joint, and of the delay of the bus


class SimulatorServo(Frozen):
    """Servo with the terms of a simulator alone, fitted to the same motion."""

    servo: list[ServoValue]
    validation: list[ServoPrediction]
    posterior: ServoPosterior


class ServoResults(Frozen):
    """Results of an identification without torque."""

    schema_version: int = SERVO_SCHEMA_VERSION
    kind: Literal["servo"] = "servo"
    name: str
    cell: str
    simulated: bool
    joint_names: list[str]
    joint_units: list[str]  #: rad or m
    software: dict[str, str]
    archives: list[str]  #: files that were fitted, or of which the first part was
    predicted: list[str]  #: other files, that were held out
    windows: int  #: that were fitted
    seconds: float  #: processor time of the fit
    delay: float  #: of commands, common to all joints [s]
    delay_known: bool = True  #: if not, it contains what remains of the difference of two clocks
    servo: list[ServoValue]
    validation: list[ServoPrediction]
    in_sample: bool  #: whether nothing was held out
    tested_on: str
    compared: str | None = None  #: file whose parameters were compared
    term_choices: list[ServoTermChoice]
    verdict: ServoVerdict
    posterior: ServoPosterior
    simulators: dict[str, SimulatorServo]  #: by engine: mujoco, physx
    stuck: list[str] = Field(default_factory=list)  #: joints in no error over all joints
    #: of fitted motions, by archive
    fitted_contacts: dict[str, list[ServoContact]] = Field(default_factory=dict)
    #: stretches of fitted motions in which something held or pushed the arm, not fitted, by archive
    left_out: dict[str, list[ServoSpan]] = Field(default_factory=dict)
    split: float  #: fraction of a single recording that was fitted
    #: what was read of logs
    recordings: list[RecordingResult] = Field(default_factory=list)
    notes: list[str]

    @property
    def error_unit(self) -> str:
        """Unit of position errors of all joints together."""
        units = {"mrad" if unit == "rad" else "mm" for unit in self.joint_units}
        return " or ".join(sorted(units))

    @classmethod
    def load(cls, path: Path) -> ServoResults:
        """Read a `results.json` of an arm without torque.

        Raises:
            InputError: the file does not match this schema.
        """
        try:
            return cls.model_validate_json(read_text(path))
        except (OSError, ValueError, ValidationError) as error:
            problem = f"cannot be read as a result of an arm without torque ({error})"
            raise InputError(path, problem.split("\n")[0], remedy="identify again") from error


def is_servo_result(path: Path) -> bool:
    """Return whether a file is the `results.json` of an arm without torque."""
    try:
        document = parse_json(read_text(path))
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and document.get("kind") == KIND
