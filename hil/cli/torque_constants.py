"""`hil torque-constants`: estimate torque constants from recordings with a known payload."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Annotated, Any, Final

import tomlkit
import typer

from hil.base.errors import InputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import SCREEN_COLUMNS
from hil.base.progress import reporter as make_reporter
from hil.base.progress import say
from hil.base.toml_text import comment_lines, inline
from hil.cli.arguments import JsonOption, QuietOption, numbers, print_json
from hil.cli.identify_options import delay_from
from hil.pipeline.note_messages import finding_lines
from hil.pipeline.sources import archives_in
from hil.pipeline.torque_constant_fit import GainsFound, find_gains
from identification.estimators.current_gains import (
    MAX_RELATIVE_STD,
    GainProblem,
    UndeterminedGain,
)
from identification.model.known_payload import Payload
from identification.text import percentage

_NOT_DETERMINED: Final = "not determined"


def torque_constants(
    archives: Annotated[list[Path], typer.Argument(metavar="ARCHIVE")],
    loaded: list[Path] | None = None,
    mass: float | None = None,
    centre: str | None = None,
    inertia: str | None = None,
    frame: str | None = None,
    delay: Annotated[str, typer.Option(metavar="SECONDS")] = "stated",
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Estimate the torque constant of each motor from recordings with and without a known payload.

    Prints TOML for a cell file ([drive_train]) or a column map ([drive]), with 95 % intervals, and
    the relative standard deviation of each constant, which `hil payload` uses. Motors whose
    constant the data do not determine are listed as "not determined", which cell and map refuse:
    exit status 5.

    Options:
        archives: Archives (*.mcap) with motor currents, or folders of them. Archives whose cell has
            a [robot.payload] were recorded with it, the others without payload.
        loaded: Archive or folder recorded with the payload of --mass (repeatable).
        mass: Mass of that payload, kg.
        centre: Its centre of mass in the frame, x,y,z in m. Default: the origin of the frame;
            if the centre is elsewhere, the constants are wrong.
        inertia: Its inertia tensor about the centre of mass, xx,xy,xz,yy,yz,zz in kg·m² in the axes
            of the frame. Default: estimated too.
        frame: URDF link of that frame. Default: the link of the last joint.
        delay: Delay of the current relative to the position, s. Default: as in the cell.
    """
    bare = [*archives_in(archives)]
    full = [*archives_in(loaded or [])]
    twice = {path.resolve() for path in bare} & {path.resolve() for path in full}
    if twice:
        raise InputError(twice.pop(), "is listed twice", remedy="give it with or without load")
    if mass is not None and not loaded:
        raise _refusal("--mass", "has no recording with this payload", "add --loaded")
    tensor = inertia or "0,0,0,0,0,0"
    payload = _payload(mass, centre or "0,0,0", tensor, frame) if loaded else None
    carried = {path: payload for path in full if payload is not None}
    lag = delay_from(delay)
    if lag == "auto":
        raise _refusal("--delay", "cannot be estimated from currents", "give seconds")
    reporter = make_reporter(quiet=quiet or json)
    result = find_gains(bare, carried, reporter, delay=lag, unknown_inertia=inertia is None)
    assumed = None if centre or not loaded else assumption(frame)
    if json:
        print_json(as_dict(result) | {"assumed": assumed})
    else:
        typer.echo(_as_toml(result, assumed))
        for warning in finding_lines(result.otherwise, result.joints):
            say(f"warning: {warning}", err=True)
    if not result.gains.determined.all():
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _refusal(field: str, problem: str, remedy: str) -> InputError:
    return InputError(None, problem, field=field, remedy=remedy)


def _payload(mass: float | None, centre: str, inertia: str, frame: str | None) -> Payload:
    if mass is None or not (math.isfinite(mass) and mass > 0.0):
        raise _refusal("--mass", "the payload needs a mass above 0", "give it in kg")
    x, y, z = numbers(centre, 3, "--centre")
    xx, xy, xz, yy, yz, zz = numbers(inertia, 6, "--inertia")
    payload = Payload(mass, (x, y, z), (xx, xy, xz, yy, yz, zz), frame)
    if not payload.possible:
        remedy = "principal moments are not negative, and none exceeds the sum of the others"
        raise _refusal("--inertia", "no body has this tensor", remedy)
    return payload


def assumption(frame: str | None) -> str:
    """Return what is assumed of a load whose centre of mass was not given."""
    origin = f"the frame {frame}" if frame else "the frame of the last joint's link"
    return (
        f"the load's centre of mass is assumed at the origin of {origin}; if it is elsewhere, give"
        " --centre x,y,z"
    )


def _as_toml(result: GainsFound, assumed: str | None) -> str:
    """Format constants and their uncertainty as TOML; what is not determined is a text."""
    side = "motor side" if result.motor_side else "joint side, gears included"
    constants = tomlkit.array()
    for motor in _motors(result):
        if motor["not_determined"] is None:
            value: float | str = float(f"{motor['torque_constant']:.6g}")
            comment = f"{motor['name']} ± {motor['half_interval']:.2g}"
        else:
            value = _NOT_DETERMINED
            comment = f"{motor['name']}: {motor['not_determined']}"
        constants.add_line(value, comment=comment)
    constants.add_line(indent="")
    gains = result.gains
    uncertainty = inline(
        [
            float(f"{share:.2g}") if determined else _NOT_DETERMINED
            for share, determined in zip(gains.relative_std, gains.determined, strict=True)
        ]
    )
    document = tomlkit.document()
    heads = textwrap.wrap(assumed or "", SCREEN_COLUMNS - 2)
    heads.append(f"N·m/A ({side}), 95 % intervals")
    for line in comment_lines("\n".join(heads)):
        document.add(line)
    document.add("torque_constant", constants)
    document.add(*comment_lines("relative standard deviations"))
    document.add("torque_uncertainty", uncertainty)
    return tomlkit.dumps(document).rstrip("\n")


def _motors(result: GainsFound) -> list[dict[str, Any]]:
    """Name, constant, standard deviation and half interval [N·m/A], or why there are none."""
    gains = result.gains
    columns = (gains.motor_names, gains.values, gains.std, gains.determined, gains.reasons)
    return [
        {
            "name": name,
            "torque_constant": float(value) if determined else None,
            "std": float(std) if determined else None,
            "half_interval": float(gains.interval_factor * std) if determined else None,
            "not_determined": None if reason is None else _undetermined_words(reason),
        }
        for name, value, std, determined, reason in zip(*columns, strict=True)
    ]


def _undetermined_words(gain: UndeterminedGain) -> str:
    """Return why a gain is not determined."""
    match gain.problem:
        case GainProblem.NO_ROW:
            return "the motor has no usable row"
        case GainProblem.NOT_LOADED:
            return "the payload does not load it"
        case GainProblem.INSEPARABLE:
            return "the payload's torque is not separable from the robot's own"
        case GainProblem.NOT_POSITIVE:
            return "its estimate is not positive: the payload's torque is below the noise"
        case GainProblem.IMPRECISE:
            return (
                f"its standard deviation is {percentage(gain.relative_std, 1)}, limit"
                f" {percentage(MAX_RELATIVE_STD)}"
            )


def as_dict(result: GainsFound) -> dict[str, object]:
    """Return the content of `--json`."""
    loads = {name: None if load is None else load.mass for name, load in result.loads.items()}
    return {
        "motors": _motors(result),
        "unit": "N·m/A",
        "side": "motor" if result.motor_side else "joint",
        "payload_kg": loads,
        "warnings": finding_lines(result.otherwise, result.joints),
    }
