"""`hil trend`: what changes over time in the robots of a fleet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

import typer

from hil.base.files import convert_write_errors, make_folder, write_files
from hil.base.one_screen import brief
from hil.base.progress import reporter as make_reporter
from hil.base.terminal_text import plural, printable
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption, print_json, with_options
from hil.cli.fleet_options import Fleet, RecordingsArgument, last, map_lines
from hil.cli.identify_options import Identifying
from hil.cli.imports import Described, Reading
from hil.fleet.documents import as_dict, write_table
from hil.fleet.messages import notes, robot_sentence, verdict
from hil.fleet.trend import FleetTrend, fleet_trend
from hil.fleet.trend_limits import TrendLimit
from hil.fleet.trend_page import trend_page

CHANGED: Final = 5
"""Exit status with --fail-on-change: something has changed."""
_MOST_BROKEN: Final = 8
_TAIL: Final = 2  # lines at the end: counts and files


@with_options(Identifying, "how")
@with_options(Described, "arm", but=("friction", "standstill"))
@with_options(Reading, "reading")
@with_options(Fleet, "fleet")
def trend(
    places: RecordingsArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE.html")] = None,
    table: Annotated[Path | None, typer.Option(metavar="FILE.csv")] = None,
    limit: Annotated[list[str] | None, typer.Option(metavar="QUANTITY+PER_CENT")] = None,
    covariate: Annotated[list[str] | None, typer.Option(metavar="COLUMN")] = None,
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

    Recordings are those of `hil batch`; only new ones are read. Friction, Coulomb and viscous
    friction, gravity load, torque scale, and the torque error of the model of the first months are
    followed by robot and joint; temperatures in the logs and what moves all robots at once are
    taken into account. Exit status 0 for any result, unless --fail-on-change is given.

    **Example:** `hil trend logs --urdf arm.urdf --robot '{robot}/{date}.csv' -o trend.html`

    Options:
        places: Folders with recordings at any depth, files, patterns such as 'robot*/*.csv', or
            URLs of archives.
        output: HTML file for the report. Default: no report.
        table: CSV file with every value of every series. Default: none.
        limit: Change whose date is foreseen, such as 'friction +50 %' (repeatable).
        covariate: Column that may explain a change, such as minutes since the start (repeatable).
            Temperatures are found by their names.
        fail_on_change: Return exit status 5 if something has changed.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    limits = [TrendLimit.parse(text) for text in limit or []]
    options = how.options(estimator="wls")
    columns = tuple(covariate or [])
    with fleet.opened(arm, reading, reporter, columns=columns) as work:
        result = fleet_trend(
            places, options, work.cluster, reporter,
            cache=work.cache, naming=work.naming, importing=work.logs,
            limits=limits, covariates=columns,
        )  # fmt: skip
    written = _written(result, output, table)
    if json:
        print_json({**as_dict(result), "written": [str(path) for path in written]})
    else:
        lines = [] if quiet else [*map_lines(work.maps, verbose=verbose), *_lines(result)]
        broken = [f"{each.path} could not be used: {each.message}" for each in result.broken]
        for line in last(broken, _MOST_BROKEN, "--json"):
            typer.echo(printable(line), err=True)
        if written and not quiet:
            lines.append(f"written: {', '.join(map(str, written))}")
        lines = [f"{verdict(result)}.", *lines, _counts(result)]
        for line in lines if verbose else brief(lines, last=_TAIL):
            typer.echo(printable(line))
    if fail_on_change and result.changed:
        raise typer.Exit(CHANGED)


def _lines(result: FleetTrend) -> Iterator[str]:
    for robot in result.robots:
        yield robot_sentence(robot, result)
    for note in notes(result):
        yield f"note: {note}"


def _counts(result: FleetTrend) -> str:
    recordings = plural(result.recordings, "recording")
    robots = plural(len(result.robots), "robot")
    return f"{recordings} of {robots}; {len(result.skipped)} skipped, {len(result.broken)} failed"


def _written(result: FleetTrend, output: Path | None, table: Path | None) -> list[Path]:
    """Write the report and the table that were asked for; return their paths."""
    written = []
    if output is not None:
        make_folder(output.parent)
        write_files(output.parent, {output.name: trend_page(result)})
        written.append(output)
    if table is not None:
        make_folder(table.parent)
        with convert_write_errors(table.parent):
            write_table(table, result)
        written.append(table)
    return written
