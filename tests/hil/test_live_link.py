"""A campaign over real sockets: the same motions, archives and refusals as in virtual time."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.packets import INIT_LENGTH
from hil.archive import open_archive
from hil.campaign import (
    Campaign,
    CampaignFolderError,
    CampaignPlan,
    MotionFailedError,
    NotRehearsedError,
    Stop,
)
from hil.campaign.live_link import LiveLink
from hil.campaign.quick_design import design
from hil.cell import Cell
from hil.demo_link import free_port, loopback_link
from hil.errors import ArchiveWriteError, ControllerFault
from hil.progress import Silent
from hil.simulation import simulated_link
from tests.hil.fast_cell import fast_cell

PATIENT = ("--patience", "2")
"""A test asks what happens, not how fast: the controller waits where this machine pauses."""


def on_loopback(cell: Cell, **changes: float) -> Cell:
    """The cell with its controller on this computer."""
    changed = cell.with_values({f"drive_train.{key}": value for key, value in changes.items()})
    return changed.with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1")


def campaign_of(folder: Path, cell: Cell, plan: CampaignPlan) -> Campaign:
    """One excitation and one validation run."""
    short = cell.with_campaign(repetitions=1, validation_runs=1)
    return Campaign.create(folder, short, CampaignPlan(plan.excitation, plan.validation[:1]))


def test_a_campaign_over_real_sockets_leaves_whole_gap_free_archives(tmp_path: Path) -> None:
    fast = fast_cell(tmp_path)
    campaign = campaign_of(tmp_path / "campaign", on_loopback(fast), design(fast, Silent()))
    with loopback_link(campaign.cell, options=PATIENT) as link:
        campaign.run(link, Stop(), Silent(), provenance={"simulated": "yes"}, unrehearsed=True)
        assert not link.exchange.alive
        assert not link.archive.alive
    names = [entry.name for entry in campaign.folder.manifest()]
    assert [name.split("_")[0] for name in names] == [
        "move", "standstill", "excitation", "validation", "move"
    ]  # fmt: skip
    total = 0
    for name in names:
        archive = open_archive(campaign.folder.archives / name)
        assert archive.complete
        assert archive.outcome is not None
        assert archive.outcome.entries["outcome"] == "completed"
        assert archive.outcome.entries["records_lost"] == "0"
        assert len(archive.attachments["init_packet.bin"]) == INIT_LENGTH
        columns = archive.columns
        # What is not in the file is in its gaps: cycles answered are cycles archived.
        span = columns["cycle"][-1] - columns["cycle"][0] + 1
        assert archive.n_samples + columns["gap"][1:].sum() == span
        total += archive.n_samples
    assert link.cycles == total

    excitation = open_archive(campaign.folder.archives / "excitation_000_a1.mcap")
    # The controller may have opened before the motion was asked for: it is held there till then.
    (began,) = (event.time for event in excitation.events if event.name == "MotionStarted")
    first = int(np.searchsorted(excitation.columns["stamp"], round(began * 1e9)))
    sent = excitation.columns["commanded_position"][first:]
    sent = sent[~np.isnan(sent).any(axis=1)]
    time = np.arange(len(sent), dtype=np.float64) * campaign.cell.period
    planned, _, _ = campaign.plan.excitation.trajectory.sample(time)
    assert sent == pytest.approx(planned, abs=2e-6)


def test_a_real_controller_is_not_driven_without_a_rehearsal(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    text = cell.with_link(transport="udp", host="10.2.12.150", port=free_port()).text
    real = Cell.from_texts(text, cell.urdf, cell.path)
    campaign = campaign_of(tmp_path / "real", real, plan)
    with LiveLink.open(campaign.cell) as link:
        with pytest.raises(NotRehearsedError, match="hil rehearse") as refused:
            campaign.run(link, Stop(), Silent())
        with pytest.raises(NotRehearsedError, match="leads out of this computer"):
            campaign.run(link, Stop(), Silent(), unrehearsed=True)
    assert refused.value.exit_code == 3
    assert not list(campaign.folder.archives.iterdir())


def test_two_runs_of_one_campaign_are_one_too_many(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    campaign = campaign_of(tmp_path / "twice", cell, plan)
    with campaign.folder.locked(), pytest.raises(CampaignFolderError, match="another run"):
        campaign.run(simulated_link(cell), Stop(), Silent(), provenance={}, unrehearsed=True)
    with campaign.folder.locked():
        pass  # it was let go of


def test_each_difference_of_the_init_packet_is_named_before_anything_moves(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    wrong = on_loopback(cell, k65=0.045, k54=0.02)
    right = tmp_path / "controller"
    right.mkdir()
    (right / "cell.toml").write_text(cell.text)
    (right / "ns16.urdf").write_text(cell.urdf)
    campaign = campaign_of(tmp_path / "init", wrong, plan)
    with (
        loopback_link(campaign.cell, simulated_by=right / "cell.toml", options=PATIENT) as link,
        pytest.raises(ControllerFault, match=r"k54 of axis 5 .*k65 of axis 6 .*--accept-init"),
    ):
        campaign.run(link, Stop(), Silent(), provenance={}, unrehearsed=True)
    assert not list(campaign.folder.archives.iterdir())


def test_an_archive_that_cannot_be_created_moves_nothing(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    campaign = campaign_of(tmp_path / "readonly", on_loopback(cell), plan)
    with loopback_link(campaign.cell, options=PATIENT) as link:
        link.connect(Stop())
        campaign.folder.archives.rmdir()
        with pytest.raises(ArchiveWriteError, match="cannot be created"):
            campaign.run(link, Stop(), Silent(), provenance={}, unrehearsed=True)
        assert link.exchange.status().program_accepted == 0


def test_a_port_in_use_is_named(cell: Cell) -> None:
    with taken_port() as port:
        local = on_loopback(cell).with_link(port=port)
        with pytest.raises(ControllerFault, match=str(port)):
            LiveLink.open(local)


@contextmanager
def taken_port() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        yield other.getsockname()[1]


def test_a_refusal_comes_with_its_flight_recorder(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    # So slow a way to the first posture, and the fault so late, that it strikes on that way even
    # where a loaded computer takes seconds to begin.
    slow = cell.with_values({"campaign.approach_speed": 0.01})
    campaign = campaign_of(tmp_path / "refused", on_loopback(slow), plan)
    fault = ("--fault", "following-error@5000x1000:axis=2:slip")
    with (
        loopback_link(campaign.cell, options=(*PATIENT, *fault)) as link,
        pytest.raises(MotionFailedError) as failed,
    ):
        campaign.run(link, Stop(), Silent(), provenance={}, unrehearsed=True)
    assert failed.value.outcome == "refused"
    recorder = failed.value.flight_recorder
    assert recorder is not None
    assert 1 < len(recorder) <= 50
    archive = open_archive(campaign.folder.archives / campaign.folder.manifest()[-1].name)
    assert archive.outcome is not None
    assert archive.outcome.entries["outcome"] == "refused"
    assert any(event.name == "Refused" for event in archive.events)
    assert recorder["cycle"][-1] in archive.columns["cycle"]


def test_a_stop_before_the_connection_moves_nothing(cell: Cell) -> None:
    with (
        loopback_link(on_loopback(cell), options=PATIENT) as link,
        pytest.raises(ControllerFault, match="before anything moved"),
    ):
        link.connect(Stop(requested=True))
