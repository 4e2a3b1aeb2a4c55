"""Before an arm moves: a rehearsal, the same folder, and the controller that the cell describes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.transports.simulated import SimulatedTransport
from hil.archive import open_archive
from hil.base.errors import ControllerError, HilError
from hil.base.progress import Silent
from hil.campaign import (
    Campaign,
    CampaignFolderError,
    MotionRefusedError,
    NotRehearsedError,
    VirtualLink,
)
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.run_notes import LowerCurrentLimits
from hil.campaign.folder import CampaignFolder
from hil.campaign.gates import require_rehearsed
from hil.campaign.rehearsal_record import Rehearsal
from hil.control.connection import active_checks
from hil.control.motion_checks import MotionChecks
from hil.control.motion_refusals import LowerLimit
from hil.control.motion_watch import Stop
from hil.control.move import plan_move, send
from hil.control.simulated_cell import simulated_controller, simulated_link
from tests.hil.campaign.runs.rig import Make, Real
from tests.hil.fast_cell import pass_rehearsal
from tests.messages import ANOTHER_CELL_OR_PLAN

pytestmark = pytest.mark.safety


def test_a_plan_is_not_run_before_it_was_rehearsed(make: Make) -> None:
    campaign = make(rehearsed=False)
    with pytest.raises(NotRehearsedError, match=r"was not rehearsed; run `hil rehearse .*`") as no:
        campaign.run(accept_dry_run=True)
    assert no.value.exit_code == 3
    pass_rehearsal(campaign.folder, passed=False)
    with pytest.raises(NotRehearsedError, match="failed its rehearsal"):
        campaign.run(accept_dry_run=True)
    pass_rehearsal(campaign.folder)
    text = campaign.folder.rehearsal.read_text("utf-8")
    other = text.replace(campaign.folder.plan_hash, "0" * 64)
    assert other != text
    campaign.folder.rehearsal.write_text(other, "utf-8")
    with pytest.raises(NotRehearsedError, match=f"with {ANOTHER_CELL_OR_PLAN}"):
        campaign.run(accept_dry_run=True)
    assert not list(campaign.folder.archives.iterdir())


def edited(campaign: Campaign) -> None:
    """Edit its cell file."""
    text = campaign.folder.cell.read_text()
    assert "standstill_s = 0.3" in text
    campaign.folder.cell.write_text(text.replace("standstill_s = 0.3", "standstill_s = 0.7"))


def test_a_cell_edited_during_its_rehearsal_is_not_rehearsed(make: Make) -> None:
    campaign = make(rehearsed=False)

    class Editing(Silent):
        def say(self, text: str) -> None:
            if "as modelled" in text:
                edited(campaign)

    with pytest.raises(CampaignFolderError, match=r"cell\.toml was changed after it was read"):
        campaign.rehearse(reporter=Editing())
    assert Rehearsal.load(campaign.folder) is None


def test_motions_of_another_folder_are_not_sent(copied: Campaign) -> None:
    edited(copied)
    copied.folder.seal()
    pass_rehearsal(copied.folder)
    with pytest.raises(CampaignFolderError, match=r"cell\.toml was changed after it was read"):
        copied.run(accept_dry_run=True)
    assert not list(copied.folder.archives.glob("excitation*"))


def test_a_link_to_another_arm_is_refused(copied: Campaign) -> None:
    other = copied.cell.with_values({"limits.velocity_deg": [300.0, 300.0]})
    with pytest.raises(CampaignFolderError, match=r"opened with another cell \(\[limits\]"):
        copied.run(simulated_link(other))
    there = copied.cell.with_link(port=4711)
    assert copied.run(simulated_link(there)).complete


def test_a_mesh_belongs_to_what_was_rehearsed(tmp_path: Path) -> None:
    folder = CampaignFolder(tmp_path)
    folder.cell.write_text('[cell]\nname = "a"\nmesh_folders = ["meshes"]\n')
    folder.urdf.write_text(
        '<robot name="a"><link name="b"><collision><geometry>'
        '<mesh filename="package://arm/link.stl"/></geometry></collision></link></robot>'
    )
    mesh = tmp_path / "meshes" / "arm" / "link.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(b"a cube")
    folder.seal()
    before = folder.plan_hash
    mesh.write_bytes(b"a larger cube")
    assert folder.plan_hash != before
    with pytest.raises(NotRehearsedError, match=r"mesh package://arm/link\.stl is not the one"):
        folder.require_unchanged()
    # On another computer, which reads what was recorded, the mesh need not be there.
    mesh.unlink()
    assert folder.plan_hash == before


@pytest.mark.parametrize("provenance", [{"operator": "me"}, {"simulated": "no"}, None])
def test_the_link_decides_whether_the_arm_is_simulated(
    make: Make, monkeypatch: pytest.MonkeyPatch, provenance: dict[str, str] | None
) -> None:
    campaign = make(real=True)
    twin = simulated_link(campaign.cell, instead_of_hardware=True)
    if provenance is None:  # as of a version that left it to the caller
        monkeypatch.setattr("hil.campaign.motion_runner.with_present_date", lambda _: {})
    campaign.run(twin, provenance=provenance, dry_run_only=True)
    monkeypatch.undo()
    first = next(campaign.folder.archives.iterdir())
    kind = open_archive(first, fields=()).header.entries.get("simulated")
    assert kind == (None if provenance is None else "yes")
    with pytest.raises(CampaignFolderError, match=r"holds archives of .*leads to a real one"):
        campaign.run(Real(campaign), dry_run_only=True)  # type: ignore[arg-type]
    hash_ = campaign.folder.plan_hash
    counts = DryRunRecord.load_valid(campaign.folder, plan_hash=hash_, motions=2, simulated=False)
    assert counts is None


def link_to_controller_with(campaign: Campaign, **figures: Any) -> VirtualLink:
    """A link to a simulated controller whose own cell file differs in some figures."""
    other = campaign.cell.with_values({k.replace("__", "."): v for k, v in figures.items()})
    controller = simulated_controller(other)
    return VirtualLink.over(SimulatedTransport(controller), campaign.cell, controller.finish)


@pytest.mark.parametrize(
    ("figures", "error", "message"),
    [
        ({"drive_train__current_limit": [3.0, 12.0]}, MotionRefusedError,
         r"motor of shoulder: \S+ A, .*controller limits that motor to 3 A, .*cell file to 20 A: enter"),
        ({"drive_train__following_error": [1.0, 0.01]}, NotRehearsedError,
         r"elbow: 0\.01 motor revolutions in the controller, 1 in the cell file.*rehearse"),
        ({"controller__cycle_ms": 1}, ControllerError,
         r"cycle is 1 ms in the controller, 2 ms in the cell; correct the cell file, or the c\w+$"),
    ],
)  # fmt: skip
def test_what_the_controller_states_is_checked_first(
    copied: Campaign, figures: dict[str, Any], error: type[HilError], message: str
) -> None:
    before = sorted(copied.folder.archives.iterdir())
    with pytest.raises(error, match=message):
        copied.run(link_to_controller_with(copied, **figures))
    assert sorted(copied.folder.archives.iterdir()) == before


def test_wider_limits_change_nothing_and_narrower_ones_are_noted(copied: Campaign) -> None:
    wider = link_to_controller_with(copied, drive_train__current_limit=[30.0, 13.0])
    assert copied.run(wider, dry_run_only=True).dry_run == "accepted"
    wider.connect(Stop())
    checks = MotionChecks.of(copied.cell)
    assert active_checks(copied.cell, wider.connection, checks) is checks
    narrower = link_to_controller_with(copied, drive_train__current_limit=[19.5, 12.0])
    lower = LowerLimit("shoulder", "current_limit", 19.5, 20.0)
    assert LowerCurrentLimits((lower,)) in copied.run(narrower).notes


def test_a_single_move_respects_the_controllers_current_limit(
    tmp_path: Path, dry: Campaign
) -> None:
    link = link_to_controller_with(dry, drive_train__current_limit=[0.5, 12.0])
    move = plan_move(dry.cell, link.connect(Stop()), dry.cell.home)
    with pytest.raises(MotionRefusedError, match=r"the motion .*controller limits that motor to 0\.5 A"):
        send(move, dry.cell, link, tmp_path / "move.mcap", stop=Stop())
    assert not (tmp_path / "move.mcap").exists()


@pytest.mark.parametrize(
    "edit",
    [
        lambda content: content.update(passed="yes"),
        lambda content: content.update(criteria=[]),
        lambda content: content["criteria"][2].update(passed=False),
        lambda content: content.update(format_version=7),
        lambda content: content["criteria"].pop(),
    ],
)
def test_a_rehearsal_passes_with_all_its_criteria(
    copied: Campaign, edit: Callable[[dict[str, Any]], object]
) -> None:
    folder = copied.folder
    require_rehearsed(folder)
    content = json.loads(folder.rehearsal.read_text())
    edit(content)
    folder.rehearsal.write_text(json.dumps(content))
    with pytest.raises(CampaignFolderError, match=r"rehearsal\.json cannot be read"):
        require_rehearsed(folder)
