"""Campaigns of the small cell to run, all with one plan."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from hil.campaign import (
    Campaign,
)
from tests.hil.campaign.runs.rig import Make, Operator
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal


@pytest.fixture(scope="session")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """The plan that all campaigns here run; tests only read it."""
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder))


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, designed: Campaign) -> Campaign:
    """A finished campaign of four repetitions; tests only read it."""
    folder = tmp_path_factory.mktemp("undisturbed")
    campaign = Campaign.create(folder / "campaign", fast_cell(folder), designed.plan)
    campaign.run(unrehearsed=True, durable=False)
    return campaign


@pytest.fixture
def make(tmp_path: Path, designed: Campaign) -> Make:
    """A rehearsed campaign of a few seconds; of a real arm where that is wanted."""

    def made(
        name: str = "campaign", *, real: bool = False, rehearsed: bool = True, **settings: float
    ) -> Campaign:
        cell = fast_cell(tmp_path, **{"repetitions": 1, **settings})
        if real:
            cell = cell.with_link(transport="udp", host="192.0.2.7")
        campaign = Campaign.create(tmp_path / name, cell, designed.plan)
        if rehearsed:
            pass_rehearsal(campaign.folder)
        return campaign

    return made


@pytest.fixture(scope="session")
def dry(tmp_path_factory: pytest.TempPathFactory, designed: Campaign) -> Campaign:
    """A campaign whose dry run is done and accepted, and nothing more; tests copy it."""
    folder = tmp_path_factory.mktemp("dry")
    cell = fast_cell(folder, repetitions=1)
    campaign = Campaign.create(folder / "campaign", cell, designed.plan)
    pass_rehearsal(campaign.folder)
    campaign.run(dry_run_only=True, operator=Operator())
    return campaign


@pytest.fixture
def copied(tmp_path: Path, dry: Campaign) -> Campaign:
    """A copy of it."""
    shutil.copytree(dry.folder.root, tmp_path / "copied")
    return Campaign.open(tmp_path / "copied")


@pytest.fixture
def campaign(tmp_path: Path, designed: Campaign) -> Campaign:
    created = Campaign.create(tmp_path / "campaign", designed.cell, designed.plan)
    pass_rehearsal(created.folder)
    return created
