"""What seeds have found in the product, each as small as it could be made."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers import State
from drivers.transports import SimulatedTransport
from hil.campaign import Link
from hil.campaign.motion_link import not_ready
from hil.campaign.stop import Stop
from hil.errors import ControllerFault
from hil.simulation import simulated_controller
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
