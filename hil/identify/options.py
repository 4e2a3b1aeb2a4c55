"""What a person may choose about an identification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from hil.errors import InputError
from identification.model.friction import ABSENT, TERMS
from identification.signals.masks import LeftOut
from identification.signals.samples import RIGID_BANDWIDTH, VelocitySource

Method = Literal["default", "paper"]
Estimator = Literal["auto", "wls", "ols", "huber", "tukey", "prior", "consistent", "iv"]

ESTIMATORS: Final[dict[Estimator, str]] = {
    "auto": "weighted least squares, regularised towards the consistent solution as far as that "
    "predicts better (chosen by inner prediction)",
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

    What is "auto" is chosen by predicting parts of what is fitted from the rest
    (:mod:`identification.selection.inner_prediction`).

    Raises:
        InputError: there is no such method or estimator.
    """

    #: "default" smooths positions only; "paper" smooths positions and torques and filters the
    #: regressor alike
    method: Method = "default"
    #: share of a single recording that is fitted; the rest is predicted. Used only where there are
    #: no validation runs.
    split: float = 0.7
    #: time by which the torque lags the position [s]; "stated" takes it from the cell, None
    #: likewise unless another one is found; "auto" estimates it per axis and compensates it
    delay: float | Literal["auto", "stated"] | None = None
    #: low-pass [Hz] the torque has come through before it was recorded; None for none. "auto" looks
    #: for one in imported torques; a controller's own currents are known to have come through none.
    torque_bandwidth: float | Literal["auto"] | None = "auto"
    estimator: Estimator = "auto"  #: by name, see `ESTIMATORS`
    bandwidth: float | Literal["auto"] = "auto"  #: widest of the smoothed positions [Hz]
    #: the slope of the smoothed positions, or the measured velocity
    velocity: VelocitySource | Literal["auto"] = "auto"
    #: entries of `[robot.friction]` that differ from the cell's
    friction: Mapping[str, Any] | Literal["auto"] = "auto"
    #: which rows are left out for being slow: long "rests", all "slow" ones and those near a
    #: reversal, or "none"; None goes by the friction law
    standstill: LeftOut | Literal["auto"] | None = "auto"
    in_sample: bool = False  #: everything is fitted and nothing predicted: all errors are in-sample

    def __post_init__(self) -> None:
        for name, known in (("method", get_args(Method)), ("estimator", tuple(ESTIMATORS))):
            if (value := getattr(self, name)) not in known:
                remedy = f"use {', '.join(known)}"
                raise InputError(None, f"{value!r} is no {name}", field=name, remedy=remedy)


FRICTION_TERMS: Final = ", ".join(
    [f"{kind.label.lower()}{'=RAD/S' if kind.speed_symbol else ''}" for kind in TERMS]
    + ["presliding=RAD"]
)
"""Of which a friction law can be put together."""


def friction_from(text: str) -> Mapping[str, Any]:
    """A friction law from its terms: ``coulomb,viscous,offset,presliding=1e-4``.

    Returns:
        Entries of `[robot.friction]`; terms that are not named are left out of the law.

    Raises:
        InputError: a term is unknown or excludes another, or its figure is none.
    """
    known = {kind.label.lower(): kind for kind in TERMS}
    absent = {kind.option: ABSENT.get(kind.option, False) for kind in TERMS} | {"presliding": 0.0}
    entries: dict[str, Any] = dict(absent)
    for term in text.split(","):
        name, _, figure = term.strip().partition("=")
        kind = known.get(name)
        if name == "presliding" or (kind is not None and kind.speed_symbol):
            try:
                value = float(figure)
            except ValueError:
                value = math.nan
            if not 0.0 < value < math.inf:
                problem = f"{term.strip()!r} has no figure above zero"
                remedy = "write for instance presliding=1e-4"
                raise InputError(None, problem, field="--friction", remedy=remedy)
            entries[kind.option if kind else name] = value
        elif kind is not None and not figure and entries[kind.option] == absent[kind.option]:
            entries[kind.option] = kind.label if kind.option in ABSENT else True
        else:
            problem = f"{term.strip()!r} is no term of friction, or excludes another one"
            remedy = f"use auto, or some of {FRICTION_TERMS}, with commas between them"
            raise InputError(None, problem, field="--friction", remedy=remedy)
    return entries


FIXED: Final = Options(
    delay="stated",
    torque_bandwidth=None,
    estimator="wls",
    bandwidth=RIGID_BANDWIDTH,
    velocity="position",
    friction={},
    standstill=None,
)
"""Nothing is decided: delay and friction law of the cell, no low-pass, weighted least squares."""
