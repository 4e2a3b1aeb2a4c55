"""A campaign of seconds: any simulated cell with everything made short."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from hil.campaign import Campaign, design
from hil.cell import Cell
from hil.cell.text import replaced_value
from hil.progress import Silent
from hil.simulation import simulated_link

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
    text = cell.text
    for key, value in SHORT.items():
        text = replaced_value(text, "campaign", key, value)
    return Cell.from_texts(text, cell.urdf, cell.path)


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
