"""Robot dynamics identification: model, regressor, excitation, estimation, validation."""

from identification.base_parameters import BaseParameters
from identification.errors import IdentificationError, ModelError, ShapeError
from identification.estimation import Estimate, estimate
from identification.evidence import Evidence, gather
from identification.factor import Factor, NormalEquations
from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.motion import Motion
from identification.preprocessing import (
    Preprocessing,
    Samples,
    prepare,
    smooth,
    standstill_variance,
)
from identification.recording import Recording, RecordingError
from identification.regressor import Regressor
from identification.repetitions import RepeatedEstimate, estimate_repetitions
from identification.torque_channel import find_torque_bandwidth
from identification.validation import PredictionError, prediction_error
from identification.verdict import Thresholds, Verdict, judge

__all__ = [
    # model
    "BaseParameters",
    "FrictionLaw",
    "Motion",
    "Regressor",
    "RobotModel",
    # recordings and their preparation
    "Recording",
    "Preprocessing",
    "Samples",
    "prepare",
    "smooth",
    "standstill_variance",
    "find_torque_bandwidth",
    # reduction of samples
    "Factor",
    "NormalEquations",
    # estimation
    "Estimate",
    "estimate",
    "RepeatedEstimate",
    "estimate_repetitions",
    # validation
    "PredictionError",
    "prediction_error",
    "Evidence",
    "gather",
    "Thresholds",
    "Verdict",
    "judge",
    # errors
    "IdentificationError",
    "ModelError",
    "RecordingError",
    "ShapeError",
]
