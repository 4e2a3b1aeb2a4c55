"""The public names of the package, which are names of `identification` as well."""

# ruff: noqa: F401
from identification.errors import IdentificationError, ModelError, ShapeError
from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.estimators.covariance import with_block_covariance
from identification.estimators.current_gains import Gains, identify_gains
from identification.estimators.delay import (
    DelayEstimate,
    estimate_delay,
    rate_products,
    with_uncertain_delay,
)
from identification.estimators.instrumental import (
    InstrumentalEstimate,
    estimate_instrumental,
    planned_motion,
)
from identification.estimators.least_squares import (
    RepeatedEstimate,
    estimate_repetitions,
    fit_least_squares,
)
from identification.estimators.loss_functions import Huber, Tukey
from identification.estimators.prior import (
    BodyPrior,
    GaussianPrior,
    PosteriorEstimate,
    body_prior,
    fit_posterior,
    with_prior,
)
from identification.estimators.robust import RobustEstimate, robust_estimate
from identification.export.parameter_files import covariance_csv, parameters_csv, parameters_json
from identification.export.urdf import write_urdf
from identification.factor.columns import instrument_factor
from identification.factor.estimate import Estimate, estimate
from identification.factor.factor import Factor
from identification.factor.normal_equations import NormalEquations
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
from identification.model.known_payload import Payload
from identification.model.motion import Motion
from identification.model.regressor import Regressor
from identification.model.robot import RobotModel
from identification.selection.essential import Elimination, eliminate
from identification.signals.noise import standstill_variance
from identification.signals.recording import Recording, RecordingError
from identification.signals.sample_times import SampleTimes, TimeBase, time_base, true_times
from identification.signals.samples import Preprocessing, Samples, prepare, smooth
from identification.validation.evidence import Evidence, gather
from identification.validation.finding import Thresholds
from identification.validation.prediction import PredictionError, prediction_error
from identification.validation.verdict import Verdict, judge

__all__ = [name for name in globals() if name[0].isalpha()]
