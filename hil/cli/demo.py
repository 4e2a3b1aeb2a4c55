"""`hil demo`: the whole way on the simulated NS 16."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Annotated

import typer

from hil.campaign import Campaign, CampaignFolderError, design, stop_on_interrupt
from hil.cell import Cell
from hil.cli.verdict import finish
from hil.identify import identify_campaign
from hil.progress import reporter as make_reporter
from hil.report import write_report
from hil.simulation import simulated_link, simulated_provenance
from sim_fixtures.ns16 import CELL_PATH


def demo(
    output: Annotated[
        Path, typer.Option(help="Campaign folder to make.", show_default=True)
    ] = Path("runs/demo"),
    repetitions: Annotated[
        int | None, typer.Option(min=2, help="Repetitions; 30 as in the paper if left out.")
    ] = None,
    validation: Annotated[
        int | None, typer.Option(min=1, help="Validation runs, never used for fitting.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the simulated cell: one seed, one run.")
    ] = None,
    effects: Annotated[
        bool,
        typer.Option(
            "--effects/--no-effects",
            help="Switch on what the model leaves out: torque ripple, friction drift, "
            "elasticity, delay.",
        ),
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier campaign in OUTPUT.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the last line.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
) -> None:
    """Design, run, archive, identify and report, all on the simulated COMAU NS 16.

    Leaves `archives/*.mcap`, `results.json` and `report.html` in OUTPUT and ends with one line
    that says whether the identified model predicts motions it has never seen, and how well.
    Nothing here is hardware: controller, drives and arm are simulated, packet for packet.
    """
    reporter = make_reporter(quiet=quiet or json)
    cell = Cell.load(CELL_PATH).with_campaign(
        repetitions=repetitions, validation_runs=validation, simulation_seed=seed
    )
    _make_room(output, force=force)
    plan = design(cell, reporter)
    campaign = Campaign.create(output, cell, plan)
    started = time.perf_counter()
    with stop_on_interrupt() as stop:
        link = simulated_link(cell, effects=effects)
        campaign.run(
            link, stop, reporter, provenance=simulated_provenance(cell, effects), durable=False
        )
    if stop.requested:
        raise KeyboardInterrupt
    took = time.perf_counter() - started
    seconds = link.cycles * cell.period
    reporter.say(
        f"recorded {seconds:.0f} s of simulated motion in {took:.1f} s "
        f"({seconds / took:.1f} x real time)"
    )
    identification = identify_campaign(campaign.folder.root, reporter)
    identification.results.save(campaign.folder.results)
    write_report(campaign.folder.report, identification.results, identification.series)
    reporter.say(f"report: {campaign.folder.report}")
    finish(identification.results, json=json)


def _make_room(output: Path, *, force: bool) -> None:
    """Remove an earlier campaign, and only a campaign, if asked to."""
    if not output.exists() or not any(output.iterdir()):
        return
    if not force:
        raise CampaignFolderError(output, "is not empty", "name another folder or add --force")
    if not ((output / "manifest.json").exists() and (output / "archives").is_dir()):
        raise CampaignFolderError(
            output, "is no campaign, so --force will not remove it", "name another folder"
        )
    shutil.rmtree(output)
