"""Robot dynamics identification: model, regressor, excitation, estimation, validation."""

from identification.base_parameters import BaseParameters
from identification.errors import IdentificationError, ModelError, ShapeError
from identification.factor import Factor, NormalEquations
from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.motion import Motion
from identification.regressor import Regressor

__all__ = [
    # model
    "BaseParameters",
    "FrictionLaw",
    "Motion",
    "Regressor",
    "RobotModel",
    # reduction of samples
    "Factor",
    "NormalEquations",
    # errors
    "IdentificationError",
    "ModelError",
    "ShapeError",
]
