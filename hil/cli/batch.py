"""`hil batch`: estimate parameters by arm, campaign and repetition."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from hil.base.exit_status import ExitStatus
from hil.base.files import convert_write_errors, make_folder
from hil.base.one_screen import TAIL_LINES, brief
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import plural, printable, typed
from hil.batch import graph as run
from hil.batch.cluster import SkippedArchive
from hil.batch.estimates import BatchEstimate, BatchEstimator, relative_error
from hil.batch.graph import BatchResult
from hil.batch.messages import batch_lines, setup_words
from hil.batch.table import write_tables
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, print_json, with_options
from hil.cli.fleet_options import Fleet, RecordingsArgument, last, map_lines, skipped_line
from hil.cli.identify_options import Identifying
from hil.cli.imports import RARE, Described, Reading
from hil.fleet.logs import LogMap, write_maps
from hil.fleet.table import NAME, write_batch
from identification.factor.messages import method_words
from identification.text import percentage

_MAX_LINES: Final = 20


@with_options(Identifying, "how")
@with_options(Described, "arm", but=("friction", "standstill_speed"))
@with_options(Reading, "reading", rare=RARE)
@with_options(Fleet, "fleet")
def batch(
    places: RecordingsArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    estimator: BatchEstimator = "auto",
    *,
    fleet: Fleet,
    arm: Described,
    reading: Reading,
    how: Identifying,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Identify every arm from all recordings in the given folders, campaign by campaign.

    Recordings are archives, and with --urdf also logs and bags. One column map describes all logs
    with the same channels: --map, or one inferred from the first of them, as by `hil identify`.
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
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    if output is not None:
        make_folder(output)
    options = how.options(estimator=estimator)
    with fleet.opened(arm, reading, reporter) as work:
        result = run.reidentify(
            places, options, work.cluster, reporter,
            cache=work.cache, importing=work.logs, place=work.naming.place,
        )  # fmt: skip
    written = _tables(output, result, work.maps)
    if json:
        print_json(as_dict(result, written))
    else:
        _print(result, work.maps, written, quiet=quiet, verbose=verbose)
    if result.broken:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _print(
    result: BatchResult,
    maps: Mapping[LogMap, int],
    written: Sequence[Path],
    *,
    quiet: bool,
    verbose: bool,
) -> None:
    """Print the arms and what was written; what could not be used goes to standard error."""
    lines: list[str] = []
    if not quiet:
        lines = [*map_lines(maps, verbose=verbose), *result_lines(result)]
        if written:
            lines.append(_files(written))
    for line in last(_broken_lines(result.broken), _MAX_LINES, "--output and --json"):
        typer.echo(printable(line), err=True)
    if result.skipped and not quiet:
        lines.append(skipped_line(result.skipped))
    lines.append(_counts(result))
    for line in lines if verbose else brief(lines, last=TAIL_LINES):
        typer.echo(printable(line))


def _files(written: Sequence[Path]) -> str:
    """Return the tables that were written, and what they are for."""
    folder = written[0].parent
    names = [path.name for path in written if path.suffix != ".parquet"]
    text = f"{folder}: {', '.join(names)}; the tables as .parquet, too"
    quantities = next((path for path in written if path.stem == NAME), None)
    return text if quantities is None else f"{text}. Over time: hil trend {typed(quantities)}"


def _counts(result: BatchResult) -> str:
    return (
        f"{plural(len(result.repetitions), 'repetition')} in "
        f"{plural(len(result.campaigns), 'campaign')} of {plural(len(result.arms), 'arm')}; "
        f"{plural(result.read, 'recording')} read, {result.cached} cached, "
        f"{len(result.skipped)} skipped, {len(result.broken)} failed"
    )


def _tables(folder: Path | None, result: BatchResult, maps: Mapping[LogMap, int]) -> list[Path]:
    if folder is None:
        return []
    with convert_write_errors(folder):
        tables = [*write_tables(folder, result), *write_batch(folder, result)]
        return [*tables, *write_maps(folder, maps)]


def result_lines(result: BatchResult) -> Iterator[str]:
    """Format each arm: its campaigns and warnings."""
    for digest, arm in result.arms.items():
        campaigns = [estimate for estimate in result.campaigns if estimate.arm == digest]
        yield f"{arm.name}: {plural(len(campaigns), 'campaign')}"
        yield from last(
            [_line(estimate) for estimate in campaigns], _MAX_LINES, "--output and --json"
        )
        pooled = [estimate for estimate in result.pooled if estimate.arm == digest]
        notes = dict.fromkeys(note for estimate in pooled for note in estimate.warnings)
        yield from (f"  note: {line}" for line in batch_lines(notes))


def _line(campaign: BatchEstimate) -> str:
    """Format a campaign."""
    named = ", ".join(
        text
        for text in (campaign.campaign, setup_words(campaign.setup), campaign.when[:10])
        if text
    )
    error = relative_error(
        campaign.estimate.noise_std, campaign.torque_rms, campaign.estimate.samples
    )
    unseen = relative_error(campaign.unseen_rms, campaign.unseen_torque_rms)
    held_out = "" if math.isnan(unseen) else f", held out {percentage(unseen, 1)}"
    repetitions = plural(campaign.repetitions, "repetition")
    return f"  {named}: {repetitions}, torque error {percentage(error, 1)}{held_out}"


def _broken_lines(broken: Sequence[SkippedArchive]) -> list[str]:
    return [f"{unused.path} could not be used: {unused.message}" for unused in broken]


def as_dict(result: BatchResult, written: Sequence[Path]) -> dict[str, Any]:
    """Return the content of `--json`; campaigns by folder, and by setup if one has several."""
    folders = Counter((estimate.arm, estimate.campaign) for estimate in result.campaigns)
    return {
        "estimator": result.estimator,
        "arms": {
            arm.name: {
                "campaigns": {
                    (
                        f"{estimate.campaign} ({setup_words(estimate.setup)})"
                        if folders[digest, estimate.campaign] > 1
                        else estimate.campaign
                    ): _level(estimate)
                    for estimate in result.campaigns
                    if estimate.arm == digest
                },
                "pooled": next((_level(o) for o in result.pooled if o.arm == digest), None),
                "siblings": next((_level(o) for o in result.siblings if o.arm == digest), None),
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
        "setup": setup_words(level.setup),
        "repetitions": level.repetitions,
        "method": method_words(level.estimate.method),
        "parameters": {
            name: {"value": float(value), "std": float(std) if math.isfinite(std) else None}
            for name, value, std in zip(
                level.estimate.names, level.estimate.values, level.estimate.std, strict=True
            )
        },
        "warnings": batch_lines(level.warnings),
    }
