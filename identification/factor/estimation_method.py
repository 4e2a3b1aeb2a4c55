"""How an estimate was made, as values; `identification.factor.messages` words them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any, Literal

from pydantic import TypeAdapter

from identification.model.nominal_masses import MassFault

Widening = Literal["torque_scale", "friction_form", "friction_drift", "elastic_gears", "siblings"]
"""What a covariance has in addition to the scatter of the residuals."""
LossName = Literal["squares", "huber", "tukey"]


@dataclass(frozen=True)
class TimeBlocks:
    """Blocks of time over which a covariance is cluster-robust."""

    count: int
    duration: float  #: of each [s]


@dataclass(frozen=True)
class PriorOrigin:
    """What the prior of an arm is made from."""

    share: float  #: standard deviation of the described bodies, as a share of them
    #: why bodies of the size of the torque take the place of the described ones; None: they do not
    fault: MassFault | None = None
    scale: float = (
        1.0  #: ratio of measured torque to the described bodies' torque, if they are unrelated
    )
    stated: int = 0  #: parameters whose values are stated
    weight: float = 1.0  #: by which the information on bodies is multiplied


@dataclass(frozen=True)
class LeastSquares:
    """Linear least squares."""

    weighting: Literal["ordinary", "weighted"] = "weighted"
    by_qr: bool = False  #: of the rows themselves, not of their Gram matrix
    essential_only: bool = False  #: of the essential parameters
    kind: Literal["least_squares"] = "least_squares"


@dataclass(frozen=True)
class Reweighted:
    """Iteratively reweighted least squares with a robust loss."""

    loss: LossName
    tuning: float  #: of the loss, in standard deviations
    passes: int
    converged: bool
    by_qr: bool = False
    kind: Literal["reweighted"] = "reweighted"


@dataclass(frozen=True)
class Instrumental:
    """Instrumental variables."""

    kind: Literal["instrumental"] = "instrumental"


@dataclass(frozen=True)
class PriorAndData:
    """Posterior of a Gaussian prior."""

    prior: PriorOrigin | None  #: None: given as numbers
    design_effect: float  #: rows of data that count as one
    kind: Literal["prior_and_data"] = "prior_and_data"


@dataclass(frozen=True)
class EstimationMethod:
    """Fit and covariance of an estimate."""

    fit: LeastSquares | Reweighted | Instrumental | PriorAndData | None = None
    """None: not stated, as in files of earlier versions."""
    blocks: TimeBlocks | None = None  #: of the covariance; None: of white residuals
    widened_by: tuple[Widening, ...] = ()
    #: whether bodies with these parameters exist; the covariance is of the unconstrained ones
    is_consistent: bool = False

    def widened(self, by: Widening) -> EstimationMethod:
        """Return the method with one more contribution to the covariance."""
        return replace(self, widened_by=(*self.widened_by, by))

    def as_json(self) -> dict[str, Any]:
        """Return JSON data."""
        return asdict(self)

    @classmethod
    def of_json(cls, content: Mapping[str, Any]) -> EstimationMethod:
        """Return the method of :meth:`as_json`.

        Raises:
            ValueError: it is none.
        """
        method: EstimationMethod = _adapter().validate_python(content)
        return method


@cache
def _adapter() -> TypeAdapter[EstimationMethod]:
    return TypeAdapter(EstimationMethod)
