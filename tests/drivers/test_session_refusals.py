"""Refused set-points, the state after a refusal, and leaving open mode."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    CyclicPacket,
    LinkLost,
    Mode,
    MotionStarted,
    Refused,
    RequestError,
    SourceFailed,
    State,
    reply_policy,
)
from drivers.errors import Check, ExitTimeout, ModeRefused, RefusalError
from drivers.events import AnswersLost
from drivers.packets import DRIVE_ON, INIT_LENGTH, LAST_NUMBER
from drivers.reply_policy import EXIT_RETRY_CYCLES, EXIT_TIMEOUT
from drivers.session import FLIGHT_RECORDER, STOP_TIMEOUT
from drivers.states import CORRECTION_MODES
from tests.drivers.rig import (
    PERIOD,
    START,
    Correction,
    Cruise,
    N,
    Rig,
    Table,
    Unspeakable,
    Unstopped,
    accelerating,
    all_drive_off,
    assert_refused,
    bump,
    closed,
    exiting,
    init_packet,
    kind_of,
    limits,
    moving,
    opened,
    running,
    smooth_move,
    started,
    still,
)

WIDE = {"jerk": np.full(N, 1e9)}


class TestRefusedSetPoints:
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("part", ["position", "velocity"])
    def test_not_finite(self, value, part):
        rows = np.tile(START, (5, 1))
        velocities = np.zeros((5, N))
        (rows if part == "position" else velocities)[4, 3] = value
        rig = running(Table(rows, velocities))
        answer = rig.cycle(4)
        assert assert_refused(rig, answer, Check.FINITE).joint == 3
        assert np.isfinite(answer.axes["d"]).all()

    @pytest.mark.parametrize(("stopping", "factor"), [(False, 1), (True, 2)])
    def test_acceleration_of_a_plan_and_of_a_stop(self, stopping, factor):
        def play(rows):
            rig = running(Unstopped(rows), guard_limits=limits(**WIDE))
            if stopping:
                rig.session.stop()
            return rig, rig.cycle(len(rows) - 1)

        assert play(accelerating(8.0 * factor * 0.999))[0].state is State.OPEN
        rig, answer = play(accelerating(8.0 * factor * 1.001)[:3])
        assert_refused(rig, answer, Check.ACCELERATION)

    def test_source_that_ignores_a_stop(self):
        source = type("Unstoppable", (Cruise,), {"SPEED": 0.1, "stop": lambda self: None})()
        rig = running(source, 300)
        rig.session.stop()
        rig.cycle(round(STOP_TIMEOUT / PERIOD))
        assert rig.state is State.OPEN
        assert "did not come to rest" in str(assert_refused(rig, rig.cycle(), SourceFailed))


INVALID_STEPS = [None, 1.0, (1.0, 2.0), (None, None), ("x", "y"), START, (START[:5], np.zeros(6))]


class TestSources:
    """A motion or correction is refused whatever its source does wrong."""

    def refused(self, base: type, *, stopped: bool = False, **parts) -> SourceFailed:
        """Return the refusal of a source with these methods and properties."""
        faulty = type("Faulty", (base,), {"__init__": lambda self: None, **parts})()
        usual = Correction(rows=90) if base is Correction else base()
        for name in vars(usual).keys() - parts.keys():
            setattr(faulty, name, getattr(usual, name))
        rig = Rig(mode=Mode.VELOCITY if base is Correction else Mode.POSITION)
        rig.session.request(faulty)
        answer = rig.open()
        if stopped:
            rig.cycle(50)
            rig.session.stop()
        if rig.state is State.OPEN:
            answer = rig.cycle()
        return assert_refused(rig, answer, SourceFailed)

    @pytest.mark.parametrize(
        ("base", "where"),
        [
            *((Cruise, part) for part in ("begin", "advance", "stop", "finished", "bounds")),
            *((Correction, part) for part in ("begin", "advance", "stop", "finished")),
        ],
    )
    @pytest.mark.parametrize(
        "kind", [ZeroDivisionError, SystemExit, KeyboardInterrupt, GeneratorExit, Unspeakable]
    )
    def test_exception_in_any_member(self, base, where, kind):
        def fails(self, *_):
            raise kind

        part = property(fails) if where in ("finished", "bounds") else fails
        error = self.refused(base, stopped=where == "stop", **{where: part})
        assert kind.__name__ in str(error)
        assert isinstance(error.__cause__, kind)

    @pytest.mark.parametrize("base", [Cruise, Correction])
    @pytest.mark.parametrize("given", [*INVALID_STEPS, (START, 0.0)])
    def test_invalid_step(self, base, given):
        self.refused(base, advance=lambda self: given)

    @pytest.mark.parametrize(
        "bounds", ["whatever", None, 1, np.array(["plan"]), np.full(2, "plan"), ["plan"]]
    )
    @pytest.mark.parametrize("finished", [False, True])
    def test_invalid_bounds(self, bounds, finished):
        self.refused(
            Cruise, bounds=property(lambda _: bounds), finished=property(lambda _: finished)
        )

    @pytest.mark.parametrize("from_cycle", [0, 1])
    def test_invalid_finished(self, from_cycle):
        def unclear(self):
            return self.advances >= from_cycle and np.array([True, False])

        self.refused(Cruise, finished=property(unclear))


FOLLOWING = {"moving": lambda: moving()[0], "leaving": exiting, "held": lambda: opened(20)}


class TestFeedback:
    """Thresholds of 2 revolutions and 20 A; a target may be a tenth of the threshold off."""

    @pytest.mark.parametrize(
        ("situation", "columns", "near", "far", "kind"),
        [
            *((of, [2], 1.99, 2.01, Check.FOLLOWING_ERROR) for of in FOLLOWING),
            # Replies may have been lost: the arm's position is compared, not its target.
            *((of, [0, 2], 0.19, 2.01, Check.FOLLOWING_ERROR) for of in ("moving", "leaving")),
            *((of, [0, 2], 0.19, 0.21, Check.ACCEPTED) for of in FOLLOWING),
            *((of, [0], 0.19, 0.21, Check.ACCEPTED) for of in FOLLOWING),
            *((of, [4], 19.9, 20.1, Check.CURRENT) for of in FOLLOWING),
            *(
                (of, [column], 0.0, np.nan, Check.FINITE)
                for of in FOLLOWING
                for column in (0, 2, 4)
            ),
        ],
    )
    def test_bounds_of_feedback(self, situation, columns, near, far, kind):
        for sign in (-1.0, 1.0):
            rig = FOLLOWING[situation]()
            rig.axes["d"][3, columns] += sign * near
            rig.cycle()
            assert not rig.seen(Refused)
            rig.axes["d"][3, 4] = 0.0
            rig.axes["d"][3, columns] += sign * far
            answer = rig.cycle()
            assert (kind_of(rig.refusal), rig.refusal.joint) == (kind, 3)
            modes = [4, 4, 4, 508, 4, 4] if kind is Check.FOLLOWING_ERROR else [505] * N
            assert answer.axes["mode"].tolist() == modes
            assert (rig.ended is None) == (situation == "held")

    @pytest.mark.parametrize(
        ("name", "column", "kind", "cell", "stated", "bound"),
        [
            ("current_limit", 4, Check.CURRENT, 20.0, 7.5, 7.5),
            ("current_limit", 4, Check.CURRENT, 20.0, 25.0, 20.0),
            ("current_limit", 4, Check.CURRENT, 20.0, np.nan, 20.0),
            ("following_error", 2, Check.FOLLOWING_ERROR, 2.0, 0.5, 0.5),
        ],
    )
    def test_narrower_limit_of_cell_and_controller(self, name, column, kind, cell, stated, bound):
        for sign in (-1, 1):
            rig, _ = moving(init=init_packet(arm_1={name: [*[cell] * 5, stated]}))
            rig.axes["d"][5, column] += sign * 0.999 * bound
            rig.cycle()
            assert rig.state is State.OPEN
            rig.axes["d"][5, 4] = 0.0
            rig.axes["d"][5, column] += sign * (bound + 0.01)
            rig.cycle()
            assert (kind_of(rig.refusal), rig.refusal.joint) == (kind, 5)
            assert rig.refusal.bound == pytest.approx(bound, rel=1e-5)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("mode", [1, 4, 5])
@pytest.mark.parametrize(
    ("columns", "near", "far", "kind"),
    [
        ([0], 0.19, 0.21, Check.FIRST_SET_POINT),
        ([2], 0.19, 0.21, Check.FIRST_SET_POINT),
        ([1], 4e-4, 6e-4, Check.STANDSTILL),
        ([3], 4e-4, 6e-4, Check.STANDSTILL),
        ([4], 19.9, 20.1, Check.CURRENT),
    ],
)
def test_motion_begins_at_rest_and_at_its_target(held, mode, columns, near, far, kind):
    """Requested before open mode, or while the arm is held in it; refused, never clamped."""
    for share, begins in ((near, True), (-near, True), (far, False), (-far, False)):
        rig = opened(20, mode=mode) if held else closed(mode=mode)
        rig.session.request(source := Cruise())
        rig.axes["d"][4, columns] += share
        answer = rig.cycle(mode=mode)
        assert (source.begun_at is not None) == begins
        assert len(rig.seen(MotionStarted)) == begins
        if not begins:
            assert assert_refused(rig, answer, kind).joint == 4


class TestFollowingError:
    def test_it_is_reported_while_the_axes_stay_open(self):
        rig, _ = moving()
        target = rig.axes["d"][:, 0].copy()
        rig.axes["d"][3, 2] += 2.01
        for _ in range(5):
            answer = rig.cycle()
            assert answer.axes["mode"].tolist() == [4, 4, 4, 508, 4, 4]
            np.testing.assert_array_equal(answer.axes["d"][:, 0], target)
            assert not answer.axes["d"][:, 1].any()
            rig.axes["d"][3, 2] = target[3]
        assert rig.session.counters.refused == 1

    def test_later_fault_of_another_kind_is_not_508(self):
        rig, _ = moving()
        rig.axes["d"][3, 2] += 2.01
        rig.cycle()
        rig.axes["d"][3, 2] -= 2.01
        rig.cycle(mode=Mode.CLOSED)
        rig.cycle(status=0)
        rig.status, rig.modes = 5, Mode.POSITION
        assert all_drive_off(rig.cycle())

    def test_drive_off_if_another_axis_has_no_finite_target(self):
        rig, _ = moving(20)
        rig.axes["d"][3, 2] += 3.0
        assert (rig.cycle().axes["mode"] == Mode.FOLLOWING_ERROR).sum() == 1
        rig.axes["d"][1, 0] = np.nan
        assert all_drive_off(rig.cycle())


class TestAfterRefusal:
    def refuse(self) -> tuple[Rig, Cruise]:
        rig, source = moving()
        rig.axes["d"][0, 4] = 99.0
        rig.cycle()
        rig.axes["d"][0, 4] = 0.0
        return rig, source

    def test_no_motion_before_the_axes_were_closed(self):
        rig, source = self.refuse()
        advances = source.advances
        for _ in range(100):
            assert all_drive_off(rig.cycle())
        assert rig.session.counters.refused == 1
        rig.cycle(3, status=0)
        assert all_drive_off(rig.cycle(status=5)), "open mode again"
        assert source.advances == advances

    def test_new_motion_after_closing(self):
        rig, source = self.refuse()
        advances = source.advances
        rig.cycle(3, mode=Mode.CLOSED)
        rig.axes["d"][:, [1, 3]] = 0.0
        rig.open()
        target = rig.axes["d"][:, 0].copy()
        np.testing.assert_array_equal(rig.cycle(20).axes["d"][:, 0], target)
        assert source.advances == advances
        here = rig.train.joint_position(target.astype(np.float64))
        rig.session.request(smooth_move(np.full(N, 0.05), 300, start=here))
        rig.run_to("completed")

    def test_flight_recorder_ends_with_the_refused_cycle(self):
        rig, _ = self.refuse()
        event = rig.seen(Refused)[-1]
        recorder = event.flight_recorder
        assert len(recorder) == FLIGHT_RECORDER
        assert recorder["cycle"][-1] == event.error.cycle
        assert recorder["target_current"][-1, 0] == 99.0
        assert np.isfinite(recorder["commanded_position"][:-1]).all()
        assert np.isnan(recorder["commanded_position"][-1]).all()
        assert recorder["state"][-1] == State.FAULTED


class TestModesRefused:
    def test_unknown_mode_while_closed(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        rig.modes[2] = 3
        rig.cycle(3)
        (event,) = rig.seen(Refused)
        assert type(event.error) is ModeRefused
        assert "joint 3 is in mode 3: the reply to that mode is unknown" in str(event.error)
        assert rig.session.counters.refused == 1
        assert (rig.state, rig.ended.outcome) == (State.FAULTED, "lost")

    def test_unknown_mode_beside_open_axes(self):
        rig = closed()
        rig.session.request(source := still(3))
        assert all_drive_off(rig.cycle(mode=[4, 4, 4, 4, 4, 3]))
        assert (rig.state, rig.ended.outcome, source.index) == (State.FAULTED, "lost", 0)

    def test_open_axes_that_were_not_closed_before(self):
        rig = started()
        assert all_drive_off(rig.cycle(mode=Mode.POSITION))
        assert kind_of(rig.refusal) is ModeRefused
        assert "joint 1 is in mode 4: it was not closed before" in str(rig.refusal)


REFUSED_REQUESTS = {
    "another motion": lambda rig: rig.session.request(still(3)),
    "make a new one": lambda rig: rig.cycle(mode=Mode.END_OF_SESSION),
    "state .exiting.": lambda rig: [rig.open(), rig.session.stop(), rig.cycle()],
    "state .open.: open mode is being left": lambda rig: [rig.open(), rig.session.stop()],
    "being left": lambda rig: [rig.cycle(mode=[4] * 5 + [0]), rig.session.stop()],
    "closed first": lambda rig: [rig.axes["d"].__setitem__((0, 2), 99.0), rig.open()],
}
"""What precedes a request, by the text of its refusal."""


@pytest.mark.parametrize("text", REFUSED_REQUESTS)
def test_request_is_refused_by_state(text):
    rig = closed()
    REFUSED_REQUESTS[text](rig)
    with pytest.raises(RequestError, match=text) as caught:
        rig.session.request(still(3))
    assert caught.value.state == rig.state.name.lower()


class TestBeforeInit:
    def test_packet_of_the_length_of_an_init_packet_is_malformed(self):
        rig = Rig(init_timeout=30.0)
        assert rig.session.deadline == np.inf
        assert rig.sync(1, INIT_LENGTH) is None
        assert rig.session.counters.malformed == 1
        assert rig.state is State.SYNC
        assert rig.session.deadline == pytest.approx(rig.now + 30.0)  # from the first packet on

    @pytest.mark.parametrize("place", [4, 7])
    def test_drive_on_in_the_four_status_bytes(self, place):
        packet = bytearray(b"\x01\x00\x00\x00" + bytes(100))
        packet[8:] = b"\x05" * (len(packet) - 8)
        assert Rig().send(bytes(packet)) is not None
        packet[place] = 5
        assert Rig().send(bytes(packet)) is None

    def test_one_sync_packet_is_a_cold_start(self):
        rig = Rig()
        rig.sync(1)
        rig.send(rig.init.encode())
        assert rig.sync(11) is not None
        assert rig.state is State.INIT


class TestNumbers:
    def test_low_number_in_a_session_is_stale(self):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.number = 4
        assert rig.cycle() is None
        assert (rig.state, rig.session.counters.stale) == (State.DRIVE_OFF, 1)

    @pytest.mark.parametrize(("number", "after"), [(9, State.SYNC), (10, State.DRIVE_OFF)])
    def test_number_below_init_restarts_after_a_silence(self, number, after):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.now += 2.0
        rig.number = number - 1
        assert rig.send(rig.packet()) is not None
        assert rig.state is after

    def test_number_1_after_the_last_one_does_not_restart(self):
        rig = Rig()
        rig.status = 0
        rig.start()
        for before in (LAST_NUMBER - 1, LAST_NUMBER):
            rig.now += 2.0
            rig.number = before
            assert rig.cycle() is not None
        assert rig.number == 1
        assert rig.state is State.DRIVE_OFF

    def test_packet_at_the_deadline_is_too_late(self):
        rig = closed()
        assert rig.session.reply(rig.packet(), rig.session.deadline) is not None
        assert any(isinstance(event, LinkLost) for event in rig.session.events())

    def test_stale_packets_count_as_missed(self):
        """A corrupted number that was far ahead makes the controller's own look stale."""
        for stale, stops in ((2, False), (3, True)):
            rig, source = moving(20)
            ahead = rig.number
            for _ in range(stale):
                rig.number = ahead - 30
                assert rig.cycle() is None
            rig.number = ahead
            rig.cycle(2)
            assert (source.stops == 1) == stops


class TestCounts:
    def test_cycles_count_from_the_init_packet(self):
        rig = closed()
        rig.cycle(5)
        assert rig.session.cycle == 6
        rig.send(rig.init.encode())
        assert rig.session.cycle == 0

    def test_interval_of_records_until_the_last_axis_closes(self):
        rig = opened()
        rig.modes[0] = Mode.CLOSED
        rig.cycle()
        rig.cycle(mode=Mode.CLOSED)
        assert [record["interval"] for record in rig.records] == [-1, 0, 0, -1]


def test_lost_reply_is_counted_in_its_interval_only():
    """Lost in its last cycle; the next is left before its last axis has opened."""
    rig, _ = moving(300)
    before = rig.axes.copy()
    rig.cycle()
    rig.axes[:] = before
    rig.cycle()
    assert rig.session.counters.not_accepted == 1
    rig.axes["d"][:, 1] = rig.axes["d"][:, 3] = 0.0
    rig.cycle(2, mode=Mode.CLOSED)
    rig.modes[:3] = rig.mode
    rig.cycle()
    rig.session.stop()
    rig.cycle(5)
    assert rig.state is State.EXITING
    assert rig.session.counters.not_accepted == 1
    assert len(rig.seen(AnswersLost)) == 1


class TestLeaving:
    """Requests for the end of open mode, with short limits."""

    RETRY, TIMEOUT = 10, 25

    @pytest.fixture(autouse=True)
    def short(self, monkeypatch):
        monkeypatch.setattr(reply_policy, "EXIT_RETRY_CYCLES", self.RETRY)
        monkeypatch.setattr(reply_policy, "EXIT_TIMEOUT", self.TIMEOUT * PERIOD)

    def test_exit_is_requested_again_until_a_fault(self):
        rig = opened(50)
        rig.session.stop()
        requests = []
        for cycle in range(self.TIMEOUT + 1):
            rig.cycle()
            requests += [cycle] if rig.exits_asked > len(requests) else []
            assert rig.state is (State.EXITING if cycle < self.TIMEOUT else State.FAULTED)
        assert requests == [0, self.RETRY, 2 * self.RETRY]
        assert kind_of(rig.refusal) is ExitTimeout
        assert f"{self.TIMEOUT} cycles ago" in str(rig.refusal)

    def test_exit_begun_by_the_controller_is_requested_later(self):
        rig = opened(50)
        rig.modes[0] = Mode.CLOSED
        requests = []
        for cycle in range(2 * self.RETRY):
            rig.cycle()
            requests += [cycle] if rig.exits_asked > len(requests) else []
        assert requests == [self.RETRY]


class TestLongGap:
    """Only an open mode that continues is compared with the set-points sent."""

    def test_closed_axes_are_not_compared(self):
        rig, _ = moving(100)
        rig.miss(10)
        rig.axes["d"][:, 0] += 5.0
        rig.axes["d"][:, 2] += 5.0
        rig.cycle(mode=Mode.CLOSED)
        assert rig.state is State.CLOSED
        assert not rig.seen(Refused)

    def test_axes_of_an_abandoned_opening_are_not_compared(self):
        rig = opened(20)
        rig.cycle(mode=Mode.CLOSED)
        rig.axes["d"][:, 0] += 0.5
        rig.axes["d"][:, 2] += 0.5
        rig.modes[:3] = rig.mode
        rig.cycle()
        rig.session.stop()
        rig.cycle()
        rig.miss(10)
        rig.cycle()
        assert rig.state is State.EXITING
        assert not rig.seen(Refused)


@pytest.mark.parametrize("mode", [8, 9])
def test_correction_of_a_reopened_axis_is_zero(mode):
    rig = opened(mode=mode)
    rig.session.stop()
    rig.cycle()
    rig.axes["mode"][2] = Mode.CLOSED
    rig.cycle()
    rig.axes["mode"][2] = mode
    assert not rig.cycle().axes["d"].any()


def test_records_of_an_arm_without_axis_map():
    rig = started(init=init_packet(open_axes_map=np.full((4, 10), 3)))
    rig.ages = np.zeros((N, 8), np.uint16)
    rig.ages[4, 2] = 7
    rig.cycle()
    record = rig.records[-1]
    assert (record["mode"] == -1).all()
    assert np.isnan([record["position"], record["target_position"]]).all()
    assert record["age"].tolist() == [0, 0, 7, 0, 0, 0, 0, 0]
    rig.ages = None
    rig.cycle()
    assert not rig.records[-1]["age"].any()


class TestRecordsWhileLeaving:
    """Commanded values of axes that were sent a set-point; NaN for the others."""

    def test_open_axes_rest_at_the_last_set_point(self):
        rig = self.leaving(axis=None)
        for record in rig.records[-2:]:
            np.testing.assert_allclose(record["commanded_position"], START, atol=1e-6)
            np.testing.assert_array_equal(record["commanded_velocity"], np.zeros(N))

    def test_closed_axis_and_reopened_axis(self):
        rig = self.leaving(axis=2)
        nothing = np.arange(N) == 2
        for name in ("commanded_position", "commanded_velocity"):
            np.testing.assert_array_equal(np.isnan(rig.records[-1][name]), nothing)
        end = rig.axes["d"][:, 0].copy()
        rig.axes["d"][2, [0, 2]] += 0.5
        rig.modes[2] = rig.mode
        d = rig.cycle().axes["d"]
        np.testing.assert_array_equal(d[:, 0], np.float32(end + 0.5 * nothing))
        assert not d[:, 1].any()
        record = rig.records[-1]
        expected = rig.train.joint_position(rig.axes["d"][:, 0].astype(np.float64))
        np.testing.assert_allclose(record["commanded_position"], expected, atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"], np.zeros(N))

    def test_axis_in_another_position_mode_is_held_near_its_target(self):
        rig = self.leaving(axis=None)
        rig.modes[2] = Mode.POSITION_RELATIVE
        rig.cycle()
        assert rig.state is State.EXITING
        rig.axes["d"][2, 2] += 2.01
        answer = rig.cycle()
        assert answer.axes["mode"][2] == Mode.FOLLOWING_ERROR
        assert kind_of(rig.refusal) is Check.FOLLOWING_ERROR

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_axis_in_a_position_mode_beside_corrections(self, mode):
        rig = opened(mode=mode)
        rig.session.stop()
        rig.cycle()
        rig.modes[2] = Mode.POSITION
        rig.axes["d"][2, 1] = 4e-4
        rig.cycle()
        record = rig.records[-1]
        held = np.arange(N) == 2
        expected = np.where(held, START, np.nan)
        np.testing.assert_allclose(record["commanded_position"], expected, atol=1e-6)
        np.testing.assert_array_equal(record["commanded_velocity"], np.where(held, 0.0, np.nan))

    @pytest.mark.parametrize("value", [99.0, np.nan])
    @pytest.mark.parametrize("mode", [Mode.POSITION, *sorted(CORRECTION_MODES)])
    def test_closed_axis_is_not_checked(self, mode, value):
        rig = opened(mode=mode)
        rig.session.stop()
        rig.cycle()
        rig.modes[2] = Mode.CLOSED
        for column in (0, 2, 4):
            rig.axes["d"][2, column] = value
            rig.cycle()
            assert rig.state is State.EXITING
        rig.axes["d"][3, 2] += 5.0
        rig.cycle()
        assert (kind_of(rig.refusal), rig.refusal.joint) == (Check.FOLLOWING_ERROR, 3)

    @staticmethod
    def leaving(axis: int | None) -> Rig:
        """Open mode is left without a motion; this axis has closed first."""
        rig = opened(3)
        rig.session.stop()
        rig.cycle()
        if axis is not None:
            rig.modes[axis] = Mode.CLOSED
        rig.cycle()
        assert rig.state is State.EXITING
        return rig


class TestAges:
    """Cycles since a value was sent, on links that send some less often."""

    TARGET, TARGET_VELOCITY, ACTUAL, VELOCITY = range(4)

    @pytest.mark.parametrize(("age", "lost"), [(0, 1), (1, 0)])
    def test_old_target_is_no_lost_reply(self, age, lost):
        rig, _ = moving(100)
        before = rig.axes.copy()
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.cycle()
        rig.axes[:] = before
        rig.ages[0, self.TARGET] = age
        rig.cycle()
        assert rig.session.counters.not_accepted == lost

    @pytest.mark.parametrize(("axis", "refused"), [(2, False), (3, True)])
    @pytest.mark.parametrize("column", [TARGET, TARGET_VELOCITY, VELOCITY])
    def test_closed_axis_after_a_long_gap(self, column, axis, refused):
        rig = TestRecordsWhileLeaving.leaving(axis=2)
        rig.miss(10)
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.ages[axis, column] = 1
        rig.cycle()
        assert bool(rig.seen(Refused)) == refused
        if refused:
            assert kind_of(rig.refusal) is Check.GAP_AGE

    def test_speed_of_an_old_target(self):
        """Mode 7 holds target and offset together to the velocity of the joint, here 2 rad/s."""
        distance = motor_distance(2.0 * PERIOD)
        for ages, refused in (((1, 2, 0), False), ((0, 0, 0), True)):
            rig = running(Correction(rows=50), mode=Mode.DELTA_POSITION)
            rig.ages = np.zeros((N, 8), np.uint16)
            for age in ages[:-1]:
                rig.ages[:, self.TARGET] = age
                rig.cycle()
            rig.ages[:, self.TARGET] = ages[-1]
            rig.axes["d"][:, [0, 2]] += 2.9 * distance[:, None]
            rig.cycle()
            assert bool(rig.seen(Refused)) == refused


def motor_distance(radians: float) -> np.ndarray:
    """Motor revolutions of joint 1 alone."""
    train = Rig().train
    first = radians * (np.arange(N) == 0)
    return train.motor_revolutions(first) - train.motor_revolutions(np.zeros(N))


class TestCorrections:
    def test_velocity_near_the_end_of_the_range(self):
        """0.1 rad/s is allowed 0.05 rad before the end of the range."""
        near = START.copy()
        near[0] = 1.95
        rig = Rig(mode=Mode.VELOCITY)
        rig.put_arm_at(near)
        rig.session.request(Correction(bump([0.1, 0, 0, 0, 0, 0], 300)))
        rig.open()
        rig.run_to("completed")


TIMEOUT = round(EXIT_TIMEOUT / PERIOD)


class TestExitTimeout:
    def test_exit_in_the_last_cycle(self):
        rig = exiting()
        rig.cycle(TIMEOUT - 1)
        rig.cycle(mode=Mode.CLOSED)
        assert rig.ended.outcome == "completed"

    def test_missed_cycles_count_as_time(self):
        rig = exiting()
        for _ in range(TIMEOUT // 400 + 1):
            assert rig.state is State.EXITING
            rig.miss(399)
            answer = rig.cycle()
        assert_refused(rig, answer, ExitTimeout)

    def test_repeated_request_with_gaps(self):
        rig = exiting()
        rig.miss(EXIT_RETRY_CYCLES + 7)
        rig.cycle()
        assert rig.exits_asked == 2
        rig.cycle(EXIT_RETRY_CYCLES - 1)
        assert rig.exits_asked == 2
        rig.cycle()
        assert rig.exits_asked == 3


@pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
@pytest.mark.parametrize(
    ("target", "age", "opening", "kind"),
    [
        (np.nan, 0, False, Check.FINITE),
        (np.nan, 0, True, Check.FINITE),
        (50.0, 0, False, Check.FOLLOWING_ERROR),
        (None, 1, False, Check.FIRST_AGE),
        (None, 0, False, None),
    ],
)
def test_axis_in_a_position_mode_gets_its_target_if_holdable(mode, target, age, opening, kind):
    """While corrections end, or begin."""
    rig = opened(5, mode=mode)
    if opening:
        rig.close()
    rig.modes = [mode if opening else 0, 0, 4, 0, 0, 0]
    if target is not None:
        rig.axes["d"][2, 0] = target
    rig.ages = np.full((N, 8), age, np.uint16)
    answer = rig.cycle()
    assert np.isfinite(answer.axes["d"]).all()
    if kind is None:
        assert rig.state is State.EXITING
        assert answer.axes["mode"].tolist() == [0, 0, 4, 0, 0, 0]
        assert answer.axes["d"][2, 0] == rig.axes["d"][2, 0]
        has = np.isfinite(rig.records[-1]["commanded_position"])
        np.testing.assert_array_equal(has, np.arange(N) == 2)
    else:
        assert kind_of(rig.refusal) is kind
        reported = [0, 0, 508, 0, 0, 0] if kind is Check.FOLLOWING_ERROR else [505] * N
        assert answer.axes["mode"].tolist() == reported


class TestIncompleteOpening:
    def opening(self, source=None, opened=N - 1) -> Rig:
        rig = Rig()
        if source is not None:
            rig.session.request(source)
        rig.close()
        rig.axes["mode"][:opened] = Mode.POSITION
        rig.cycle()
        assert rig.state is State.OPENING
        return rig

    @pytest.mark.parametrize("last", [Mode.CLOSED, Mode.POSITION])
    def test_stop_leaves_open_mode_and_holds_each_axis(self, last):
        """The last axis as well if it opens after all."""
        rig = self.opening(Cruise())
        rig.session.stop("enough")
        assert rig.session.requested is False
        rig.axes["d"][1, [0, 2]] += 0.01
        target = rig.axes["d"][:, 0].copy()
        for _ in range(4):
            answer = rig.cycle()
            assert (rig.state, rig.exits_asked) == (State.EXITING, 1)
            np.testing.assert_array_equal(answer.axes["d"][:, 0], target)
            assert not answer.axes["d"][: N - 1, 1].any()
            rig.modes[N - 1] = last
        assert set(rig.records["interval"]) == {-1}
        assert rig.ended.outcome == "stopped"
        rig.cycle(mode=Mode.CLOSED)
        assert rig.state is State.CLOSED

    @pytest.mark.parametrize("opened", [1, N - 1])
    def test_motion_that_waits_too_long_is_dropped(self, opened):
        rig = self.opening(source := Cruise(), opened)
        rig.cycle(TIMEOUT - 1)
        assert rig.state is State.OPENING
        assert rig.exits_asked == 0
        rig.cycle()
        assert (rig.state, rig.exits_asked) == (State.EXITING, 1)
        assert rig.ended.outcome == "stopped"
        assert "did not open" in rig.ended.reason
        assert ("axis 1 alone is to open, use --only-axis" in rig.ended.reason) is (opened == 1)
        assert source.begun_at is None
        rig.cycle(TIMEOUT - 1)
        assert rig.state is State.EXITING
        assert all_drive_off(rig.cycle())

    def test_no_timeout_without_a_motion(self):
        rig = self.opening()
        rig.cycle(TIMEOUT + 10)
        assert (rig.state, rig.exits_asked) == (State.OPENING, 0)


NOT_FINITE = [np.nan, np.inf, -np.inf]


class OtherAxis(Rig):
    """A seventh axis is open in the controller, of this arm or of another."""

    def __init__(self, arm: int):
        axis = 6 if arm == 1 else 0
        table = np.full((4, 10), 0xFF)
        table[0, :N] = range(N)
        table[arm - 1, axis] = N
        super().__init__(
            init=init_packet(n_axes=N + 1, open_axes_map=table),
            slots=np.arange(N),
            other_axes={(arm, axis + 1)},
        )
        self.arm = arm
        self.drive = DRIVE_ON

    def packet(self) -> bytes:
        packet = bytearray(super().packet())
        packet[4 + self.arm - 1] = self.drive
        return bytes(packet)


@pytest.mark.parametrize("arm", [1, 2])
@pytest.mark.parametrize("value", NOT_FINITE)
class TestOtherAxes:
    def refused(self, rig, answer, arm):
        assert all_drive_off(answer)
        assert np.isfinite(answer.axes["d"]).all()
        assert rig.state is State.FAULTED
        error = rig.refusal
        assert type(error) is RefusalError
        assert f"axis {7 if arm == 1 else 1} of arm {arm}" in str(error)

    def test_during_a_motion(self, arm, value):
        rig = OtherAxis(arm)
        rig.session.request(Cruise())
        rig.open()
        rig.cycle(50)
        rig.axes["d"][6, 0] = value
        self.refused(rig, rig.cycle(), arm)
        assert rig.ended.outcome == "refused"

    def test_with_closed_axes_one_event_and_505_in_each_cycle(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.session.request(still(3))
        rig.axes["mode"][6] = Mode.POSITION
        rig.cycle()
        rig.axes["d"][6, 0] = value
        self.refused(rig, rig.cycle(), arm)
        assert rig.ended.outcome == "refused"
        for _ in range(5):
            assert all_drive_off(rig.cycle())
        assert len(rig.seen(Refused)) == 1
        rig.axes["d"][6, 0] = 1.0
        assert rig.cycle().axes["mode"][6] == Mode.POSITION
        rig.axes["d"][6, 0] = value
        rig.cycle()
        assert len(rig.seen(Refused)) == rig.session.counters.refused == 2

    def test_no_motion_begins(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        rig.cycle(3)
        rig.session.request(source := Cruise())
        assert all_drive_off(rig.cycle(mode=Mode.POSITION))
        assert source.begun_at is None
        assert rig.ended.outcome == "refused"

    def test_echo_with_its_drive_off(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.drive = 0
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        packet = rig.packet()
        answer = CyclicPacket.decode(rig.send(packet), N + 1)
        assert answer.axes[6].tobytes() == CyclicPacket.decode(packet, N + 1).axes[6].tobytes()
        assert not rig.seen(Refused)

    def test_with_the_drive_of_the_moved_arm_off(self, arm, value):
        rig = OtherAxis(arm)
        rig.status = 0
        rig.start()
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        for _ in range(3):
            assert all_drive_off(rig.cycle())
        [refusal] = rig.seen(Refused)
        assert f"of arm {arm}" in str(refusal.error)


@pytest.mark.parametrize(
    ("column", "off", "kind"),
    [
        (0, 1.9, None),
        *((column, 2.1, Check.FOLLOWING_ERROR) for column in (0, 2)),
        *((0, value, RefusalError) for value in NOT_FINITE),
    ],
)
def test_open_axes_in_a_pause_are_held_near_their_target(column, off, kind):
    rig = opened(5)
    rig.axes["mode"][5] = Mode.PAUSE_BY_CONTROLLER
    rig.cycle()
    rig.axes["d"][0, column] += off
    for _ in range(5):
        answer = rig.cycle()
        modes = {None: [4] * 5 + [0], Check.FOLLOWING_ERROR: [508] + [4] * 4 + [0]}.get(
            kind, [505] * N
        )
        assert answer.axes["mode"].tolist() == modes
        assert np.isfinite(answer.axes["d"]).all()
    assert [kind_of(event.error) for event in rig.seen(Refused)] == [kind] * (kind is not None)
    if kind is None:
        assert rig.state is State.FREEZING
        assert answer.axes["d"][0, 0] == rig.axes["d"][0, 0]
