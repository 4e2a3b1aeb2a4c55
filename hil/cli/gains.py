"""`hil gains`: torque constants from recordings with a known payload."""

from __future__ import annotations

import json as json_module
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.arguments import JsonOption, QuietOption
from hil.cli.identify_options import LONGEST_DELAY
from hil.cli.verdict import NOT_GOOD
from hil.errors import InputError
from hil.identify.gain_run import GainsFound, find_gains
from hil.progress import reporter as make_reporter
from identification.model.payload import Payload


def gains(
    archives: Annotated[list[Path], typer.Argument(metavar="ARCHIVE...")],
    loaded: list[Path] | None = None,
    mass: float | None = None,
    centre: str = "0,0,0",
    inertia: str = "0,0,0,0,0,0",
    frame: str | None = None,
    delay: float | None = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Find the torque constant of every motor, from recordings with and without a known payload.

    Prints TOML to paste into a cell or a column map, with 95 % intervals. A motor whose constant
    the data cannot determine is named, and gets "nan", which neither accepts: exit status 5.

    Options:
        archives: Archives with motor currents (*.mcap). One whose cell has a [robot.payload] was
            recorded with it, the others without load.
        loaded: Archive recorded with the payload of --mass; may be repeated.
        mass: Mass of that payload in kg.
        centre: Its centre of mass in the frame, x,y,z in m.
        inertia: Its tensor about the centre of mass, xx,xy,xz,yy,yz,zz in kg·m² in the axes of the
            frame.
        frame: Link of the URDF whose frame that is; the last joint's if left out.
        delay: Time in s by which currents lag positions; the cell's if left out.
    """
    if delay is not None and not abs(delay) <= LONGEST_DELAY:
        raise InputError(
            None, f"{delay} is no delay", field="--delay", remedy=f"give s, at most {LONGEST_DELAY}"
        )
    twice = {path.resolve() for path in archives} & {path.resolve() for path in loaded or []}
    if twice:
        raise InputError(twice.pop(), "is named with load and without", remedy="name it once")
    payload = _payload(mass, centre, inertia, frame, bool(loaded))
    found = find_gains(
        archives,
        dict.fromkeys(loaded or [], payload) if payload is not None else {},
        make_reporter(quiet=quiet or json),
        delay=delay,
    )
    typer.echo(json_module.dumps(_as_json(found), indent=1) if json else _as_toml(found))
    if not found.gains.determined.all():
        raise typer.Exit(NOT_GOOD)


def _payload(
    mass: float | None, centre: str, inertia: str, frame: str | None, wanted: bool
) -> Payload | None:
    if not wanted:
        if mass is not None:
            raise InputError(
                None, "which recording was made with it?", field="--mass", remedy="add --loaded"
            )
        return None
    if mass is None or not (math.isfinite(mass) and mass > 0.0):
        raise InputError(
            None, "the payload needs a mass above 0", field="--mass", remedy="give it in kg"
        )
    x, y, z = _numbers(centre, 3, "--centre")
    xx, xy, xz, yy, yz, zz = _numbers(inertia, 6, "--inertia")
    payload = Payload(mass, (x, y, z), (xx, xy, xz, yy, yz, zz), frame)
    if not payload.possible:
        raise InputError(
            None,
            "no body has this tensor",
            field="--inertia",
            remedy="principal moments are not negative, and none exceeds the sum of the others",
        )
    return payload


def _numbers(text: str, count: int, field: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(
            None, f"{text!r} is not {count} numbers", field=field, remedy="separate them by commas"
        )
    return values


def _as_toml(found: GainsFound) -> str:
    side = "motor side" if found.motor_side else "joint side, gears included"
    lines = [
        f"# N·m/A ({side}), 95 % intervals, weighted least squares",
        "torque_constant = [",
    ]
    # What is not determined has its place in the list; a cell or map refuses it by name.
    lines += [
        f"    {one['torque_constant']:.6g},  # {one['name']} ± {one['half_interval']:.2g}"
        if one["not_determined"] is None
        else f"    nan,  # {one['name']}: not determined; {one['not_determined']}"
        for one in _motors(found)
    ]
    return "\n".join([*lines, "]"])


def _motors(found: GainsFound) -> list[dict[str, Any]]:
    """Name, constant, spread and half of the interval [N·m/A], or why there are none."""
    gains = found.gains
    return [
        {
            "name": name,
            "torque_constant": float(value) if determined else None,
            "std": float(std) if determined else None,
            "half_interval": float(gains.interval_factor * std) if determined else None,
            "not_determined": reason,
        }
        for name, value, std, determined, reason in zip(
            gains.motor_names, gains.values, gains.std, gains.determined, gains.reasons, strict=True
        )
    ]


def _as_json(found: GainsFound) -> dict[str, object]:
    loads = {name: None if load is None else load.mass for name, load in found.loads.items()}
    return {
        "motors": _motors(found),
        "unit": "N·m/A",
        "side": "motor" if found.motor_side else "joint",
        "payload_kg": loads,
    }
