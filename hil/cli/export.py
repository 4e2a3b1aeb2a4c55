"""`hil export`: write the identified arm for simulators and for the controller of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from hil.base.errors import InputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import brief
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
from hil.export.controller_code import (
    CodeName,
    ExportedCode,
    export_code,
)
from hil.export.drive_files import (
    ExportedDrives,
    WhatToExport,
    export_drives,
    patch_drives,
    write_ranges,
)
from hil.export.model_files import (
    Exported,
    ExportedEnsemble,
    FormatName,
    export_ensemble,
    export_model,
)
from hil.export.servo_files import (
    ExportedServo,
    ServoFormatName,
    export_servo,
)
from hil.pipeline.identified_model import IdentifiedModel
from hil.pipeline.options import Options
from hil.pipeline.stored_identification import read_or_identify
from hil.pipeline.stored_servo import servo_folder
from identification.export.controller.c_source import Precision
from identification.export.simulators import FORMATS

ExportName = Literal[FormatName, CodeName, ServoFormatName]


@with_options(Identifying, "how", but=FEW)
def export(
    archives: ArchivesArgument,
    to: Annotated[ExportName, typer.Option(metavar="FORMAT")],
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    estimator: EstimatorOption = "auto",
    *,
    how: Identifying,
    again: bool = False,
    ranges: bool = False,
    ensemble: Annotated[int | None, typer.Option(min=1, max=10000, metavar="N")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    into: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    precision: Precision = "double",
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the identified arm for a simulator or a controller, and verify the file.

    The physically consistent parameters come from results.json and parameters.json in a folder of
    archives, if they were identified from these. Otherwise, or with an option of the
    identification, the command first identifies, as `hil identify` does. The inverse dynamics of
    the file, by MuJoCo (extra `mujoco`) or pinocchio, must match the model at 1000 random states.
    Effects that the format cannot express are listed with their torque over the recorded motion.
    Code for a controller has every effect; C is compiled, if there is a compiler, and compared with
    pinocchio. Exit status 5 if the model is not good.

    Results of recordings without torque give position servos, which MuJoCo plays back.

    **Example:** `hil export runs/demo --to mjcf`, `hil export runs/demo --to c -o arm.c`

    Options:
        to: Simulator: mjcf, isaaclab, genesis, urdf, sdf, pinocchio; controller: c, st.
        output: File to write; with --ensemble a folder, or an .npz file of all parameters.
            Default: identified.*, arm.c or arm.st in the campaign folder or working directory.
        ranges: Also write NAME.ranges.json for domain randomisation: value and 95 % interval of
            each field of the simulator, and whether data or prior decide.
        ensemble: Write N arms drawn from the posterior, all physically consistent;
            for isaaclab and genesis in NAME.ranges.json.
        seed: Seed of the random draws.
        into: Your own MJCF or URDF: change its friction, armature and servos, in place or as
            --output.
        precision: Of the numbers in code for a controller.
        again: Identify again even if results are there.
    """
    reporter = make_reporter(quiet=quiet or json)
    options = how.options(estimator=estimator)
    what = WhatToExport(output, ranges, ensemble, seed, into).checked(to)
    folder = servo_folder(archives)
    if folder is not None:
        servo, good = export_servo(folder, to, what)
        print_export(servo, json=json, quiet=quiet)
    else:
        reuse = options == Options() and not again
        arm = read_or_identify(archives, options, reporter, reuse=reuse)
        good = arm.good
        print_export(_exported(arm, archives, to, what, precision), json=json, quiet=quiet)
    if not good:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _exported(
    arm: IdentifiedModel,
    archives: Sequence[Path],
    to: ExportName,
    what: WhatToExport,
    precision: Precision,
) -> Exported | ExportedEnsemble | ExportedCode | ExportedDrives:
    """Write an arm with torque."""
    folder = archives[0] if archives[0].is_dir() else Path()
    target = what.output or folder / _default_name(to, ensemble=what.count is not None)
    if to == "c" or to == "st":
        if what.count is not None or what.ranges:
            field = "--ranges" if what.ranges else "--ensemble"
            raise InputError(None, "is for files of simulators", field=field, remedy="leave it out")
        return export_code(arm, target, to, precision)
    if what.into is not None:
        return patch_drives(arm, what.into, what)
    if to == "isaaclab" or to == "genesis":
        return export_drives(arm, target, to, what)
    if what.count is not None:
        exported: Exported | ExportedEnsemble = export_ensemble(
            arm, target, to, what.count, what.seed
        )
    else:
        exported = export_model(arm, target, to)
    if what.ranges:
        say(f"written: {write_ranges(arm, target, to, what)}", err=True)
    return exported


def _default_name(to: ExportName, *, ensemble: bool) -> str:
    """Return the name of the file or folder, in the campaign folder or the working directory."""
    if to == "c" or to == "st":
        return f"arm.{to}"
    if to == "isaaclab" or to == "genesis":
        return f"identified_{to}.py"
    return "identified_ensemble" if ensemble else f"identified{FORMATS[to].suffix}"


def print_export(
    exported: Exported | ExportedEnsemble | ExportedCode | ExportedDrives | ExportedServo,
    *,
    json: bool,
    quiet: bool,
) -> None:
    """Print the summary of written files."""
    if json:
        print_json(exported.to_dict())
        return
    for line in brief(exported.lines()[-1 if quiet else 0 :]):
        say(line)
