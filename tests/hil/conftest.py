"""A small simulated cell: the NS 16 with a campaign of seconds instead of minutes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, Stop, design
from hil.cell import Cell
from hil.control import operator_control
from hil.control.simulated_cell import simulated_link, simulated_provenance
from sim_fixtures import SimulatedDrive
from sim_fixtures.ns16 import CELL_PATH

SETTINGS = {
    "repetitions": 3,
    "validation_runs": 2,
    "n_via": 4,
    "candidates": 20,
    "approach_speed": 1.0,
    "standstill_s": 1.0,
    "settle_s": 0.2,
}


def small(**changes: float) -> Cell:
    """The NS 16 cell with a short campaign."""
    settings = (SETTINGS | changes).items()
    return Cell.load(CELL_PATH).with_values({f"campaign.{key}": value for key, value in settings})


def run_campaign(
    folder: Path,
    cell: Cell,
    plan: CampaignPlan,
    *,
    effects: bool = False,
    drive: SimulatedDrive | None = None,
) -> Campaign:
    """A campaign of `cell`, executed on a simulated robot that may differ in its `drive`."""
    campaign = Campaign.create(folder, cell, plan)
    link = simulated_link(cell, effects=effects, drive=drive)
    provenance = simulated_provenance(cell, effects)
    campaign.run(link, Stop(), Silent(), provenance=provenance, durable=False, unrehearsed=True)
    return campaign


@pytest.fixture
def shown_in_virtual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A motion in virtual time is shown every 100 cycles, whatever the wall clock says.

    Shown every 0.1 s by the clock, it would be over before a fast computer shows it again.
    """
    monkeypatch.setattr(operator_control, "SHOW_PERIOD", 0.0)


@pytest.fixture(scope="session")
def run() -> Callable[..., Campaign]:
    """`run_campaign`."""
    return run_campaign


@pytest.fixture(scope="session")
def cell() -> Cell:
    """The small cell."""
    return small()


@pytest.fixture(scope="session")
def plan(cell: Cell) -> CampaignPlan:
    """Its excitation and validation motions."""
    return design(cell, Silent())


@pytest.fixture(scope="session")
def campaign(tmp_path_factory: pytest.TempPathFactory, cell: Cell, plan: CampaignPlan) -> Campaign:
    """A finished campaign; tests only read it."""
    return run_campaign(tmp_path_factory.mktemp("campaign") / "small", cell, plan)
