"""What an identification leaves behind, as plain numbers: `results.json`."""

from .conduct import ConductResult, RecordedResult, StepResult, WarmUpResult
from .consistency import ConsistencyResult, LinkResult
from .essential import BlindResult, EliminationStepResult, EssentialParameter, EssentialResult
from .exports import ExportResult
from .judgement import FindingResult, JointJudgement, JudgementResult, ProfileResult
from .results import (
    SCHEMA_VERSION,
    CalibrationResult,
    ChoiceResult,
    CoverageResult,
    CriteriaResult,
    DelaysResult,
    EndogeneityResult,
    EstimatorResult,
    ExcitationResult,
    FittedResult,
    ParameterResult,
    Results,
    UncertaintyResult,
    ValidationResult,
    VerdictResult,
)

__all__ = [
    "BlindResult",
    "CalibrationResult",
    "ConductResult",
    "ConsistencyResult",
    "ChoiceResult",
    "CoverageResult",
    "CriteriaResult",
    "DelaysResult",
    "EliminationStepResult",
    "EndogeneityResult",
    "EssentialParameter",
    "EssentialResult",
    "EstimatorResult",
    "ExcitationResult",
    "ExportResult",
    "FindingResult",
    "FittedResult",
    "JointJudgement",
    "JudgementResult",
    "LinkResult",
    "ParameterResult",
    "ProfileResult",
    "RecordedResult",
    "Results",
    "SCHEMA_VERSION",
    "StepResult",
    "UncertaintyResult",
    "ValidationResult",
    "VerdictResult",
    "WarmUpResult",
]
