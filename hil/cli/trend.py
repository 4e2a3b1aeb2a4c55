"""`hil trend`: show what changes over time in the robots of a fleet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from hil.base.exit_status import ExitStatus
from hil.base.files import convert_write_errors, make_folder, write_into
from hil.base.one_screen import TAIL_LINES, brief
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import plural, printable
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, print_json, with_options
from hil.cli.fleet_options import Fleet, RecordingsArgument, last, map_lines, skipped_line
from hil.cli.identify_options import Identifying
from hil.cli.imports import RARE, Described, Reading
from hil.fleet.conditions import Conditions
from hil.fleet.documents import as_dict
from hil.fleet.estimated import estimated_fleet
from hil.fleet.logs import LogMap
from hil.fleet.messages import notes, sentences, verdict
from hil.fleet.table import is_table, read_table, write_trend
from hil.fleet.trend import FleetTrend, fleet_trend
from hil.fleet.trend_limits import TrendLimit
from hil.fleet.trend_page import trend_page

_MAX_BROKEN_LINES: Final = 8


@with_options(Identifying, "how")
@with_options(Described, "arm", but=("friction", "standstill_speed"))
@with_options(Reading, "reading", rare=RARE)
@with_options(Fleet, "fleet")
def trend(
    places: RecordingsArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE.html")] = None,
    table: Annotated[Path | None, typer.Option(metavar="FILE.csv")] = None,
    limit: Annotated[list[str] | None, typer.Option(metavar="QUANTITY+PER_CENT")] = None,
    covariate: Annotated[list[str] | None, typer.Option(metavar="COLUMN")] = None,
    conditions: Annotated[Path | None, typer.Option(metavar="FILE.csv")] = None,
    fail_on_change: bool = False,
    *,
    fleet: Fleet,
    arm: Described,
    reading: Reading,
    how: Identifying,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Watch a fleet: which robot changes, in which joint, how fast, and since when.

    Reads the same recordings as `hil batch`, and only new ones. Tracks friction (also its Coulomb
    and viscous parts), gravity load, torque scale, and the torque error of the first months' model
    for each robot and joint; corrects for temperature and for changes that all robots share. Exit
    status 0 for any result, unless --fail-on-change is given.

    **Example:** `hil trend logs --urdf arm.urdf --robot '{robot}/{date}.csv' -o trend.html`

    Options:
        places: Folders with recordings at any depth, files, patterns such as 'robot*/*.csv', or
            URLs of archives; or a table of quantities that `hil batch` or `hil trend` wrote.
        output: HTML file for the report. Default: no report.
        table: CSV file with every value of every series. Default: none.
        limit: Change whose date is predicted, such as 'friction +50 %' (repeatable).
        covariate: Column that may explain a change, such as a payload (repeatable). Temperatures
            and the time since the start are found by their names.
        conditions: CSV file of conditions that the logs lack, such as ambient temperature: columns
            when (date), robot (unless the same for all), and numbers.
        fail_on_change: Return exit status 5 if something has changed.
    """
    limits = [TrendLimit.parse(text) for text in limit or []]
    stated = Conditions() if conditions is None else Conditions.load(conditions)
    maps: Mapping[LogMap, int] = {}
    judge = partial(fleet_trend, limits=limits, covariates=(*(covariate or []), *stated.names))
    if len(places) == 1 and is_table(Path(places[0])):
        result = judge(read_table(Path(places[0]), stated))
    else:
        reporter = make_reporter(quiet=quiet or json, messages=verbose)
        with fleet.opened(arm, reading, reporter, covariate or (), (conditions, table)) as work:
            types, sources = estimated_fleet(
                places, how.options(estimator="wls"), work.cluster, reporter,
                cache=work.cache, naming=work.naming, importing=work.logs, conditions=stated,
            )  # fmt: skip
        maps = work.maps
        result = judge(types, sources)
    written = _written(result, output, table)
    if json:
        print_json({**as_dict(result), "written": [str(path) for path in written]})
    else:
        _print(result, maps, written, quiet=quiet, verbose=verbose)
    if fail_on_change and result.changed:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _print(
    result: FleetTrend,
    maps: Mapping[LogMap, int],
    written: Mapping[Path, str],
    *,
    quiet: bool,
    verbose: bool,
) -> None:
    """Print the verdict, the robots and what was written; the rest goes to standard error."""
    lines = [] if quiet else [*map_lines(maps, verbose=verbose), *_lines(result)]
    broken = [f"{each.path} could not be used: {each.message}" for each in result.sources.broken]
    for line in last(broken, _MAX_BROKEN_LINES, "--json"):
        typer.echo(printable(line), err=True)
    if written and not quiet:
        lines += [f"{path}: {use}" for path, use in written.items()]
    if result.sources.skipped and not quiet:
        lines.append(skipped_line(result.sources.skipped))
    lines = [f"{verdict(result)}.", *lines, _counts(result)]
    for line in lines if verbose else brief(lines, last=TAIL_LINES):
        typer.echo(printable(line))


def _lines(result: FleetTrend) -> Iterator[str]:
    yield from sentences(result)
    for note in notes(result):
        yield f"note: {note}"


def _counts(result: FleetTrend) -> str:
    recordings = plural(result.recordings, "recording")
    robots = plural(len(result.robots), "robot")
    skipped, failed = len(result.sources.skipped), len(result.sources.broken)
    return f"{recordings} of {robots}; {skipped} skipped, {failed} failed"


def _written(result: FleetTrend, output: Path | None, table: Path | None) -> dict[Path, str]:
    """Write the requested report and table; return what each is, by path."""
    written = {}
    if output is not None:
        write_into(output.parent, {output.name: trend_page(result)})
        written[output] = "each joint over time, for a browser"
    if table is not None:
        make_folder(table.parent)
        with convert_write_errors(table.parent):
            write_trend(table, result)
        written[table] = "every value of every series"
    return written
