"""`hil report`: the report of a campaign, made anew."""

from __future__ import annotations

import json as json_format

import typer

from hil.campaign import Campaign
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption
from hil.progress import reporter as make_reporter
from hil.results import Results


def report(
    campaign: CampaignArgument,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Make the report of CAMPAIGN anew and print where it is.

    From the results that are there, without estimating anything; where archives have come since,
    or nothing was identified yet, as `hil identify` does it.
    """
    opened = Campaign.open(campaign)
    page = opened.report(reporter=make_reporter(quiet=quiet or json))
    if not json:
        typer.echo(page)
        return
    verdict = Results.load(opened.folder.results).verdict
    document = {"report": str(page), "good": verdict.good, "verdict": verdict.line}
    typer.echo(json_format.dumps(document))
