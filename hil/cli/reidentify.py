"""`hil reidentify`: from any number of archives to parameters by arm, campaign and repetition."""

from __future__ import annotations

import json as json_module
import math
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from hil.batch import run
from hil.batch.keys import code_digest
from hil.batch.local import TIMEOUT, LocalWorkers
from hil.batch.table import write_tables
from hil.batch.trend import trends, write_trend
from hil.batch.trend_words import summary
from hil.batch.types import BatchEstimator, BatchResult, Broken, Choices, LevelEstimate
from hil.batch.workers import Workers
from hil.cli.identify import LONGEST_DELAY, bandwidth_from
from hil.files import make_folder
from hil.progress import Reporter
from hil.progress import reporter as make_reporter
from identification.preprocessing import Smoother

SOME_BROKEN: Final = 5
"""Exit status: done, but some archives could not be used."""

_LISTED: Final = 20


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
    ] = "wls",
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes; one for each core if left out.", show_default=False),
    ] = None,
    cache: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER|none",
            help="Where factors are kept. If left out: in .hil-cache beside the archives, or below "
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
    delay: Annotated[
        float | None,
        typer.Option(
            min=-LONGEST_DELAY,
            max=LONGEST_DELAY,
            metavar="SECONDS",
            help="Time by which the torque lags the position; the cell's if left out.",
            show_default=False,
        ),
    ] = None,
    smoother: Annotated[
        Smoother, typer.Option(help="Of the positions; see `hil identify --smoother`.")
    ] = "spline",
    torque_bandwidth: Annotated[
        str,
        typer.Option(
            help='Low-pass in Hz that the torque came through, "none", or "auto": looked for in '
            "imported torques."
        ),
    ] = "auto",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only what matters.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Identify every arm from all archives below some folders, campaign by campaign.

    What an archive contributes is kept, so that a second run, by another estimator or with more
    archives, reads only what is new. Ctrl-C loses nothing that was kept.

    Exit status: 0 all archives were used, 5 some could not be (they are listed with the reason), 2
    there is nothing to fit.
    """
    reporter = make_reporter(quiet=quiet or json)
    if output is not None:
        make_folder(output)
    keep = cache != "none"
    plan = run.Plan(
        estimator=estimator,
        choices=Choices(smoother, delay, bandwidth_from(torque_bandwidth)),
        cache=Path(cache) if keep and cache is not None else None,
        keep=keep,
    )
    with _workers(dask, workers, places) as hands:
        threads = workers or len(os.sched_getaffinity(0))
        result = run.reidentify(places, plan, hands, reporter, threads=threads)
    written = [] if output is None else [*write_tables(output, result), write_trend(output, result)]
    if json:
        typer.echo(json_module.dumps(_as_dict(result, written)))
    else:
        _say(result, written, reporter, quiet=quiet)
    if result.broken:
        raise typer.Exit(SOME_BROKEN)


def _workers(
    address: str | None, count: int | None, places: Sequence[str]
) -> AbstractContextManager[Workers]:
    if address is None:
        return LocalWorkers(count)
    from hil.batch.distributed import DaskWorkers  # an extra

    hands = DaskWorkers(address, identity=code_digest, timeout=TIMEOUT)
    try:
        hands.require_folders([Path(place) for place in places if "://" not in place])
    except BaseException:
        hands.close()
        raise
    return hands


def _say(result: BatchResult, written: Sequence[Path], reporter: Reporter, *, quiet: bool) -> None:
    for line in [] if quiet else _table(result):
        typer.echo(line)
    for path in written:
        reporter.say(f"wrote {path}")
    for arm in () if quiet else trends(result).arms:
        typer.echo(f"{arm.name}: {summary(arm)}")
    for line in _unused("could not be used", result.broken):
        typer.echo(line, err=True)
    typer.echo(
        f"{len(result.repetitions)} repetitions in {len(result.campaigns)} campaigns of "
        f"{len(result.pooled)} arms; {result.read} archives read, {result.cached} known, "
        f"{len(result.skipped)} left alone, {len(result.broken)} broken"
    )


def _table(result: BatchResult) -> list[str]:
    """One line per campaign: how much there is, and how well it is explained."""
    lines = [f"{'campaign':<40} {'repetitions':>11} {'torque error':>13} {'unseen':>8}"]
    for digest, arm in result.arms.items():
        lines.append(arm.name)
        for one in result.campaigns:
            if one.arm == digest:
                name = one.campaign if len(one.campaign) <= 38 else "…" + one.campaign[-37:]
                left, unseen = _relative(one)
                lines.append(f"  {name:<38} {one.repetitions:>11} {left:>13} {unseen:>8}")
        lines += [
            f"  {doubt}" for one in result.pooled if one.arm == digest for doubt in one.doubts
        ]
    return lines


def _relative(one: LevelEstimate) -> tuple[str, str]:
    """Torque error over torque, all joints: of what was fitted, and of what was predicted."""
    weights = one.samples / max(1, one.samples.sum())

    def share(error: Any, torque: Any) -> str:
        whole = float((weights * torque**2).sum())
        found = math.sqrt(float((weights * error**2).sum()) / whole) if whole > 0.0 else math.nan
        return "-" if math.isnan(found) else f"{found:.1%}"

    return share(one.noise_std, one.torque_rms), share(one.unseen_rms, one.unseen_torque_rms)


def _unused(words: str, listed: Sequence[Broken]) -> list[str]:
    lines = [f"{one.path} {words}: {one.reason}" for one in listed[:_LISTED]]
    if len(listed) > _LISTED:
        lines.append(f"and {len(listed) - _LISTED} more, listed with --output and --json")
    return lines


def _as_dict(result: BatchResult, written: Sequence[Path]) -> dict[str, Any]:
    return {
        "estimator": result.estimator,
        "arms": {
            arm.name: {
                "campaigns": {
                    one.campaign: _level(one) for one in result.campaigns if one.arm == digest
                },
                "pooled": next((_level(o) for o in result.pooled if o.arm == digest), None),
            }
            for digest, arm in result.arms.items()
        },
        "read": result.read,
        "cached": result.cached,
        "broken": [one._asdict() for one in result.broken],
        "skipped": [one._asdict() for one in result.skipped],
        "written": [str(path) for path in written],
    }


def _level(one: LevelEstimate) -> dict[str, Any]:
    return {
        "repetitions": one.repetitions,
        "method": one.method,
        "parameters": {
            name: {"value": float(value), "std": float(std) if math.isfinite(std) else None}
            for name, value, std in zip(one.names, one.values, one.std, strict=True)
        },
        "doubts": list(one.doubts),
    }
