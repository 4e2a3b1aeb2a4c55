"""`hil run`: a campaign on its controller, then identification and report."""

from __future__ import annotations

import json as json_format
import sys
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.console import Console

from hil.archive import ArchiveName
from hil.archive.live import LiveView
from hil.campaign import Campaign, Link, stop_on_interrupt
from hil.campaign.run import RunResult
from hil.cell_link import require_watchable
from hil.cli.arguments import CampaignArgument, JsonOption, QuietOption, print_json
from hil.cli.payload import payload_lines
from hil.cli.verdict import NOT_GOOD, as_json, finish
from hil.errors import ControllerFault, InputError, OperatorStopError
from hil.progress import reporter as make_reporter
from hil.progress import say
from hil.screen import Screen, can_read, confirmed
from hil.weighing import weigh


def run(
    campaign: CampaignArgument,
    rehearse: bool = False,
    dry_run: bool = False,
    accept_dry_run: bool = False,
    accept_torque: Annotated[list[str] | None, typer.Option(metavar="JOINT")] = None,
    no_identify: bool = False,
    payload: Annotated[str | None, typer.Option(metavar="NAME")] = None,
    live: Annotated[str | None, typer.Option(metavar="[HOST:]PORT")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Run what is missing of a campaign on its controller, then identify and report.

    In this order: the plan's rehearsal must have been passed (`hil rehearse`); every motion is
    run once at 20 % of its speed and a person accepts what he saw; the excitation is repeated
    until friction hardly changes any more; then standstill, repetitions, validation motions, and
    back to where the arm was. A repetition that fails its quality check is archived with the
    reason and run again. Ctrl-C brings the arm to rest on its path; the same command goes on.

    With --payload only the excitation is run, without and with a payload in turns, as pairs; after
    each pair it says how narrow the intervals are, and prints at the end what `hil payload` does.

    **Without a terminal:** `hil run C --dry-run`, somebody looks, then
    `hil run C --accept-dry-run --json`.

    Exit status 0 when the model is good (with --dry-run or --no-identify: when all was run), 3
    when a gate refuses, 4 when the controller, the link or the guard ended a motion, 5 when the
    model is not good or a motion was of no use again and again, 130 when it was stopped.

    Options:
        rehearse: Rehearse the plan first, where that was not passed yet.
        dry_run: Only the dry run: every motion at 20 % of its speed.
        accept_dry_run: I watched the dry run and the motions are free. On a simulated controller it
            need not have been done before.
        accept_torque: With --accept-dry-run: I know why the torque of this joint ran against the
            model's gravity in the dry run that was done before. Repeat it.
        no_identify: Only run; no parameters, no report.
        payload: Weigh a payload: run the excitation without and with it in turns, asking for it to
            be mounted and removed, until another pair is not worth it. The recordings lie in the
            folder payload/NAME of CAMPAIGN.
        live: Let Foxglove look at the run as it goes on; on 127.0.0.1 unless a HOST is named.
    """
    if dry_run and accept_dry_run:
        remedy = "run the one, look at the arm, then the other"
        raise InputError(None, "--dry-run and --accept-dry-run together", remedy=remedy)
    if payload is not None and (dry_run or no_identify):
        problem = "does its own dry runs, and weighs what it records"
        remedy = "leave out --dry-run and --no-identify"
        raise InputError(None, problem, field="--payload", remedy=remedy)
    opened = Campaign.open(campaign)
    if rehearse:
        with stop_on_interrupt() as stop:
            opened.rehearse(reporter=make_reporter(quiet=quiet or json), stop=stop)
    choices: dict[str, Any] = {
        "dry_run_only": dry_run,
        "accept_dry_run": accept_dry_run,
        "accept_torque": accept_torque or (),
    }
    if payload is not None:
        _weigh(opened, payload, choices, live=live, quiet=quiet, json=json)
        return
    result = _run(opened, choices, quiet=quiet or json, live=live)
    if dry_run or no_identify:
        _tell(result, json=json)
        return
    _identify(opened, result, quiet=quiet, json=json)


def _weigh(
    campaign: Campaign, name: str, choices: Mapping[str, Any], live: str | None, quiet: bool,
    json: bool,
) -> None:  # fmt: skip
    """Record pairs and weigh; a simulated arm mounts by itself."""
    silent = quiet or json
    simulated = campaign.cell.controller.transport == "simulated"
    if not simulated and (silent or not can_read(sys.stdin)):
        problem = "needs somebody at a terminal who mounts the payload"
        remedy = "record both by `hil run` or `hil record`: `hil payload BARE --loaded LOADED`"
        raise InputError(None, problem, field="--payload", remedy=remedy)

    def mount(load: bool) -> bool:
        deed = f"Mount {name}" if load else f"Take {name} off"
        if simulated:
            return True
        question = f"{deed}, and change nothing else. Type yes when the arm may move; anything "
        with stop_on_interrupt() as stop:
            return confirmed(Console(), f"{question}else ends the recording: ", "yes", stop)

    def run_side(side: Campaign, repetitions: int, link: Link | None) -> None:
        more = {**choices, "link": link, "repetitions": repetitions}
        _run(side, more, quiet=silent, live=live)

    weighed = weigh(campaign, name, run=run_side, mount=mount, reporter=make_reporter(quiet=silent))
    found = weighed.found
    if json:
        print_json(found.as_json() | {"pairs": weighed.pairs})
    else:
        say("\n".join(payload_lines(found)))
    if found.estimate.contradicted:
        raise typer.Exit(NOT_GOOD)


def _run(
    campaign: Campaign, choices: Mapping[str, Any], *, quiet: bool, live: str | None
) -> RunResult:
    """Run with the screen; Ctrl-C stops the arm, then the program."""
    name = campaign.folder.root.resolve().name
    view = None if live is None else LiveView.parse(live)
    require_watchable(campaign.cell, view)  # also where nothing is left to run
    with (
        stop_on_interrupt() as stop,
        Screen.of(campaign.cell, stop, title=name, quiet=quiet) as operator,
    ):
        try:
            return campaign.run(
                stop=stop, reporter=operator, operator=operator, live=view, **choices
            )
        except (ControllerFault, OSError) as fault:
            if stop.requested:  # an OSError: of a terminal that was closed
                again = f"Go on with `hil run {campaign.folder.root}`."
                raise OperatorStopError(f"{fault} {again}") from fault
            raise


def _identify(campaign: Campaign, result: RunResult, *, quiet: bool, json: bool) -> None:
    """Identify from all that is whole, report, and end with the verdict."""
    found = campaign.identify(reporter=make_reporter(quiet=quiet or json))
    if not json:
        finish(found.results, json=False, quiet=quiet)
        return
    verdict = json_format.loads(as_json(found.results))
    print_json({**result.to_dict(), "verdict": verdict})
    if not found.verdict.good:
        raise typer.Exit(NOT_GOOD)


def _tell(result: RunResult, *, json: bool) -> None:
    """What was done, where nothing is identified."""
    if json:
        print_json({**result.to_dict(), "verdict": None})
        return
    done, wanted = result.repetitions
    tested, tests = result.validations
    say(
        f"{result.campaign}: dry run {result.dry_run}, repetitions {done} of {wanted}, validation "
        f"{tested} of {tests}, {len(result.rejected)} rejected"
    )
    for note in result.notes:
        say(note)
    for one in result.rejected:
        name = ArchiveName.parse(one.archive)
        what = one.archive if name is None else f"{name.motion} ({one.archive})"
        say(f"{what}: {one.reason}")
    if result.dry_run == "to be accepted":
        known = "".join(f" --accept-torque {joint}" for joint in result.against_gravity)
        why = "you know why, and " if known else ""
        command = f"`hil run {result.campaign} --accept-dry-run{known}`"
        say(f"if {why}the motions looked right, go on with {command}")
