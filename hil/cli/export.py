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
from hil.exporting import FormatName, default_output, export_model
from hil.identify import identify_paths
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
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the identified arm for a simulator, and verify the file by reading it back.

    Identifies from the archives as `hil identify` does, then writes the physically consistent
    parameters. Inverse dynamics of the file, by MuJoCo (extra `mujoco`) or pinocchio, must equal
    those of the model at 1000 random states. Effects that the format cannot express are listed with
    their torque over the recorded motion. Exit status 5 if the model is not good.

    **Example:** `hil export runs/demo --to mjcf`

    Options:
        to: mjcf: MuJoCo XML; urdf: other tools.
        output: File to write. Default: identified.xml or .urdf in the campaign folder or the
            working directory.
    """
    reporter = make_reporter(quiet=quiet or json)
    found = identify_paths(archives, reporter, how.options(estimator=estimator))
    target = output or default_output(archives, to)
    exported = export_model(found, target, to)
    if json:
        print_json(exported.to_dict())
    else:
        for line in exported.lines()[-1 if quiet else 0 :]:
            say(line)
    if not found.verdict.good:
        raise typer.Exit(NOT_GOOD)
