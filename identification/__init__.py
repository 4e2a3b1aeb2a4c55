"""Robot dynamics identification: model, regressor, excitation, estimation, validation."""

from identification.base_parameters import BaseParameters
from identification.consistent import Consistency, ConsistentEstimate, consistent_estimate
from identification.coupling import Coupling
from identification.covariance import with_block_covariance
from identification.delay import DelayEstimate, estimate_delays
from identification.delay_compensation import (
    compensate,
    delay_sensitivity,
    rate_products,
    with_uncertain_delay,
)
from identification.elements import (
    Anchors,
    ExtensionSpring,
    GasCylinder,
    JointElements,
    TorsionSpring,
)
from identification.endogeneity import EndogeneityTest, endogeneity_test
from identification.errors import IdentificationError, ModelError, ShapeError
from identification.essential import Elimination, eliminate
from identification.estimation import Estimate, estimate
from identification.evidence import Evidence, gather
from identification.factor import Factor, NormalEquations
from identification.friction import FrictionLaw, JointFriction
from identification.friction_text import friction_in_words, friction_source
from identification.gains import Gains, identify_gains
from identification.instrument_factor import InstrumentFactor
from identification.instrument_motion import planned_motion
from identification.instrumental import InstrumentalEstimate, estimate_instrumental
from identification.least_squares import (
    fit_least_squares,
    ordinary_least_squares,
    weighted_least_squares,
)
from identification.losses import Huber, Tukey
from identification.model import RobotModel
from identification.motion import Motion
from identification.noise import standstill_variance
from identification.nominal_prior import nominal_prior
from identification.parameter_text import parameters_csv, parameters_json
from identification.payload import Payload
from identification.phase_factor import PhaseFactor
from identification.preprocessing import Preprocessing, Samples, prepare, smooth
from identification.prior import GaussianPrior, PosteriorEstimate, fit_with_prior, with_prior
from identification.qr_factor import QRFactor
from identification.recording import Recording, RecordingError
from identification.regressor import Regressor
from identification.repetitions import RepeatedEstimate, estimate_repetitions
from identification.resampling import resample
from identification.robust import RobustEstimate, robust_estimate
from identification.signals.clock import Clock, TimeBase, time_base, true_times
from identification.urdf_write import write_urdf
from identification.validation import PredictionError, prediction_error
from identification.verdict import Thresholds, Verdict, judge

__all__ = [
    # model
    "Anchors",
    "BaseParameters",
    "Coupling",
    "ExtensionSpring",
    "FrictionLaw",
    "GasCylinder",
    "JointElements",
    "JointFriction",
    "Motion",
    "Payload",
    "Regressor",
    "RobotModel",
    "TorsionSpring",
    # recordings and their preparation
    "Recording",
    "Clock",
    "TimeBase",
    "resample",
    "time_base",
    "true_times",
    "Preprocessing",
    "Samples",
    "prepare",
    "smooth",
    "standstill_variance",
    "DelayEstimate",
    "estimate_delays",
    "delay_sensitivity",
    "rate_products",
    "with_uncertain_delay",
    "compensate",
    "Gains",
    "identify_gains",
    # reduction of samples
    "Factor",
    "NormalEquations",
    "QRFactor",
    "PhaseFactor",
    "InstrumentFactor",
    # estimators: from recordings
    "Estimate",
    "fit_least_squares",
    "RobustEstimate",
    "robust_estimate",
    "Huber",
    "Tukey",
    "GaussianPrior",
    "PosteriorEstimate",
    "fit_with_prior",
    "nominal_prior",
    "RepeatedEstimate",
    "estimate_repetitions",
    # estimators: from factors
    "estimate",
    "ordinary_least_squares",
    "weighted_least_squares",
    "with_prior",
    "with_block_covariance",
    "Consistency",
    "ConsistentEstimate",
    "consistent_estimate",
    "planned_motion",
    "InstrumentalEstimate",
    "estimate_instrumental",
    "EndogeneityTest",
    "endogeneity_test",
    "Elimination",
    "eliminate",
    # validation
    "PredictionError",
    "prediction_error",
    "Evidence",
    "gather",
    "Thresholds",
    "Verdict",
    "judge",
    # back to other tools
    "write_urdf",
    "parameters_csv",
    "parameters_json",
    "friction_in_words",
    "friction_source",
    # errors
    "IdentificationError",
    "ModelError",
    "ShapeError",
    "RecordingError",
]
