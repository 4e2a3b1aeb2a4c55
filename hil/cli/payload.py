"""`hil payload`: identify the payload for the settings of a controller."""

from __future__ import annotations

import json as json_module
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.arguments import JsonOption, QuietOption, figures
from hil.cli.identify_options import DelayOption, delay_from
from hil.cli.verdict import NOT_GOOD
from hil.errors import InputError
from hil.files import write_output
from hil.identify.options import Options
from hil.identify.payload_run import PayloadFound, find_payload
from hil.progress import reporter as make_reporter


def payload(
    bare: Annotated[list[Path], typer.Argument(metavar="BARE...")],
    loaded: list[Path] | None = None,
    frame: str | None = None,
    shape: Annotated[
        tuple[str, float, float, float] | None, typer.Option(metavar="box X Y Z")
    ] = None,
    check: Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE")] = None,
    urdf: Path | None = None,
    delay: DelayOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Identify the payload: mass, centre of mass and inertia with 95 % intervals.

    Fits the difference between recordings without and with the payload, on one model of the arm.
    Prints the values in the form that COMAU, UR and Franka controllers expect. Exit status 5 if a
    value of --check lies outside its interval, or no physically possible body fits.

    Options:
        bare: Archives (*.mcap) recorded without the payload, or campaign folders.
        loaded: Archive recorded with it, or campaign folder (repeatable).
        frame: URDF link in whose frame the values are given. Default: tool0 or flange if fixed to
            the last joint, else the link of that joint.
        shape: Edges of a uniform box along the axes of the frame, m. Components that the motion
            does not determine are those of the possible body closest to it. Default: a point mass.
        check: Known value, such as mass=4.0 (kg): exit status 5 if it lies outside its 95 %
            interval (repeatable).
        urdf: File for the payload as a link of a URDF.
    """
    box, wanted = _box(shape), figures(check or [], "--check", "mass=4.0", bare=False)
    reporter = make_reporter(quiet=quiet or json)
    options = Options(estimator="wls", delay=delay_from(delay))
    found = find_payload(bare, loaded or [], reporter, frame=frame, box=box, options=options)
    outside = found.outside(wanted)
    text = json_module.dumps(
        found.as_json() | {"checked": wanted, "outside": outside}, indent=1, ensure_ascii=False
    )
    lines = payload_lines(found, wanted, outside)
    if urdf is not None:
        write_output(urdf, found.urdf)
    typer.echo(text if json else "\n".join(lines))
    if outside or found.estimate.contradicted:
        raise typer.Exit(NOT_GOOD)


def payload_lines(
    found: PayloadFound, wanted: Collection[str] = (), outside: Sequence[str] = ()
) -> list[str]:
    """Format the result and its comparison with known values."""
    lines = [*found.sentences, ""]
    lines += [
        f"{name:5} {value:10.5g}  {low:10.5g} to {high:<10.5g} {unit}"
        for name, value, low, high, unit in found.table
    ]
    for controller, typed in found.controllers.items():
        lines += ["", f"{controller}:", typed]
    lines += ["", *(f"warning: {warning}" for warning in found.warnings)]
    lines += [f"check: {sentence}" for sentence in outside]
    if wanted and not outside:
        lines.append(f"check: {', '.join(wanted)} inside the 95 % interval")
    return lines


def _box(shape: tuple[str, float, float, float] | None) -> tuple[float, float, float] | None:
    if shape is None:
        return None
    kind, x, y, z = shape
    if kind != "box" or not all(math.isfinite(edge) and edge > 0.0 for edge in (x, y, z)):
        problem = f"{kind} {x:g} {y:g} {z:g} is not a shape"
        remedy = "give box and three edges above 0 m, such as box 0.2 0.1 0.1"
        raise InputError(None, problem, field="--shape", remedy=remedy)
    return x, y, z
