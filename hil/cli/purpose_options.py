"""Options that say what an identified model has to be good for."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, Final

import typer

from hil.base.errors import InputError
from hil.cli.arguments import PURPOSE
from identification.validation.purpose import PURPOSES, PurposeLimits, PurposeName

_UNITS: Final[dict[str, dict[str, float]]] = {
    "N": {"N": 1.0, "kN": 1e3},
    "kg": {"kg": 1.0, "g": 1e-3},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
}
_QUANTITY: Final = re.compile(r"([0-9.eE+-]+)\s*([a-zA-Z]*)")


@dataclass(frozen=True)
class Required:
    """What the model has to be good for; see `hil.cli.arguments.with_options`."""

    purposes: Annotated[
        list[str] | None,
        typer.Option(
            "--for",
            metavar="PURPOSE",
            help=f"Judge the model by this purpose (repeatable): {', '.join(PURPOSES)}.",
            rich_help_panel=PURPOSE,
        ),
    ] = None
    contact: Annotated[
        str | None,
        typer.Option(
            metavar="FORCE",
            help="Contact force at the flange to be detected, such as 50N.",
            rich_help_panel=PURPOSE,
        ),
    ] = None
    payload_change: Annotated[
        str | None,
        typer.Option(
            metavar="MASS",
            help="Change of payload that has to be detected, such as 0.5kg.",
            rich_help_panel=PURPOSE,
        ),
    ] = None
    flange_error: Annotated[
        str,
        typer.Option(
            metavar="LENGTH",
            help="Flange error of a simulation after 0.2 s.",
            rich_help_panel=PURPOSE,
        ),
    ] = "5mm"

    def options(self) -> dict[str, Any]:
        """Return the fields of `hil.pipeline.options.Options`; InputError if one is invalid."""
        contact = quantity(self.contact, "N", "--contact")
        payload = quantity(self.payload_change, "kg", "--payload-change")
        distance = quantity(self.flange_error, "m", "--flange-error")
        requested = tuple(map(_purpose, self.purposes or []))
        for name, limit, option in (
            ("contact", contact, "--contact 50N"),
            ("payload", payload, "--payload-change 0.5kg"),
        ):
            if name in requested and limit is None:
                problem = f"{name} needs a limit to be judged by"
                raise InputError(None, problem, field="--for", remedy=f"add {option}")
        if "parameters" in requested:
            problem = "single parameters are counted, not judged"
            remedy = "require a precision of them with `hil design --precision`"
            raise InputError(None, problem, field="--for", remedy=remedy)
        limits = PurposeLimits(contact=contact, payload=payload, distance=distance or 0.0)
        return {"purposes": requested, "required": limits}


def _purpose(text: str) -> PurposeName:
    for name in PURPOSES:
        if text == name:
            return name
    remedy = f"use {', '.join(PURPOSES)}"
    raise InputError(None, f"unknown purpose {text!r}", field="--for", remedy=remedy)


def quantity(text: str | None, unit: str, option: str) -> float | None:
    """Parse a number with a unit, such as 50N, in SI; InputError if it is none above zero."""
    if text is None:
        return None
    match = _QUANTITY.fullmatch(text.strip())
    factors = _UNITS[unit]
    factor = factors.get(match[2] or unit) if match else None
    try:
        value = float(match[1]) * factor if match and factor else math.nan
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        units = ", ".join(factors)
        remedy = f"write a number above zero with its unit: {units}"
        raise InputError(None, f"{text!r} is not a quantity in {unit}", field=option, remedy=remedy)
    return value
