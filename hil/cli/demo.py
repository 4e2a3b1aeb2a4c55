"""`hil demo`: run a complete campaign on a simulated NS 16, or a UR5e."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Annotated, Literal

import typer

from hil.base.errors import ExecutionError, InputError
from hil.base.progress import Reporter
from hil.base.progress import reporter as make_reporter
from hil.campaign import (
    Campaign,
    CampaignFolder,
    CampaignFolderError,
    design,
    plan_around,
    stop_on_interrupt,
)
from hil.campaign.planned_motions import require_runnable
from hil.campaign.simulated_sessions import run_simulated
from hil.cell import Cell
from hil.cli.arguments import JsonOption, QuietOption, VerboseOption
from hil.cli.verdict import finish
from hil.control.errors import stopped
from hil.design import load_design
from hil.report.output_files import EXPORT_FILES, REPORT
from hil.results.provenance import RESULTS
from hil.results.series import SERIES
from sim_fixtures.ns16 import CELL_PATH
from sim_fixtures.ur import CELL_PATH as UR_CELL_PATH


def demo(
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("runs/demo"),
    controller: Annotated[Literal["c4g", "ur"], typer.Option()] = "c4g",
    repetitions: Annotated[int | None, typer.Option(min=2)] = None,
    validation: Annotated[int | None, typer.Option(min=1)] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    effects: Annotated[bool, typer.Option("--effects/--no-effects")] = False,
    excitation: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    force: bool = False,
    resume: bool = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Design, run, archive, identify and report a campaign on a simulated arm.

    Writes `archives/*.mcap`, `results.json` and `report.html` to OUTPUT. Prints first
    what the identified model is good for, judged on motions that were not fitted. No hardware is
    used; controller, drives and arm are simulated down to the packet, in virtual time.

    Options:
        output: Campaign folder to create.
        controller: c4g: a COMAU NS 16 with its C4G Open; ur: a UR5e, by RTDE.
        repetitions: Number of repetitions of the excitation. Default: 30, as in the paper.
        validation: Number of validation runs, which are never fitted.
        seed: Seed of the simulated cell; runs with the same seed are identical.
        effects: Simulate effects that the model does not contain: torque ripple, friction drift,
            elasticity, delay.
        excitation: Run this excitation (a result of `hil design` for the NS 16 cell) instead of
            searching for one for a few seconds.
        force: Replace an earlier campaign in OUTPUT.
        resume: Continue an interrupted campaign in OUTPUT.
    """
    reporter = make_reporter(quiet=quiet or json, messages=verbose)
    if resume:
        if excitation is not None:
            problem = "contradicts --resume, which continues with the excitation of the campaign"
            remedy = "omit --excitation, or choose another folder"
            raise InputError(excitation, problem, remedy=remedy)
        campaign = Campaign.open(output)
        _require_same(campaign, repetitions=repetitions, validation=validation, seed=seed)
    else:
        _require_replaceable(output, force=force)
        cell = simulated_arm(controller).with_campaign(
            repetitions=repetitions, validation_runs=validation, simulation_seed=seed
        )
        plan = (
            design(cell, reporter)
            if excitation is None
            else plan_around(cell, load_design(excitation, cell))
        )
        require_runnable(cell, plan)  # before an earlier campaign is removed
        _make_room(output)
        campaign = Campaign.create(output, cell, plan)
    _run(campaign, reporter, effects=effects)
    results = campaign.identify(reporter=reporter).results
    written = (output, output / REPORT)
    finish(results, json=json, quiet=quiet, verbose=verbose, written=written)


def simulated_arm(controller: Literal["c4g", "ur"]) -> Cell:
    """Return the cell of a simulated arm with this controller."""
    if controller == "c4g":
        return Cell.load(CELL_PATH)
    return Cell.load(UR_CELL_PATH).with_values({"controller.transport": "simulated"})


def _require_same(
    campaign: Campaign, *, repetitions: int | None, validation: int | None, seed: int | None
) -> None:
    """Refuse options that contradict the campaign that --resume continues."""
    cell = campaign.cell
    for option, given, begun in (
        ("--repetitions", repetitions, cell.campaign.repetitions),
        ("--validation", validation, cell.campaign.validation_runs),
        ("--seed", seed, cell.simulation.seed),
    ):
        if given is not None and given != begun:
            raise InputError(
                campaign.folder.root,
                f"its campaign was begun with {option} {begun}, not {given}",
                remedy=f"omit {option} with --resume, or choose another folder",
            )


def _run(campaign: Campaign, reporter: Reporter, *, effects: bool) -> None:
    """Run the missing motions on a simulated controller; Ctrl-C stops the arm, then the program."""
    cell = campaign.cell
    started = time.perf_counter()
    with stop_on_interrupt() as stop:
        try:
            cycles = run_simulated(campaign, stop, reporter, effects=effects)
        except ExecutionError as fault:
            if stop.requested:
                raise stopped(fault, "resume with --resume") from fault
            raise
    took = time.perf_counter() - started
    seconds = cycles * cell.period
    reporter.say(
        f"recorded {seconds:.0f} s of simulated motion in {took:.1f} s "
        f"({seconds / took:.1f} x real time)"
    )


_OURS = {"archives", "cell.toml", "robot.urdf", "plan.json", "manifest.json", "paper"}
_OURS |= {"rehearsal", "rehearsal.json", "dry_run.json", "warmup.json", "precision.json"}
_OURS |= {"campaign.lock", "second_session", RESULTS, REPORT, SERIES, *EXPORT_FILES}


def _require_replaceable(output: Path, *, force: bool) -> None:
    """Refuse an output that --force must not replace: only an earlier campaign may be."""
    if not output.exists() and not output.is_symlink():
        return
    if output.is_symlink() or not output.is_dir():
        raise CampaignFolderError(output, "is not a folder", "give a folder")
    entries = {path.name for path in output.iterdir()}
    if entries and not force:
        remedy = (
            "choose another folder (--output), or add --resume to continue or --force to replace it"
        )
        raise CampaignFolderError(output, "is not empty", remedy)
    foreign = sorted(entries - _OURS)
    if foreign or (entries and "manifest.json" not in entries):
        what = f"contains {foreign[0]}" if foreign else "is not a campaign"
        problem = f"{what}, so --force will not remove it"
        raise CampaignFolderError(output, problem, "choose another folder")


def _make_room(output: Path) -> None:
    if output.exists():
        with CampaignFolder(output).locked():
            shutil.rmtree(output)
