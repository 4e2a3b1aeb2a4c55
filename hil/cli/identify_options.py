"""Options shared by the commands that identify."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, cast

import numpy as np
import typer

from hil.base.errors import InputError
from hil.cli.arguments import ESTIMATION
from hil.importers.dialect import number_of
from hil.pipeline.estimators import ESTIMATORS, Estimator
from hil.pipeline.options import Options, friction_from
from identification.rollout.servo_by_torque import PositionServo

MAX_STATED_DELAY: Final = 0.5
"""Largest delay accepted, s."""

EstimatorOption = Annotated[
    Estimator,
    typer.Option(
        metavar="NAME", help=f"One of {', '.join(ESTIMATORS)}.", rich_help_panel=ESTIMATION
    ),
]
DelayOption = Annotated[
    str | None,
    typer.Option(
        metavar="SECONDS",
        help="Lag of the torque behind the position, s; or auto, stated. Default: as in the "
        "cell, unless the data contradict it.",
        rich_help_panel=ESTIMATION,
    ),
]

FEW: Final = ("bandwidth", "velocity", "exclude_rows", "torque_bandwidth")
"""Options that `hil export` does not have."""


@dataclass(frozen=True)
class Identifying:
    """Options of an identification; see `hil.cli.arguments.with_options`."""

    friction: Annotated[
        str,
        typer.Option(
            metavar="TERMS",
            help="Friction law, such as coulomb,viscous,offset.",
            rich_help_panel=ESTIMATION,
        ),
    ] = "auto"
    delay: DelayOption = None
    bandwidth: Annotated[
        str,
        typer.Option(
            metavar="HZ",
            help="Largest bandwidth of the smoothed positions.",
            rich_help_panel=ESTIMATION,
        ),
    ] = "auto"
    velocity: Annotated[
        Literal["auto", "position", "measured"],
        typer.Option(
            metavar="SOURCE",
            help="Velocity: position (smoothed) or measured.",
            rich_help_panel=ESTIMATION,
        ),
    ] = "auto"
    exclude_rows: Annotated[
        Literal["auto", "rests", "halts", "slow", "none"],
        typer.Option(
            metavar="ROWS",
            help="Rows not fitted: rests, halts, slow, none.",
            rich_help_panel=ESTIMATION,
        ),
    ] = "auto"
    torque_bandwidth: Annotated[
        str,
        typer.Option(
            metavar="HZ",
            help="Bandwidth to which the torque was filtered before recording; or none, auto.",
            rich_help_panel=ESTIMATION,
        ),
    ] = "auto"

    def options(self, **more: Any) -> Options:
        """Return the options of an identification; `more` are the options of one command."""
        low_pass = self.torque_bandwidth
        friction = self.friction
        return Options(
            friction=friction_from(friction) if friction != "auto" else "auto",
            delay=delay_from(self.delay),
            bandwidth=_bandwidth(self.bandwidth, "--bandwidth"),
            velocity=self.velocity,
            exclude_rows=self.exclude_rows,
            torque_bandwidth=None
            if low_pass == "none"
            else _bandwidth(low_pass, "--torque-bandwidth"),
            **more,
        )


def delay_from(text: str | None) -> float | Literal["auto", "stated"] | None:
    """Parse the value of `--delay`, s; InputError if it is not one."""
    if text is None or text in ("auto", "stated"):
        return cast('Literal["auto", "stated"] | None', text)
    value = number_of(text)
    if not abs(value) <= MAX_STATED_DELAY:
        remedy = (
            f"give seconds between {-MAX_STATED_DELAY:g} and {MAX_STATED_DELAY:g}, stated or auto"
        )
        raise InputError(None, f"{text!r} is not a delay", field="--delay", remedy=remedy)
    return value


def servo_from(text: str | None) -> PositionServo | str | None:
    """Parse the value of `--servo`; InputError if it is neither gains and delay nor a word."""
    if text is None or text == "identified":
        return text
    figures = [number_of(part) for part in text.split(",")]
    if len(figures) != 3 or not (figures[0] > 0.0 and figures[1] >= 0.0):
        remedy = "give kp,kd,delay such as 2000,50,0.004, or the word identified"
        raise InputError(None, f"{text!r} is not a servo", field="--servo", remedy=remedy)
    if not 0.0 <= figures[2] <= MAX_STATED_DELAY:
        remedy = f"give a delay of 0 to {MAX_STATED_DELAY:g} s"
        raise InputError(None, f"{text!r} is not a servo", field="--servo", remedy=remedy)
    return PositionServo(np.array(figures[0]), np.array(figures[1]), figures[2])


def _bandwidth(text: str, option: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    value = number_of(text)
    if not 0.0 < value < math.inf:
        remedy = 'give a frequency above 0 Hz, or "auto"'
        raise InputError(None, f"{text!r} is not a bandwidth", field=option, remedy=remedy)
    return value
