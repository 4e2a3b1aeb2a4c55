"""`hil report`: regenerate the report of a campaign, or of identified recordings."""

from __future__ import annotations

import typer

from hil.archive.campaign_archives import RecordedCampaign
from hil.base.progress import reporter as make_reporter
from hil.campaign import Campaign
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption, print_json
from hil.report.output_files import REPORT, rewrite_report
from hil.report.servo_page import rewrite_servo_report
from hil.results.provenance import RESULTS
from hil.results.results import Results, VerdictResult
from hil.results.servo_result import ServoVerdict, is_servo_result


def report(
    campaign: CampaignArgument,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Regenerate the report of CAMPAIGN and print its path.

    Uses the existing results without a new estimate. If archives were added since, or there are no
    results yet, identifies first as `hil identify` does. The folder of `hil identify LOG` has a
    report as well, which is regenerated from its results.
    """
    page = campaign / REPORT
    verdict: VerdictResult | ServoVerdict
    if is_servo_result(campaign / RESULTS):
        verdict = rewrite_servo_report(campaign).verdict
    elif (campaign / RESULTS).is_file() and not RecordedCampaign(campaign).sealed:
        verdict = rewrite_report(campaign).verdict
    else:
        opened = Campaign.open(campaign)
        page = opened.report(reporter=make_reporter(quiet=quiet or json))
        verdict = Results.load(opened.folder.results).verdict
    if not json:
        typer.echo(page)
        return
    print_json({"report": str(page), "good": verdict.good, "verdict": verdict.line})
