"""Options of an identification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import InitVar, dataclass
from typing import Any, Final, Literal, get_args
from warnings import warn

from hil.base.errors import InputError
from identification.model.friction import ABSENT, TERMS
from identification.signals.masks import ExcludedRows
from identification.signals.samples import RIGID_BANDWIDTH, VelocitySource
from identification.validation.purpose import NOTHING_REQUIRED, PurposeLimits, PurposeName

from .estimators import ESTIMATORS, Estimator

Method = Literal["default", "paper"]


@dataclass(frozen=True)
class Options:
    """Options of an identification.

    Those that are "auto" are chosen by :mod:`identification.selection.questions`.

    Raises:
        InputError: the method or estimator is unknown.
    """

    #: "default" smooths positions only; "paper" also smooths torques and filters the regressor
    method: Method = "default"
    split: float = 0.7  #: fitted share of a single recording without validation runs
    #: time by which the torque lags the position [s]; "stated" uses the cell's, None too unless the
    #: data show another one; "auto" estimates and compensates it per axis
    delay: float | Literal["auto", "stated"] | None = None
    #: bandwidth [Hz] of a low-pass filter in the recorded torque; None for none; "auto" detects one
    #: in imported torques (a controller's currents are unfiltered)
    torque_bandwidth: float | Literal["auto"] | None = "auto"
    estimator: Estimator = "auto"  #: see :mod:`hil.pipeline.estimators`
    bandwidth: float | Literal["auto"] = "auto"  #: maximum bandwidth of the smoothed positions [Hz]
    #: derivative of the smoothed positions, or measured velocity
    velocity: VelocitySource | Literal["auto"] = "auto"
    #: entries of `[robot.friction]` that replace the cell's
    friction: Mapping[str, Any] | Literal["auto"] = "auto"
    #: rows excluded for low speed: long "rests" of the arm, long "halts" of each joint, all "slow"
    #: rows and those near a reversal, or "none"; None depends on the friction law
    exclude_rows: ExcludedRows | Literal["auto"] | None = "auto"
    in_sample: bool = False  #: fit all recordings and hold out none
    #: what the model must be good for; by default it is judged by its error on unseen motion
    purposes: tuple[PurposeName, ...] = ()
    required: PurposeLimits = NOTHING_REQUIRED  #: of these
    standstill: InitVar[ExcludedRows | Literal["auto", ""]] = ""  #: `exclude_rows` before 0.2

    def __post_init__(self, standstill: ExcludedRows | Literal["auto", ""]) -> None:
        if standstill:
            warn("standstill is now called exclude_rows", DeprecationWarning, stacklevel=3)
            object.__setattr__(self, "exclude_rows", standstill)
        for name, choices in (("method", get_args(Method)), ("estimator", tuple(ESTIMATORS))):
            if (value := getattr(self, name)) not in choices:
                remedy = f"use {', '.join(choices)}"
                raise InputError(None, f"unknown {name} {value!r}", field=name, remedy=remedy)


FRICTION_TERMS: Final = ", ".join(
    [f"{kind.label.lower()}{'=RAD/S' if kind.speed_symbol else ''}" for kind in TERMS]
    + ["presliding=RAD"]
)
"""Terms that :func:`friction_from` accepts."""


def friction_from(text: str) -> Mapping[str, Any]:
    """Return entries of `[robot.friction]` for a law such as ``coulomb,viscous,presliding=1e-4``.

    Raises:
        InputError: a term is unknown, repeats or excludes another, or has an invalid value.
    """
    kinds = {kind.label.lower(): kind for kind in TERMS}
    absent = {kind.option: ABSENT.get(kind.option, False) for kind in TERMS} | {"presliding": 0.0}
    entries: dict[str, Any] = dict(absent)
    for term in text.split(","):
        name, equals, figure = term.strip().partition("=")
        kind = kinds.get(name)
        option = kind.option if kind else "presliding"
        unknown = kind is None and name != "presliding"
        if unknown or entries[option] != absent[option]:
            problem = "is not a friction term" if unknown else "repeats a term or excludes it"
            remedy = f"use auto, or a comma-separated list of {FRICTION_TERMS}"
            raise InputError(None, f"{term.strip()!r} {problem}", field="--friction", remedy=remedy)
        value: Any = True
        if kind is None or kind.speed_symbol:
            try:
                value = float(figure)
            except ValueError:
                value = math.nan
            if not 0.0 < value < math.inf:
                problem = f"{term.strip()!r} needs a value above zero"
                remedy = f"for example {name}=1e-4"
                raise InputError(None, problem, field="--friction", remedy=remedy)
        elif equals:
            problem = f"{name!r} takes no value"
            remedy = f"write {name}"
            raise InputError(None, problem, field="--friction", remedy=remedy)
        elif option in ABSENT:
            value = kind.label
        entries[option] = value
    return entries


FIXED: Final = Options(
    delay="stated",
    torque_bandwidth=None,
    estimator="wls",
    bandwidth=RIGID_BANDWIDTH,
    velocity="position",
    friction={},
    exclude_rows=None,
)
"""No automatic choice: delay and friction of the cell, no low-pass, weighted least squares."""
