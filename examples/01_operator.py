"""The operator's procedure in twenty lines: design, rehearse, run, identify, report.

Prints each step on the simulated NS 16, then the verdict: the torque error on held-out motions. The
picture is one archived repetition. Started again, it resumes where it was stopped. For a real arm,
name its cell file: `examples/01_operator.py my_cell.toml runs/mine`.
"""

import sys
from pathlib import Path

from hil import Campaign, Cell, Screen, stop_on_interrupt
from hil import reporter as progress
from hil.campaign import design
from hil.plots import save
from hil.plots.archive_view import draw_archive, view_of

PICTURE = Path("runs/examples/01_operator.png")


def operate(cell: Cell, folder: Path) -> Campaign:
    """Everything from a cell file to a validated model."""
    here = folder / "plan.json"
    reporter = progress()
    if here.exists():
        campaign = Campaign.open(folder)
    else:
        campaign = Campaign.create(folder, cell, design(cell, reporter))
    with stop_on_interrupt() as stop:
        print(campaign.rehearse(reporter=reporter, stop=stop).line)
        with Screen.of(cell, stop) as screen:
            simulated = cell.only_simulated  # on a real arm, the screen asks the person
            campaign.run(stop=stop, operator=screen, reporter=screen, accept_dry_run=simulated)
    print(campaign.identify(reporter=reporter).results.verdict.line)
    print(campaign.report())
    return campaign


if __name__ == "__main__":
    quick = "--quick" in sys.argv
    path, folder = ([a for a in sys.argv[1:] if a != "--quick"] + ["", ""])[:2]
    cell = Cell.load(path or "sim_fixtures/ns16/cell.toml")
    if quick:
        cell = cell.with_campaign(repetitions=3, validation_runs=2)
    campaign = operate(cell, Path(folder or "runs/examples/operator"))
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    repetition = campaign.folder.completed("excitation")[0]
    save(draw_archive(view_of(repetition)), PICTURE)
