"""A payload in words: its figures, what to do about an expected value, why it is doubtful."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, assert_never

import numpy as np

from hil.base.one_screen import columns
from hil.pipeline.note_messages import (
    SCALE_SOURCES,
    finding_lines,
    note_lines,
    scale_words,
    scaled_words,
)
from identification.estimators.payload_estimate import NAMES
from identification.factor.messages import blocks_words
from identification.hypotheses.gravity_direction import GravityDirection
from identification.validation.finding_messages import MOUNTING_STEP

from .payload_found import (
    BareCheck,
    CorrectMapScale,
    EstimateConstants,
    NextStep,
    OutsideInterval,
    PayloadFigure,
    PayloadFound,
    PlainStep,
    ScaledTorque,
)
from .payload_settings import NOT_DETERMINED, ControllerLoad, controller_settings

_INERTIA: Final = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Figures of `hil torque-constants --inertia`, in its order."""


def payload_lines(
    found: PayloadFound, expected: Mapping[str, float] | None = None, *, settings: bool = True
) -> list[str]:
    """Return sentences, table and commands, and the comparison with expected values.

    Without `settings` the commands of controllers are named and not written.
    """
    expected = expected or {}
    outside = found.outside(expected)
    controllers = controller_commands(found)
    lines = [*_summary(found), ""]
    rows = columns([_row(figure) for figure in found.figures])
    lines += [
        f"{row}  {figure.unit}".rstrip() for row, figure in zip(rows, found.figures, strict=True)
    ]
    for controller, command in controllers.items() if settings else ():
        lines += ["", f"{controller}:", command]
    lines += ["", *(f"warning: {warning}" for warning in _warnings(found))]
    lines += [f"check: {line}" for line in outside_lines(outside)]
    if outside:
        lines += [f"next: {line}" for line in step_lines(found.next_steps(expected))]
    elif expected:
        lines.append(f"check: {', '.join(expected)} inside the 95 % interval")
    if controllers and not settings:
        lines.append(f"settings of {', '.join(controllers)}: -v")
    return lines


def payload_as_json(found: PayloadFound) -> dict[str, Any]:
    """Return all values as JSON data; infinite ends and undetermined values are null."""
    torque = found.wrist_torque
    estimate = found.estimate
    mounting = found.bare_check.mounting

    def figure(value: float | None, low: float, high: float, unit: str) -> dict[str, Any]:
        interval = [end if np.isfinite(end) else None for end in (low, high)]
        return {"value": value, "interval": interval, "unit": unit}

    return {
        "frame": found.frame,
        "figures": {
            each.name: figure(each.value, each.low, each.high, each.unit) for each in found.figures
        },
        "wrist_torque": figure(*torque, "N·m"),
        "undetermined": list(estimate.undetermined),
        "impossible": list(estimate.impossible),
        "torque_uncertainty": {
            "std": found.scale.std.tolist(),
            "of": scaled_words(found.scale),
            "source": SCALE_SOURCES[found.scale.source],
        },
        "mounting": None if mounting is None else mounting_words(mounting),
        "otherwise": certain_lines(found.bare_check),
        "least_squares": estimate.parameters.tolist(),
        "method": _method(found),
        "controllers": controller_commands(found),
        "bare": list(found.bare),
        "loaded": list(found.loaded),
        "warnings": _warnings(found),
    }


def controller_commands(found: PayloadFound) -> dict[str, str]:
    """Return commands that set the payload, by controller; units and frames as in its manual.

    What is not determined has a comment instead of its command. Empty if the recordings are other
    than described.
    """
    if found.is_doubtful:
        return {}
    with_centre = found.determines(*NAMES[1:4])
    with_inertia = found.determines(*NAMES[4:])
    return controller_settings(ControllerLoad(found.body, with_centre, with_inertia))


def outside_lines(outside: Iterable[OutsideInterval]) -> list[str]:
    """Return a line about each expected value outside its interval."""
    return [
        f"{figure.name} {expected:g} {figure.unit} is outside the 95 % interval {figure.low:.4g} to"
        f" {figure.high:.4g} {figure.unit}"
        for figure, expected in outside
    ]


def step_lines(steps: Iterable[NextStep]) -> list[str]:
    """Return what to do about expected values outside their intervals."""
    return [*map(_step_words, steps)]


def mounting_words(gravity: GravityDirection) -> str:
    """Return why the stated direction of gravity is unlikely, with what to do."""
    angle = float(np.degrees(gravity.angle))
    declared, best = (
        ", ".join(f"{part:.2f}" for part in vector) for vector in (gravity.declared, gravity.best)
    )
    return (
        f"with gravity ({best}) m/s² in base axes, {angle:.0f}° from the declared ({declared})"
        f" m/s², the bare recordings are predicted with {np.sqrt(gravity.ratio):.2f} times the"
        f" error; {MOUNTING_STEP}, and import the recordings again; if it is right, check the zero"
        " positions of the joints"
    )


def certain_lines(check: BareCheck) -> list[str]:
    """Return what bare recordings certainly are other than described, with remedies."""
    return finding_lines(check.certain, check.joints)


def _summary(found: PayloadFound) -> list[str]:
    body = found.body
    estimate = found.estimate
    torque = found.wrist_torque
    low, high = estimate.intervals[0]
    centre = ", ".join(
        f"{_rounded(1e3 * part, 1)}" if found.determines(name) else "?"
        for name, part in zip(NAMES[1:4], body.centre, strict=True)
    )
    lines = [
        f"The payload weighs {body.mass:.4g} kg (95 %: {low:.4g} to"
        f" {high:.4g} kg), its centre of mass is at {centre} mm in the frame {found.frame};"
        f" its weight loads the flange with up to {torque[0]:.3g} N·m"
        f" ({torque[1]:.3g} to {torque[2]:.3g}).",
        f"The intervals are computed {scale_words(found.scale)}.",
    ]
    ambiguous = [
        name for name in estimate.undetermined if not estimate.impossible or name not in NAMES[4:]
    ]
    if ambiguous:
        lines.append(f"{', '.join(ambiguous)} {NOT_DETERMINED}.")
    if estimate.impossible:
        lines.append(
            f"The estimate of {', '.join(estimate.impossible)} is negative, which no body has:"
            " the inertia is not determined. Friction or delay of the torques may differ"
            " between the recordings; record the same motion bare and loaded, on a warm arm."
        )
    if estimate.is_beyond_reach:
        distance = float(np.linalg.norm(body.centre))
        lines.append(
            f"A load of {body.mass:.3g} kg with its centre of mass {distance:.2g} m from the"
            " frame is implausible, as even foam of that mass would be smaller: the difference"
            " may be a change of the arm itself. Record both on a warm arm, one after the"
            " other, and check with a load of known mass."
        )
    if found.bare_check.mounting is not None:
        mounting = mounting_words(found.bare_check.mounting)
        lines.append(f"The mounting is doubtful: {mounting}. No controller settings.")
    lines += [
        f"Doubtful: {each}. No controller settings." for each in certain_lines(found.bare_check)
    ]
    return lines


def _warnings(found: PayloadFound) -> list[str]:
    check = found.bare_check
    lines = [*note_lines(found.warnings), *finding_lines(check.uncertain, check.joints)]
    return [*dict.fromkeys(lines)]


def _method(found: PayloadFound) -> str:
    by_model = "" if found.bare else ", against the model of the arm"
    return f"{blocks_words(found.estimate.blocks)}{by_model}"


def _step_words(step: NextStep) -> str:
    match step:
        case PlainStep.CHECK_CONSTANTS:
            return (
                "check the torque constants with a known load: repeat with --check mass=KG, which"
                " prints the command for it"
            )
        case PlainStep.RECORD_BARE:
            return (
                "estimate the torque constants from the known load: record the same motion without"
                " it, then hil torque-constants BARE --loaded LOADED"
            )
        case ScaledTorque(factor, mass):
            return (
                f"the torques are too large by a factor of {factor:.3f} if the load weighs"
                f" {mass:g} kg; they come from the torque constants or sensors"
            )
        case CorrectMapScale(factor):
            return (
                "the archives hold torques without motor currents: check unit and scale of"
                f" [torque] in the column map (scale = {factor:.4f} times the present one)"
            )
        case EstimateConstants():
            command = _constants_command(step)
            return f"estimate the torque constants from the known load: {command}"
        case never:
            assert_never(never)


def _constants_command(step: EstimateConstants) -> str:
    """Return the command that estimates torque constants."""
    load = step.load
    arguments = ["hil", "torque-constants", *map(str, step.bare)]
    for path in step.loaded:
        arguments += ["--loaded", str(path)]
    centre = ",".join(_rounded(load[name], 4) for name in NAMES[1:4])
    arguments += ["--mass", f"{load['mass']:g}", f"--centre={centre}", "--frame", step.frame]
    if load.keys() >= {*_INERTIA}:
        tensor = ",".join(_rounded(load[name], 5) for name in _INERTIA)
        arguments.append(f"--inertia={tensor}")
    return shlex.join(arguments)


def _row(figure: PayloadFigure) -> Sequence[str]:
    """Return the cells of a figure, rounded to two digits of half its interval."""
    name, value, low, high = figure
    if value is None:
        return (name, "not determined", "", "", "")
    half = 0.5 * (high - low)
    finite = np.isfinite(half) and half > 0.0
    decimals = max(0, 1 - math.floor(math.log10(half))) if finite else 4
    shown, low_text, high_text = (_rounded(each, decimals) for each in (value, low, high))
    return (name, shown, low_text, "to", high_text)


def _rounded(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # + 0.0: no minus before a zero
