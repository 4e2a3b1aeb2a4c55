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
    open_mode,
)
from drivers.c4g_packets import DRIVE_ON, LAST_NUMBER
from drivers.errors import Check, ExitTimeout, ModeRefused, RefusalError
from drivers.events import RepliesLost
from drivers.open_mode import EXIT_RETRY_CYCLES, EXIT_TIMEOUT
from drivers.session import FLIGHT_RECORDER_CYCLES, STOP_TIMEOUT
from drivers.states import POSITION_MODES
from tests.drivers.rig import (
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    Table,
    Unspeakable,
    Unstopped,
    accelerating,
    all_drive_off,
    assert_refused,
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
from tests.messages import OPEN_MODE_BEING_LEFT, SOME_DID_NOT_OPEN

pytestmark = pytest.mark.safety

NOT_FINITE = [np.nan, np.inf, -np.inf]


class TestRefusedSetPoints:
    @pytest.mark.parametrize("value", NOT_FINITE)
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
    @pytest.mark.parametrize(("scale", "is_refused"), [(0.999, False), (1.001, True)])
    def test_acceleration_of_a_plan_and_of_a_stop(self, stopping, factor, scale, is_refused):
        rows = accelerating(8.0 * factor * scale, 3 if is_refused else 40)
        rig = running(Unstopped(rows), guard_limits=limits(jerk=np.full(N, 1e9)))
        if stopping:
            rig.session.stop()
        answer = rig.cycle(len(rows) - 1)
        if is_refused:
            assert_refused(rig, answer, Check.ACCELERATION)
        else:
            assert rig.state is State.OPEN

    @pytest.mark.parametrize("settle", [0, 5])
    def test_source_that_ends_while_moving(self, settle):
        """Rest would be a jump, also where the end is not held before open mode is left."""

        class Ending(Cruise):
            def advance(self):
                step = super().advance()
                self.finished = self.advances > 300
                return step

        rig = running(Ending(), 300, settle_cycles=settle)
        rig.cycle()
        assert (rig.state, rig.exits_asked) == (State.OPEN if settle else State.EXITING, not settle)
        assert assert_refused(rig, rig.cycle(), Check.ACCELERATION).joint == 0

    def test_source_that_ignores_a_stop(self):
        source = type("Unstoppable", (Cruise,), {"SPEED": 0.1, "stop": lambda self: None})()
        rig = running(source, 300)
        rig.session.stop()
        rig.cycle(round(STOP_TIMEOUT / PERIOD))
        assert rig.state is State.OPEN
        assert "did not come to rest" in str(assert_refused(rig, rig.cycle(), SourceFailed))


INVALID_STEPS = [None, 1.0, (1.0, 2.0), (None, None), ("x", "y"), START, (START[:5], np.zeros(6))]
MEMBERS = ("begin", "advance", "stop", "finished")


class TestSources:
    """A motion is refused whatever its source does wrong."""

    def refused(self, base: type, *, stopped: bool = False, **parts) -> SourceFailed:
        """Return the refusal of a source with these methods and properties."""
        faulty = type("Faulty", (base,), {"__init__": lambda self: None, **parts})()
        usual = base()
        for name in vars(usual).keys() - parts.keys():
            setattr(faulty, name, getattr(usual, name))
        rig = Rig()
        rig.session.request(faulty)
        answer = rig.open()
        if stopped:
            rig.cycle(50)
            rig.session.stop()
        if rig.state is State.OPEN:
            answer = rig.cycle()
        return assert_refused(rig, answer, SourceFailed)

    @pytest.mark.parametrize("where", [*MEMBERS, "bounds"])
    @pytest.mark.parametrize(
        "kind", [ZeroDivisionError, SystemExit, KeyboardInterrupt, GeneratorExit, Unspeakable]
    )
    def test_exception_in_any_member(self, where, kind):
        def fails(self, *_):
            raise kind

        part = property(fails) if where in ("finished", "bounds") else fails
        error = self.refused(Cruise, stopped=where == "stop", **{where: part})
        assert kind.__name__ in str(error)
        assert isinstance(error.__cause__, kind)

    @pytest.mark.parametrize("given", [*INVALID_STEPS, (START, 0.0)])
    def test_invalid_step(self, given):
        self.refused(Cruise, advance=lambda self: given)

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
        both = np.array([True, False])
        self.refused(Cruise, finished=property(lambda it: it.advances >= from_cycle and both))


FOLLOWING = {"moving": lambda: moving()[0], "leaving": exiting, "held": lambda: opened(20)}


class TestFeedback:
    """Thresholds of 2 revolutions and 20 A; a target may be a tenth of the threshold off."""

    @pytest.mark.parametrize("situation", FOLLOWING)
    @pytest.mark.parametrize(
        ("columns", "near", "far", "kind"),
        [
            ([2], 1.99, 2.01, Check.FOLLOWING_ERROR),
            # Replies may have been lost: the arm's position is compared, not its target.
            ([0, 2], 0.19, 2.01, Check.FOLLOWING_ERROR),
            ([0, 2], 0.19, 0.21, Check.ACCEPTED),
            ([0], 0.19, 0.21, Check.ACCEPTED),
            ([4], 19.9, 20.1, Check.CURRENT),
            *(([column], 0.0, np.nan, Check.FINITE) for column in (0, 2, 4)),
        ],
    )
    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    def test_bounds_of_feedback(self, situation, columns, near, far, kind, sign):
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
        """The drives of the cell carry 20 A, less than its guard allows."""
        wide = limits(current=np.full(N, 30.0))
        for sign in (-1, 1):
            init = init_packet(arm_1={name: [*[cell] * 5, stated]})
            rig, _ = moving(init=init, guard_limits=wide)
            rig.axes["d"][5, column] += sign * 0.999 * bound
            rig.cycle()
            assert rig.state is State.OPEN
            rig.axes["d"][5, 4] = 0.0
            rig.axes["d"][5, column] += sign * (bound + 0.01)
            rig.cycle()
            assert (kind_of(rig.refusal), rig.refusal.joint) == (kind, 5)
            assert rig.refusal.bound == pytest.approx(bound, rel=1e-5)

    @pytest.mark.parametrize("held", [False, True])
    @pytest.mark.parametrize("mode", [4, 5])
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
    def test_motion_begins_at_rest_and_at_its_target(self, held, mode, columns, near, far, kind):
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

    @pytest.mark.parametrize(("off", "begins"), [(0.09, True), (0.15, False)])
    def test_arm_is_near_the_set_point_that_was_held(self, off, begins):
        """Not only near a target that is itself off it."""
        rig = opened(20)
        rig.session.request(source := Cruise())
        rig.axes["d"][4, 0] += off
        rig.axes["d"][4, 2] += 2.0 * off
        answer = rig.cycle()
        assert (source.begun_at is not None) == begins
        if not begins:
            assert assert_refused(rig, answer, Check.FIRST_SET_POINT).joint == 4


class TestFollowingError:
    def test_it_is_reported_while_the_axes_stay_open(self):
        """Unless another axis has no finite target."""
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
        rig.axes["d"][1, 0] = np.nan
        assert all_drive_off(rig.cycle())

    def test_later_fault_of_another_kind_is_not_508(self):
        rig, _ = moving()
        rig.axes["d"][3, 2] += 2.01
        rig.cycle()
        rig.axes["d"][3, 2] -= 2.01
        rig.cycle(mode=Mode.CLOSED)
        rig.cycle(status=0)
        rig.status = 5
        rig.modes = Mode.POSITION
        assert all_drive_off(rig.cycle())


class TestAfterRefusal:
    def refuse(self) -> tuple[Rig, int]:
        """After a refusal, and the set-points of its source so far."""
        rig, source = moving()
        advances = source.advances
        rig.axes["d"][0, 4] = 99.0
        rig.cycle()
        rig.axes["d"][0, 4] = 0.0
        assert source.advances == advances
        return rig, source

    def test_no_motion_before_the_axes_were_closed(self):
        rig, source = self.refuse()
        advances = source.advances
        for _ in range(100):
            assert all_drive_off(rig.cycle())
        assert rig.session.counters.refused == 1
        rig.cycle(3, status=0)
        assert all_drive_off(rig.cycle(status=5)), "open mode again"
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
        assert len(recorder) == FLIGHT_RECORDER_CYCLES
        assert recorder["cycle"][-1] == event.error.cycle
        assert recorder["target_current"][-1, 0] == 99.0
        assert np.isfinite(recorder["commanded_position"][:-1]).all()
        assert np.isnan(recorder["commanded_position"][-1]).all()
        assert recorder["state"][-1] == State.FAULTED


@pytest.mark.parametrize(
    ("before", "modes", "message"),
    [
        (closed, [0, 0, 3, 0, 0, 0], "joint 3 is in mode 3: the reply to that mode is unknown"),
        (closed, [4, 4, 4, 4, 4, 3], "joint 6 is in mode 3: the reply to that mode is unknown"),
        (started, [4] * N, "joint 1 is in mode 4: it was not closed before"),
    ],
)
def test_refused_modes(before, modes, message):
    rig = before()
    rig.session.request(source := still(3))
    for _ in range(3):
        answer = rig.cycle(mode=modes)
        assert all_drive_off(answer) == (4 in modes)
    (event,) = rig.seen(Refused)
    assert type(event.error) is ModeRefused
    assert message in str(event.error)
    assert rig.session.counters.refused == 1
    assert (rig.state, rig.ended.outcome, source.index) == (State.FAULTED, "lost", 0)


LEFT = f"{OPEN_MODE_BEING_LEFT}; wait for closed axes"
REFUSED_REQUESTS = {
    "closed: another motion was requested before and has not ended":
        lambda rig: rig.session.request(still(3)),
    "ended: the controller ended the session; make a new one":
        lambda rig: rig.cycle(mode=Mode.END_OF_SESSION),
    f"exiting: {LEFT}": lambda rig: [rig.open(), rig.session.stop(), rig.cycle()],
    f"open: {LEFT}": lambda rig: [rig.open(), rig.session.stop()],
    f"opening: {LEFT}": lambda rig: [rig.cycle(mode=[4] * 5 + [0]), rig.session.stop()],
    "faulted: the controller has to report its axes closed first":
        lambda rig: [rig.axes["d"].__setitem__((0, 2), 99.0), rig.open()],
}  # fmt: skip
"""What precedes a request, by the text of its refusal."""


@pytest.mark.parametrize("text", REFUSED_REQUESTS)
def test_request_is_refused_by_state(text):
    rig = closed()
    REFUSED_REQUESTS[text](rig)
    with pytest.raises(RequestError) as caught:
        rig.session.request(still(3))
    assert f"{caught.value.state}: {caught.value.reason}" == text
    assert caught.value.state == rig.state.name.lower()
    assert str(caught.value).startswith("no motion can be requested in state ")


class TestNumbers:
    def test_low_number_in_a_session_is_stale(self):
        """Without a silence before it, it is no restart."""
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.number = 4
        assert rig.cycle() is None
        assert (rig.state, rig.session.counters.stale) == (State.DRIVE_OFF, 1)

    def test_one_sync_packet_is_a_cold_start(self):
        """After which sync packets follow the init packet."""
        rig = Rig()
        rig.sync(1)
        rig.send(rig.init.encode())
        assert rig.sync(11) is not None
        assert rig.state is State.INIT

    @pytest.mark.parametrize(
        ("numbers", "after"),
        [
            ((9,), State.SYNC),
            ((10,), State.DRIVE_OFF),
            ((LAST_NUMBER, 1), State.DRIVE_OFF),  # it follows, and is no restart
        ],
    )
    def test_number_below_init_restarts_after_a_silence(self, numbers, after):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        for number in numbers:
            rig.now += 2.0
            rig.number = number - 1 or LAST_NUMBER
            assert rig.send(rig.packet()) is not None
        assert rig.state is after

    def test_packet_at_the_deadline_is_too_late(self):
        rig = closed()
        assert rig.session.reply(rig.packet(), rig.session.deadline) is not None
        assert any(isinstance(event, LinkLost) for event in rig.session.events())

    @pytest.mark.parametrize(("stale", "stops"), [(2, False), (3, True)])
    def test_stale_packets_count_as_missed(self, stale, stops):
        """A corrupted number that was far ahead makes the controller's own look stale."""
        rig, source = moving(20)
        ahead = rig.number
        for _ in range(stale):
            rig.number = ahead - 30
            assert rig.cycle() is None
        rig.number = ahead
        rig.cycle(2)
        assert (source.stops == 1) == stops

    def test_cycles_count_from_the_init_packet(self):
        rig = closed()
        rig.cycle(5)
        assert rig.session.cycle == 6
        rig.send(rig.init.encode())
        assert rig.session.cycle == 0


def test_lost_reply_is_counted_in_its_interval_only():
    """Lost in its last cycle; the next is left before its last axis has opened."""
    rig, _ = moving(300)
    before = rig.axes.copy()
    rig.cycle()
    rig.axes[:] = before
    rig.cycle()
    assert rig.session.counters.rejected == 1
    rig.axes["d"][:, [1, 3]] = 0.0
    rig.cycle(2, mode=Mode.CLOSED)
    rig.modes[:3] = rig.mode
    rig.cycle()
    rig.session.stop()
    rig.cycle(5)
    assert rig.state is State.EXITING
    assert rig.session.counters.rejected == 1
    assert len(rig.seen(RepliesLost)) == 1


class TestExit:
    """Requests for the end of open mode, with short limits."""

    RETRY = 10
    TIMEOUT = 25

    @pytest.fixture(autouse=True)
    def short(self, monkeypatch):
        monkeypatch.setattr(open_mode, "EXIT_RETRY_CYCLES", self.RETRY)
        monkeypatch.setattr(open_mode, "EXIT_TIMEOUT", self.TIMEOUT * PERIOD)

    @pytest.mark.parametrize(
        ("by_controller", "requested"), [(False, [0, RETRY, 2 * RETRY]), (True, [RETRY, 2 * RETRY])]
    )
    def test_exit_is_requested_again_until_a_fault(self, by_controller, requested):
        rig = opened(50)
        if by_controller:
            rig.modes[0] = Mode.CLOSED
        else:
            rig.session.stop()
        requests = []
        for cycle in range(self.TIMEOUT + 1):
            rig.cycle()
            requests += [cycle] if rig.exits_asked > len(requests) else []
            assert rig.state is (State.EXITING if cycle < self.TIMEOUT else State.FAULTED)
        assert requests == requested
        assert kind_of(rig.refusal) is ExitTimeout
        assert f"{self.TIMEOUT} cycles ago" in str(rig.refusal)


TIMEOUT = round(EXIT_TIMEOUT / PERIOD)


def test_missed_cycles_count_as_time_to_leave():
    rig = exiting()
    rig.miss(EXIT_RETRY_CYCLES + 7)
    rig.cycle()
    assert rig.exits_asked == 2
    rig.cycle(EXIT_RETRY_CYCLES - 1)
    assert rig.exits_asked == 2
    rig.cycle()
    assert rig.exits_asked == 3
    begun = rig.session.entered_at
    answer = None
    while rig.session.cycle - begun < TIMEOUT:
        assert rig.state is State.EXITING
        rig.miss(399)
        answer = rig.cycle()
    assert_refused(rig, answer, ExitTimeout)


class TestLongGap:
    """Only an open mode that continues is compared with the set-points sent."""

    def test_closed_axes_are_not_compared(self):
        rig, _ = moving(100)
        rig.miss(10)
        rig.axes["d"][:, [0, 2]] += 5.0
        rig.cycle(mode=Mode.CLOSED)
        assert rig.state is State.CLOSED
        assert not rig.seen(Refused)

    def test_axes_of_an_abandoned_opening_are_not_compared(self):
        rig = opened(20)
        rig.cycle(mode=Mode.CLOSED)
        rig.axes["d"][:, [0, 2]] += 0.5
        rig.modes[:3] = rig.mode
        rig.cycle()
        rig.session.stop()
        rig.cycle()
        rig.miss(10)
        rig.cycle()
        assert rig.state is State.EXITING
        assert not rig.seen(Refused)

    def test_axis_that_opens_again_is_not_compared(self):
        rig = leaving(axis=2)
        rig.axes["d"][2, [0, 2]] += 0.5
        rig.modes[2] = rig.mode
        rig.cycle()
        rig.miss(10)
        rig.cycle()
        rig.now += 0.9  # a pause
        rig.axes["d"][2, 3] = 1.0
        rig.cycle()
        assert rig.state is State.EXITING
        assert not rig.seen(Refused)

    def test_axes_that_open_are_not_compared(self):
        rig = opened(20)
        rig.cycle(mode=Mode.CLOSED)
        rig.axes["d"][:, [0, 2]] += 0.5
        rig.miss(10)
        rig.cycle(mode=Mode.POSITION)
        assert rig.state is State.OPEN
        assert not rig.seen(Refused)


def test_records_of_an_arm_without_axis_map():
    rig = started(init=init_packet(open_axes_map=np.full((4, 10), 3)))
    rig.cycle()
    record = rig.records[-1]
    assert (record["mode"] == -1).all()
    assert np.isnan([record["position"], record["target_position"]]).all()


def leaving(axis: int | None = None, mode: int = Mode.POSITION) -> Rig:
    """Open mode is left without a motion; this axis has closed first."""
    rig = opened(3, mode=mode)
    rig.session.stop()
    rig.cycle()
    if axis is not None:
        rig.modes[axis] = Mode.CLOSED
    rig.cycle()
    assert rig.state is State.EXITING
    return rig


class TestWhileLeaving:
    """Commanded values of axes that were sent a set-point; NaN for the others."""

    def test_closed_axis_and_reopened_axis(self):
        rig = leaving(axis=2)
        assert rig.records["interval"].tolist() == [-1, *[0] * 6]
        nothing = np.arange(N) == 2
        for record, missing in zip(rig.records[-2:], (~EVERY, nothing), strict=True):
            expected = np.where(missing, np.nan, START)
            np.testing.assert_allclose(record["commanded_position"], expected, atol=1e-6)
            np.testing.assert_array_equal(record["commanded_velocity"], 0.0 * expected)
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
        rig = leaving()
        rig.modes[2] = Mode.POSITION_RELATIVE
        rig.cycle()
        assert rig.state is State.EXITING
        rig.axes["d"][2, 2] += 2.01
        answer = rig.cycle()
        assert answer.axes["mode"][2] == Mode.FOLLOWING_ERROR
        assert kind_of(rig.refusal) is Check.FOLLOWING_ERROR

    @pytest.mark.parametrize("value", [99.0, np.nan])
    @pytest.mark.parametrize("mode", sorted(POSITION_MODES))
    def test_closed_axis_is_not_checked(self, mode, value):
        rig = leaving(axis=2, mode=mode)
        for column in (0, 2, 4):
            rig.axes["d"][2, column] = value
            rig.cycle()
            assert rig.state is State.EXITING
        rig.axes["d"][3, 2] += 5.0
        rig.cycle()
        assert (kind_of(rig.refusal), rig.refusal.joint) == (Check.FOLLOWING_ERROR, 3)


EVERY = np.ones(N, dtype=bool)


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

    def test_axis_in_another_position_mode_is_held_near_its_target(self):
        rig = self.opening()
        rig.modes[2] = Mode.POSITION_RELATIVE
        rig.cycle()
        assert rig.state is State.OPENING
        rig.axes["d"][2, 2] += 2.01
        assert rig.cycle().axes["mode"][2] == Mode.FOLLOWING_ERROR
        assert kind_of(rig.refusal) is Check.FOLLOWING_ERROR

    @pytest.mark.parametrize("opened", [1, N - 1])
    def test_motion_that_waits_too_long_is_dropped(self, opened):
        rig = self.opening(source := Cruise(), opened)
        rig.cycle(TIMEOUT - 1)
        assert (rig.state, rig.exits_asked) == (State.OPENING, 0)
        rig.cycle()
        assert (rig.state, rig.exits_asked) == (State.EXITING, 1)
        assert rig.ended.outcome == "stopped"
        hint = ": if axis 1 alone is to open, use --only-axis" if opened == 1 else ""
        assert rig.ended.reason == f"{SOME_DID_NOT_OPEN} {EXIT_TIMEOUT:g} s{hint}"
        assert source.begun_at is None
        rig.cycle(TIMEOUT - 1)
        assert rig.state is State.EXITING
        assert all_drive_off(rig.cycle())

    def test_no_timeout_without_a_motion(self):
        rig = self.opening()
        rig.cycle(TIMEOUT + 10)
        assert (rig.state, rig.exits_asked) == (State.OPENING, 0)


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

    def lose_target(self, value: float, mode: int | None = None) -> None:
        """Its target is no number; drive-off is requested, once with an event."""
        self.axes["d"][6, 0] = value
        refusals = len(self.seen(Refused))
        for _ in range(3):
            answer = self.cycle(mode=mode)
            assert all_drive_off(answer)
            assert np.isfinite(answer.axes["d"]).all()
        assert len(self.seen(Refused)) == refusals + 1
        assert State.FAULTED in self.path
        assert type(self.refusal) is RefusalError
        assert f"axis {7 if self.arm == 1 else 1} of arm {self.arm}" in str(self.refusal)


@pytest.mark.parametrize("arm", [1, 2])
@pytest.mark.parametrize("value", NOT_FINITE)
class TestOtherAxes:
    def test_during_a_motion(self, arm, value):
        rig = OtherAxis(arm)
        rig.session.request(Cruise())
        rig.open()
        rig.cycle(50)
        rig.lose_target(value)
        assert (rig.state, rig.ended.outcome) == (State.FAULTED, "refused")

    def test_with_closed_axes(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.session.request(still(3))
        rig.axes["mode"][6] = Mode.POSITION
        rig.cycle()
        rig.lose_target(value)
        assert rig.ended.outcome == "refused"
        rig.axes["d"][6, 0] = 1.0
        assert rig.cycle().axes["mode"][6] == Mode.POSITION
        rig.lose_target(value)
        assert rig.session.counters.refused == 2

    def test_in_the_first_cycle(self, arm, value):
        rig = OtherAxis(arm)
        rig.start()
        rig.axes["mode"][6] = Mode.POSITION
        rig.lose_target(value)

    def test_no_motion_begins(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.axes["mode"][6] = Mode.POSITION
        rig.lose_target(value)
        rig.session.request(source := Cruise())
        assert all_drive_off(rig.cycle(mode=Mode.POSITION))
        assert (source.begun_at, rig.ended.outcome) == (None, "refused")

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
