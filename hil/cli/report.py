"""`hil report`: regenerate the report of a campaign."""

from __future__ import annotations

import typer

from hil.base.progress import reporter as make_reporter
from hil.campaign import Campaign
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption, print_json
from hil.results.results import Results


def report(
    campaign: CampaignArgument,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Regenerate the report of CAMPAIGN and print its path.

    Uses the existing results without a new estimate. If archives were added since, or there are no
    results yet, identifies first as `hil identify` does.
    """
    opened = Campaign.open(campaign)
    page = opened.report(reporter=make_reporter(quiet=quiet or json))
    if not json:
        typer.echo(page)
        return
    verdict = Results.load(opened.folder.results).verdict
    print_json({"report": str(page), "good": verdict.good, "verdict": verdict.line})
