"""What an identification leaves behind: `results.json`, checked on the way in and out.

Everything is plain numbers in SI units, so that another program can read it without `hil`; what
is infinite or was not measured stands as the string "Infinity" or "NaN".
Per-joint lists follow `joint_names`; per-parameter lists follow `parameters`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from hil.errors import InputError
from hil.files import write_atomically

SCHEMA_VERSION = 1


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


class CriteriaResult(_Frozen):
    """Excitation criteria of one trajectory (paper eqs. 5, 7, 9); log det in SI units."""

    log10_det: float
    coupling_index: float
    coupling_index_max: float
    fitness: float
    n_samples: int
    condition: float | None
    scaled_condition: float | None


class ExcitationResult(_Frozen):
    """The excitation: as planned, and as it was really executed (from the archives)."""

    method: str | None = None
    """Name of the search that found it."""
    duration: float
    n_via: int | None
    fly: float | None
    n_sines: int | None = None
    """Sines per joint, where the motion is a sum of sines."""
    planned: CriteriaResult | None
    executed: CriteriaResult


class ParameterResult(_Frozen):
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
    truth: float | None
    """Planted value; only a simulated cell has one."""


class ValidationResult(_Frozen):
    """Torque prediction on one motion that was never used for fitting; lists are per joint."""

    archive: str
    duration: float
    mean_abs_error: list[float]
    rms_error: list[float]
    mean_error: list[float]
    relative_error: list[float]
    overall_relative_error: float
    """||e|| / ||tau|| over all joints, rows in which the joint moves."""
    all_rows_relative_error: float
    """The same over every row, standstill and the first and last rows included."""


class CoverageResult(_Frozen):
    """How many parameters lie within 2 and 3 standard deviations of the planted truth."""

    within_2: int
    within_3: int
    total: int


class VerdictResult(_Frozen):
    """Is the model good? One sentence, and the reasons."""

    good: bool
    line: str
    reasons: list[str]
    """What is wrong; empty if good."""
    doubts: list[str]
    """What is not as it should be, but too small or too uncertain to say no."""


class UncertaintyResult(_Frozen):
    """Standard deviation of each parameter by four routes."""

    reported: Literal[
        "least_squares", "independent_repetitions", "phase_clustered", "scatter_of_mean"
    ]
    """The route that `ParameterResult.std` was taken from."""
    method: str
    """How estimate and reported standard deviation were made, in words."""
    interval_factor: float
    """Standard deviations in half a 95 % interval."""
    least_squares: list[float]
    independent_repetitions: list[float] | None
    phase_clustered: list[float] | None
    scatter_of_mean: list[float] | None


class Results(_Frozen):
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
    parameters: list[ParameterResult]
    n_base: int
    uncertainty: UncertaintyResult
    repetitions: list[str]
    """Archive file names."""
    repetition_values: list[list[float]]
    noise_std: list[float]
    """Torque residual standard deviation per joint, N·m."""
    correlation: list[list[float]]
    """Normalised Ψ of eq. 5 (signed), friction included, from the executed motion."""
    validation: list[ValidationResult]
    coverage: CoverageResult | None
    verdict: VerdictResult

    def save(self, path: Path) -> None:
        """Write `path` as indented JSON."""
        write_atomically(path, self.model_dump_json(indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> Results:
        """Read and check a `results.json`.

        Raises:
            InputError: the file is not of this schema.
        """
        try:
            results = cls.model_validate_json(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(
                path, f"is not a result of this version ({error})", remedy="identify again"
            ) from error
        if results.schema_version != SCHEMA_VERSION:
            raise InputError(
                path, f"is of version {results.schema_version}", remedy="identify again"
            )
        return results
