"""Packets that never arrive, and motions that are told to stop."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    GapSeen,
    Mode,
    MotionEnded,
    MotionHeld,
    MotionNotCarriedOn,
    MotionPaused,
    MotionStarted,
    NotFinite,
    RefusalError,
    State,
)
from drivers.guard import LAG
from planner import JointLimits, TrajectoryPlayer, plan
from tests.drivers.rig import (
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    assert_refused,
    limits,
    moving,
    smooth_move,
    still,
)

PLANNED = {
    name: getattr(limits(), name) for name in ("lower", "upper", "velocity", "acceleration", "jerk")
}
MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


def moving_at(share):
    """An arm whose first joint moves at a share of full speed."""
    wide = limits(lower=np.full(N, -9.0), upper=np.full(N, 9.0))
    rig = Rig(guard_limits=wide)
    source = type("Faster", (Cruise,), {"SPEED": share * wide.velocity[0], "RAMP": 1.0})()
    rig.session.request(source)
    rig.open()
    rig.cycle(1200)
    return rig, source


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


class TestLongGaps:
    """The arm of `Rig` goes on unanswered as if nothing were missed, unless a test stops it."""

    def after_gap(self, missed, change, cycles=300):
        rig, source = moving(cycles)
        change(rig.axes["d"])
        rig.miss(missed)
        return rig, source, rig.cycle()

    def refused(self, answer, rig, kind):
        error = assert_refused(rig, answer, kind)
        assert error.joint == 0
        assert isinstance(error, RefusalError)
        return error

    def held(self, d):
        d[:, [1, 3]] = 0.0

    def test_a_controller_that_held_the_last_target_is_not_run_away_from(self):
        rig, source, answer = self.after_gap(3, self.held)
        step = 0.3 * 120.0 / (2.0 * np.pi) * PERIOD
        error = self.refused(answer, rig, MotionHeld)
        assert error.value == pytest.approx(step, rel=1e-3)
        assert error.bound == pytest.approx(step / 2, rel=1e-3)
        assert source.advances == 300

    @pytest.mark.parametrize("factor", [0.0, 0.49, 1.51, -1.0, np.nan])
    def test_one_whose_target_velocity_is_another_is_not_run_away_from(self, factor):
        def change(d):
            d[0, 1] *= factor

        kind = MotionHeld if np.isfinite(factor) else NotFinite
        rig, _, answer = self.after_gap(3, change)
        self.refused(answer, rig, kind)

    def test_one_whose_arm_stands_is_not_run_away_from_whatever_its_target_velocity(self):
        rig, _, answer = self.after_gap(3, lambda d: d[0].__setitem__(3, 0.0))
        self.refused(answer, rig, MotionHeld)

    def test_an_arm_that_lags_behind_is_not_one_that_stands(self):
        rig, _, _ = self.after_gap(3, lambda d: d[0].__setitem__(3, 0.3 * d[0, 3]))
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("sign", [-1, 1])
    def test_one_whose_target_went_elsewhere_is_not_one_that_stands(self, sign):
        def change(d):
            d[0, [0, 2]] += sign * 0.201

        rig, _, answer = self.after_gap(3, change)
        error = self.refused(answer, rig, MotionNotCarriedOn)
        assert error.value == pytest.approx(0.201, abs=1e-5)
        assert error.bound == pytest.approx(0.2)

    def test_a_target_carried_on_a_little_further_is_stopped_on_the_path(self):
        def change(d):
            d[0, [0, 2]] += 3 * d[0, 1]

        rig, source, _ = self.after_gap(3, change)
        assert rig.state is State.OPEN
        assert source.stops == 1

    @pytest.mark.parametrize(("missed", "cycles"), [(3, 6), (7, 14), (8, 15), (400, 15)])
    def test_jerk_has_no_bound_for_30_ms_at_most(self, missed, cycles):
        """However far a controller carried the motion on, by the steps it had."""
        rig, source = moving_at(0.1)
        spread = []

        def go_on_from(position, velocity, cycles):
            source._position = position
            spread.append(cycles)

        source.go_on_from = go_on_from
        rig.miss(missed)
        rig.axes["d"][:, 0] += missed * rig.axes["d"][:, 1]
        rig.axes["d"][:, 2] = rig.axes["d"][:, 0]
        rig.cycle()
        assert spread == [cycles]
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("late", [0, 1, 2])
    def test_a_target_reported_late_is_further_on_by_now(self, late):
        """The set-point after the gap is one step from where the controller has its target."""
        path = plan([START, START + MOVE * 6.0], JointLimits(**PLANNED))
        rig = Rig()
        rig.session.request(TrajectoryPlayer(path, PERIOD, JointLimits(**PLANNED)))
        rig.open()
        targets, d = [rig.axes["d"][:, 0].copy()] * 4, rig.axes["d"]

        def report():
            now, before = targets[-1 - late], targets[-2 - late]
            d[:, 0], d[:, 1] = now, now - before
            d[:, 2], d[:, 3] = targets[-1], targets[-1] - targets[-2]

        for _ in range(200):
            report()
            targets.append(rig.cycle().axes["d"][:, 0].copy())
        step = targets[-1] - targets[-2]
        rig.miss(5)
        targets += [targets[-1] + ahead * step for ahead in range(1, 6)]
        for _ in range(3):
            report()
            targets.append(rig.cycle().axes["d"][:, 0].copy())
        np.testing.assert_allclose(np.diff(targets[-5:], axis=0), [step] * 4, rtol=0.02, atol=1e-5)
        assert rig.state is State.OPEN

    def test_a_short_gap_is_bridged_even_so(self):
        rig, source, _ = self.after_gap(2, self.held)
        assert rig.state is State.OPEN
        assert (source.advances, source.stops) == (301, 0)

    def test_a_motion_that_creeps_below_standstill_may_be_stopped(self):
        rig, source, _ = self.after_gap(3, self.held, cycles=5)
        assert rig.state is State.OPEN
        assert source.stops == 1

    def test_an_arm_that_is_only_held_stays_held(self):
        rig = Rig()
        rig.open()
        rig.cycle(3)
        rig.miss(30)
        rig.cycle()
        assert rig.state is State.OPEN


class TestPauses:
    """The controller's numbers go on without a gap, but its packets come late by the clock."""

    @pytest.mark.parametrize("share", [0.25, 0.5, 0.8, 1.0])
    @pytest.mark.parametrize("pause", [0.02, 0.9])
    def test_an_arm_that_came_to_rest_is_not_driven_on(self, share, pause):
        """From rest to a full step in one cycle is a jump, however the numbers look."""
        rig, _ = moving_at(share)
        rig.now += pause
        rig.axes["d"][:, 3] = 0.0
        error = assert_refused(rig, rig.cycle(), MotionPaused)
        assert error.bound == pytest.approx(LAG * limits().acceleration[0])

    def test_an_arm_that_lags_behind_by_a_servo_is_driven_on(self):
        """A loaded computer looks like that: its cycle was stretched, nothing else."""
        rig, source = moving_at(1.0)
        rig.now += 0.9
        rig.axes["d"][:, 3] *= 1.0 - 0.9 * LAG * 8.0 / 2.0
        rig.cycle(20)
        assert (rig.state, source.stops) == (State.OPEN, 0)

    def test_an_arm_that_is_only_held_stays_held(self):
        rig = Rig()
        rig.open()
        rig.cycle(3)
        rig.now += 0.9
        rig.cycle(3)
        assert rig.state is State.OPEN


class TestCorruptedNumbers:
    """A number that was changed on its way makes the controller's own look stale for a while."""

    def corrupted(self, ahead: int):
        rig, source = moving()
        true = rig.number
        rig.number = true + ahead - 1
        rig.cycle()
        assert rig.state is State.OPEN
        rig.number = true + 1
        return rig, source

    def test_another_packet_with_the_same_number_is_no_duplicate(self):
        rig, _ = moving()
        packet, reply = rig.transcript[-1]
        other = bytearray(packet)
        other[4] = 0
        assert rig.send(bytes(other)) is None
        assert rig.session.counters.stale == 1
        assert rig.send(packet) == reply

    def test_no_old_set_point_is_given_out_when_the_numbers_meet(self):
        rig, _ = self.corrupted(64)
        answers = [rig.cycle() for _ in range(63)]
        assert answers == [None] * 63
        assert rig.session.counters.stale == 63

    def test_packets_that_went_unanswered_meanwhile_are_a_gap(self):
        rig, source = self.corrupted(3)
        assert (rig.cycle(), rig.cycle()) == (None, None)
        rig.cycle()
        assert rig.state is State.OPEN
        assert source.stops == 0
        rig, source = self.corrupted(64)
        rig.cycle(63)
        rig.axes["d"][:, [1, 3]] = 0.0
        assert_refused(rig, rig.cycle(), MotionHeld)

    def test_a_stale_packet_or_two_are_not(self):
        rig, source = moving()
        for packet, _ in rig.transcript[-5:-3]:
            assert rig.send(packet) is None
        rig.cycle()
        assert (rig.state, source.stops) == (State.OPEN, 0)


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
