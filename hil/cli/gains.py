"""`hil gains`: torque constants from recordings with a known payload."""

from __future__ import annotations

import json as json_module
import math
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.arguments import JsonOption, QuietOption
from hil.cli.identify_options import LONGEST_DELAY
from hil.cli.verdict import NOT_GOOD
from hil.errors import InputError
from hil.identify.gain_run import GainsFound, find_gains
from hil.progress import reporter as make_reporter
from identification.estimators.gains import GainMethod
from identification.model.payload import Payload


def gains(
    archives: Annotated[list[Path], typer.Argument(metavar="ARCHIVE...")],
    loaded: list[Path] | None = None,
    mass: float | None = None,
    centre: str = "0,0,0",
    inertia: str = "0,0,0,0,0,0",
    frame: str | None = None,
    method: str = "weighted",
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
        method: weighted or total (least squares with errors in the currents).
        delay: Time in s by which currents lag positions; the cell's if left out.
    """
    methods: dict[str, GainMethod] = {"weighted": "weighted", "total": "total"}
    if method not in methods:
        raise InputError(
            None, f"{method!r} is unknown", field="--method", remedy=f"use {', '.join(methods)}"
        )
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
        method=methods[method],
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
    gains, side = found.gains, "motor side" if found.motor_side else "joint side, gears included"
    lines = [
        f"# N·m/A ({side}), 95 % intervals, {gains.method} least squares",
        "torque_constant = [",
    ]
    for motor, name in enumerate(gains.motor_names):
        reason = gains.reasons[motor]
        if reason is None:
            half = gains.interval_factor * gains.std[motor]
            lines.append(f"    {gains.values[motor]:.6g},  # {name} ± {half:.2g}")
        else:
            # Keeps its place in the list; a cell or map that it is pasted into refuses it by name.
            lines.append(f"    nan,  # {name}: not determined; {reason}")
    return "\n".join([*lines, "]"])


def _as_json(found: GainsFound) -> dict[str, object]:
    gains = found.gains
    return {
        "motors": [
            {
                "name": name,
                "torque_constant": float(gains.values[m]) if gains.determined[m] else None,
                "std": float(gains.std[m]) if gains.determined[m] else None,
                "half_interval": (
                    float(gains.interval_factor * gains.std[m]) if gains.determined[m] else None
                ),
                "not_determined": gains.reasons[m],
            }
            for m, name in enumerate(gains.motor_names)
        ],
        "unit": "N·m/A",
        "side": "motor" if found.motor_side else "joint",
        "method": gains.method,
        "payload_kg": {
            name: None if load is None else load.mass for name, load in found.loads.items()
        },
    }
