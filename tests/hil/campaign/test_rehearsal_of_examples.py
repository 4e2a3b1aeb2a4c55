"""Rehearsals of the example cells at every usual cycle, with and without unmodelled effects."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.base.progress import Silent
from hil.campaign import Campaign
from hil.campaign.plan import design
from hil.campaign.rehearsal_record import CRITERIA
from hil.cell import Cell

ROOT = Path(__file__).resolve().parents[3]
CELLS = {
    "NS 16": ROOT / "sim_fixtures" / "ns16" / "cell.toml",
    "two joints": ROOT / "examples" / "two_joints" / "cell.toml",
}


@pytest.mark.slow
@pytest.mark.parametrize("cycle_ms", [1, 2, 4])
@pytest.mark.parametrize("name", CELLS)
def test_it_passes_with_and_without_effects(tmp_path: Path, name: str, cycle_ms: int) -> None:
    """One plan of a short search, found at the cycle of the rehearsal."""
    cell = Cell.load(CELLS[name]).with_values({"controller.cycle_ms": cycle_ms})
    cell = cell.with_campaign(repetitions=3, validation_runs=2)
    rehearsal = Campaign.create(tmp_path / "campaign", cell, design(cell, Silent())).rehearse()
    assert rehearsal.passed, rehearsal.failures
    assert [criterion.name for criterion in rehearsal.criteria] == [*CRITERIA]
