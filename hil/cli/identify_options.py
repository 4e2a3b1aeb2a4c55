"""Options of an identification, as every command that identifies has them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, cast

import typer

from hil.errors import InputError
from hil.identify.options import ESTIMATORS, FRICTION_TERMS, Estimator, Options, friction_from

LONGEST_DELAY: Final = 0.5
"""s; what lags by more belongs to another recording."""

EstimatorOption = Annotated[
    Estimator,
    typer.Option(help="; ".join(f"{name}: {words}" for name, words in ESTIMATORS.items()) + "."),
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

FEW: Final = ("bandwidth", "velocity", "standstill", "torque_bandwidth")
"""Options that commands lack which identify on the way to something else."""


@dataclass(frozen=True)
class Identifying:
    """How archives are identified, as it is typed; see `hil.cli.arguments.with_options`."""

    friction: Annotated[
        str,
        typer.Option(
            metavar="TERMS|auto",
            help=f"Friction law, whatever the archive says: some of {FRICTION_TERMS}, with commas "
            "between them. auto: the archive's, with what predicts best at reversals (and, of "
            "imported recordings, at speed).",
        ),
    ] = "auto"
    delay: DelayOption = None
    bandwidth: Annotated[
        str,
        typer.Option(
            metavar="HZ|auto",
            help="Widest bandwidth of the smoothed positions; auto: the one with which parts of "
            "the fitted recordings are best predicted from the rest.",
        ),
    ] = "auto"
    velocity: Annotated[
        Literal["auto", "position", "measured"],
        typer.Option(help="Slope of the smoothed positions, or the measured velocity, if any."),
    ] = "auto"
    standstill: Annotated[
        Literal["auto", "rests", "slow", "none"],
        typer.Option(
            help="Rows that are not fitted: rests longer than 0.25 s, and the two rows between "
            "which a velocity changes its sign; all slow rows and those near a velocity reversal; "
            "or none. auto: slow rows, or rests where that predicts parts of the fitted "
            "recordings better."
        ),
    ] = "auto"
    torque_bandwidth: Annotated[
        str,
        typer.Option(
            help="Bandwidth in Hz of a low-pass the torque came through before it was recorded; "
            'the model is then filtered alike. "none", or "auto": estimated, of imported torques.',
        ),
    ] = "auto"

    def options(self, **more: Any) -> Options:
        """The options of an identification, and those that one command alone has.

        Raises:
            InputError: one of them cannot be used.
        """
        low_pass, friction = self.torque_bandwidth, self.friction
        return Options(
            friction=friction_from(friction) if friction != "auto" else "auto",
            delay=delay_from(self.delay),
            bandwidth=_bandwidth(self.bandwidth, "--bandwidth"),
            velocity=self.velocity,
            standstill=self.standstill,
            torque_bandwidth=None
            if low_pass == "none"
            else _bandwidth(low_pass, "--torque-bandwidth"),
            **more,
        )


def delay_from(text: str | None) -> float | Literal["auto", "stated"] | None:
    """Delay in s as the option says it.

    Raises:
        InputError: it is none.
    """
    if text is None or text in ("auto", "stated"):
        return cast('Literal["auto", "stated"] | None', text)
    value = _number(text)
    if not abs(value) <= LONGEST_DELAY:
        remedy = f"give seconds between {-LONGEST_DELAY:g} and {LONGEST_DELAY:g}, stated or auto"
        raise InputError(None, f"{text!r} is no delay", field="--delay", remedy=remedy)
    return value


def _bandwidth(text: str, option: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    value = _number(text)
    if not 0.0 < value < math.inf:
        remedy = 'give a frequency above 0 Hz, or "auto"'
        raise InputError(None, f"{text!r} is no bandwidth", field=option, remedy=remedy)
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
