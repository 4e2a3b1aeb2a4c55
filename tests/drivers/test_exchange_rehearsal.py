from __future__ import annotations

import numpy as np
import pytest

from drivers import CyclicPacket, Mode, State
from drivers.exchange.rehearsal import Rehearsal, rehearse
from tests.drivers.rig import PERIOD, N, drive_train, limits


@pytest.mark.parametrize("period", [0.001, 0.002])
def test_it_goes_as_far_as_a_motion_in_open_mode(period):
    assert rehearse(drive_train(), limits(), period) is State.OPEN


def test_it_tells_the_arm_to_stay_in_the_middle_of_its_range():
    lower, upper = np.linspace(-3.0, -1.0, N), np.linspace(1.0, 2.5, N)
    rehearsal = Rehearsal(drive_train(), limits(lower=lower, upper=upper), PERIOD)
    for _ in range(5):
        answer = CyclicPacket.decode(rehearsal.cycle(), N)
    assert (answer.axes["mode"] == Mode.POSITION).all()
    told = drive_train().joint_position(answer.axes["d"][:, 0].astype(float))
    np.testing.assert_allclose(told, 0.5 * (lower + upper), atol=1e-6)
