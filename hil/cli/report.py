"""`hil report`: the report of a campaign, made anew."""

from __future__ import annotations

from pathlib import Path

import typer

from hil.campaign import Campaign
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption, print_json
from hil.files import make_folder, write_files
from hil.progress import reporter as make_reporter
from hil.results import Results, csv_tables


def report(
    campaign: CampaignArgument,
    csv: Path | None = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Make the report of CAMPAIGN anew and print where it is.

    From the results that are there, without estimating anything; where archives have come since,
    or nothing was identified yet, as `hil identify` does it.

    Options:
        csv: Folder for every table of the results as CSV.
    """
    opened = Campaign.open(campaign)
    page = opened.report(reporter=make_reporter(quiet=quiet or json))
    if csv is not None:
        make_folder(csv)
        write_files(csv, csv_tables(Results.load(opened.folder.results)))
    if not json:
        typer.echo(page)
        return
    verdict = Results.load(opened.folder.results).verdict
    print_json({"report": str(page), "good": verdict.good, "verdict": verdict.line})
