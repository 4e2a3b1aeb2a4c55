"""`hil rehearse`: run the plan on a simulated copy of the cell."""

from __future__ import annotations

from typing import Annotated

import typer

from hil.base.exit_status import ExitStatus
from hil.base.one_screen import brief
from hil.base.progress import reporter as make_reporter
from hil.base.progress import say
from hil.campaign import Campaign, stop_on_interrupt
from hil.campaign.record_messages import rehearsal_line
from hil.campaign.rehearsal_record import Rehearsal
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption, VerboseOption


def rehearse(
    campaign: CampaignArgument,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    again: bool = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Run the plan of CAMPAIGN on a simulated arm and judge the result. Nothing moves.

    Masses, inertias, rotor inertias and friction of the simulated arm differ by up to 10 % from the
    nominal ones, its currents are noisy, and its link loses a packet now and then. The rehearsal
    passes if the intervals contain the simulated parameters, held-out motion is predicted down to
    the noise, no motion is refused and no motor comes near its limit. Everything is then run again
    with ripple, drift, elasticity and delay. `hil run` requires a rehearsal of the same cell, URDF
    and plan. It takes one to two minutes, on a busy computer up to five.

    Exit status: 0 passed, 5 failed.

    Options:
        seed: Seed of the parameters, noise and link faults of the simulation. Default: 1.
        again: Rehearse again even if it passed.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    opened = Campaign.open(campaign)
    with stop_on_interrupt() as stop:
        rehearsal = opened.rehearse(reporter=reporter, seed=seed, stop=stop, again=again)
    if json:
        typer.echo(rehearsal.model_dump_json())
    else:
        lines = [] if quiet else _lines(rehearsal, verbose=verbose)
        if rehearsal.passed and not quiet:
            lines.append(f"next: {opened.folder.run_command}")
        result = rehearsal_line(rehearsal)
        for line in [*lines, result] if verbose else brief([result, *lines]):
            say(line)
    if not rehearsal.passed:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _lines(rehearsal: Rehearsal, *, verbose: bool) -> list[str]:
    """Return criteria, and what a rehearsal cannot detect; on one screen how many were met."""
    if verbose:
        criteria = [
            f"{'ok' if criterion.passed else 'FAILED'}: {criterion.sentence}"
            for criterion in rehearsal.criteria
        ]
        return [*criteria, *(f"not covered: {sentence}" for sentence in rehearsal.not_seen)]
    if rehearsal.passed:
        return ["its criteria: -v"]
    passed = len(rehearsal.criteria) - len(rehearsal.failures)
    return [f"{passed} of {len(rehearsal.criteria)} criteria are met: -v shows them"]
