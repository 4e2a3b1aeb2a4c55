"""Options of an identification, as every command that identifies has them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

import typer

from hil.errors import InputError
from hil.identify.options import ESTIMATORS, FRICTION_TERMS, Estimator, Options, friction_from

LONGEST_DELAY: Final = 0.5
"""s; what lags by more belongs to another recording."""

EstimatorOption = Annotated[
    Estimator,
    typer.Option(help="; ".join(f"{name}: {words}" for name, words in ESTIMATORS.items()) + "."),
]
BandwidthOption = Annotated[
    str,
    typer.Option(
        metavar="HZ|auto",
        help="Widest bandwidth of the smoothed positions; auto: the one with which parts of "
        "the fitted recordings are best predicted from the rest.",
    ),
]
VelocityOption = Annotated[
    Literal["auto", "position", "measured"],
    typer.Option(help="Slope of the smoothed positions, or the measured velocity, if any."),
]
FrictionOption = Annotated[
    str,
    typer.Option(
        metavar="TERMS|auto",
        help=f"Friction law, whatever the archive says: some of {FRICTION_TERMS}, with commas "
        "between them. auto: the archive's, with what predicts best at reversals (and, of "
        "imported recordings, at speed).",
    ),
]
StandstillOption = Annotated[
    Literal["auto", "rests", "slow", "none"],
    typer.Option(
        help="Rows that are not fitted: rests longer than 0.25 s; all slow rows and those near "
        "a velocity reversal; or none. auto: slow rows, or rests where that predicts parts of the "
        "fitted recordings better."
    ),
]
DelayOption = Annotated[
    str | None,
    typer.Option(
        metavar="SECONDS|auto|stated",
        help="Time by which the torque lags the position; stated: the cell's. If left out: "
        "the cell's, unless the recordings show another one. auto: estimated for each axis and "
        "compensated.",
    ),
]
TorqueBandwidthOption = Annotated[
    str,
    typer.Option(
        help="Bandwidth in Hz of a low-pass the torque came through before it was recorded; "
        'the model is then filtered alike. "none", or "auto": estimated, of imported torques.',
    ),
]


def options_from(**given: Any) -> Options:
    """The options of an identification, texts as the command line has them.

    Raises:
        InputError: one of them cannot be used.
    """
    for name, read in _READ.items():
        if name in given:
            given[name] = read(given[name])
    return Options(**given)


def delay_from(text: str | None) -> float | Literal["auto", "stated"] | None:
    """Delay in s as the option says it.

    Raises:
        InputError: it is none.
    """
    if text is None:
        return None
    if text in ("auto", "stated"):
        return "auto" if text == "auto" else "stated"
    value = _number(text)
    if not abs(value) <= LONGEST_DELAY:
        remedy = f"give seconds between {-LONGEST_DELAY:g} and {LONGEST_DELAY:g}, stated or auto"
        raise InputError(None, f"{text!r} is no delay", field="--delay", remedy=remedy)
    return value


def _bandwidth(text: str, option: str = "--bandwidth") -> float | str:
    value = _number(text)
    if text != "auto" and not 0.0 < value < math.inf:
        remedy = 'give a frequency above 0 Hz, or "auto"'
        raise InputError(None, f"{text!r} is no bandwidth", field=option, remedy=remedy)
    return text if text == "auto" else value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


_READ: Final[dict[str, Callable[[Any], Any]]] = {
    "delay": delay_from,
    "bandwidth": _bandwidth,
    "friction": lambda text: text if text == "auto" else friction_from(text),
    "torque_bandwidth": lambda text: (
        None if text == "none" else _bandwidth(text, "--torque-bandwidth")
    ),
}
