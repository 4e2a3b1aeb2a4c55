"""`hil rehearse`: exactly this plan on the simulated twin of the cell."""

from __future__ import annotations

from typing import Annotated

import typer

from hil.campaign import Campaign, stop_on_interrupt
from hil.campaign.rehearsal import Rehearsal
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption
from hil.progress import reporter as make_reporter
from hil.progress import say

from .verdict import NOT_GOOD


def rehearse(
    campaign: CampaignArgument,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    again: bool = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Run exactly the plan of CAMPAIGN on a simulated arm, and judge it. Nothing moves.

    The arm is like the cell's, but its masses, inertias, rotors and friction lie up to 10 % from
    the nominal figures, its currents are noisy, and its link loses a packet now and then. The
    plan passes if what was planted is found again, unseen motion is predicted down to the noise,
    no motion is refused and no motor comes near its limit; then everything is run once more with
    ripple, drift, elasticity and delay. `hil run` demands a rehearsal of exactly this cell, URDF
    and plan. It takes one or two minutes; Ctrl-C stops it, and the same command goes on.

    Exit status 0 if it passed, 5 if not.

    Options:
        seed: Of what is planted in the simulated arm, its noise and its link's faults; 1 if left
            out.
        again: Rehearse once more, even if it passed.
    """
    reporter = make_reporter(quiet=quiet or json)
    with stop_on_interrupt() as stop:
        found = Campaign.open(campaign).rehearse(
            reporter=reporter, seed=seed, stop=stop, again=again
        )
    if json:
        typer.echo(found.model_dump_json())
    else:
        for line in [] if quiet else _lines(found):
            say(line)
        say(found.line)
    if not found.passed:
        raise typer.Exit(NOT_GOOD)


def _lines(found: Rehearsal) -> list[str]:
    criteria = [f"{'ok' if one.passed else 'FAILED'}: {one.sentence}" for one in found.criteria]
    return [*criteria, *(f"not seen here: {sentence}" for sentence in found.not_seen)]
