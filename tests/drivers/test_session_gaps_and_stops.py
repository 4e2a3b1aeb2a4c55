"""Packets that never arrive, and motions that are told to stop."""

from __future__ import annotations

import numpy as np
from rig import (
    START,
    Cruise,
    Rig,
    smooth_move,
    still,
)

from drivers import (
    GapSeen,
    Mode,
    MotionEnded,
    MotionStarted,
    State,
)

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


class TestGaps:
    def test_motion_goes_on_one_period_after_a_gap(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(300)
        rig.miss(2)
        rig.cycle()
        assert source.advances == 301
        assert rig.seen(GapSeen) == [GapSeen(2, rig.records["cycle"][-1])]
        last, before = rig.records[-1], rig.records[-2]
        assert last["gap"] == 2
        assert last["cycle"] - before["cycle"] == 3
        assert rig.state is State.OPEN
        assert source.stops == 0

    def test_more_than_the_allowed_gap_stops_on_the_path(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(300)
        rig.miss(3)
        rig.cycle()
        assert source.stops == 1
        rig.run()
        assert rig.ended.outcome == "stopped"
        assert "3 packets" in rig.ended.reason

    def test_two_gaps_that_are_small_enough_do_not_add_up(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        for _ in range(20):
            rig.miss(2)
            rig.cycle(2)
        assert source.stops == 0
        assert rig.session.counters.missed == 40

    def test_a_duplicate_does_not_advance_the_motion(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(50)
        packet, reply = rig.transcript[-1]
        assert rig.send(packet) == reply
        assert source.advances == 50

    def test_motion_survives_the_wrap_of_the_numbers(self):
        rig = Rig(ring_capacity=64)
        rig.close()
        rig.cycle(0x7FFF - rig.number - 20)
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        rig.run()
        assert rig.ended.outcome == "completed"
        assert rig.session.counters.missed == 0


class TestStop:
    def test_stop_brings_the_motion_to_rest_on_its_path_and_leaves(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(400)
        rig.session.stop()
        rig.session.stop("once more")
        rig.run()
        assert source.stops == 1
        assert rig.ended == MotionEnded("stopped", "a stop was asked for", 0, rig.ended.cycle)
        commanded = rig.records["commanded_position"]
        moved = commanded[np.isfinite(commanded[:, 0])]
        np.testing.assert_allclose(moved[:, 1:], START[1:] + 0 * moved[:, 1:], atol=1e-6)
        assert np.abs(np.diff(moved[-5:, 0])).max() == 0.0

    def test_a_motion_that_has_not_begun_is_dropped(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.session.stop("changed my mind")
        rig.close()
        assert rig.ended.outcome == "stopped"
        rig.open()
        rig.cycle(10)
        assert rig.seen(MotionStarted) == []

    def test_stop_while_holding_leaves_open_mode(self):
        rig = Rig()
        rig.open()
        rig.session.stop()
        rig.cycle()
        assert rig.exits_asked == 1
        assert rig.state is State.EXITING

    def test_stop_with_axes_closed_changes_nothing(self):
        rig = Rig()
        rig.close()
        rig.session.stop()
        rig.modes = Mode.POSITION
        rig.cycle(3)
        assert rig.exits_asked == 0
