"""Loss of drive, open mode, link, packets or replies during a motion."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import GapSeen, Guard, InitReceived, Mode, MotionEnded, MotionStarted, State
from drivers.c4g_packets import LAST_NUMBER, PacketSequence
from drivers.errors import AxisNotInMode, Check
from drivers.events import RepliesLost
from drivers.guard import SERVO_LAG_SECONDS
from drivers.open_mode import MAX_RESENDS, SentSetPoints
from tests.drivers.losses import FAR, at_speed, lose, planned
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    all_drive_off,
    assert_refused,
    closed,
    exiting,
    kind_of,
    limits,
    moving,
    only,
    opened,
    refused,
    resumptions,
    running,
    smooth_move,
    still,
)
from tests.messages import (
    CONTROLLER_CLOSED,
    NOTHING_RECEIVED,
    RESTARTED_WITH_SYNC,
    SWITCHED_ON_AGAIN,
)

pytestmark = pytest.mark.safety

OFF = "the drive went off"
RESTARTED = "the controller restarted: it sent an init packet"
PAUSED = "the controller paused the exchange"


class TestLostMotion:
    @pytest.mark.parametrize(
        ("change", "state", "reason"),
        [
            ({"status": 0}, State.DRIVE_OFF, OFF),
            ({"mode": Mode.CLOSED}, State.CLOSED, CONTROLLER_CLOSED),
            ({"mode": Mode.DRIVING_ON}, State.DRIVING_ON, SWITCHED_ON_AGAIN),
            ({"mode": Mode.PAUSE_BY_PC}, State.FREEZING, PAUSED),
            ({"mode": Mode.PAUSE_BY_CONTROLLER}, State.FREEZING, PAUSED),
            ({"mode": Mode.FOLLOWING_ERROR}, State.FAULTED, ""),
            ({"mode": Mode.END_OF_SESSION}, State.ENDED, ""),
            ("silence", State.FAULTED, "nothing was received"),
            ("init", State.INIT, RESTARTED),
        ],
    )
    def test_open_mode_going_away_ends_the_motion(self, change, state, reason):
        """Axes that are open afterwards have to close first."""
        rig, source = moving()
        if change == "silence":
            rig.session.tick(rig.now + 1.0)
            rig.events += rig.session.events()
        elif change == "init":
            rig.start()
            assert len(rig.seen(InitReceived)) == 2
        else:
            rig.cycle(**change)
        assert rig.state is state
        assert (rig.ended.outcome, rig.ended.interval) == ("lost", 0)
        assert reason in rig.ended.reason
        advances = source.advances
        if state not in (State.CLOSED, State.DRIVING_ON, State.ENDED):
            assert all_drive_off(rig.cycle(mode=Mode.POSITION, status=5))
            assert rig.state is State.FAULTED
            if isinstance(change, str):
                assert rig.records["interval"][-1] == -1
            rig.axes["d"][:, [1, 3]] = 0.0
            rig.open()
            assert rig.state is State.OPEN
        rig.cycle(5)
        assert source.advances == advances

    @pytest.mark.parametrize("length", [12, 260, 732])
    def test_sync_packets_in_mid_motion_are_said_to_be_a_restart(self, length):
        """They get no reply before silence has ended the session; then they are followed."""
        rig, _ = moving()
        for _ in range(3):
            assert rig.sync(1, length) is None
        rig.session.tick(rig.now + 1.0)
        rig.events += rig.session.events()
        assert rig.ended.outcome == "lost"
        assert rig.ended.reason == RESTARTED_WITH_SYNC
        assert rig.sync(1) is not None
        assert rig.state is State.SYNC

    def test_a_stale_number_10_is_no_restart(self):
        """Sync packets are numbered 1 to 9; 10 is the init packet, by its length."""
        rig, _ = moving()
        assert rig.sync(10) is None
        rig.session.tick(rig.now + 1.0)
        rig.events += rig.session.events()
        assert rig.ended.reason == "only packets that do not follow the last one came (1)"

    def test_a_late_sync_packet_is_no_restart(self):
        rig, source = moving()
        advances = source.advances
        assert rig.sync(1) is None
        rig.cycle()
        rig.session.tick(rig.now + 1.0)
        rig.events += rig.session.events()
        assert source.advances == advances + 1
        assert rig.ended.reason == NOTHING_RECEIVED

    @pytest.mark.parametrize(("change", "reason"), [({"status": 0}, OFF), ("init", RESTARTED)])
    def test_a_late_sync_packet_is_no_cause_of_what_follows(self, change, reason):
        rig, _ = moving()
        assert rig.sync(1) is None
        if change == "init":
            rig.start()
        else:
            rig.cycle(**change)
        assert (rig.ended.outcome, rig.ended.reason) == ("lost", reason)

    @pytest.mark.parametrize(
        ("waits", "change", "reason"),
        [
            (Mode.CLOSED, {"status": 0}, OFF),
            (Mode.DRIVING_ON, {"status": 0}, OFF),
            (Mode.CLOSED, {"mode": Mode.DRIVING_ON}, SWITCHED_ON_AGAIN),
            (Mode.CLOSED, {"mode": Mode.PAUSE_BY_PC}, PAUSED),
            (Mode.CLOSED, {"mode": Mode.PAUSE_BY_CONTROLLER}, PAUSED),
        ],
    )
    def test_a_waiting_motion_is_lost_and_another_may_follow(self, waits, change, reason):
        rig = Rig()
        rig.session.request(source := Cruise())
        rig.start()
        rig.cycle(mode=waits)
        assert rig.session.requested
        rig.cycle(**change)
        assert rig.ended == MotionEnded("lost", reason, -1, rig.ended.cycle)
        rig.cycle(3, status=5)
        rig.session.request(still(3))
        rig.open()
        rig.run_to("completed")
        assert source.begun_at is None

    def test_axis_that_closes_is_refused_during_a_motion(self):
        rig, _ = moving()
        rig.axes["mode"][2] = Mode.CLOSED
        error = assert_refused(rig, rig.cycle(), AxisNotInMode)
        assert "joint 3 is in mode 0; the motion needs 4" in str(error)
        rig = opened(3)  # without one, open mode is left
        rig.axes["mode"][2] = Mode.CLOSED
        answer = rig.cycle()
        assert rig.state is State.EXITING
        np.testing.assert_array_equal(answer.axes["mode"], rig.axes["mode"])

    def test_interval_of_a_motion_requested_while_leaving(self):
        rig = running(still(3))
        while rig.session.requested:
            rig.cycle()
            rig.status = 0 if rig.state is State.EXITING else 5  # as in a corrupted packet
        assert (rig.ended.outcome, rig.ended.interval) == ("completed", 0)
        rig.session.request(still(3))
        assert all_drive_off(rig.cycle(status=5))
        assert (rig.ended.outcome, rig.ended.interval) == ("lost", -1)


STEP = 1.9 * 0.002 * 120.0 / (2.0 * np.pi)
"""Motor revolutions per cycle of joint 1 at full speed."""
PULL = 2.0 * 8.0 * 0.002**2 * 120.0 / (2.0 * np.pi) + 2e-5
"""Most that a step may change by from one cycle to the next in a stop, rounding included."""


def report_late(rig: Rig) -> None:
    """Make the controller accept replies, and report its target, a cycle late."""
    follow = rig._follow
    late = [rig.axes["d"].copy()]

    def follow_late(answer):
        follow(answer)
        late.append(rig.axes["d"].copy())
        rig.axes["d"][:] = late[-2]

    rig._follow = follow_late


class TestLostReplies:
    """The motion waits, and continues by one step from the target that is held."""

    @pytest.mark.parametrize("field", ["commanded_position", "commanded_velocity"])
    def test_set_point_sent_again_is_recorded_as_before(self, field):
        rig = at_speed()
        lose(rig, 3)
        first, second, third = rig.records[field][-3:]
        np.testing.assert_array_equal([second, third], [first] * 2)

    @pytest.mark.parametrize("share", [0.25, 0.5, 0.8, 1.0])
    @pytest.mark.parametrize(("lost", "continues"), [(1, True), (2, True), (5, False)])
    def test_one_step_at_each_speed(self, share, lost, continues):
        """Until it is accepted, and in each later cycle up to rest."""
        rig = at_speed(speed=1.9 * share)
        target = rig.axes["d"][0, 0]
        last = 0.0
        before = rig.session.cycle
        lose(rig, lost)
        for _ in range(30):
            answer = rig.cycle()
            step = answer.axes["d"][0, 0] - target
            target = answer.axes["d"][0, 0]
            assert -1e-5 <= step <= 1.001 * share * STEP
            assert last == 0.0 or abs(step - last) <= PULL
            last = step
        events = rig.seen(RepliesLost)
        assert sum(event.count for event in events) == rig.session.counters.rejected == lost
        assert events[0].cycle == before + 2
        rig.session.stop()
        rig.run_to("stopped")
        assert (rig.ended.reason == "a stop was requested") is continues

    def test_motion_omits_nothing(self):
        """Except for repetitions, the set-points are those of a motion without losses."""
        rig = at_speed(100)
        other = at_speed(100)
        np.testing.assert_array_equal(lose(rig, 1).axes, lose(rig, 1).axes)
        rig.cycle(60)
        other.cycle(60)
        sent, velocity = (rig.records[f"commanded_{what}"] for what in ("position", "velocity"))
        again = np.append(False, (np.diff(sent, axis=0) == 0.0).all(axis=1))
        again &= velocity.any(axis=1)
        assert again.sum() == 2
        np.testing.assert_array_equal(
            sent[~again][-150:], other.records["commanded_position"][-150:]
        )

    def test_link_that_becomes_late_stops_the_motion(self):
        """Replies are accepted a cycle late; coming to rest has no jumps."""
        rig = at_speed()
        report_late(rig)
        rig.run_to("stopped")
        assert rig.ended.reason == "3 replies were lost in 100 cycles"
        sent = rig.records["commanded_position"]
        waits = (np.diff(sent[600:, 0]) == 0.0) & (rig.records["commanded_velocity"][601:, 0] != 0)
        assert waits.sum() == 3

    def test_late_target_is_reported_once(self):
        rig = at_speed(0)
        report_late(rig)
        rig.cycle(600)
        assert (rig.state, rig.session.counters.rejected) == (State.OPEN, 1)

    def test_controller_that_accepts_no_reply_is_refused(self):
        rig = at_speed()
        answer = lose(rig, MAX_RESENDS + 2)
        assert assert_refused(rig, answer, Check.ACCEPTED).joint == 0

    @pytest.mark.parametrize("max_gap", [0, 1])
    def test_a_target_older_than_may_be_missed_is_refused(self, max_gap):
        """At a speed whose steps are more than a tenth of the threshold."""
        for behind in (max_gap, max_gap + 1):
            rig = at_speed(speed=6.0, max_gap=max_gap, guard_limits=only(**FAR))
            target = rig.axes["d"].copy()
            rig.cycle(behind)
            rig.axes["d"][:] = target
            answer = rig.cycle()
            assert rig.session.counters.rejected == (behind if behind <= max_gap else 0)
        assert assert_refused(rig, answer, Check.ACCEPTED).joint == 0

    @pytest.mark.parametrize(("max_gap", "pattern"), [(2, 3), (2, 40), (0, 40), (5, 9)])
    def test_many_losses_in_100_cycles_stop_the_motion(self, max_gap, pattern):
        rig = at_speed(max_gap=max_gap)
        for lost in range(1, max_gap + 2):
            assert not rig.session.stop_reason
            lose(rig, 1)
            rig.cycle(1 if lost > max_gap else pattern - 1)
        rig.run_to("stopped")
        assert rig.ended.reason == f"{max_gap + 1} replies were lost in 100 cycles"

    def test_earlier_losses_do_not_count(self):
        rig = at_speed()
        for _ in range(6):
            lose(rig, 1)
            rig.cycle(49)
        assert rig.session.counters.rejected == 6
        assert (rig.session.stop_reason, rig.state) == (None, State.OPEN)


class TestGaps:
    @pytest.mark.parametrize("missed", [1, 2, 3])
    def test_motion_advances_one_period_after_a_gap(self, missed):
        """More than two packets missed stop it on its path."""
        rig, source = moving()
        rig.miss(missed)
        rig.cycle()
        assert source.advances == 301
        assert rig.seen(GapSeen) == [GapSeen(missed, rig.records["cycle"][-1])]
        last = rig.records[-1]
        before = rig.records[-2]
        assert (last["gap"], last["cycle"] - before["cycle"]) == (missed, missed + 1)
        assert (rig.state, source.stops) == (State.OPEN, missed == 3)
        if missed == 3:
            rig.run_to("stopped")
            assert "3 packets" in rig.ended.reason

    def test_motion_survives_the_wrap_of_the_numbers(self):
        """And a cyclic packet with number 10 is no init packet."""
        rig = closed()
        rig.now += 2.0  # after a silence any number is new
        rig.number = LAST_NUMBER - 100
        rig.cycle()
        rig.session.request(smooth_move(MOVE, 300))
        rig.open()
        rig.run_to("completed")
        assert 10 < rig.number < 1000
        assert (rig.session.counters.missed, len(rig.seen(InitReceived))) == (0, 1)

    def test_short_gaps_do_not_add_up(self):
        rig, source = moving(0)
        for _ in range(20):
            rig.miss(2)
            rig.cycle(2)
        assert (source.stops, rig.session.counters.missed) == (0, 40)

    @pytest.mark.parametrize("leaving", [False, True])
    @pytest.mark.parametrize(
        ("columns", "off", "kind"),
        [([0, 2], 1.9, Check.ACCEPTED), ([1], 0.001, Check.GAP_VELOCITY), ([], 0.0, None)],
    )
    def test_arm_without_a_motion_is_held_where_it_was_and_at_rest(
        self, leaving, columns, off, kind
    ):
        """Meanwhile the controller may have left open mode, moved the arm, and come back."""
        rig = opened(20)
        if leaving:
            rig.session.stop()
            rig.cycle()
        rig.miss(400)
        rig.axes["d"][0, columns] += off
        answer = rig.cycle()
        if kind is None:
            assert rig.state is (State.EXITING if leaving else State.OPEN)
        else:
            assert all_drive_off(answer)
            assert kind_of(rig.refusal) is kind
            assert rig.refusal.value == pytest.approx(off)

    def test_closed_axis_is_not_compared(self):
        rig = exiting()
        rig.miss(10)
        rig.axes["mode"][0] = 0
        rig.axes["d"][0] = 3.0
        rig.cycle()
        assert rig.state is State.EXITING


def hold(d):
    """As a controller that held its target while packets were missing."""
    d[:, [1, 3]] = 0.0


def extrapolate(d):
    d[0, [0, 2]] += 3 * d[0, 1]


class TestLongGaps:
    """The arm of `Rig` continues without replies, unless a test stops it."""

    def after_gap(self, missed, change, cycles=300):
        rig, source = moving(cycles)
        change(rig.axes["d"])
        rig.miss(missed)
        return rig, source, rig.cycle()

    def test_controller_that_held_its_target_is_refused(self):
        rig, source, answer = self.after_gap(3, hold)
        step = 0.3 * 120.0 / (2.0 * np.pi) * PERIOD
        error = assert_refused(rig, answer, Check.GAP_VELOCITY)
        assert error.joint == 0
        assert error.value == pytest.approx(step, rel=1e-3)
        assert error.bound == pytest.approx(step / 2, rel=1e-3)
        assert source.advances == 300

    @pytest.mark.parametrize("factor", [0.0, 0.49, 1.51, -1.0, np.nan])
    def test_another_target_velocity_is_refused(self, factor):
        rig, _, answer = self.after_gap(3, lambda d: np.multiply.at(d, (0, 1), factor))
        kind = Check.GAP_VELOCITY if np.isfinite(factor) else Check.FINITE
        assert assert_refused(rig, answer, kind).joint == 0

    @pytest.mark.parametrize(
        ("missed", "change", "cycles", "stops"),
        [(3, extrapolate, 300, 1), (2, hold, 300, 0), (3, hold, 5, 1)],
        ids=["extrapolated", "short gap", "below standstill"],
    )
    def test_motion_that_continues_is_stopped_on_its_path(self, missed, change, cycles, stops):
        rig, source, _ = self.after_gap(missed, change, cycles)
        assert (rig.state, source.stops) == (State.OPEN, stops)
        assert source.advances == cycles + 1

    @pytest.mark.parametrize(("missed", "cycles"), [(3, 6), (7, 14), (8, 15), (400, 15)])
    def test_jerk_has_no_bound_for_30_ms_at_most(self, missed, cycles):
        """Depends on the number of steps that the controller extrapolated."""
        rig = at_speed(1200, speed=0.2)
        resumed = resumptions(rig)
        rig.miss(missed)
        rig.axes["d"][:, 0] += missed * rig.axes["d"][:, 1]
        rig.axes["d"][:, 2] = rig.axes["d"][:, 0]
        rig.cycle()
        assert [spread for _, _, spread in resumed] == [cycles]
        assert rig.state is State.OPEN

    @pytest.mark.parametrize(
        ("speed", "factor", "arm", "expected"),
        [
            *((0.5, factor, 0.9, 0.5 * factor) for factor in (1.2, 0.8)),
            *((0.01, factor, 0.9, 0.01) for factor in (1.2, 0.0)),
            (0.02, 1.2, 0.6, 0.024),  # the arm alone is below standstill
        ],
    )
    def test_the_motion_continues_with_the_velocity_of_its_target(
        self, speed, factor, arm, expected
    ):
        """Not that of the arm; below standstill, where a velocity says little, with its own."""
        rig = at_speed(1200, speed=speed)
        resumed = resumptions(rig)
        rig.miss(5)
        d = rig.axes["d"]
        d[:, [0, 2]] += 5 * d[:, [1]]
        d[:, 1] *= factor
        d[:, 3] *= arm
        rig.cycle()
        ((_, velocity, _),) = resumed
        np.testing.assert_allclose(velocity, expected * np.eye(N)[0], rtol=1e-4, atol=1e-6)

    @pytest.mark.parametrize("late", [0, 1, 2])
    def test_a_target_reported_late_is_further_on_by_now(self, late):
        """The set-point after the gap is one step from where the controller has its target."""
        rig = running(planned())
        targets = [rig.axes["d"][:, 0].copy()] * 4
        d = rig.axes["d"]

        def report():
            now = targets[-1 - late]
            before = targets[-2 - late]
            d[:, 0], d[:, 1] = now, now - before
            # An arm that lags behind.
            d[:, 2], d[:, 3] = targets[-1], 0.9 * (targets[-1] - targets[-2])

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

    @pytest.mark.parametrize(
        ("column", "factor", "off", "kind"),
        [
            (0, 1.0, 0.0, None),
            (0, 1.0, 0.25, Check.ACCEPTED),
            (1, 0.4, 0.0, Check.GAP_VELOCITY),
            (1, 1.6, 0.0, Check.GAP_VELOCITY),
        ],
    )
    def test_motion_that_can_be_resumed_is_compared_as_well(self, column, factor, off, kind):
        rig = running(planned(), 200)
        d = rig.axes["d"]
        rig.miss(5)
        d[:, [0, 2]] += 5.0 * d[:, [1]]
        d[0, column] = factor * d[0, column] + off
        answer = rig.cycle()
        if kind is None:
            assert rig.state is State.OPEN
        else:
            assert assert_refused(rig, answer, kind).joint == 0

    def test_motion_held_at_its_begin_stays(self):
        """Slower than what counts as standstill, only its target shows that it was held."""
        rig = running(planned())
        target = rig.axes["d"][:, 0].copy()
        while np.abs(rig.axes["d"][:, 0] - target).max() < 0.5 * limits().standstill:
            target = rig.axes["d"][:, 0].copy()
            rig.cycle()
        target = rig.axes["d"][:, 0].copy()
        hold(rig.axes["d"])
        rig.miss(8)
        np.testing.assert_allclose(rig.cycle().axes["d"][:, 0], target, rtol=0, atol=1e-6)
        rig.run_to("stopped")


class TestPauses:
    """Packet numbers have no gap, but packets come late by the clock."""

    @pytest.mark.parametrize("share", [0.25, 0.5, 0.8, 1.0])
    @pytest.mark.parametrize("pause", [0.02, 0.9])
    def test_arm_at_rest_is_refused(self, share, pause):
        """From rest to a full step in one cycle is a jump, however the numbers look."""
        rig = at_speed(1200, speed=2.0 * share)
        rig.now += pause
        rig.axes["d"][:, 3] = 0.0
        error = assert_refused(rig, rig.cycle(), Check.PAUSE_VELOCITY)
        assert error.bound == pytest.approx(SERVO_LAG_SECONDS * limits().acceleration[0])

    @pytest.mark.parametrize("missed", [0, 2])
    @pytest.mark.parametrize(("cycles", "state"), [(3.9, State.OPEN), (4.1, State.FAULTED)])
    def test_pause_is_longer_than_an_allowed_gap_by_two_cycles(self, missed, cycles, state):
        rig = at_speed(1200, speed=2.0)
        rig.miss(missed)
        rig.now = rig.session._arrived_at + (cycles - 1.0) * PERIOD
        rig.axes["d"][:, 3] = 0.0
        rig.cycle()
        assert rig.state is state

    def test_arm_that_lags_or_rests_without_a_motion_continues(self):
        """As on a busy computer, whose cycle was longer."""
        rig = at_speed(1200, speed=2.0)
        rig.now += 0.9
        rig.axes["d"][:, 3] *= 1.0 - 0.9 * SERVO_LAG_SECONDS * 8.0 / 2.0
        rig.cycle(20)
        assert (rig.state, rig.session.stop_reason) == (State.OPEN, None)
        rig = opened(3)
        rig.now += 0.9
        rig.cycle(3)
        assert rig.state is State.OPEN


class TestNumbers:
    HALF = LAST_NUMBER // 2

    @pytest.mark.parametrize(
        ("window", "ahead"),
        [(0.0, 1), (0.9, 1), (1.9, 1), (500.0, 500), (HALF, HALF), (HALF + 1, HALF), (1e9, HALF)],
    )
    def test_numbers_within_the_window_are_new(self, window, ahead):
        sequence = PacketSequence()
        sequence.restart(10, window)
        assert sequence.is_duplicate(10)
        for number in (9, 10, 11 + ahead, LAST_NUMBER):
            assert sequence.is_stale(number)
        for number in (11, 10 + ahead):
            assert not sequence.is_stale(number)

    def test_before_the_init_packet_half_of_them_count_as_missed(self):
        sequence = PacketSequence()
        assert (sequence.last, sequence.cycle, sequence.broken) == (0, 0, False)
        assert PacketSequence().accept(self.HALF) == self.HALF - 1
        assert PacketSequence().accept(self.HALF + 1) == 0

    def test_only_the_same_bytes_are_a_duplicate(self):
        """A number changed on its way makes the controller's own look stale for a while."""
        rig, source = moving(50)
        packet, reply = rig.transcript[-1]
        other = bytearray(packet)
        other[4] = 0
        assert rig.send(bytes(other)) is None
        assert rig.session.counters.stale == 1
        assert rig.send(packet) == reply
        assert source.advances == 50
        true = rig.number
        rig.number = true + 63
        rig.cycle()
        assert rig.state is State.OPEN
        rig.number = true + 1
        assert [rig.cycle() for _ in range(63)] == [None] * 63
        assert rig.session.counters.stale == 64


class TestStop:
    def test_stop_brings_the_motion_to_rest_on_its_path_and_leaves(self):
        rig = running(source := Cruise(), 400)
        rig.session.stop()
        rig.session.stop("once more")
        rig.run()
        assert source.stops == 1
        assert rig.ended == MotionEnded("stopped", "a stop was requested", 0, rig.ended.cycle)
        commanded = rig.records["commanded_position"]
        moved = commanded[np.isfinite(commanded[:, 0])]
        np.testing.assert_allclose(moved[:, 1:], START[1:] + 0 * moved[:, 1:], atol=1e-6)
        assert np.abs(np.diff(moved[-5:, 0])).max() == 0.0

    def test_a_motion_that_has_not_begun_is_dropped(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.session.stop("changed my mind")
        rig.open()
        rig.cycle(10)
        assert (rig.ended.outcome, rig.seen(MotionStarted), rig.exits_asked) == ("stopped", [], 0)


TURNS = np.array([40.0, -30.0, 20.0, -10.0, 5.0, -2.0])
SLOW = 0.01
"""Steps of which many lie within what a target may be off."""
STANDSTILL = 5e-4
SENT_STEP = 3.9 * STANDSTILL
"""Below four times standstill nothing is sent again."""


class Sent:
    """Set-points of a joint from TURNS on, each `step` further; the other joints stand."""

    def __init__(self, step: float, depth: int = 3, count: int = 8, joint: int = 1):
        self.set_points = SentSetPoints(Guard(limits(), PERIOD), depth)
        self.step = step * np.eye(N)[joint]
        self.last = TURNS
        self.set_points.begin(TURNS)
        for _ in range(count):
            self.add(1.0)

    def add(self, steps: float) -> None:
        self.last = self.last + steps * self.step
        self.set_points.add(self.last)

    def check(self, ahead: float, missed: int = 0, *, stopping: bool = False, **named) -> int:
        """A target that many steps ahead of the one sent last."""
        target = self.last + ahead * self.step
        return self.set_points.check(target, missed, 7, stopping=stopping, **named)

    def refuse(self, ahead: float, missed: int = 0, **named) -> None:
        error = refused(Check.ACCEPTED, self.check, ahead, missed, **named)
        assert (error.joint, error.cycle) == (1, 7)


NEAR_TARGETS = [  # step, depth; steps ahead, packets missed; whether it is refused
    # A tenth of the threshold off any of them, either way.
    *((way * 0.01, 3, 19.99, 0, False) for way in (-1, 1)),
    *((way * 0.01, 3, 20.01, 0, True) for way in (-1, 1)),
    *((way * 0.01, 3, -21.99, 0, False) for way in (-1, 1)),
    *((way * 0.01, 3, -22.01, 0, True) for way in (-1, 1)),
    # One of so many back counts and none before.
    *((0.24, depth, 1.0 - depth, 0, False) for depth in (1, 2, 3)),
    *((0.24, depth, -depth, 0, True) for depth in (1, 2, 3)),
    # A quarter of the threshold from the last, whatever was sent.
    *((0.2499, 3, ahead, missed, False) for ahead, missed in ((-2.0, 0), (2.0, 2))),
    *((0.2501, 3, ahead, missed, True) for ahead, missed in ((-2.0, 0), (2.0, 2))),
    # Extrapolated by as many steps as packets were missed, less than `depth`.
    *((0.24, 3, ahead, missed, ahead > missed) for ahead in (1.0, 2.0) for missed in range(3)),
    *((0.24, 2, ahead, 5, ahead > 1.0) for ahead in (1.0, 2.0)),
]


class TestTargets:
    @pytest.mark.parametrize(("step", "depth", "ahead", "missed", "is_refused"), NEAR_TARGETS)
    def test_a_target_is_near_one_of_those_sent(self, step, depth, ahead, missed, is_refused):
        sent = Sent(step, depth)
        (sent.refuse if is_refused else sent.check)(ahead, missed)

    def test_first_target_and_extrapolation_by_the_last_step(self):
        sent = Sent(0.1, count=0)
        assert sent.check(0.0) == 0
        assert sent.check(2.0, missed=2) == 0
        sent.refuse(2.01)
        sent = Sent(0.01)
        sent.add(24.0)
        sent.check(24.0, missed=1)
        sent.add(1.0)
        sent.refuse(24.0, missed=1)

    def test_begin_resets_the_history(self):
        sent = Sent(SLOW)
        assert sent.check(-1.0) == 1
        assert sent.set_points.is_resent
        sent.set_points.begin(TURNS)
        assert not sent.set_points.is_resent
        sent.last = TURNS
        sent.add(1.0)
        assert sent.check(-1.0) == 1
        sent.refuse(25.0)

    def test_selected_joints(self):
        sent = Sent(0.24)
        others = np.arange(N) != 1
        assert sent.check(9.0, where=others) == 0
        assert sent.check(-1.0, where=others) == 0
        sent.refuse(9.0, where=~others)


class TestSentAgain:
    @pytest.mark.parametrize(
        ("step", "ahead", "missed", "lost"),
        [
            *((SLOW, -lost, 0, lost) for lost in (1, 2, 3)),
            *((SLOW, ahead, 2, 0) for ahead in (1.0, 2.0)),
            # Other joints are at their target; this one is behind.
            (SLOW, -1.01, 1, 1),
            # Below standstill one lost reply is hidden.
            *((0.999 * STANDSTILL, -behind, 0, lost) for behind, lost in ((1, 0), (2, 2))),
            (1.01 * STANDSTILL, -1, 0, 1),
        ],
    )
    def test_number_of_lost_replies(self, step, ahead, missed, lost):
        assert Sent(step).check(ahead, missed) == lost

    def test_extrapolated_target_is_no_loss(self):
        sent = Sent(SLOW)
        for step in (1.0, 2.1, -1.0):
            sent.add(step)  # one more of the last is a tenth of a step from two set-points ago
        assert sent.set_points.check(sent.last - sent.step, 1, 7, stopping=False) == 0

    def test_joint_furthest_behind_counts(self):
        sent = Sent(SLOW)
        sent.step = SLOW * np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
        for _ in range(4):
            sent.add(1.0)
        target = sent.last - sent.step * np.array([0, 1, 0, 0, 2, 0])
        assert sent.set_points.check(target, 0, 1, stopping=False) == 2

    @pytest.mark.parametrize("way", [-1.0, 1.0])
    @pytest.mark.parametrize(
        ("steps", "behind", "counts"),
        [
            ([1.0] * 8, (0, 1, 1, 2, 1, 2, 0, 1), [0, 1, 0, 1, 0, 1, 0, 1]),
            # At rest a target one behind looks like the last; it is still the same answer lost.
            ([0.0, 1.0, 1.0], (1, 0, 1), [1, 0, 0]),
            ([1.0, 1.0, 1.0], (1, 0, 1), [1, 0, 1]),
        ],
    )
    def test_each_is_counted_once(self, steps, behind, counts, way):
        sent = Sent(way * SENT_STEP)
        counted = []
        for step, back in zip(steps, behind, strict=True):
            counted.append(sent.check(-back))
            sent.add(step)
        assert counted == counts

    @pytest.mark.parametrize(("share", "again"), [(3.99, False), (4.01, True)])
    def test_small_step_is_not_repeated(self, share, again):
        sent = Sent(share * STANDSTILL)
        assert sent.check(-1.0) == 1
        assert sent.set_points.resend_needed is again

    @pytest.mark.parametrize("behind", [1, 2])
    @pytest.mark.parametrize("count", [5, MAX_RESENDS])
    def test_repetition_counts_until_accepted_or_refused(self, count, behind):
        sent = Sent(SLOW)
        for repeated in range(count):
            assert sent.check(-behind) == (1 if repeated else behind)
            assert sent.set_points.resend_needed
            sent.set_points.resend()
        if count == MAX_RESENDS:
            sent.refuse(-behind)
        assert sent.check(0.0) == 0
        assert not sent.set_points.resend_needed

    @pytest.mark.parametrize("stopping", [False, True])
    def test_target_behind_after_a_repetition(self, stopping):
        """A set-point sent again looks accepted if the target is reported a cycle late."""
        sent = Sent(SLOW)
        sent.check(-1.0)
        sent.set_points.resend()
        sent.check(0.0)
        for _ in range(3):
            sent.add(1.0)
            assert sent.check(-1.0, stopping=stopping) == (not stopping)
            assert sent.set_points.resend_needed is not stopping
            if not stopping:
                sent.set_points.resend()
                sent.check(0.0)

    def test_a_target_reported_late_is_so_after_a_repetition(self):
        """A target that is the set-point sent twice does not show that it is reported in time."""
        sent = Sent(SENT_STEP)
        assert sent.check(-1.0) == 1
        for behind, lost in ((-3.0, 0), (-6.0, 1)):
            sent.add(3.0)
            assert sent.check(behind) == lost
        sent.set_points.resend()
        assert sent.check(0.0) == 0
        sent.add(3.0)
        assert sent.check(-3.0) == 0
        assert not sent.set_points.resend_needed

    @pytest.mark.parametrize("cycles", [0, 1])
    def test_after_a_resumption_nothing_was_repeated(self, cycles):
        """A stop after it counts the first target behind as a loss."""
        sent = Sent(SLOW)
        sent.check(-1.0)
        sent.set_points.resend()
        sent.add(1.0)
        sent.set_points.resume_from(sent.last, sent.step)
        assert not sent.set_points.is_resent
        for _ in range(cycles):
            sent.add(1.0)
        assert sent.check(-1.0, stopping=True) == 1
