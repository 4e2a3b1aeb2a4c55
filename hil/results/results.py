"""Schema of `results.json`.

Numbers are in SI units; infinite and unknown numbers are the strings "Infinity" and "NaN". Lists
per joint are in the order of `joint_names`, lists per parameter in the order of `parameters`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from hil.base.errors import InputError
from hil.base.safe_input import parse_json, read_text
from hil.base.type_adapter import adapter_of
from identification.excitation.criteria import Criteria
from identification.factor.estimate import KNOWN_STD_SHARES
from identification.purposes.thresholds import ContactThreshold
from identification.selection.essential import EliminationStep
from identification.selection.settings import Settings
from identification.text import percentage
from identification.validation.finding_messages import WordedFinding
from identification.validation.purpose import Purpose


class Frozen(BaseModel):
    """A section of the file: immutable, without unknown fields."""

    model_config = ConfigDict(
        frozen=True,
        extra="ignore",
        ser_json_inf_nan="strings",
        from_attributes=True,
        defer_build=True,
    )

    @classmethod
    def of(cls, source: object = None, **others: Any) -> Self:
        """Build a section from the equally named attributes of `source` and from `others`."""
        attributes = {
            name: getattr(source, name) for name in cls.model_fields if hasattr(source, name)
        }
        return cls.model_validate(
            {
                name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in (attributes | others).items()
            }
        )

    @classmethod
    def rows(cls, **columns: Any) -> list[Self]:
        """Build a section per entry of the columns; a column may be None, except the first."""
        lists = {
            name: values.tolist() if isinstance(values, np.ndarray) else values
            for name, values in columns.items()
        }
        return [
            cls.of(**{name: values and values[k] for name, values in lists.items()})
            for k in range(len(next(iter(lists.values()))))
        ]

    def to_json(self) -> str:
        """Return indented JSON."""
        return self.model_dump_json(indent=1) + "\n"


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


Known = Annotated[float | None, BeforeValidator(_known)]
"""A number, null if unknown."""


class StepResult(Frozen):
    """One step of a campaign."""

    step: str
    done: bool
    words: str  #: Summary
    details: list[str]
    warning: bool = False  #: Whether what follows was recorded in spite of it


class PrecisionResult(Frozen):
    """One required precision over the repetitions."""

    requirement: str
    repetitions: list[int]
    ratio: list[float]  #: 95 % interval over the required one, after each of them
    worst: str  #: Quantity that was worst at the end
    promised: float | None = None  #: Ratio that the design promised for the planned repetitions


class ExecutionLogResult(Frozen):
    """Execution of a campaign."""

    steps: list[StepResult]
    precision: list[PrecisionResult] = []  #: Empty if none was required


class JointJudgement(Frozen):
    """Errors of one joint on held-out motion, or on the fit if `JudgementResult.in_sample`."""

    joint: str
    unit: Literal["N·m", "N"]
    rms: float  #: Root mean square of the torque error, in `unit`
    relative: Known  #: ||e|| / ||tau||
    fitted_relative: Known = None  #: `relative` on the fitted motion
    noise_relative: Known = None  #: `relative` that the noise of the torque alone would cause
    explained: Known  #: Variance explained (R²)
    limit: Known  #: Torque limit of the drive, or the URDF's effort limit, in `unit`
    share_of_limit: Known  #: RMS error over `limit`
    nominal_relative: Known  #: `relative` of the nominal (CAD) model
    controller_relative: Known  #: `relative` of the controller's dynamic model
    nominal_scale: Known = None
    """Measured torque over the torque of the nominal inertias, friction excluded."""
    controller_inertia: Known = None
    """The controller's diagonal inertia (joint side, with rotor) over the identified one: median
    over the recorded postures."""
    controller_inertia_spread: Known = None  #: Standard deviation of that ratio

    @property
    def has_moved(self) -> bool:
        """Whether a row shows it in motion; without, it has no error."""
        return self.relative is not None or self.rms > 0.0


class OverallJudgement(Frozen):
    """Relative errors over all joints together, each as of :class:`JointJudgement`."""

    relative: Known
    fitted_relative: Known
    noise_relative: Known
    nominal_relative: Known
    nominal_with_friction_relative: Known
    """Of the nominal model with friction that is fitted to the same recordings."""
    controller_relative: Known


class ProfileResult(Frozen):
    """Mean residual of one joint in bins of its speed or position."""

    centre: list[float]
    mean: list[Known]
    std: list[Known]  #: Standard error, with the residual's autocorrelation


class JudgementResult(Frozen):
    """Checks of the verdict, errors per joint and analysis of the residual."""

    in_sample: bool = False  #: Whether nothing was held out; errors are then on fitted motion
    nominal: str | None = None  #: Description of the nominal model
    findings: list[WordedFinding]
    next_steps: list[str]
    joints: list[JointJudgement]
    all_joints: OverallJudgement | None = None  #: Null in earlier files
    speed: list[ProfileResult]  #: Over rad/s or m/s
    position: list[ProfileResult]  #: Over rad or m

    @property
    def worst_first(self) -> list[WordedFinding]:
        """Findings in descending order of severity.

        Causes, the one that explains most of the error first, then symptoms, then conditions.
        """
        levels = ("wrong", "doubtful", "information", "good")
        roles = ("cause", "symptom", "condition")

        def rank(finding: WordedFinding) -> tuple[int, int, float]:
            explained = finding.explains or 0.0
            return levels.index(finding.level), roles.index(finding.role), -explained

        return sorted(self.findings, key=rank)

    @property
    def doubtful(self) -> list[WordedFinding]:
        """Findings that are warnings, the most consequential first."""
        return [finding for finding in self.worst_first if finding.level == "doubtful"]

    def at(self, index: int | None) -> WordedFinding | None:
        """Return a finding by its index, such as the headline of the verdict."""
        if index is None or not 0 <= index < len(self.findings):
            return None
        return self.findings[index]

    def any_joint(self, figure: str) -> bool:
        """Whether a field of :class:`JointJudgement` is known for any joint."""
        return any(getattr(joint, figure) is not None for joint in self.joints)


class EssentialParameter(Frozen):
    """One parameter of the essential model."""

    name: str
    unit: str
    estimate: float
    std: float

    @property
    def relative_std(self) -> float:
        """Std / |estimate|."""
        return self.std / abs(self.estimate) if self.estimate else math.inf


class EssentialResult(Frozen):
    """Essential parameters."""

    reason: str  #: Criterion of the choice
    cut: int  #: Index of the chosen step
    steps: list[EliminationStep]  #: Down to one parameter
    refused: list[str]
    """Parameters with a large relative standard deviation that the held-out motion needs."""
    parameters: list[EssentialParameter]


class LinkResult(Frozen):
    """A link of the physically consistent model, about its joint's origin, SI units."""

    joint: str
    mass: float
    centre: list[float]  #: Centre of mass in the joint's frame, m
    rotor_inertia: float | None
    rotor_at_bound: bool = False  #: Whether that is zero because no torque shows a rotor
    room: float
    """Smallest second moment over the nominal body's; 0 at the limit of consistency."""
    reference: str  #: Origin of its nominal body


class ConsistencyResult(Frozen):
    """Physically consistent parameters closest to the estimate."""

    sentence: str
    impossible: bool
    costly: bool
    held_out: float  #: Relative torque error on held-out motion
    unconstrained_held_out: float
    in_sample: float
    unconstrained_in_sample: float
    moved: list[str]  #: Parameters changed by more than three standard deviations
    shift: list[float]  #: Change of each parameter in standard deviations
    bounds: list[str]
    links: list[LinkResult]
    status: str


class ExportResult(Frozen):
    """Files for other tools, in the folder of `results.json`."""

    written: list[str]
    withheld: dict[str, str]  #: Files that were not written, with the reason


class RecordingResult(Frozen):
    """What was read of a log or a bag."""

    file: str
    use: Literal["fitted", "predicted"]
    content: str  #: Joints, duration and rate
    changes: list[str]  #: What is not as the file has it: signs, order, units, rows
    channels: list[str]  #: Meaning of each group of channels, and why


class OccasionResult(Frozen):
    """When and by whom the arm was recorded and identified."""

    recorded_from: str | None = None  #: Start of the first recording, ISO 8601; null if unknown
    recorded_to: str | None = None  #: Start of the last one
    identified_at: str  #: Time of the identification, ISO 8601
    operator: str = ""  #: Of the cell file, as the following
    serial_number: str = ""
    notes: str = ""

    def entries(self) -> dict[str, str]:
        """Return what is known, by title."""
        recorded = " to ".join(dict.fromkeys(filter(None, (self.recorded_from, self.recorded_to))))
        rows = {
            "recorded": recorded,
            "identified": self.identified_at,
            "operator": self.operator,
            "serial number": self.serial_number,
            "notes": self.notes,
        }
        return {title: text for title, text in rows.items() if text}


SCHEMA_VERSION: Final = 3


class ExcitationResult(Frozen):
    """The excitation as planned, and as executed according to the archives."""

    method: str | None = None  #: Of the design
    duration: float
    n_via: int | None = None
    fly: float | None = None
    n_sines: int | None = None  #: Sines per joint of a sum of sines
    coupling_index_max: float
    planned: Criteria | None = None
    executed: Criteria


def outside_mark(z: float | None) -> str:
    """Return `out3` or `out2` for more than 3 or 2 standard deviations, else an empty string."""
    if z is None or abs(z) <= 2.0:
        return ""
    return "out3" if abs(z) > 3.0 else "out2"


class ParameterResult(Frozen):
    """One parameter."""

    name: str
    expression: str
    unit: str
    table2_id: int | None
    estimate: float
    std: float  #: In units of the torque of this arm
    repetition_mean: float
    repetition_std: float | None
    """Standard deviation of a single repetition."""
    truth: Known  #: True value of a simulated arm
    undetermined: bool = False  #: Whether the motion does not determine it
    of_this_run: bool = False
    """Whether it is valid for this run only: friction depends on the temperature of the gears."""
    prior_std: float | None = None  #: Of the prior from CAD; infinite if there is none
    prior_ratio: float | None = None
    """Posterior over prior standard deviation: 0 if determined by the data, 1 by the prior."""
    learned: bool | None = None
    """Whether at least three quarters of the information come from the data."""
    absolute_std: float | None = None
    """With the uncertainty of the torque's scale; null in files of earlier versions."""

    @property
    def label(self) -> str:
        """Name for figures, after its number in the paper's Table 2."""
        return self.name if self.table2_id is None else f"{self.table2_id} {self.name}"

    @property
    def data_share(self) -> float | None:
        """Share of the information that comes from the data, 0 to 1; None without a prior."""
        bounded = self.prior_std is not None and math.isfinite(self.prior_std)
        if not bounded or self.prior_ratio is None or not math.isfinite(self.prior_ratio):
            return None
        return 1.0 - min(self.prior_ratio, 1.0) ** 2

    @property
    def relative_std(self) -> float:
        """Std / |estimate|."""
        return self.std / abs(self.estimate) if self.estimate else math.inf

    @property
    def deviation(self) -> float | None:
        """(estimate - truth) / std, absolute; None if unknown."""
        return self.deviation_of(self.estimate, self.std)

    @property
    def outside(self) -> str:
        """Mark of its deviation, see :func:`outside_mark`."""
        return outside_mark(self.deviation)

    @property
    def grade(self) -> Literal["within 10 %", "within 50 %", "not identified", "undetermined"]:
        """Accuracy: 10 % or better, 50 % or better, worse, or undetermined."""
        if self.undetermined or not math.isfinite(self.std):
            return "undetermined"
        well, roughly = (self.std <= share * abs(self.estimate) for share in KNOWN_STD_SHARES)
        return "within 10 %" if well else "within 50 %" if roughly else "not identified"

    def deviation_of(self, estimate: float, std: float) -> float | None:
        """Return the deviation of another estimate of this parameter.

        `std` is in units of the torque of this arm, whose scale the truth does not have.
        """
        if self.truth is None or not std > 0.0:
            return None
        absolute = self.std if self.absolute_std is None else max(self.absolute_std, self.std)
        scale = math.sqrt(absolute**2 - self.std**2) if math.isfinite(absolute) else 0.0
        z = (estimate - self.truth) / math.hypot(std, scale)
        return z if math.isfinite(z) else None


def by_id(parameters: Sequence[ParameterResult]) -> list[ParameterResult]:
    """Return parameters in the order of the paper's Table 2, the others last."""
    return sorted(parameters, key=lambda parameter: parameter.table2_id or len(parameters) + 1000)


class ValidationResult(Frozen):
    """Torque prediction on one held-out motion; lists are per joint."""

    archive: str
    duration: float = Field(gt=0.0)
    mean_abs_error: list[float]
    rms_error: list[float]
    mean_error: list[float]
    relative_error: list[float]
    overall_relative_error: float  #: ||e|| / ||tau|| over all joints, rows in which the joint moves
    all_rows_relative_error: float
    """As above over all rows, including standstill and the first and last rows."""
    all_rows_joint_errors: list[float]  #: As above per joint


class FittedResult(Frozen):
    """Torque error on the fitted motion, all recordings; lists are per joint."""

    relative_error: list[float]
    """||e|| / ||tau||, rows in which the joint moves; torque as recorded."""
    overall_relative_error: float
    all_rows_relative_error: float
    """As above over all rows, including standstill and the first and last rows."""
    all_rows_joint_errors: list[float]  #: As above per joint
    smoothed_relative_error: list[float] | None = None
    """All rows, of the smoothed torque if that was fitted."""
    smoothed_overall_relative_error: float | None = None

    @property
    def message(self) -> str:
        """Summary, without full stop."""
        smoothed = self.smoothed_overall_relative_error
        text = (
            "on the fitted motion (in-sample) the torque error is"
            f" {percentage(self.overall_relative_error, 2)} over all joints,"
            f" {percentage(self.all_rows_relative_error, 2)} over all rows including standstill"
        )
        if smoothed is not None:
            text += f", and {percentage(smoothed, 2)} of the smoothed torque over all rows"
        return text


class CalibrationResult(Frozen):
    """Held-out means of torque and their 95 % intervals; lists are per joint."""

    block: float = Field(gt=0.0)  #: Time that a mean covers, s
    means: int = Field(gt=0)  #: Number of means, all joints
    inside: float  #: Share inside their intervals; 0.95 if the intervals are correct
    white_inside: float  #: Share inside the intervals for white residuals
    joint_inside: list[Known]  #: Share per joint; null if its intervals are unknown
    half_width: list[Known]  #: Median half width of the intervals, N·m or N

    @property
    def message(self) -> str:
        """Summary, without full stop."""
        return (
            f"{percentage(self.inside, 1)} of {self.means} held-out means of torque "
            f"({self.block:g} s, per"
            f" joint) are inside their 95 % intervals; intervals that assume white residuals"
            f" contain {percentage(self.white_inside)}"
        )


class DelaysResult(Frozen):
    """Delay of the torque behind the position; lists are per joint, s."""

    found: list[Known]  #: Estimate; null if undetermined and not applied
    interval: list[Known]  #: Half width of its 95 % interval
    applied: list[float]  #: Used by the fit


class CoverageResult(Frozen):
    """Number of parameters within 2 and 3 standard deviations of their true value."""

    within_2: int
    within_3: int
    total: int


class VerdictResult(Frozen):
    """Verdict on the model."""

    good: bool
    line: str  #: Summary
    reasons: list[str]  #: Why the model is not good
    warnings: list[str]  #: Problems that do not make the model bad
    purposes: list[Purpose] = []  #: What the model is good for; empty in earlier files
    headline: int | None = None  #: Finding of the judgement that the line names; by its index


class EstimatorResult(Frozen):
    """Estimator of the parameters."""

    name: str  #: Of `hil identify --estimator`
    words: str  #: Description
    prior: str | None  #: Description of the prior, or the reason why there is none
    condition: float  #: Of the weighted regressor with columns of unit length
    grouping: str  #: Explanation of the number of base parameters


class UncertaintyResult(Frozen):
    """Standard deviation of the parameters."""

    method: str  #: Description of estimate and standard deviation
    interval_factor: float  #: Half width of a 95 % interval in standard deviations


class ChoiceResult(Frozen):
    """A setting chosen by inner prediction."""

    name: str  #: Of the setting
    candidates: list[str]  #: Descriptions, the default first
    errors: list[float]
    """``||e|| / ||tau||`` over all joints, of a low-pass their geometric mean by joint; geometric
    mean over the segments."""
    chosen: int  #: Index of the candidate


class SettingsResult(Frozen):
    """What the identification used, so that exports and rollouts need no other one."""

    archives: list[str]  #: File names, in the order in which they were given
    predicted: list[str]  #: Archives that were held out as a whole
    split: float  #: Fitted share of the first fitted recording
    in_sample: bool
    estimator: str
    settings: dict[str, Any]  #: Entries of :class:`Settings`, without its choices

    @classmethod
    def entries(cls, settings: Settings) -> dict[str, Any]:
        """Return the value of `settings`: their choices are in :attr:`Results.choices`."""
        entries: dict[str, Any] = adapter_of(Settings).dump_python(
            replace(settings, choices=()), mode="json"
        )
        return entries

    def decided(self) -> Settings:
        """Return the settings.

        Raises:
            ValueError: they are from another version.
        """
        entries = {**self.settings}
        preprocessing = {**entries.get("preprocessing", {})}
        if "left_out" in preprocessing:  # of earlier versions
            preprocessing["exclude_rows"] = preprocessing.pop("left_out")
            entries["preprocessing"] = preprocessing
        settings: Settings = adapter_of(Settings).validate_python(entries)
        return settings


class Results(Frozen):
    """Results of one identification."""

    schema_version: int = SCHEMA_VERSION
    name: str
    cell: str
    simulated: bool
    simulated_by_unknown: bool = False  #: By a program at the other end of a link
    effects: list[str]  #: Unmodelled effects of the simulation, with their sizes
    joint_names: list[str]
    period: float
    software: dict[str, str]
    excitation: ExcitationResult
    estimator: EstimatorResult
    notes: list[str]  #: Decisions in the preparation of the recordings
    parameters: list[ParameterResult]
    n_base: int
    uncertainty: UncertaintyResult
    repetitions: list[str]  #: Archive file names
    repetition_values: list[list[float]]
    noise_std: list[float]  #: Torque residual standard deviation per joint, N·m
    correlation: list[list[float]]
    """Normalised Ψ of eq. 5 (signed), friction included, from the executed motion."""
    validation: list[ValidationResult]  #: Empty if nothing was held out
    fitted: FittedResult
    calibration: CalibrationResult | None = None  #: Null without enough data
    delays: DelaysResult | None = None  #: Null if they could not be estimated
    choices: list[ChoiceResult]  #: Settings chosen by inner prediction, in order
    coverage: CoverageResult | None
    verdict: VerdictResult
    contact_thresholds: list[ContactThreshold] = []  #: Empty if too little was held out
    essential: EssentialResult | None = None
    consistency: ConsistencyResult | None = None
    exports: ExportResult | None = None
    judgement: JudgementResult
    conduct: ExecutionLogResult | None = None  #: Null without a campaign folder
    recordings: list[RecordingResult] = []  #: Imported ones; empty of archives
    occasion: OccasionResult | None = None  #: Null in files of earlier versions
    settings: SettingsResult | None = None  #: Likewise

    @property
    def remarks(self) -> list[str]:
        """Warnings about the recordings that no check found; they follow the verdict's."""
        return self.verdict.warnings[len(self.judgement.doubtful) :]

    @property
    def not_significant(self) -> list[str]:
        """Labels of parameters whose 95 % interval includes zero."""
        factor = self.uncertainty.interval_factor
        return [p.label for p in by_id(self.parameters) if not abs(p.estimate) > factor * p.std]

    @classmethod
    def load(cls, path: Path) -> Results:
        """Read a `results.json`.

        Raises:
            InputError: the file does not match this schema.
        """

        def refusal(problem: str, field: str = "") -> InputError:
            again = "identify again from the archives"
            return InputError(path, problem, field=field, remedy=again)

        try:
            text = read_text(path)
            document = parse_json(text)
        except (OSError, ValueError) as error:
            raise refusal(f"cannot be read as a result ({error})") from error
        version = document.get("schema_version") if isinstance(document, dict) else None
        if version != SCHEMA_VERSION:
            problem = f"is of version {version!r}; this program reads version {SCHEMA_VERSION}"
            raise refusal(problem, "schema_version")
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            problem = f"{first['msg'].lower()}; found {str(first['input'])[:80]!r}"
            raise refusal(problem, ".".join(str(part) for part in first["loc"])) from error
