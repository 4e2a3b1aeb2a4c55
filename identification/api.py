"""The public names of the package, which stand in `identification` as well."""

from identification.errors import IdentificationError, ModelError, ShapeError
from identification.estimators.consistent import (
    Consistency,
    ConsistentEstimate,
    consistent_estimate,
)
from identification.estimators.covariance import with_block_covariance
from identification.estimators.delay import (
    DelayEstimate,
    compensate,
    delay_sensitivity,
    estimate_delays,
    rate_products,
    with_uncertain_delay,
)
from identification.estimators.gains import Gains, identify_gains
from identification.estimators.instrumental import (
    InstrumentalEstimate,
    estimate_instrumental,
    planned_motion,
)
from identification.estimators.least_squares import (
    RepeatedEstimate,
    estimate_repetitions,
    fit_least_squares,
    ordinary_least_squares,
)
from identification.estimators.losses import Huber, Tukey
from identification.estimators.prior import (
    GaussianPrior,
    PosteriorEstimate,
    fit_with_prior,
    nominal_prior,
    with_prior,
)
from identification.estimators.robust import RobustEstimate, robust_estimate
from identification.export.friction import friction_in_words, friction_source
from identification.export.parameters import parameters_csv, parameters_json
from identification.export.urdf import write_urdf
from identification.factor.factor import Estimate, Factor, NormalEquations, QRFactor, estimate
from identification.factor.phases import PhaseFactor, instrument_factor
from identification.model.base_parameters import BaseParameters
from identification.model.coupling import Coupling
from identification.model.elements import (
    Anchors,
    ExtensionSpring,
    GasCylinder,
    JointElements,
    TorsionSpring,
)
from identification.model.friction import FrictionLaw, JointFriction
from identification.model.motion import Motion
from identification.model.payload import Payload
from identification.model.regressor import Regressor
from identification.model.robot import RobotModel
from identification.selection.essential import Elimination, eliminate
from identification.signals.clock import Clock, TimeBase, time_base, true_times
from identification.signals.noise import standstill_variance
from identification.signals.recording import Recording, RecordingError
from identification.signals.samples import Preprocessing, Samples, prepare, smooth
from identification.validation.endogeneity import EndogeneityTest, endogeneity_test
from identification.validation.evidence import Evidence, gather
from identification.validation.prediction import PredictionError, prediction_error
from identification.validation.verdict import Thresholds, Verdict, judge

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
    "instrument_factor",
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
