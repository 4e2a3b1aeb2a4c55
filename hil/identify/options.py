"""What a person may choose about an identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from hil.errors import InputError
from identification.preprocessing import Smoother

Method = Literal["default", "paper"]
Estimator = Literal["wls", "ols", "huber", "tukey", "prior", "consistent", "iv"]

ESTIMATORS: Final[dict[Estimator, str]] = {
    "wls": "weighted least squares (eq. 4): every joint's residual in its own noise",
    "ols": "ordinary least squares: every joint's residual alike, in N·m",
    "huber": "iteratively reweighted least squares, Huber's loss",
    "tukey": "iteratively reweighted least squares, Tukey's bisquare",
    "prior": "weighted least squares with a Gaussian prior from CAD",
    "consistent": "weighted least squares among the parameters that a machine can have",
    "iv": "instrumental variables, the commanded motion as instruments",
}


@dataclass(frozen=True)
class Options:
    """How archives are turned into a result.

    Attributes:
        method: "default" smooths positions only; "paper" smooths positions and torques and
            filters the regressor alike.
        split: share of a single recording that is fitted; the rest is predicted. Used only where
            there are no validation runs.
        delay: time by which the torque lags the position [s]; None takes it from the cell, "auto"
            estimates it per axis and compensates it.
        torque_bandwidth: low-pass [Hz] the torque has come through before it was recorded; None
            for none. "auto" looks for one in imported torques; a controller's own currents are
            known to have come through none.
        smoother: of the positions: "spline" or "butterworth".
        estimator: by name, see `ESTIMATORS`.
        in_sample: everything is fitted and nothing predicted: all errors are in-sample.

    Raises:
        InputError: a name is unknown, or the split no share.
    """

    method: Method = "default"
    split: float = 0.7
    delay: float | Literal["auto"] | None = None
    torque_bandwidth: float | Literal["auto"] | None = "auto"
    smoother: Smoother = "spline"
    estimator: Estimator = "wls"
    in_sample: bool = False

    def __post_init__(self) -> None:
        for name, kind in (
            ("method", Method),
            ("smoother", Smoother),
            ("estimator", Estimator),
        ):
            value, known = getattr(self, name), get_args(kind)
            if value not in known:
                raise InputError(
                    None, f"{value!r} is no {name}", field=name, remedy=f"use {', '.join(known)}"
                )
        if not 0.0 < self.split < 1.0:
            raise InputError(
                None, f"{self.split} is no share", field="split", remedy="give one between 0 and 1"
            )
