"""`hil rollout`: simulate the held-out motion with the identified arm, and compare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from hil.base.errors import InputError
from hil.base.exit_status import ExitStatus
from hil.base.files import make_folder
from hil.base.one_screen import MAX_JOINT_ROWS, SCREEN_LINES, Paragraph, Part, columns, one_screen
from hil.base.progress import reporter as make_reporter
from hil.base.progress import say
from hil.cli.arguments import (
    ArchivesArgument,
    JsonOption,
    QuietOption,
    VerboseOption,
    print_json,
    with_options,
)
from hil.cli.identify_options import EstimatorOption, Identifying, servo_from
from hil.pipeline.options import Options
from hil.pipeline.stored_identification import read_or_identify
from hil.plots.plan_picture import save
from hil.report.chart_picture import draw_charts
from hil.report.output_files import REPORT
from hil.report.rollout_section import overview_charts, overview_legends
from hil.results.rollout_result import ROLLOUT, ArmErrors, RolloutResult, milli
from hil.rollout.servo_rollout import roll_out_servo, without_torque
from hil.rollout.torque_rollout import (
    PICTURE,
    POLISHED,
    Rollout,
    RolloutOptions,
    roll_out,
    write_rollout,
)


@with_options(Identifying, "how")
def rollout(
    archives: ArchivesArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    predict: Annotated[list[Path] | None, typer.Option(metavar="ARCHIVE")] = None,
    samples: Annotated[int, typer.Option(min=3, max=1000)] = 50,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    feedback: Annotated[float, typer.Option(min=0.0, max=20.0, metavar="HZ")] = 1.0,
    servo: Annotated[str | None, typer.Option(metavar="KP,KD,DELAY")] = None,
    polish: bool = False,
    split: Annotated[float, typer.Option(min=0.1, max=0.9)] = 0.7,
    estimator: EstimatorOption = "auto",
    *,
    how: Identifying,
    again: bool = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Simulate held-out motions by MuJoCo (extra `mujoco`) with the identified arm.

    Windows start at measured states; after 0.1, 0.2, 0.5 and 1 s the positions are compared with
    the measured ones, for the identified arm, the nominal one, and arms drawn from the posterior.
    The arm is driven by the recorded torque and weak feedback, or by a servo. Parameters and
    settings come from results.json and parameters.json in a folder, as for `hil export`; its report
    gets a section. Archives without torque are simulated on the servo of the folder's results, or
    on one that is identified with friction and rotors from commanded and measured positions, with
    the masses of the URDF. Writes rollout.json and rollout.png. Exit status 5 if the model is not
    good.

    **Example:** `hil rollout runs/demo`

    Options:
        output: Folder for rollout.json and rollout.png. Default: the campaign folder; none for
            single archives.
        predict: Archive to simulate instead of fit, of any kind (repeatable).
        samples: Arms drawn from the posterior.
        seed: Seed of the random draws.
        feedback: Natural frequency of the feedback that keeps the simulated arm near the measured
            motion; 0 for none.
        servo: A servo in place of the recorded torque: gains in N·m/rad and N·m·s/rad and delay
            in s, or identified from commanded and measured positions.
        polish: Fit friction, rotors, servo and delay to windows of the fitted motion, and write
            polished.xml if the held-out windows are predicted better.
        split: Fraction of the recording that is fitted if there is no validation run; the rest is
            simulated.
        again: Identify again even if results.json and parameters.json are there.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    requested = RolloutOptions(samples, seed, feedback, servo_from(servo), polish)
    options = how.options(split=split, estimator=estimator)
    output = _folder(output, archives)
    as_usual = options == Options() and not again
    if without_torque(archives):
        if servo is not None:
            problem = "cannot be given for recordings without torque, from which it is identified"
            raise InputError(archives[0], problem, field="--servo", remedy="omit it")
        simulated, good = roll_out_servo(archives, predict or (), split, reporter, reuse=as_usual)
    else:
        arm = read_or_identify(archives, options, reporter, reuse=as_usual, predict=predict or ())
        good = arm.good
        simulated = roll_out(arm, requested, reporter)
    files = [] if output is None else _write(output, simulated)
    if json:
        print_json(simulated.result.model_dump(mode="json"))
    else:
        result = simulated.result
        lines = [*result.lines(), *files] if verbose else screen(result, files)
        for line in [result.message] if quiet else lines:
            say(line)
    if not good:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def screen(result: RolloutResult, files: Sequence[str] = ()) -> list[str]:
    """Return one screen: the result, errors of identified and nominal arm side by side, files."""
    arms = [("identified", result.identified), ("nominal", result.nominal)]
    if result.polish is not None:
        arms[1:] = [("polished", result.polish.errors)]
    shown = [(name, arm) for name, arm in arms if arm is not None]
    joints = range(min(MAX_JOINT_ROWS, len(result.joint_names)))
    hidden = len(result.joint_names) - len(joints)
    heads = [text for name, _ in shown for text in (name, *[""] * (len(result.horizons) - 1))]
    lines = columns(
        [
            ["", "", *heads],
            ["", "", *(f"{h:g} s" for _ in shown for h in result.horizons)],
            *(_row(result, joint, shown) for joint in joints),
            [result.tool, "mm", *(milli(at) for _, arm in shown for at in arm.tool)],
        ],
        left=2,
    )
    parts: list[Part] = [
        Paragraph(result.message, most=3, complete=True),
        f"{result.windows} windows; position error of each arm after",
        *lines,
    ]
    if hidden > 0:
        parts.append(f"{hidden} more joints: -v")
    table = [] if result.servo is None else result.servo.table(result.joint_names)
    servo = [] if result.servo is None else result.servo.notes
    warning = f"warning: {result.band_message}" if result.band_message else ""
    remarks = [*servo, *result.stability(), warning, *result.notes]
    written = [Paragraph(file, complete=True) for file in files]
    least = sum(1 if isinstance(part, str) else part.least for part in (*parts, *written))
    spare = SCREEN_LINES - least - 1
    more: list[Part] = [*table, *(Paragraph(text, most=2) for text in remarks if text)]
    return one_screen([*parts, *more[:spare], *written, "arms drawn and driving torques: -v"])


def _row(result: RolloutResult, joint: int, arms: Sequence[tuple[str, ArmErrors]]) -> list[str]:
    """Return name, unit and errors of a joint for each arm at the horizons."""
    unit = "mrad" if result.units[joint] == "rad" else "mm"
    errors = [milli(at[joint]) for _, arm in arms for at in arm.joints]
    return [result.joint_names[joint], unit, *errors]


def _folder(output: Path | None, archives: list[Path]) -> Path | None:
    """Return the folder for the files, which exists then: a campaign's own by default."""
    if len(archives) == 1 and archives[0].is_dir():
        output = output or archives[0]
    if output is not None:
        make_folder(output)
    return output


def _write(output: Path, simulated: Rollout) -> list[str]:
    """Write all files of a rollout, and return what they are."""
    missing = write_rollout(output, simulated)
    columns = [[chart] for chart in overview_charts(simulated.result)]
    legends = overview_legends(simulated.result)
    save(draw_charts(columns, legends, enlarged=1.4), output / PICTURE)
    lines = [f"{output / PICTURE}: the errors over time; {output / ROLLOUT}: all figures"]
    if simulated.polished is not None:
        lines.append(f"{output / POLISHED}: the polished arm, for MuJoCo")
    return [*lines, missing or f"{output / REPORT}: now has a section on the rollout"]
