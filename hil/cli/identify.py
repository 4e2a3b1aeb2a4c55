"""`hil identify`: from archives to a model, a verdict and a report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from hil.cli.verdict import finish
from hil.errors import InputError
from hil.files import make_folder
from hil.identify import Options, identify_archives, identify_campaign
from hil.progress import reporter as make_reporter
from hil.report import write_report


def identify(
    archives: Annotated[
        list[Path],
        typer.Argument(
            help="Archives (*.mcap), or one campaign folder.",
            show_default=False,
            metavar="ARCHIVE...",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            help="Folder for results.json and report.html. If left out: the campaign folder (with "
            "--paper its folder paper), or none for loose archives.",
            show_default=False,
        ),
    ] = None,
    paper: Annotated[
        bool,
        typer.Option(
            "--paper",
            help="As the paper does it: smooth positions and torques, filter the regressor alike.",
        ),
    ] = False,
    split: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=0.9,
            help="Where there is no validation run: share of the recording that is fitted; the "
            "rest is predicted.",
        ),
    ] = 0.7,
    delay: Annotated[
        float | None,
        typer.Option(
            min=-0.5,
            max=0.5,
            help="Time in s by which the torque lags the position; the cell's if left out.",
        ),
    ] = None,
    torque_bandwidth: Annotated[
        str,
        typer.Option(
            help="Bandwidth in Hz of a low-pass the torque came through before it was recorded; "
            'the model is then filtered alike. "none", or "auto": looked for in imported torques.',
        ),
    ] = "auto",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the verdict.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
) -> None:
    """Estimate the dynamic parameters from archives, and say whether the result is good.

    Excitations and imported recordings are fitted; validation runs are predicted and never
    fitted. Everything needed (URDF, friction law, drive train) travels inside the archives.
    Exit status 0 if the model is good, 5 if it is not.
    """
    reporter = make_reporter(quiet=quiet or json)
    if delay is not None and not math.isfinite(delay):
        raise InputError(None, f"{delay} is no time", field="--delay", remedy="give seconds")
    options = Options(
        method="paper" if paper else "default",
        split=split,
        delay=delay,
        torque_bandwidth=_bandwidth(torque_bandwidth),
    )
    if len(archives) == 1 and archives[0].is_dir():
        output = output or (archives[0] / "paper" if paper else archives[0])
        make_folder(output)
        loose = sorted(archives[0].glob("*.mcap"))
        if loose and not (archives[0] / "manifest.json").exists():
            found = identify_archives(loose, reporter, options)  # a folder of `hil record`
        else:
            found = identify_campaign(archives[0], reporter, options)
    else:
        folder = next((path for path in archives if path.is_dir()), None)
        if folder is not None:
            raise InputError(
                folder, "is a folder among archives", remedy="name one campaign folder, or files"
            )
        if output is not None:
            make_folder(output)
        found = identify_archives(archives, reporter, options)
    if output is not None:
        found.results.save(output / "results.json")
        write_report(output / "report.html", found.results, found.series)
        reporter.say(f"report: {output / 'report.html'}")
    finish(found.results, json=json)


def _bandwidth(text: str) -> float | Literal["auto"] | None:
    if text == "auto":
        return "auto"
    if text == "none":
        return None
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise InputError(
            None,
            f"{text!r} is no bandwidth",
            field="--torque-bandwidth",
            remedy='give a frequency above 0 Hz, "none" or "auto"',
        )
    return value
