"""The campaign's folder, or a part of it, is removed while the campaign runs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.transports.simulated import SimulatedTransport
from hil.campaign import Campaign
from hil.campaign.link import Link
from hil.errors import HilError
from hil.progress import Silent
from hil.simulation import controller_settings, simulated_controller
from tests.hil.fast_cell import fast_campaign, fast_cell


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    return fast_campaign(tmp_path / "campaign", fast_cell(tmp_path, repetitions=1))


def remove_at(
    monkeypatch: pytest.MonkeyPatch, campaign: Campaign, archive: str, parts: Sequence[str]
) -> None:
    """Remove parts of the folder when an archive has been written to five times."""
    true, count = os.write, 0

    def write(descriptor: int, data: Any) -> int:
        nonlocal count
        name = Path(f"/proc/self/fd/{descriptor}").readlink().name
        count += name == archive
        if count == 5 and name == archive:
            for part in parts:
                shutil.rmtree(campaign.folder.root / part, ignore_errors=True)
        return true(descriptor, data)

    monkeypatch.setattr(os, "write", write)


@pytest.mark.parametrize("parts", [("archives",), ("",)], ids=["the archives", "all of it"])
def test_a_run_whose_folder_is_removed_says_so_with_the_arm_at_rest(
    campaign: Campaign, parts: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = campaign.folder.root
    controller = simulated_controller(campaign.cell, settings=controller_settings(campaign.cell))
    link = Link.over(SimulatedTransport(controller), campaign.cell, finish=controller.finish)
    remove_at(monkeypatch, campaign, "excitation_000_a1.mcap", parts)
    with pytest.raises(HilError) as told:
        campaign.run(link, None, Silent(), accept_dry_run=True, durable=True)
    monkeypatch.undo()
    assert told.value.exit_code in (1, 2)
    assert str(root) in str(told.value)
    assert "see whether it was moved or removed" in str(told.value)
    assert np.abs(controller.plant.velocity).max() < 1e-3
