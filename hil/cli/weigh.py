"""`hil run --payload`: weigh a payload by a campaign."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final, Literal

import typer
from rich.console import Console

from hil.base.errors import InputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import brief
from hil.base.progress import reporter as make_reporter
from hil.campaign import Campaign, stop_on_interrupt
from hil.campaign.campaign_run import RunResult
from hil.campaign.folder import PAYLOAD_RESULT
from hil.campaign.operator_keys import can_read
from hil.campaign.screen import confirmed
from hil.cli.arguments import PAYLOAD, numbers, print_json
from hil.precision.requirements import Requirement
from hil.weighing.messages import weighed_as_json, weighed_lines
from hil.weighing.payload_campaign import (
    DEFAULT_CENTRE,
    Execute,
    PayloadCampaign,
    PayloadMounting,
    assumed_payload,
)
from identification.model.known_payload import Payload

_ANSWER: Final = "Type yes when the arm may move; anything else ends the run: "


@dataclass(frozen=True)
class WeighingOptions:
    """Options of a payload campaign; see `hil.cli.arguments.with_options`."""

    payload: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Weigh a payload with the motion of CAMPAIGN: two pairs of recordings, and with "
            "--precision as many as it takes. They go into payload/NAME.",
            rich_help_panel=PAYLOAD,
        ),
    ] = None
    payload_mass: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            metavar="KG",
            help="Largest expected mass: motion, rehearsal and dry run are checked with "
            "it. Needed for the first run with a payload.",
            rich_help_panel=PAYLOAD,
        ),
    ] = None
    payload_centre: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Its expected centre of mass, m in the frame of the flange. Default: "
            f"{','.join(f'{part:g}' for part in DEFAULT_CENTRE)}.",
            rich_help_panel=PAYLOAD,
        ),
    ] = None
    mounted: Annotated[
        Literal["yes", "no"] | None,
        typer.Option(
            metavar="yes|no",
            help="Without a terminal: confirm that the payload is mounted now, or not. The run "
            "stops where that has to change.",
            rich_help_panel=PAYLOAD,
        ),
    ] = None

    def check(self, *, no_identify: bool) -> None:
        """Raise InputError for options that do not go with a payload, or only with one."""
        if self.payload is not None:
            if no_identify:
                problem = "--no-identify and --payload together"
                raise InputError(None, problem, remedy="leave one of them out")
            return
        for field in fields(self):
            if getattr(self, field.name) is not None:
                option = "--" + field.name.replace("_", "-")
                remedy = "add --payload NAME"
                raise InputError(None, "needs a payload", field=option, remedy=remedy)

    def assumed(self, campaign: Campaign) -> Payload | None:
        """Return the payload that is expected; None if it is not stated again."""
        if self.payload_mass is None:
            if self.payload_centre is not None:
                problem = "needs the mass, too"
                remedy = "add --payload-mass KG"
                raise InputError(None, problem, field="--payload-centre", remedy=remedy)
            return None
        return assumed_payload(campaign.cell, self.payload_mass, centre_from(self.payload_centre))


def centre_from(text: str | None) -> tuple[float, float, float]:
    """Return a payload's centre from `--payload-centre`, else `DEFAULT_CENTRE` (InputError)."""
    if text is None:
        return DEFAULT_CENTRE
    x, y, z = numbers(text, 3, "--payload-centre")
    return x, y, z


def weigh(
    campaign: Campaign,
    weighing: WeighingOptions,
    execute: Execute,
    choices: Mapping[str, Any],
    requirements: Sequence[Requirement],
    *,
    rehearse: bool,
    quiet: bool,
    verbose: bool,
    json: bool,
) -> RunResult | None:
    """Run a payload campaign and print what it found; return the result of a dry run alone.

    `choices` are passed to `Campaign.run` for both sides.
    """
    silent = quiet or json
    asks = can_read(sys.stdin) and not silent
    if asks and weighing.mounted is not None:
        problem = "is for runs without a terminal; here the operator is asked"
        raise InputError(None, problem, field="--mounted", remedy="leave it out")
    reporter = make_reporter(quiet=silent)
    weighed = PayloadCampaign.of(campaign, weighing.payload or "", weighing.assumed(campaign))
    if rehearse:
        with stop_on_interrupt() as stop:
            weighed.rehearse(reporter, stop)

    def ask(demand: str) -> bool:
        with stop_on_interrupt() as stop:
            return confirmed(Console(), f"{demand} {_ANSWER}", "yes", stop)

    mounting = PayloadMounting(
        weighed,
        reporter,
        ask=ask if asks else None,
        mounted={"yes": True, "no": False, None: None}[weighing.mounted],
    )
    if choices["dry_run_only"]:
        return weighed.dry_run(execute, mounting, choices)
    result = weighed.run(execute, mounting, reporter, requirements=requirements, choices=choices)
    if json:
        print_json(weighed_as_json(result))
    else:
        file = f"{weighed.root / PAYLOAD_RESULT}: all figures, for programs"
        lines = [*weighed_lines(result, settings=verbose), file]
        typer.echo("\n".join(lines if verbose else brief(lines)))
    if result.payload.is_doubtful:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)
    return None
