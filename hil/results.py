"""What an identification leaves behind: `results.json`, checked on the way in and out.

Everything is plain numbers in SI units, so that another program can read it without `hil`; what
is infinite or was not measured stands as the string "Infinity" or "NaN".
Per-joint lists follow `joint_names`; per-parameter lists follow `parameters`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
)

from hil.errors import InputError
from hil.reading import parse_json, read_text


class Frozen(BaseModel):
    """A section of a file: unchangeable, without unknown fields; no finite number is a word."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", ser_json_inf_nan="strings", from_attributes=True
    )

    @classmethod
    def of(cls, source: object = None, **others: Any) -> Self:
        """With what an object has under the names of fields, and others; arrays become lists."""
        own = {name: getattr(source, name) for name in cls.model_fields if hasattr(source, name)}
        return cls.model_validate(
            {
                name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in (own | others).items()
            }
        )

    @classmethod
    def rows(cls, **columns: Any) -> list[Self]:
        """One for each entry of columns, the first of which is there; a column of None is None."""
        lists = {
            name: values.tolist() if isinstance(values, np.ndarray) else values
            for name, values in columns.items()
        }
        return [
            cls.of(**{name: values and values[k] for name, values in lists.items()})
            for k in range(len(next(iter(lists.values()))))
        ]

    def to_json(self) -> str:
        """As indented JSON, the text of a file."""
        return self.model_dump_json(indent=1) + "\n"


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


Known = Annotated[float | None, BeforeValidator(_known)]
"""A number, or null where it is not a number."""


class StepResult(Frozen):
    """One step of a campaign."""

    step: str
    done: bool
    words: str  #: What is known of it
    details: list[str]


class RecordedResult(Frozen):
    """One motion, as its archive has it."""

    archive: str
    kind: str
    when: str | None  #: Begin, ISO 8601 (UTC); null in virtual time
    seconds: float
    cycles: int
    missed: int  #: Packets that never arrived
    late: int  #: Answers that were late
    not_accepted: int = Field(validation_alias=AliasChoices("not_accepted", "not_taken"))
    """Answers that the controller did not take."""
    lost: int  #: Cycles that were exchanged and not archived
    outcome: str
    why: str  #: Why it ended so


class WarmUpResult(Frozen):
    """Friction while the arm warmed up, motion by motion."""

    verdict: str  #: One of `warm`, `not warm`, `going on`
    threshold: float  #: Change per motion that counts as warm, as a share
    friction: list[list[float | None]]
    """Of each motion and joint, N·m or N; null for a joint that hardly moves."""
    change: list[float | None]
    """Largest change per motion of any joint, as a share; null before it can be determined."""


class ConductResult(Frozen):
    """How a campaign was run."""

    steps: list[StepResult]
    warm_up: WarmUpResult | None
    recorded: list[RecordedResult]
    """Every archive of the manifest, in the order in which they were made."""


class FindingResult(Frozen):
    """One check and its outcome."""

    check: str
    level: Literal["good", "information", "doubtful", "wrong"]
    words: str
    next_step: str  #: What to do about it; empty where nothing needs doing


class JointJudgement(Frozen):
    """One joint on unseen motion; on that of the fit where `JudgementResult.in_sample`."""

    joint: str
    unit: Literal["N·m", "N"]
    rms: float  #: Root mean square of the torque error, in `unit`
    relative: Known  #: ||e|| / ||tau||
    fitted_relative: Known = None  #: The same on the motion that was fitted
    explained: Known
    """Share of the torque's variance that is explained (R²): zero is no better than a constant."""
    limit: Known
    """Largest torque of the joint, in `unit`; of the drive, or the URDF's effort limit."""
    share_of_limit: Known  #: RMS error over `limit`
    nominal_relative: Known  #: ||e|| / ||tau|| of the nominal (CAD) model on the same motion
    controller_relative: Known  #: The same of the controller's own dynamic model
    nominal_scale: Known = None
    """Measured torque over what the nominal inertias ask for, friction set aside."""
    controller_inertia: Known = None
    """The controller's own diagonal inertia (joint side, rotor included) over the identified one:
    median over the recorded postures."""
    controller_inertia_spread: Known = None  #: Standard deviation of that ratio over the postures


class ProfileResult(Frozen):
    """Mean residual of one joint over bins of its speed or position, all recordings."""

    centre: list[float]
    mean: list[Known]
    std: list[Known]  #: Standard error that allows for the residual's correlation in time


class JudgementResult(Frozen):
    """Every check, the figures per joint, and what the residual follows."""

    in_sample: bool = False
    """Whether nothing was held out: all figures are of the fitted motion then."""
    nominal: str | None = None  #: What `JointJudgement.nominal_relative` is of, in words
    findings: list[FindingResult]
    next_steps: list[str]
    joints: list[JointJudgement]
    speed: list[ProfileResult]  #: Over rad/s or m/s
    position: list[ProfileResult]  #: Over rad or m
    lag: list[float]  #: Of `autocorrelation`, s
    autocorrelation: list[list[Known]]  #: Of each joint's residual
    effective_rows: list[float]  #: Independent samples that each joint's rows are worth
    friction_over_time: list[list[Known]] | None
    """Per joint: share by which friction was higher than estimated, in the order of recording."""

    @property
    def worst_first(self) -> list[FindingResult]:
        """Findings with the worst first, otherwise in the order of the checks."""
        levels = ("wrong", "doubtful", "information", "good")
        return sorted(self.findings, key=lambda finding: levels.index(finding.level))

    def any_joint(self, figure: str) -> bool:
        """Whether a figure of :class:`JointJudgement` is known of any joint."""
        return any(getattr(joint, figure) is not None for joint in self.joints)


class EliminationStepResult(Frozen):
    """The model after one more parameter was removed."""

    removed: str | None  #: None for the model it all begins with
    left: int
    spread: float  #: Largest over smallest relative standard deviation of those left
    in_sample: float  #: Relative torque error on the fitted motion
    held_out: float  #: Relative torque error on the held-out motion
    largest_relative_std: float  #: Of those left


class EssentialParameter(Frozen):
    """One parameter of the essential model, as estimated with the others of it."""

    name: str
    unit: str
    estimate: float
    std: float

    @property
    def relative_std(self) -> float:
        """Std / |estimate|."""
        return self.std / abs(self.estimate) if self.estimate else math.inf


class BlindResult(Frozen):
    """Parameters chosen inside the fitted motion alone, tried on the held-out motion."""

    left: int  #: How many were chosen
    essential: float
    """Relative torque error of these on the held-out motion, which had no say in the choice."""
    full: float  #: That of all parameters


class EssentialResult(Frozen):
    """Which parameters the motion needs."""

    reason: str  #: Why the cut is where it is
    cut: int  #: Index of the step chosen
    steps: list[EliminationStepResult]  #: The whole path, down to one parameter
    refused: list[str]
    """Less well known than the rule of thumb allows, but needed by the held-out motion."""
    parameters: list[EssentialParameter]
    by_spread_left: int
    """Number of parameters that relative standard deviations alone leave (Pham and Gautier)."""
    by_spread_held_out: float  #: Held-out error of those
    blind: BlindResult | None


class LinkResult(Frozen):
    """A link of the physically consistent model, about its joint's origin, SI units."""

    joint: str
    mass: float
    centre: list[float]  #: Centre of mass in the joint's frame, m
    rotor_inertia: float | None
    room: float
    """Smallest second moment over the nominal body's: 1 as there, 0 at the edge of possible."""
    reference: str  #: What stood for its nominal body


class ConsistencyResult(Frozen):
    """The nearest parameters that a machine can have, and what they cost."""

    sentence: str
    impossible: bool
    costly: bool
    held_out: float  #: Relative torque error of the consistent model on held-out motion
    unconstrained_held_out: float
    in_sample: float
    unconstrained_in_sample: float
    moved: list[str]  #: Parameters moved by more than three standard deviations
    shift: list[float]  #: How far each parameter was moved, in its standard deviations
    bounds: list[str]
    links: list[LinkResult]
    status: str


class ExportResult(Frozen):
    """Files for other tools, in the folder of `results.json`."""

    written: list[str]
    withheld: dict[str, str]  #: File name and why it was not written


SCHEMA_VERSION: Final = 2


class CriteriaResult(Frozen):
    """Excitation criteria of one trajectory (paper eqs. 5, 7, 9); log det in SI units."""

    log10_det: float
    coupling_index: float
    coupling_index_max: float
    fitness: float
    n_samples: int
    condition: float | None
    scaled_condition: float | None


class ExcitationResult(Frozen):
    """The excitation: as planned, and as it was really executed (from the archives)."""

    method: str | None = None  #: Name of the search that found it
    duration: float
    n_via: int | None
    fly: float | None
    n_sines: int | None = None  #: Sines per joint, where the motion is a sum of sines
    planned: CriteriaResult | None
    executed: CriteriaResult


def outside_mark(z: float | None) -> str:
    """`out3` or `out2` for a deviation beyond 3 or 2 standard deviations; "" for any other."""
    if z is None or abs(z) <= 2.0:
        return ""
    return "out3" if abs(z) > 3.0 else "out2"


class ParameterResult(Frozen):
    """One parameter: pooled estimate, its standard deviation, and what it is compared with."""

    name: str
    expression: str
    unit: str
    table2_id: int | None
    estimate: float
    std: float
    repetition_mean: float
    repetition_std: float | None
    """Standard deviation over the repetitions (of one repetition, not of their mean)."""
    truth: Known  #: Planted value; only a simulated cell has one
    undetermined: bool = False
    """Whether the motion says nothing about it, alone or as part of a combination."""
    of_this_run: bool = False
    """Whether it holds for this run only: friction changes with the temperature of the gears."""
    prior_std: float | None = None
    """What was believed before the data, from CAD; infinite where nothing was."""
    prior_ratio: float | None = None
    """Standard deviation with prior and data over that of the prior alone: 0 where all that is
    known comes from the data, 1 where all comes from the prior."""
    learned: bool | None = None
    """Whether at least three quarters of what is known of it come from the data."""

    @property
    def label(self) -> str:
        """Name for figures, led by the number it has in the paper's Table 2."""
        return self.name if self.table2_id is None else f"{self.table2_id} {self.name}"

    @property
    def relative_std(self) -> float:
        """Std / |estimate|."""
        return self.std / abs(self.estimate) if self.estimate else math.inf

    @property
    def deviation(self) -> float | None:
        """(estimate - truth) / std; None without a truth or a usable standard deviation."""
        return self.deviation_of(self.estimate, self.std)

    @property
    def outside(self) -> str:
        """Mark of its deviation, see :func:`outside_mark`."""
        return outside_mark(self.deviation)

    @property
    def grade(self) -> Literal["well", "roughly", "hardly", "undetermined"]:
        """How well the data determine it: to 10 %, to 50 %, worse, or not at all."""
        if self.undetermined or not math.isfinite(self.std):
            return "undetermined"
        size = abs(self.estimate)
        return (
            "well" if self.std <= 0.1 * size else "roughly" if self.std <= 0.5 * size else "hardly"
        )

    def deviation_of(self, estimate: float, std: float) -> float | None:
        """The same of another estimate of this parameter."""
        if self.truth is None or not std > 0.0:
            return None
        z = (estimate - self.truth) / std
        return z if math.isfinite(z) else None


class ValidationResult(Frozen):
    """Torque prediction on one motion that was never used for fitting; lists are per joint."""

    archive: str
    duration: float = Field(gt=0.0)
    mean_abs_error: list[float]
    rms_error: list[float]
    mean_error: list[float]
    relative_error: list[float]
    overall_relative_error: float  #: ||e|| / ||tau|| over all joints, rows in which the joint moves
    all_rows_relative_error: float
    """The same over every row, standstill and the first and last rows included."""
    all_rows_joint_errors: list[float] = Field(default_factory=list)
    """The same of each joint; empty in a file that was written before there were any."""


class FittedResult(Frozen):
    """Torque error on the motion that was fitted, all recordings; lists are per joint."""

    relative_error: list[float]
    """||e|| / ||tau||, rows in which the joint moves; torque as recorded."""
    overall_relative_error: float
    all_rows_relative_error: float
    """The same over every row, standstill and the first and last rows included."""
    all_rows_joint_errors: list[float] = Field(default_factory=list)
    """The same of each joint; empty in a file that was written before there were any."""
    smoothed_relative_error: list[float] | None = None
    """Every row, of the torque as it was fitted, where that was smoothed; null where not."""
    smoothed_overall_relative_error: float | None = None

    @property
    def words(self) -> str:
        """The figures over all joints, in a sentence without its full stop."""
        smoothed = self.smoothed_overall_relative_error
        text = (
            "on the fitted motion (in-sample) the torque error is"
            f" {self.overall_relative_error:.2%} over all joints,"
            f" {self.all_rows_relative_error:.2%} with every row, standstill included"
        )
        if smoothed is not None:
            text += f"; of the torque smoothed as it was fitted {smoothed:.2%}, every row"
        return text


class CalibrationResult(Frozen):
    """Held-out means of torque and their 95 % intervals; lists are per joint."""

    block: float = Field(gt=0.0)  #: Time that a mean covers, s
    means: int = Field(gt=0)  #: How many were compared with their interval, all joints
    inside: float  #: Share of them inside: 0.95 if the intervals are honest
    white_inside: float  #: Share inside the intervals that white residuals would have
    joint_inside: list[Known]  #: Null for a joint whose intervals are not known
    half_width: list[Known]  #: Median of half the interval, N·m or N

    def words(self, joint_names: Sequence[str]) -> str:
        """The figures, in a sentence without its full stop."""
        shares = [1.0 if share is None else share for share in self.joint_inside]
        lowest = min(shares, default=1.0)
        text = (
            f"{self.inside:.1%} of {self.means} held-out means of torque ({self.block:g} s, per"
            " joint) lie inside their 95% intervals"
        )
        if lowest < self.inside:
            text += f", {lowest:.0%} of {joint_names[shares.index(lowest)]}"
        return f"{text}; intervals for white residuals would hold {self.white_inside:.0%}"


class DelaysResult(Frozen):
    """Delay of the torque behind the position; lists are per joint, s."""

    found: list[Known]  #: Null where the recordings do not determine it
    interval: list[Known]  #: Half a 95 % interval of it
    applied: list[float]  #: What the fit took it to be


class ChoiceResult(Frozen):
    """A setting that was chosen by predicting parts of what was fitted from the rest."""

    name: str
    candidates: list[str]
    errors: list[float | None]
    """||e|| / ||tau|| of the predictions, all joints and rows; null where there was none."""
    chosen: int  #: Index of the candidate that was used


class CoverageResult(Frozen):
    """How many parameters lie within 2 and 3 standard deviations of the planted truth."""

    within_2: int
    within_3: int
    total: int


class VerdictResult(Frozen):
    """Is the model good? One sentence, and the reasons."""

    good: bool
    line: str
    reasons: list[str]  #: What is wrong; empty if good
    warnings: list[str] = Field(validation_alias=AliasChoices("warnings", "doubts"))
    """What is not as it should be, but too small or too uncertain to say no."""


class EstimatorResult(Frozen):
    """How the parameters were estimated."""

    name: str  #: As `hil identify --estimator` has it
    words: str
    prior: str | None
    """What the prior of `ParameterResult.prior_std` is, in words; or why there is none."""
    condition: float  #: Of the weighted regressor with columns of unit length
    grouping: str  #: Why there are as many base parameters, in words


class EndogeneityResult(Frozen):
    """Durbin-Wu-Hausman test: was least squares biased by noise in the regressor?"""

    sentence: str
    biased: bool
    statistic: float
    p_value: float
    degrees_of_freedom: tuple[int, int]
    noise: list[float]
    """What the instruments do not explain of the regressor, as a share of each joint's torque."""
    shifted: list[str]
    """Parameters in which least squares and instrumental variables differ by more than chance."""
    shift: list[float]  #: Least squares less instrumental variables, per parameter


class UncertaintyResult(Frozen):
    """Standard deviation of each parameter by several routes."""

    reported: Literal[
        "least_squares",
        "independent_repetitions",
        "phase_clustered",
        "scatter_of_mean",
        "posterior",
    ]
    """The route that `ParameterResult.std` was read from."""
    method: str  #: How estimate and reported standard deviation were made, in words
    interval_factor: float  #: Standard deviations in half a 95 % interval
    least_squares: list[float]
    independent_repetitions: list[float] | None
    phase_clustered: list[float] | None
    scatter_of_mean: list[float] | None
    posterior: list[float] | None = None


class Results(Frozen):
    """One identification, whole."""

    schema_version: int = SCHEMA_VERSION
    name: str
    cell: str
    simulated: bool
    effects: list[str]
    """Unmodelled effects that were switched on in the simulation (names with sizes)."""
    joint_names: list[str]
    period: float
    software: dict[str, str]
    excitation: ExcitationResult
    estimator: EstimatorResult
    endogeneity: EndogeneityResult | None
    endogeneity_untested: str | None  #: Why there was no such test
    notes: list[str]  #: What was found and done when the recordings were prepared
    parameters: list[ParameterResult]
    n_base: int
    uncertainty: UncertaintyResult
    repetitions: list[str]  #: Archive file names
    repetition_values: list[list[float]]
    noise_std: list[float]  #: Torque residual standard deviation per joint, N·m
    correlation: list[list[float]]
    """Normalised Ψ of eq. 5 (signed), friction included, from the executed motion."""
    validation: list[ValidationResult]  #: Empty where nothing was held out
    fitted: FittedResult | None = None  #: In-sample errors, to stand beside those on unseen motion
    calibration: CalibrationResult | None = None
    """Null where nothing was held out, or too little was fitted to predict parts of it."""
    delays: DelaysResult | None = None  #: Null where they could not be looked for
    choices: list[ChoiceResult] = Field(default_factory=list)
    """Settings that were chosen automatically, in order."""
    coverage: CoverageResult | None
    verdict: VerdictResult
    essential: EssentialResult | None = None  #: Which parameters the motion needs
    consistency: ConsistencyResult | None = None  #: The nearest parameters that a machine can have
    exports: ExportResult | None = None  #: Files for other tools beside this one
    judgement: JudgementResult | None = None
    """Every check behind the verdict, and the figures it rests on."""
    conduct: ConductResult | None = None  #: How the campaign was run; null of loose archives

    @property
    def not_significant(self) -> list[str]:
        """Labels of parameters whose 95 % interval includes zero."""
        factor = self.uncertainty.interval_factor
        return [p.label for p in self.parameters if not abs(p.estimate) > factor * p.std]

    @classmethod
    def load(cls, path: Path) -> Results:
        """Read and check a `results.json`.

        Raises:
            InputError: the file is not of this schema.
        """

        def refusal(problem: str, field: str = "") -> InputError:
            again = "identify again from the archives, which hold all that is needed"
            return InputError(path, problem, field=field, remedy=again)

        try:
            text = read_text(path)
            found = parse_json(text)
        except (OSError, ValueError) as error:
            raise refusal(f"cannot be read as a result ({error})") from error
        version = found.get("schema_version") if isinstance(found, dict) else None
        if version != SCHEMA_VERSION:
            problem = f"is of version {version!r}; this program reads version {SCHEMA_VERSION}"
            raise refusal(problem, "schema_version")
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            problem = f"{first['msg'].lower()}; found {str(first['input'])[:80]!r}"
            raise refusal(problem, ".".join(str(part) for part in first["loc"])) from error


def csv_tables(results: Results) -> dict[str, str]:
    """CSV in full precision: the text of each table, by file name: the path of its field.

    A list with a number for each joint has a column for each, `field.joint`; a matrix with a
    column for each parameter has their names. What is neither stays in `results.json`.
    """
    fields = results.model_dump(mode="json")
    names = [parameter["name"] for parameter in fields["parameters"]]
    tables = {}
    for path, rows in _tables(fields, ""):
        if isinstance(rows[0], dict):
            records = [dict(_cells(row, fields["joint_names"])) for row in rows]
        else:
            heads = names if len(rows[0]) == len(names) else range(len(rows[0]))
            records = [dict(zip(map(str, heads), row, strict=True)) for row in rows]
        text = StringIO()
        columns = dict.fromkeys(key for row in records for key in row)
        writer = csv.DictWriter(text, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
        tables[f"{path}.csv"] = text.getvalue()
    return tables


def _tables(value: dict[str, Any], path: str) -> Iterator[tuple[str, list[Any]]]:
    """Lists of records and of rows of equal length, however deep, and where they are."""
    for name, item in value.items():
        if isinstance(item, dict):
            yield from _tables(item, f"{path}{name}.")
        elif isinstance(item, list) and item:
            records = all(isinstance(row, dict) for row in item)
            matrix = all(isinstance(row, list) and len(row) == len(item[0]) > 0 for row in item)
            if records or matrix:
                yield f"{path}{name}", item


def _cells(record: dict[str, Any], joints: list[str]) -> Iterator[tuple[str, Any]]:
    for name, item in record.items():
        if not isinstance(item, list | dict):
            yield name, item
        elif isinstance(item, list) and len(item) == len(joints):
            yield from ((f"{name}.{joint}", cell) for joint, cell in zip(joints, item, strict=True))
