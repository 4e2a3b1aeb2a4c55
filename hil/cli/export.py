"""`hil export`: write the identified arm for simulators and for the controller of an arm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from hil.base.errors import InputError
from hil.base.progress import reporter as make_reporter
from hil.base.progress import say
from hil.cli.arguments import (
    ArchivesArgument,
    JsonOption,
    QuietOption,
    print_json,
    with_options,
)
from hil.cli.identify_options import FEW, EstimatorOption, Identifying
from hil.cli.verdict import NOT_GOOD
from hil.export.controller_code import (
    CodeName,
    ExportedCode,
    default_code_output,
    export_code,
)
from hil.export.model_files import (
    Exported,
    ExportedEnsemble,
    FormatName,
    default_output,
    export_ensemble,
    export_model,
)
from hil.pipeline.identified_model import read_or_identify
from hil.pipeline.options import Options
from identification.export.controller.c_source import Precision

ExportName = Literal[FormatName, CodeName]


@with_options(Identifying, "how", but=FEW)
def export(
    archives: ArchivesArgument,
    to: Annotated[ExportName, typer.Option(metavar="FORMAT")],
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    estimator: EstimatorOption = "auto",
    *,
    how: Identifying,
    again: bool = False,
    ensemble: Annotated[int | None, typer.Option(min=1, max=10000, metavar="N")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    precision: Precision = "double",
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the identified arm for a simulator or a controller, and verify the file.

    The physically consistent parameters are those of results.json and parameters.json in a folder
    of archives, if these are of its archives. Otherwise, or with an option of the identification,
    they are identified as by `hil identify`. Inverse dynamics of the file, by MuJoCo (extra
    `mujoco`) or pinocchio, must equal those of the model at 1000 random states. Effects that the
    format cannot express are listed with their torque over the recorded motion. Code for a
    controller has every effect; C is compiled, where a compiler is found, and compared with
    pinocchio likewise. Exit status 5 if the model is not good.

    **Example:** `hil export runs/demo --to mjcf`, `hil export runs/demo --to c -o arm.c`

    Options:
        to: For a simulator mjcf (MuJoCo), urdf, sdf or pinocchio; for a controller c (C99) or st
            (structured text).
        output: File to write; with --ensemble a folder, or an .npz file of all parameters.
            Default: identified.*, arm.c or arm.st in the campaign folder or working directory.
        ensemble: Write so many arms drawn from the posterior, all of them physically consistent.
        seed: Of the draws.
        precision: Of the numbers in code for a controller.
        again: Identify again even if results.json and parameters.json are there.
    """
    reporter = make_reporter(quiet=quiet or json)
    options = how.options(estimator=estimator)
    as_usual = options == Options() and not again
    arm = read_or_identify(archives, options, reporter, reuse=as_usual)
    exported: Exported | ExportedEnsemble | ExportedCode
    if to == "c" or to == "st":
        if ensemble is not None:
            problem = "is for files of simulators"
            raise InputError(None, problem, field="--ensemble", remedy="leave it out")
        exported = export_code(arm, output or default_code_output(archives, to), to, precision)
    else:
        target = output or default_output(archives, to, ensemble=ensemble is not None)
        exported = (
            export_model(arm, target, to)
            if ensemble is None
            else export_ensemble(arm, target, to, ensemble, seed)
        )
    print_export(exported, json=json, quiet=quiet)
    if not arm.good:
        raise typer.Exit(NOT_GOOD)


def print_export(
    exported: Exported | ExportedEnsemble | ExportedCode, *, json: bool, quiet: bool
) -> None:
    """Print the summary of written files."""
    if json:
        print_json(exported.to_dict())
        return
    for line in exported.lines()[-1 if quiet else 0 :]:
        say(line)
