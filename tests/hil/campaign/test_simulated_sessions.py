"""A long simulated campaign in two sessions at once: every motion once, the same run again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hil.archive.check import check_archive
from hil.base.errors import ExecutionError, OperatorStopError
from hil.base.progress import Silent
from hil.campaign import Campaign, simulated_sessions
from hil.campaign.folder import CampaignFolder
from hil.campaign.motion_runner import RunOptions
from hil.campaign.simulated_sessions import (
    adopt_second_session,
    halves,
    run_second_session,
    run_simulated,
)
from hil.control.motion_watch import Stop
from hil.control.simulated_cell import simulated_provenance
from tests.hil.fast_cell import fast_campaign, fast_cell

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder, repetitions=4))


@pytest.fixture(autouse=True)
def however_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Campaigns of these tests are shorter than a second process is worthwhile for."""
    monkeypatch.setattr(simulated_sessions, "MIN_SPLIT_SECONDS", 0.0)


def again(campaign: Campaign, folder: Path) -> Campaign:
    return Campaign.create(folder, campaign.cell, campaign.plan)


def run(campaign: Campaign, stop: Stop | None = None) -> dict[str, str]:
    """Run a campaign; return the checksums of its archives by name, in the manifest's order."""
    run_simulated(campaign, stop or Stop(), Silent(), effects=False)
    assert not campaign.folder.second_session.exists()
    return {entry.name: entry.sha256 for entry in campaign.folder.manifest()}


def begin_second(campaign: Campaign, *only: tuple[str, int]) -> CampaignFolder:
    """Run motions in the folder of the second session, as a process that is then killed."""
    folder = simulated_sessions._second_folder(campaign)
    options = RunOptions(
        provenance=simulated_provenance(campaign.cell, effects=False),
        unrehearsed=True,
        only=frozenset(only),
        first_move=7,
    )
    run_second_session(folder, options, effects=False)
    return CampaignFolder(folder)


def test_every_motion_runs_once_and_a_second_run_is_identical(
    designed: Campaign, tmp_path: Path
) -> None:
    first = again(designed, tmp_path / "first")
    archives = run(first)
    assert not first.missing()
    assert all(check_archive(first.folder.archives / name).conforms for name in archives)
    assert len({*archives.values()}) == len(archives), "each session has noise of its own"
    assert archives == run(again(designed, tmp_path / "second"))


def test_the_motions_are_divided_in_order_by_their_duration(designed: Campaign) -> None:
    first, second = halves(designed.motions)
    assert [*first, *second] == [*designed.motions]
    times = [sum(motion.trajectory.duration for motion in part) for part in (first, second)]
    longest = max(motion.trajectory.duration for motion in designed.motions)
    assert times[1] <= times[0] <= times[1] + 2.0 * longest


def test_short_motions_need_no_second_session(
    designed: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated_sessions, "MIN_SPLIT_SECONDS", 1000.0)
    assert halves(designed.motions) == (designed.motions, ())


def test_archives_of_a_killed_second_session_count(designed: Campaign, tmp_path: Path) -> None:
    campaign = again(designed, tmp_path / "campaign")
    done = {entry.name for entry in begin_second(campaign, ("excitation", 3)).manifest()}
    adopt_second_session(campaign)
    assert {entry.name for entry in campaign.folder.manifest()} == done
    assert ("excitation", 3) not in {(m.kind, m.index) for m in campaign.missing()}
    run(campaign)
    assert not campaign.missing()


def test_an_adoption_that_was_interrupted_continues(designed: Campaign, tmp_path: Path) -> None:
    campaign = again(designed, tmp_path / "campaign")
    second = begin_second(campaign, ("excitation", 3))
    entries = second.manifest()
    moved = entries[0]
    (second.archives / moved.name).replace(campaign.folder.archives / moved.name)
    campaign.folder.add(moved.name, moved.outcome)
    adopt_second_session(campaign)
    assert [replace(entry, reason="") for entry in campaign.folder.manifest()] == entries


def test_a_stopped_campaign_is_resumed(designed: Campaign, tmp_path: Path) -> None:
    campaign = again(designed, tmp_path / "campaign")
    with pytest.raises((ExecutionError, OperatorStopError)):
        run(campaign, Stop(requested=True))
    assert campaign.missing()
    run(campaign)
    assert not campaign.missing()
