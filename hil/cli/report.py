"""`hil report`: the report of a campaign, made anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.campaign import Campaign
from hil.progress import reporter as make_reporter


def report(
    campaign: Annotated[
        Path, typer.Argument(help="The campaign's folder (`hil design -o`).", show_default=False)
    ],
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the last line.")] = False,
) -> None:
    """Make the report of CAMPAIGN anew and print where it is.

    From the results that are there, without estimating anything; where archives have come since,
    or nothing was identified yet, as `hil identify` does it.
    """
    typer.echo(Campaign.open(campaign).report(reporter=make_reporter(quiet=quiet)))
