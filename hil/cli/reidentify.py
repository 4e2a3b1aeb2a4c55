"""`hil reidentify`: from any number of archives to parameters by arm, campaign and repetition."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Final

import typer

from hil.batch import run
from hil.batch.cache import code_digest
from hil.batch.table import write_tables
from hil.batch.types import BatchEstimator, BatchResult
from hil.batch.workers import TIMEOUT, LocalWorkers, Workers
from hil.cli import reidentify_words as words
from hil.cli.identify_options import (
    BandwidthOption,
    DelayOption,
    FrictionOption,
    SmootherOption,
    StandstillOption,
    TorqueBandwidthOption,
    VelocityOption,
    options_from,
)
from hil.compare.trend import Trends, trends
from hil.files import make_folder, writing_to
from hil.progress import Reporter
from hil.progress import reporter as make_reporter
from hil.terminal_text import printable

SOME_BROKEN: Final = 5
"""Exit status: done, but some archives could not be used."""


def reidentify(
    places: Annotated[
        list[str],
        typer.Argument(
            help="Folders with archives anywhere below, archives, or URLs of either.",
            show_default=False,
            metavar="FOLDER...",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder for the tables (CSV, Parquet) and the trend report; none if left out.",
            show_default=False,
        ),
    ] = None,
    estimator: Annotated[
        BatchEstimator,
        typer.Option(help="One of those that need no sample: see `hil identify --estimator`."),
    ] = "auto",
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes; one for each core if left out.", show_default=False),
    ] = None,
    cache: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER|none",
            help="Where factors are cached. If left out: .hil-cache beside the archives, or below "
            "the user's cache folder where those cannot be written to.",
            show_default=False,
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Scheduler of a Dask cluster that does the work, such as tcp://host:8786.",
            show_default=False,
        ),
    ] = None,
    bandwidth: BandwidthOption = "auto",
    velocity: VelocityOption = "auto",
    friction: FrictionOption = "auto",
    standstill: StandstillOption = "auto",
    delay: DelayOption = None,
    smoother: SmootherOption = "spline",
    torque_bandwidth: TorqueBandwidthOption = "auto",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only what matters.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Identify every arm from all archives below some folders, campaign by campaign.

    What an archive contributes is cached, so that a second run, by another estimator or with more
    archives, reads only what is new. Ctrl-C loses nothing of the cache.

    Exit status: 0 every archive that is meant to be fitted was used, 5 some could not be (they are
    reported with the reason), 2 there is nothing to fit. What is not meant to be fitted, such as
    moves, motions that were stopped, and copies, is left alone, and summed up by reason.
    """
    reporter = make_reporter(quiet=quiet or json)
    if output is not None:
        make_folder(output)
    keep = cache != "none"
    plan = run.Plan(
        options_from(
            delay=delay,
            torque_bandwidth=torque_bandwidth,
            smoother=smoother,
            estimator=estimator,
            bandwidth=bandwidth,
            velocity=velocity,
            friction=friction,
            standstill=standstill,
        ),
        cache=Path(cache) if keep and cache is not None else None,
        keep=keep,
    )
    with _workers(dask, workers, places) as hands:
        result = run.reidentify(places, plan, hands, reporter)
    found = trends(result)
    written: list[Path] = []
    if output is not None:
        from hil.report.trend import FILE_NAME, write_trend_report  # matplotlib is slow to import

        page = output / FILE_NAME
        with writing_to(output):
            written = [*write_tables(output, result), page]
            write_trend_report(page, found)
    if json:
        typer.echo(json_module.dumps(words.as_dict(result, found, written)))
    else:
        _say(result, found, written, reporter, quiet=quiet)
    if result.broken:
        raise typer.Exit(SOME_BROKEN)


def _workers(
    address: str | None, count: int | None, places: Sequence[str]
) -> AbstractContextManager[Workers]:
    if address is None:
        return LocalWorkers(count)
    from hil.batch.cluster import DaskWorkers  # an extra

    hands = DaskWorkers(address, identity=code_digest, timeout=TIMEOUT)
    try:
        hands.require_folders([Path(place) for place in places if "://" not in place])
    except BaseException:
        hands.close()
        raise
    return hands


def _say(
    result: BatchResult, found: Trends, written: Sequence[Path], reporter: Reporter, *, quiet: bool
) -> None:
    for line in words.alarm_lines(found) if quiet else words.lines(result, found):
        typer.echo(printable(line))
    if written:
        reporter.say(words.written_line(written))
    for line in words.broken_lines(result.broken):
        typer.echo(printable(line), err=True)
    if result.skipped and not quiet:
        typer.echo(printable(words.skipped_line(result.skipped)))
    typer.echo(printable(words.last_line(result)))
