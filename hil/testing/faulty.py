"""The simulated cell of a test with faults that the test works out."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from drivers.transports import SimulatedTransport
from hil.campaign import Campaign, Link, design
from hil.cell import Cell
from hil.progress import Silent
from hil.simulation import simulated_controller, simulated_link
from sim_fixtures import SimulatedController
from sim_fixtures.fault_script import parse_fault, split_faults

SHORT: Final = {
    "repetitions": 2,
    "validation_runs": 1,
    "n_via": 3,
    "candidates": 10,
    "approach_speed": 1.0,
    "standstill_s": 0.5,
    "settle_s": 0.2,
    "warmup_drift": 0,
}
"""Of `[campaign]`."""


def shortened(cell: Cell) -> Cell:
    """The cell with a campaign of seconds instead of minutes, in its text too."""
    return cell.with_values({f"campaign.{key}": value for key, value in SHORT.items()})


def run_campaign(root: Path, cell: Cell) -> Campaign:
    """Design and run a campaign of a simulated cell in a new folder, in virtual time.

    Its motion is found in a second and tells little: the folder is whole, an estimate from it is
    not one to rely on.

    Raises:
        CampaignFolderError: the folder holds something already.
        CellError: the cell is not a simulated one.
    """
    campaign = Campaign.create(root, cell, design(cell, Silent()))
    campaign.run(simulated_link(cell), durable=False, unrehearsed=True)
    return campaign


def faulty_controller(cell: Cell, *lines: str) -> SimulatedController:
    """A fresh simulated controller of a cell, with the faults that are its own.

    Args:
        cell: has a table [simulation].
        lines: what goes wrong, as `hil simulate --fault` takes it; faults of the link are read
            and left to the link.

    Raises:
        FaultScriptError: a line describes no fault.
    """
    _, own = split_faults(map(parse_fault, lines))
    return simulated_controller(cell, faults=own)


def faulty_link(cell: Cell, *lines: str, controller: SimulatedController | None = None) -> Link:
    """A link in virtual time to a simulated controller, not yet connected.

    Args:
        cell: has a table [simulation].
        lines: what goes wrong with link and controller.
        controller: `faulty_controller` of the same lines, where it is at hand.

    Raises:
        FaultScriptError: a line describes no fault.
    """
    controller = controller or faulty_controller(cell, *lines)
    of_link, _ = split_faults(map(parse_fault, lines))
    return Link.over(SimulatedTransport(controller, of_link), cell, controller.finish)
