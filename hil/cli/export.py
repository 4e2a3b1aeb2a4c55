"""`hil export`: write the identified arm for MuJoCo and other simulators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.arguments import (
    ArchivesArgument,
    JsonOption,
    QuietOption,
    print_json,
    with_options,
)
from hil.cli.identify_options import FEW, EstimatorOption, Identifying
from hil.cli.verdict import NOT_GOOD
from hil.exporting import FormatName, default_output, export_model, model_for_export
from hil.identify import Options
from hil.progress import reporter as make_reporter
from hil.progress import say


@with_options(Identifying, "how", but=FEW)
def export(
    archives: ArchivesArgument,
    to: Annotated[FormatName, typer.Option()],
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    estimator: EstimatorOption = "auto",
    *,
    how: Identifying,
    again: bool = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the identified arm for a simulator, and verify the file by reading it back.

    The physically consistent parameters are those of results.json and parameters.json in a folder
    of archives, if these are of its archives. Otherwise, or with an option of the identification,
    they are identified as by `hil identify`. Inverse dynamics of the file, by MuJoCo (extra
    `mujoco`) or pinocchio, must equal those of the model at 1000 random states. Effects that the
    format cannot express are listed with their torque over the recorded motion. Exit status 5 if
    the model is not good.

    **Example:** `hil export runs/demo --to mjcf`

    Options:
        to: mjcf: MuJoCo XML; urdf: other tools.
        output: File to write. Default: identified.xml or .urdf in the campaign folder or the
            working directory.
        again: Identify again even if results.json and parameters.json are there.
    """
    reporter = make_reporter(quiet=quiet or json)
    options = how.options(estimator=estimator)
    as_usual = options == Options() and not again
    found = model_for_export(archives, options, reporter, reuse=as_usual)
    target = output or default_output(archives, to)
    exported = export_model(found, target, to)
    if json:
        print_json(exported.to_dict())
    else:
        for line in exported.lines()[-1 if quiet else 0 :]:
            say(line)
    if not found.good:
        raise typer.Exit(NOT_GOOD)
