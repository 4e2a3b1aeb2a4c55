"""`hil batch`: estimate parameters by arm, campaign and repetition."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

import typer

from hil.base.files import convert_write_errors, make_folder
from hil.base.one_screen import brief
from hil.base.progress import Reporter
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import plural, printable
from hil.batch import graph as run
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster, SkippedArchive
from hil.batch.estimates import BatchEstimate, BatchEstimator, relative_error
from hil.batch.graph import BatchResult
from hil.batch.table import write_tables
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, print_json, with_options
from hil.cli.identify_options import Identifying
from hil.cli.imports import Described, Reading
from hil.fleet.logs import LogMap, LogReading, LogsOfBatch, write_maps
from hil.fleet.naming import Naming
from identification.text import percentage

RobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar="WHERE",
        help="Where robots are named: folder, column=NAME, metadata=KEY, or a path's pattern such "
        "as '{robot}/{date}.csv'. Default: one robot.",
    ),
]
SOME_BROKEN: Final = 5
"""Exit status if some archives could not be used."""

_MOST_LINES: Final = 20


@with_options(Identifying, "how")
@with_options(Described, "arm", but=("friction", "standstill"))
@with_options(Reading, "reading")
def batch(
    places: Annotated[list[str], typer.Argument(metavar="RECORDING")],
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    robot: RobotOption = None,
    estimator: BatchEstimator = "auto",
    workers: Annotated[int | None, typer.Option(min=1)] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS")] = None,
    cache: Annotated[str | None, typer.Option(metavar="FOLDER|none")] = None,
    *,
    arm: Described,
    reading: Reading,
    how: Identifying,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Identify every arm from all recordings below given folders, campaign by campaign.

    Recordings are archives, and with --urdf also logs and bags. One column map describes all logs
    with the same channels: --map, or what is concluded from the first of them as by `hil identify`.
    The factor of each recording is cached, so another run with other estimators or more recordings
    reads only new ones. The cache survives Ctrl-C.

    Exit status: 0 all recordings to be fitted were used, 5 some could not be (each is reported with
    its reason), 2 there is nothing to fit. Archives that are not for fitting, such as moves,
    stopped motions and copies, are skipped and counted by reason.

    **Example:** `hil batch 'line3/robot*/*.csv' --urdf arm.urdf -o line3-tables`

    Options:
        places: Folders with recordings at any depth, files, patterns such as 'robot*/*.csv', or
            URLs of archives.
        output: Folder for the tables (CSV and Parquet). Default: none.
        estimator: Estimator that needs no samples: see `hil identify --estimator`.
        workers: Number of processes. Default: one per core, and none if few archives are read.
        scheduler: Address of a running Dask scheduler, such as tcp://host:8786. Its workers need
            this version of hil and these paths.
        cache: Folder of cached factors, or none. Default: .hil-cache next to the archives, or in
            the user's cache folder if those are read-only.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    if output is not None:
        make_folder(output)
    options = how.options(estimator=estimator)
    naming = Naming.parse(robot)
    if not arm.is_given:
        reading.refuse_without_robot()
    with (
        Cluster(workers, scheduler=scheduler, reporter=reporter) as cluster,
        cache_of(cache, for_logs=arm.is_given) as location,
    ):
        logs = logs_of(arm, reading, naming, location, cluster, reporter)
        result = run.reidentify(
            places, options, cluster, reporter,
            cache=location, importing=logs, place=naming.place,
        )  # fmt: skip
    written = _tables(output, result, logs)
    if json:
        print_json(as_dict(result, written))
    else:
        _print(result, logs, written, quiet=quiet, verbose=verbose)
    if result.broken:
        raise typer.Exit(SOME_BROKEN)


_TAIL: Final = 3  # lines at the end: files, what was skipped, counts


def _print(
    result: BatchResult,
    logs: LogsOfBatch | None,
    written: Sequence[Path],
    *,
    quiet: bool,
    verbose: bool,
) -> None:
    """Print the arms and what was written; what could not be used goes to standard error."""
    lines: list[str] = []
    if not quiet:
        maps = {} if logs is None else logs.maps
        lines = [*map_lines(maps, verbose=verbose), *result_lines(result)]
        if written:
            names = ", ".join(path.name for path in written)
            lines.append(f"written to {written[0].parent}: {names}")
    for line in _last(_broken_lines(result.broken)):
        typer.echo(printable(line), err=True)
    if result.skipped and not quiet:
        lines.append(skipped_line(result.skipped))
    lines.append(_counts(result))
    for line in lines if verbose else brief(lines, last=_TAIL):
        typer.echo(printable(line))


def _counts(result: BatchResult) -> str:
    return (
        f"{plural(len(result.repetitions), 'repetition')} in "
        f"{plural(len(result.campaigns), 'campaign')} of {plural(len(result.arms), 'arm')}; "
        f"{plural(result.read, 'recording')} read, {result.cached} cached, "
        f"{len(result.skipped)} skipped, {len(result.broken)} failed"
    )


@contextmanager
def cache_of(cache: str | None, *, for_logs: bool) -> Iterator[CacheLocation]:
    """Provide the cache of an option; archives of logs need one, which goes with the batch."""
    if cache != "none":
        yield CacheLocation(str(Path(cache).resolve()) if cache else None)
    elif for_logs:
        with TemporaryDirectory(prefix="hil-") as folder:
            yield CacheLocation(folder)
    else:
        yield CacheLocation(keep=False)


def logs_of(
    arm: Described,
    reading: Reading,
    naming: Naming,
    cache: CacheLocation,
    cluster: Cluster,
    reporter: Reporter,
) -> LogsOfBatch | None:
    """Return the import of logs, None without a description of their robot."""
    if not arm.is_given:
        return None
    how = LogReading.of(arm.robot, reading.options, repr(arm), naming.facts)
    return LogsOfBatch(how, cache, cluster, reporter)


def map_lines(maps: Mapping[LogMap, int], *, verbose: bool) -> Iterator[str]:
    """Name the map of each kind of logs; with `verbose` also what it says of the channels."""
    for log_map, count in maps.items():
        source = f"concluded from {log_map.first}" if log_map.first else "given by --map"
        yield f"{plural(count, 'log')} read by the column map {source}"
        if verbose:
            yield from (f"  {meaning}" for meaning in log_map.meanings)


def _tables(folder: Path | None, result: BatchResult, logs: LogsOfBatch | None) -> list[Path]:
    if folder is None:
        return []
    with convert_write_errors(folder):
        written = write_tables(folder, result)
    return [*written, *([] if logs is None else write_maps(folder, logs.maps))]


def result_lines(result: BatchResult) -> Iterator[str]:
    """Format each arm: its campaigns and warnings."""
    for digest, arm in result.arms.items():
        campaigns = [estimate for estimate in result.campaigns if estimate.arm == digest]
        yield f"{arm.name}: {plural(len(campaigns), 'campaign')}"
        yield from _last([_line(estimate) for estimate in campaigns])
        pooled = [estimate for estimate in result.pooled if estimate.arm == digest]
        for warning in dict.fromkeys(text for estimate in pooled for text in estimate.warnings):
            yield f"  note: {warning}"


def _line(campaign: BatchEstimate) -> str:
    """Format a campaign."""
    named = ", ".join(
        text for text in (campaign.campaign, campaign.setup, campaign.when[:10]) if text
    )
    error = relative_error(
        campaign.estimate.noise_std, campaign.torque_rms, campaign.estimate.samples
    )
    unseen = relative_error(campaign.unseen_rms, campaign.unseen_torque_rms)
    held_out = "" if math.isnan(unseen) else f", held out {percentage(unseen, 1)}"
    repetitions = plural(campaign.repetitions, "repetition")
    return f"  {named}: {repetitions}, torque error {percentage(error, 1)}{held_out}"


def _last(lines: Sequence[str]) -> Iterator[str]:
    """Yield the last lines, after the number of the others."""
    if (more := len(lines) - _MOST_LINES) > 0:
        yield f"  {more} more: see --output and --json"
    yield from lines[-_MOST_LINES:]


def _broken_lines(broken: Sequence[SkippedArchive]) -> list[str]:
    return [f"{unused.path} could not be used: {unused.message}" for unused in broken]


def skipped_line(skipped: Sequence[SkippedArchive]) -> str:
    """Count the skipped archives by reason, without the name of another archive in it."""
    others = [
        unused._replace(copy_of="another") if unused.copy_of else unused for unused in skipped
    ]
    counts = Counter(unused.message for unused in others)
    reasons = "; ".join(f"{count} {reason}" for reason, count in counts.most_common())
    return f"skipped, not for fitting: {reasons}"


def as_dict(result: BatchResult, written: Sequence[Path]) -> dict[str, Any]:
    """Return the content of `--json`; campaigns by folder, and by setup if one has several."""
    folders = Counter((estimate.arm, estimate.campaign) for estimate in result.campaigns)
    return {
        "estimator": result.estimator,
        "arms": {
            arm.name: {
                "campaigns": {
                    estimate.campaign
                    + (
                        f" ({estimate.setup})" if folders[digest, estimate.campaign] > 1 else ""
                    ): _level(estimate)
                    for estimate in result.campaigns
                    if estimate.arm == digest
                },
                "pooled": next((_level(o) for o in result.pooled if o.arm == digest), None),
            }
            for digest, arm in result.arms.items()
        },
        "read": result.read,
        "cached": result.cached,
        "broken": [unused.as_json() for unused in result.broken],
        "skipped": [unused.as_json() for unused in result.skipped],
        "written": [str(path) for path in written],
    }


def _level(level: BatchEstimate) -> dict[str, Any]:
    return {
        "when": level.when or None,
        "setup": level.setup,
        "repetitions": level.repetitions,
        "method": level.estimate.method,
        "parameters": {
            name: {"value": float(value), "std": float(std) if math.isfinite(std) else None}
            for name, value, std in zip(
                level.estimate.names, level.estimate.values, level.estimate.std, strict=True
            )
        },
        "warnings": list(level.warnings),
    }
