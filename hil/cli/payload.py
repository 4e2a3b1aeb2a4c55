"""`hil payload`: identify the payload for the settings of a controller."""

from __future__ import annotations

import json as json_module
from pathlib import Path
from typing import Annotated

import typer

from hil.base.exit_status import ExitStatus
from hil.base.one_screen import brief
from hil.base.progress import reporter as make_reporter
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, figures
from hil.cli.identify_options import DelayOption, delay_from
from hil.payload.payload_by_model import weigh_by_model
from hil.payload.payload_messages import (
    outside_lines,
    payload_as_json,
    payload_lines,
    step_lines,
)
from hil.payload.payload_run import find_payload
from hil.pipeline.options import Options


def payload(
    bare: Annotated[list[Path], typer.Argument(metavar="BARE")],
    loaded: list[Path] | None = None,
    model: Annotated[list[Path] | None, typer.Option(metavar="FOLDER")] = None,
    frame: str | None = None,
    check: Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE")] = None,
    delay: DelayOption = None,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Identify the payload: mass, centre of mass and inertia with 95 % intervals.

    Fits the difference between recordings without and with the payload, on one model of the arm.
    With -v prints the values in the form that controllers of COMAU, UR, Franka, KUKA, ABB and FANUC
    expect.
    Exit status 5 if a value of --check lies outside its interval, or if the bare recordings
    certainly contradict the description of the arm, such as another mounting or other zeros.

    **Examples:**

    - `hil payload empty.mcap --loaded full.mcap`
    - `hil payload --model runs/mine full.mcap`: without a bare recording of the motion

    Options:
        bare: Archives (*.mcap) recorded without the payload, or campaign folders; with --model,
            archives recorded with it.
        loaded: Archive recorded with the payload, or campaign folder (repeatable).
        model: Campaign folder, or archive, of the bare arm in any motion (repeatable): the payload
            is the difference from its model; the scale of friction is estimated too.
        frame: URDF link in whose frame the values are given. Default: tool0 or flange if fixed to
            the last joint, else the link of this joint.
        check: Known value, such as mass=4.0 (kg): exit status 5 if it lies outside its 95 %
            interval (repeatable).
    """
    wanted = figures(check or [], "--check", "mass=4.0", bare=False)
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    if model:
        automatic = Options(delay=delay_from(delay))
        weighed = [*bare, *(loaded or [])]
        result = weigh_by_model(model, weighed, reporter, frame=frame, options=automatic)
    else:
        options = Options(estimator="wls", delay=delay_from(delay))
        result = find_payload(bare, loaded or [], reporter, frame=frame, options=options)
    outside = result.outside(wanted)
    if json:
        steps = step_lines(result.next_steps(wanted) if outside else ())
        more = {"checked": wanted, "outside": outside_lines(outside), "next_steps": steps}
        fields = payload_as_json(result) | more
        typer.echo(json_module.dumps(fields, indent=1, ensure_ascii=False))
    else:
        lines = payload_lines(result, wanted, settings=verbose)
        typer.echo("\n".join(lines if verbose else brief(lines)))
    if outside or result.is_doubtful:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)
