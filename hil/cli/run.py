"""`hil run`: run a campaign on its controller, identify and report."""

from __future__ import annotations

import json as json_format
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.archive import ArchiveName
from hil.archive.live import LiveView
from hil.base.errors import ExecutionError, InputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import brief
from hil.base.progress import reporter as make_reporter
from hil.base.progress import say
from hil.campaign import Campaign, MotionFailedError, stop_on_interrupt
from hil.campaign.campaign_run import RunResult
from hil.campaign.folder import CampaignFolder
from hil.campaign.reached_precision import requirements_of
from hil.campaign.record_messages import precision_line
from hil.campaign.run_messages import run_lines
from hil.campaign.screen import Screen
from hil.cli.arguments import (
    CampaignArgument,
    JsonOption,
    QuietOption,
    VerboseOption,
    print_json,
    with_options,
)
from hil.cli.verdict import as_json, finish
from hil.cli.weigh import WeighingOptions, weigh
from hil.control.cell_link import require_real_time
from hil.control.errors import stopped
from hil.precision.requirements import Requirement
from hil.report.output_files import REPORT


@with_options(WeighingOptions, "weighing")
def run(
    campaign: CampaignArgument,
    rehearse: bool = False,
    dry_run: bool = False,
    accept_dry_run: bool = False,
    accept_torque: Annotated[list[str] | None, typer.Option(metavar="JOINT")] = None,
    no_identify: bool = False,
    until_precise: bool = False,
    precision: Annotated[list[str] | None, typer.Option(metavar="REQUIREMENTS")] = None,
    *,
    weighing: WeighingOptions,
    live: Annotated[str | None, typer.Option(metavar="[HOST:]PORT")] = None,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Run the missing motions of a campaign on its controller, then identify and report.

    The order is: rehearsal (must have passed, see `hil rehearse`); dry run of every motion at 20 %
    of its speed, which the operator accepts; warm-up until friction hardly changes; standstill,
    repetitions, validation motions, and return to the initial posture. A repetition that fails the
    quality check is archived with the reason and run again. Ctrl-C stops the arm on its path; the
    same command resumes.

    **Without a terminal:** `hil run C --dry-run`, an operator watches, then `hil run C
    --accept-dry-run --json`.

    Exit status: 0 the model is good (with --dry-run or --no-identify: all motions were run), 3 a
    gate refused, 4 controller, link or guard ended a motion, 5 the model is not good or a motion
    failed its quality check repeatedly, 130 stopped.

    Options:
        rehearse: Rehearse the plan first, if it has not passed yet.
        dry_run: Run only the dry run: every motion at 20 % of its speed.
        accept_dry_run: Confirm that the dry run was watched and its motions are clear. On a
            simulated controller no earlier dry run is needed.
        accept_torque: Joint whose torque opposed gravity in the dry run for a known reason.
        no_identify: Only run; no parameters and no report.
        until_precise: End the repetitions when the required precision is reached, or when more of
            them do not help. Their number in [campaign] is the limit.
        precision: Such as "parameters 5 %" or "parameters 5 % absolute". Default: as in the design.
        live: Stream the run to Foxglove; on 127.0.0.1 unless HOST is given.
    """
    choices = _choices(dry_run, accept_dry_run, accept_torque or ())
    opened = _opened(campaign)
    weighing.check(no_identify=no_identify)
    states = until_precise or (weighing.payload is not None and precision is not None)
    required = _required(opened, states, precision or [])
    execute = partial(_run, quiet=quiet or json, live=live)
    if weighing.payload is not None:
        more = {"rehearse": rehearse, "quiet": quiet, "verbose": verbose, "json": json}
        result = weigh(opened, weighing, execute, choices, required, **more)
    else:
        if rehearse:
            _rehearse(opened, quiet=quiet or json)
        result = execute(opened, {**choices, "until_precise": required})
    if result is not None and (dry_run or no_identify):
        _print(result, verbose=verbose, json=json)
    elif result is not None:
        _identify(opened, result, quiet=quiet, verbose=verbose, json=json)


def _choices(dry_run: bool, accept_dry_run: bool, accept_torque: Sequence[str]) -> dict[str, Any]:
    """Return what `Campaign.run` is to do about the dry run."""
    if dry_run and accept_dry_run:
        remedy = "run --dry-run first, watch the arm, then --accept-dry-run"
        raise InputError(None, "--dry-run and --accept-dry-run together", remedy=remedy)
    return {
        "dry_run_only": dry_run,
        "accept_dry_run": accept_dry_run,
        "accept_torque": accept_torque,
    }


def _rehearse(campaign: Campaign, *, quiet: bool) -> None:
    with stop_on_interrupt() as stop:
        campaign.rehearse(reporter=make_reporter(quiet=quiet), stop=stop)


def _opened(root: Path) -> Campaign:
    """Return a campaign that is run by itself (InputError for a side of a payload campaign)."""
    opened = Campaign.open(root)
    if opened.folder.weighs is not None:
        whole, _ = opened.folder.weighs
        problem = "is one side of a payload campaign"
        remedy = f"run `{opened.folder.run_command}`"
        if not CampaignFolder(whole).sealed:
            problem = f"is a side of a payload campaign, but {whole.resolve()} is no campaign"
            remedy = "move the folder to a path without payload/NAME and run it there"
        raise InputError(root, problem, remedy=remedy)
    if opened.cell.assumes_payload:
        problem = "is a copy of the loaded side of a payload campaign"
        remedy = "run the campaign that it was copied from, with --payload"
        raise InputError(root, problem, remedy=remedy)
    return opened


def _required(
    campaign: Campaign, until_precise: bool, texts: Sequence[str]
) -> tuple[Requirement, ...]:
    """Return the precision that ends the repetitions, none without --until-precise."""
    if until_precise:
        return requirements_of(campaign, texts)
    if texts:
        remedy = "add --until-precise"
        raise InputError(None, "--precision without --until-precise", remedy=remedy)
    return ()


def _run(
    campaign: Campaign, choices: Mapping[str, Any], *, quiet: bool, live: str | None
) -> RunResult:
    """Run with the screen; Ctrl-C stops the arm, then the program."""
    parts = campaign.folder.root.resolve().parts
    name = parts[-1] if campaign.folder.weighs is None else " ".join(parts[-2:])
    view = None if live is None else LiveView.parse(live)
    require_real_time(campaign.cell, view)  # also where nothing is left to run
    with (
        stop_on_interrupt() as stop,
        Screen.of(campaign.cell, stop, title=name, quiet=quiet) as operator,
    ):
        try:
            return campaign.run(
                stop=stop, reporter=operator, operator=operator, live=view, **choices
            )
        except (ExecutionError, OSError) as fault:
            failed = isinstance(fault, MotionFailedError) and fault.outcome != "stopped"
            if stop.requested and not failed:  # an OSError: of a terminal that was closed
                again = f"resume with `{campaign.folder.run_command}`"
                raise stopped(fault, again) from fault
            raise


def _identify(
    campaign: Campaign, result: RunResult, *, quiet: bool, verbose: bool, json: bool
) -> None:
    """Identify from all complete archives, report, and end with the verdict."""
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    identification = campaign.identify(reporter=reporter)
    if not json:
        root = campaign.folder.root
        written = (root, root / REPORT)
        finish(identification.results, json=False, quiet=quiet, verbose=verbose, written=written)
        return
    verdict = json_format.loads(as_json(identification.results))
    print_json({**result.to_dict(), "verdict": verdict})
    if not identification.verdict.good:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def _print(result: RunResult, *, verbose: bool, json: bool) -> None:
    """Print what was run, without identification."""
    if json:
        print_json({**result.to_dict(), "verdict": None})
        return
    done, requested = result.repetitions
    tested, tests = result.validations
    lines = [
        f"{result.campaign}: dry run {result.dry_run}, repetitions {done} of {requested}, "
        f"validation {tested} of {tests}, {len(result.rejected)} rejected"
    ]
    lines += [] if result.precision is None else [precision_line(result.precision)]
    lines += run_lines(result.notes)
    for rejection in result.rejected:
        name = ArchiveName.parse(rejection.archive)
        what = rejection.archive if name is None else f"{name.motion} ({rejection.archive})"
        lines.append(f"{what}: {rejection.reason}")
    for line in lines if verbose else brief(lines):
        say(line)
    if result.dry_run == "to be accepted":
        accept_options = "".join(f" --accept-torque {joint}" for joint in result.against_gravity)
        why = "you know why, and " if accept_options else ""
        command = f"`{result.command} --accept-dry-run{accept_options}`"
        say(f"if {why}the motions looked right, continue with {command}")
