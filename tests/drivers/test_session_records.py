"""What is kept of each cycle."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    Mode,
    State,
)
from tests.drivers.rig import (
    PERIOD,
    START,
    Rig,
    running,
    smooth_move,
)

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


class TestRecords:
    def test_one_record_per_answered_cyclic_packet_with_the_packet_in_si(self):
        rig = Rig()
        rig.start(cold=True)
        rig.cycle(4, status=0)
        rig.status = 5
        rig.close()
        d = rig.axes["d"]
        d[:, 1] = [0.01, -0.02, 0.03, 0.0, 0.01, -0.01]
        d[:, 3] = [0.02, -0.01, 0.01, 0.02, 0.0, 0.01]
        d[:, 4] = [1, 2, 3, 4, 5, 6]
        rig.axes["extra"] = np.arange(18).reshape(6, 3)
        rig.cycle()
        assert len(rig.records) == 6
        record = rig.records[-1]
        assert (record["cycle"], record["number"], record["gap"]) == (8, 18, 0)
        assert (record["state"], record["status"]) == (State.CLOSED, 5)
        assert record["arrival"] == pytest.approx(rig.now)
        np.testing.assert_array_equal(record["mode"], Mode.CLOSED)
        np.testing.assert_allclose(record["target_position"], START, atol=1e-6)
        np.testing.assert_allclose(record["position"], START, atol=1e-6)
        wire = d.astype(np.float64)
        for name, column in (("target_velocity", 1), ("velocity", 3)):
            expected = rig.train.joint_velocity(wire[:, column], PERIOD)
            np.testing.assert_allclose(record[name], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(record["target_current"], [1, 2, 3, 4, 5, 6])
        np.testing.assert_array_equal(record["model_current"], [0, 3, 6, 9, 12, 15])
        np.testing.assert_array_equal(record["diagonal_inertia"], [1, 4, 7, 10, 13, 16])
        np.testing.assert_array_equal(record["extra3"], [2, 5, 8, 11, 14, 17])
        assert np.isnan(record["commanded_position"]).all()
        assert np.isnan(record["commanded_velocity"]).all()

    def test_records_of_an_interval_hold_what_was_commanded_and_nothing_else_does(self):
        source = smooth_move(MOVE, 300)
        rig = running(source)
        rig.run()
        rig.cycle(5)
        inside = rig.records[rig.records["interval"] == 0]
        outside = rig.records[rig.records["interval"] == -1]
        # first set-point, 300 more, 5 of settling of which the last asks for exit
        assert len(inside) == 306
        np.testing.assert_allclose(inside["commanded_position"][:301], source.positions, atol=1e-7)
        np.testing.assert_allclose(
            inside["commanded_velocity"][1:301], source.velocities[1:], atol=1e-4
        )
        assert set(inside["state"]) == {State.OPEN, State.EXITING}
        assert np.isnan(outside["commanded_position"]).all()
