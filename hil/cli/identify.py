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
from hil.identify.options import ESTIMATORS, FRICTION_TERMS, Estimator, friction_from
from hil.outcome import write_outcome
from hil.progress import reporter as make_reporter
from hil.reading import lies_there
from identification.preprocessing import Smoother

LONGEST_DELAY = 0.5
"""s; what lags by more belongs to another recording."""


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
            "--output",
            "-o",
            help="Folder for results.json, report.html and the files for other tools. If left "
            "out: the campaign folder (with --paper its folder paper), or none for loose archives.",
            show_default=False,
        ),
    ] = None,
    predict: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="ARCHIVE",
            help="Archive that is predicted and never fitted, whatever its kind. May be repeated.",
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
    in_sample: Annotated[
        bool,
        typer.Option(
            "--in-sample",
            help="Fit everything and hold nothing out: all errors are in-sample, which no verdict "
            "can call good.",
        ),
    ] = False,
    estimator: Annotated[
        Estimator,
        typer.Option(
            help="; ".join(f"{name}: {words}" for name, words in ESTIMATORS.items()) + "."
        ),
    ] = "auto",
    bandwidth: Annotated[
        str,
        typer.Option(
            metavar="HZ|auto",
            help="Widest bandwidth of the smoothed positions; auto: the one with which parts of "
            "the fitted recordings are best predicted from the rest.",
        ),
    ] = "auto",
    velocity: Annotated[
        Literal["auto", "position", "measured"],
        typer.Option(help="Slope of the smoothed positions, or the measured velocity, if any."),
    ] = "auto",
    friction: Annotated[
        str,
        typer.Option(
            metavar="TERMS|auto",
            help=f"Friction law, whatever the archive says: some of {FRICTION_TERMS}, with commas "
            "between them. auto: the archive's, with what predicts best at reversals (and, of "
            "imported recordings, at speed).",
        ),
    ] = "auto",
    standstill: Annotated[
        Literal["auto", "rests", "slow", "none"],
        typer.Option(
            help="Rows that are not fitted: rests longer than 0.25 s; all slow rows and those near "
            "a velocity reversal; or none. auto: slow with a friction that jumps at a reversal, "
            "rests otherwise."
        ),
    ] = "auto",
    delay: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS|auto",
            help="Time by which the torque lags the position; the cell's if left out. auto: looked "
            "for axis by axis, reported and compensated.",
            show_default=False,
        ),
    ] = None,
    smoother: Annotated[
        Smoother,
        typer.Option(
            help="spline: a smoothing spline as close as the measured noise allows; butterworth: a "
            "low-pass without phase."
        ),
    ] = "spline",
    torque_bandwidth: Annotated[
        str,
        typer.Option(
            help="Bandwidth in Hz of a low-pass the torque came through before it was recorded; "
            'the model is then filtered alike. "none", or "auto": looked for in imported torques.',
        ),
    ] = "auto",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the verdict.")] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the verdict and key figures as JSON.")
    ] = False,
) -> None:
    """Estimate the dynamic parameters from archives, and say whether the result is good.

    Excitations and imported recordings are fitted; validation runs are predicted and never
    fitted. Everything needed (URDF, friction law, drive train) travels inside the archives.
    Exit status 0 if the model is good, 5 if it is not.
    """
    reporter = make_reporter(quiet=quiet or json)
    options = Options(
        method="paper" if paper else "default",
        split=split,
        delay=_delay(delay),
        torque_bandwidth=bandwidth_from(torque_bandwidth),
        smoother=smoother,
        estimator=estimator,
        bandwidth=_bandwidth(bandwidth),
        velocity=velocity,
        friction="auto" if friction == "auto" else friction_from(friction),
        standstill=standstill,
        in_sample=in_sample,
    )
    unseen = predict or ()
    if len(archives) == 1 and archives[0].is_dir():
        output = output or (archives[0] / "paper" if paper else archives[0])
        make_folder(output)
        loose = sorted(archives[0].glob("*.mcap"))
        if not loose and not lies_there(archives[0] / "manifest.json"):
            raise InputError(
                archives[0],
                "holds neither a campaign nor archives",
                remedy="name the folder of a campaign (`hil design -o`), or archives (*.mcap)",
            )
        if loose and not lies_there(archives[0] / "manifest.json"):
            # A folder of `hil record`.
            found = identify_archives(loose, reporter, options, predict=unseen)
        else:
            found = identify_campaign(archives[0], reporter, options, predict=unseen)
    else:
        folder = next((path for path in archives if path.is_dir()), None)
        if folder is not None:
            raise InputError(
                folder, "is a folder among archives", remedy="name one campaign folder, or files"
            )
        if output is not None:
            make_folder(output)
        found = identify_archives(archives, reporter, options, predict=unseen)
    results = found.results
    if output is not None:
        results = write_outcome(output, found, reporter)
    finish(results, json=json, quiet=quiet)


def _delay(text: str | None) -> float | Literal["auto"] | None:
    if text is None:
        return None
    if text == "auto":
        return "auto"
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= LONGEST_DELAY:
        raise InputError(
            None,
            f"{text!r} is no delay",
            field="--delay",
            remedy=f"give seconds between {-LONGEST_DELAY:g} and {LONGEST_DELAY:g}, or auto",
        )
    return value


def _bandwidth(text: str) -> float | Literal["auto"]:
    found = None if text == "none" else bandwidth_from(text, "--bandwidth")
    if found is None:
        raise InputError(
            None,
            "the positions have to be smoothed",
            field="--bandwidth",
            remedy='give a frequency above 0 Hz, or "auto"',
        )
    return found


def bandwidth_from(text: str, option: str = "--torque-bandwidth") -> float | Literal["auto"] | None:
    """Bandwidth in Hz as the option says it.

    Raises:
        InputError: it is none.
    """
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
            field=option,
            remedy='give a frequency above 0 Hz, "none" or "auto"',
        )
    return value
