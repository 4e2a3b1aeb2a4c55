"""A measured position that slips within a motion, by less than the following-error threshold."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.campaign.errors import RepetitionsRejectedError
from hil.campaign.operator import RunStatus
from hil.cell import Cell
from hil.cli import app, exit_code_of
from hil.control import slips
from hil.control.errors import SlippedError
from hil.control.motion_watch import MotionProgress, OperatorRequest, Stop
from hil.control.move import plan_move, send, turned
from hil.control.slips import slip_of
from identification.signals.position_steps import PositionJump
from hil.testing.faulty import faulty_controller, faulty_link
from sim_fixtures import SimulatedController
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.campaign.runs.rig import Make, Operator

pytestmark = pytest.mark.safety

LASTING = 10**6  # cycles


@dataclass
class Slipping:
    """Lets the encoder of an axis slip `at` s of a motion, for some cycles."""

    controller: SimulatedController
    size: float  # of the following-error threshold
    at: float = 0.8
    axis: int = 2
    cycles: int = LASTING
    _done: bool = False

    def show(self, progress: MotionProgress) -> None:
        if not self._done and (progress.motion_time or 0.0) > self.at:
            self._done = True
            self.controller.disturb("slip", self.axis, self.size, self.cycles)

    def request(self) -> OperatorRequest:
        return OperatorRequest()


def moved(folder: Path, period: int, size: float, cycles: int = LASTING) -> Path:
    """The archive of a move of joint 2 by 20°, in a cycle of `period` ms."""
    cell = Cell.load(CELL_PATH).with_values({"controller.cycle_ms": period})
    controller = faulty_controller(cell)
    link = faulty_link(cell, controller=controller)
    here = link.connect(Stop())
    planned = plan_move(cell, here, turned(cell, here, "joint_2", 20.0))
    path = folder / "move.mcap"
    watch = Slipping(controller, size, cycles=cycles)
    send(planned, cell, link, path, stop=Stop(), watch=watch, durable=False)
    return path


@pytest.mark.usefixtures("shown_in_virtual_time")
@pytest.mark.parametrize("period", [1, 2, 4])
@pytest.mark.parametrize("size", [0.9, 0.05])
def test_a_slip_is_named_when_the_motion_has_ended(
    tmp_path: Path, period: int, size: float
) -> None:
    """Of 2.8° as of 0.16°: the threshold is 3.1°."""
    with pytest.raises(SlippedError, match=r"position of joint_2 slipped by .*coupling") as slipped:
        moved(tmp_path, period, size)
    assert exit_code_of(slipped.value) == 4
    archive = open_archive(tmp_path / "move.mcap")
    assert archive.complete
    assert archive.outcome is not None
    assert archive.outcome.outcome == "rejected"
    degrees = math.degrees(abs(slipped.value.slip.size))
    threshold = 360.0 * Cell.load(CELL_PATH).drive_table.following_error[1]
    ratio = abs(Cell.load(CELL_PATH).drive_train.joint_from_motor[1, 1])
    assert degrees == pytest.approx(size * threshold * ratio, rel=0.1)


@pytest.mark.usefixtures("shown_in_virtual_time")
@pytest.mark.parametrize("period", [1, 2, 4])
@pytest.mark.parametrize("cycles", [1, 2])
def test_one_wrong_packet_is_no_slip(tmp_path: Path, period: int, cycles: int) -> None:
    assert slip_of(moved(tmp_path, period, 0.9, cycles=cycles)) is None


@pytest.mark.usefixtures("shown_in_virtual_time")
def test_a_velocity_of_the_same_positions_hides_no_slip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SlippedError):
        moved(tmp_path, 2, 0.3)
    path = tmp_path / "move.mcap"
    monkeypatch.setattr(
        "hil.control.slips._travel",
        lambda velocity, time: open_archive(path).columns["position"] + 0.0 * velocity,
    )
    slip = slip_of(path)
    assert slip is not None and slip.joint == "joint_2"


@pytest.mark.usefixtures("shown_in_virtual_time")
def test_a_repetition_with_a_slip_ends_the_run(make: Make) -> None:
    campaign = make(repetitions=3)
    controller = faulty_controller(campaign.cell)
    slipping = Slipping(controller, 0.3, at=0.3, axis=1)

    class Watching(Operator):
        def show(self, status: RunStatus) -> None:
            super().show(status)
            if status.phase == "repetition" and status.motion is not None:
                slipping.show(status.motion)

    link = faulty_link(campaign.cell, controller=controller)
    with pytest.raises(SlippedError, match="position of shoulder slipped"):
        campaign.run(link, operator=Watching(), durable=False)
    entries = campaign.folder.manifest()
    assert (entries[-1].kind, entries[-1].outcome) == ("excitation", "rejected")
    assert not campaign.folder.completed("excitation")


def test_a_campaign_without_slips_has_none(make: Make) -> None:
    """Also where the operator slows and holds it."""
    campaign = make(repetitions=2)
    held = iter([False] * 20 + [True] * 3)
    operator = Operator(lambda _: OperatorRequest(0.4, held=next(held, False)))
    with contextlib.suppress(RepetitionsRejectedError):  # it was slowed
        campaign.run(operator=operator, durable=False)
    names = [entry.name for entry in campaign.folder.manifest()]
    assert len(names) > 5
    assert {slip_of(campaign.folder.archives / name) for name in names} == {None}


def test_the_move_of_a_campaign_is_entered_as_rejected(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = make()
    monkeypatch.setattr(slips, "slip_of", lambda _: PositionJump("", "elbow", 0.1, 0.02))
    way = ["move", str(campaign.folder.root), "--joint", "elbow", "--by", "5", "--json"]
    result = CliRunner().invoke(app, way)
    assert isinstance(result.exception, SlippedError)
    assert exit_code_of(result.exception) == 4
    assert "Check encoder" in str(result.exception)
    assert [entry.outcome for entry in campaign.folder.manifest()] == ["rejected"]
