"""What seeds have found in the product, each as small as it could be made."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers import State
from drivers.exchange import exchange
from drivers.transports import SimulatedTransport
from hil.archive import ArchiveSpec, open_archive
from hil.campaign import Link
from hil.campaign.intervals import START_TOLERANCE
from hil.campaign.motion_link import not_ready
from hil.campaign.stop import Stop
from hil.errors import ControllerFault
from hil.simulation import simulated_controller
from planner import Move, TrajectoryPlayer, plan_moves
from tests.hil.fast_cell import fast_cell


class TestAControllerThatDoesNotBeginASession:
    """Seed 72 with `hurry@0`: a run begun anew met a controller whose session went on.

    Its drive was off, so that its packets were echoed as those before an init packet are, for all
    of the 60 s; then the person was told to switch the drive on, which does not help.
    """

    def test_the_person_is_told_to_start_its_program_anew(self, tmp_path: Path) -> None:
        cell = fast_cell(tmp_path)
        controller = simulated_controller(cell)
        first = Link.over(SimulatedTransport(controller), cell)
        first.connect(Stop())
        controller.emergency_stop()
        second = Link.over(SimulatedTransport(controller), cell)
        with pytest.raises(ControllerFault, match=r"did not begin a session.*anew") as told:
            second.connect(Stop(), timeout=0.5)
        assert "switch the drive on" not in str(told.value)

    def test_a_session_that_ended_at_once_is_not_said_to_have_been_waited_for(
        self, tmp_path: Path
    ) -> None:
        cell = fast_cell(tmp_path)
        controller = simulated_controller(cell)
        controller.finish()
        link = Link.over(SimulatedTransport(controller), cell)
        with pytest.raises(ControllerFault, match="ended the session within 0") as told:
            link.connect(Stop())
        assert "60 s" not in str(told.value)

    def test_one_whose_drive_is_off_is_still_told_so(self) -> None:
        assert "switch the drive on" in str(not_ready(State.DRIVE_OFF, 60.0))
        assert "within 60 s" in str(not_ready(State.DRIVE_OFF, 60.0))


def test_a_motion_whose_drive_goes_off_before_it_begins_is_not_waited_for_without_end(
    tmp_path: Path,
) -> None:
    """Seed 455: the drive was lost between two motions, and virtual time went on for ever."""
    cell = fast_cell(tmp_path)
    controller = simulated_controller(cell)
    link = Link.over(SimulatedTransport(controller), cell)
    where = link.connect(Stop())
    controller.emergency_stop()
    packets = iter(range(10))
    exchange(link.transport, link.session, until=lambda: next(packets, None) is None)
    way = plan_moves(where, (Move(where + 0.1),), cell.joint_limits).trajectory
    player = TrajectoryPlayer(way, cell.period, cell.joint_limits, start_tolerance=START_TOLERANCE)
    drives = {"drive_train.json": cell.drive_table.model_dump_json().encode()}
    spec = ArchiveSpec(tmp_path / "a.mcap", cell.joint_names, cell.period, {"kind": "move"}, drives)
    with pytest.raises(ControllerFault, match="went off before the motion began; nothing was sent"):
        link.run(player, spec, Stop())
    assert (open_archive(spec.path).outcome or {})["outcome"] == "void"
