"""What never leaves, what comes of it, and how open mode is left."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import (
    CyclicPacket,
    LinkLost,
    Mode,
    MotionStarted,
    RefusalError,
    Refused,
    RequestError,
    SourceFailed,
    State,
    reply_policy,
)
from drivers.errors import (
    AccelerationLimit,
    AgeAfterGap,
    CurrentLimit,
    ExitTimeout,
    FirstSetPoint,
    FirstSetPointUnknown,
    FollowingError,
    ModeRefused,
    NotAtStandstill,
    NotFinite,
    SetPointNotAccepted,
    TargetNotFinite,
)
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
    GoesOn,
    N,
    Rig,
    Table,
    Unspeakable,
    accelerating,
    all_drive_off,
    assert_refused,
    bump,
    closed,
    exiting,
    init_packet,
    limits,
    moving,
    opened,
    running,
    smooth_move,
    started,
    still,
)

WIDE = {"jerk": np.full(N, 1e9)}


def play(rows, velocities=None, bounds="plan", **options) -> tuple[Rig, CyclicPacket]:
    """Run a table of positions to its end; the last answer."""
    rig = running(Table(rows, velocities, bounds), **options)
    return rig, rig.cycle(len(rows) - 1)


class TestRefusedSetPoints:
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("part", ["position", "velocity"])
    def test_not_finite(self, value, part):
        rows = np.tile(START, (5, 1))
        velocities = np.zeros((5, N))
        (rows if part == "position" else velocities)[4, 3] = value
        rig, answer = play(rows, velocities)
        assert assert_refused(rig, answer, NotFinite).joint == 3
        assert np.isfinite(answer.axes["d"]).all()

    @pytest.mark.parametrize(("stopping", "factor"), [(False, 1), (True, 2)])
    def test_a_plan_and_a_stop_have_their_acceleration(self, stopping, factor):
        def play_on(rows):
            rig = running(GoesOn(rows), guard_limits=limits(**WIDE))
            if stopping:
                rig.session.stop()
            return rig, rig.cycle(len(rows) - 1)

        assert play_on(accelerating(8.0 * factor * 0.999))[0].state is State.OPEN
        rig, answer = play_on(accelerating(8.0 * factor * 1.001)[:3])
        assert_refused(rig, answer, AccelerationLimit)

    @pytest.mark.parametrize("bounds", ["override", "stop"])
    def test_a_source_that_takes_wider_bounds_than_it_was_granted(self, bounds):
        rig, answer = play(np.tile(START, (5, 1))[:2], None, bounds)
        assert bounds in str(assert_refused(rig, answer, SourceFailed))

    def test_a_source_that_takes_the_bounds_of_an_override_for_its_stop(self):
        rig, source = moving()
        rig.session.stop()
        rig.cycle()
        source.bounds = "override"
        assert_refused(rig, rig.cycle(), SourceFailed)

    def test_a_source_that_ignores_a_stop(self):
        class Deaf(Cruise):
            SPEED = 0.1

            def stop(self):
                pass

        rig = running(Deaf(), 300)
        rig.session.stop()
        rig.cycle(round(STOP_TIMEOUT / PERIOD))
        assert rig.state is State.OPEN
        error = assert_refused(rig, rig.cycle(), SourceFailed)
        assert "did not come to rest" in str(error)

    def test_a_long_hold_of_the_end_of_a_stop_is_no_slow_stop(self):
        rig, _ = moving(settle_cycles=round(STOP_TIMEOUT / PERIOD) + 10)
        rig.session.stop()
        rig.run(12_000)
        assert rig.ended.outcome == "stopped"


NO_STEP = [None, 1.0, (1.0, 2.0), (None, None), ("x", "y"), START, (START[:5], np.zeros(6))]


class TestSources:
    """Whatever a source does wrong, its motion or correction is refused."""

    def refused(self, base: type, *, stopped: bool = False, **parts) -> SourceFailed:
        """Why a source with these methods and properties was refused."""
        odd = type("Odd", (base,), {"__init__": lambda self: None, **parts})()
        usual = Correction(rows=90) if base is Correction else base()
        for name in vars(usual).keys() - parts.keys():
            setattr(odd, name, getattr(usual, name))
        rig = Rig(mode=Mode.VELOCITY if base is Correction else Mode.POSITION)
        rig.session.request(odd)
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
    def test_by_raising_anything_anywhere(self, base, where, kind):
        def fails(self, *_):
            raise kind

        part = property(fails) if where in ("finished", "bounds") else fails
        error = self.refused(base, stopped=where == "stop", **{where: part})
        assert kind.__name__ in str(error)
        assert isinstance(error.__cause__, kind)

    @pytest.mark.parametrize("base", [Cruise, Correction])
    @pytest.mark.parametrize("given", [*NO_STEP, (START, 0.0)])
    def test_by_giving_what_is_no_step(self, base, given):
        self.refused(base, advance=lambda self: given)

    @pytest.mark.parametrize(
        "bounds", ["whatever", None, 1, np.array(["plan"]), np.full(2, "plan"), ["plan"]]
    )
    @pytest.mark.parametrize("finished", [False, True])
    def test_by_naming_no_set_of_bounds(self, bounds, finished):
        self.refused(
            Cruise, bounds=property(lambda _: bounds), finished=property(lambda _: finished)
        )

    @pytest.mark.parametrize("from_cycle", [0, 1])
    def test_by_not_saying_whether_it_is_over(self, from_cycle):
        def unclear(self):
            return self.advances >= from_cycle and np.array([True, False])

        self.refused(Cruise, finished=property(unclear))


FOLLOWING = {"moving": lambda: moving()[0], "leaving": exiting, "held": lambda: opened(20)}


class TestFeedback:
    """Thresholds of 2 revolutions and 20 A; a target may be a tenth of the threshold off."""

    @pytest.mark.parametrize(
        ("situation", "columns", "near", "far", "kind"),
        [
            *((of, [2], 1.99, 2.01, FollowingError) for of in FOLLOWING),
            # The controller may have missed our answers; the arm counts, not its target.
            *((of, [0, 2], 0.19, 2.01, FollowingError) for of in ("moving", "leaving")),
            *((of, [0, 2], 0.19, 0.21, SetPointNotAccepted) for of in FOLLOWING),
            *((of, [0], 0.19, 0.21, SetPointNotAccepted) for of in FOLLOWING),
            *((of, [4], 19.9, 20.1, CurrentLimit) for of in FOLLOWING),
            *((of, [column], 0.0, np.nan, NotFinite) for of in FOLLOWING for column in (0, 2, 4)),
        ],
    )
    def test_what_is_too_far_off_is_refused(self, situation, columns, near, far, kind):
        for sign in (-1.0, 1.0):
            rig = FOLLOWING[situation]()
            rig.axes["d"][3, columns] += sign * near
            rig.cycle()
            assert not rig.seen(Refused)
            rig.axes["d"][3, 4] = 0.0
            rig.axes["d"][3, columns] += sign * far
            answer = rig.cycle()
            assert (type(rig.refusal), rig.refusal.joint) == (kind, 3)
            modes = [4, 4, 4, 508, 4, 4] if kind is FollowingError else [505] * N
            assert answer.axes["mode"].tolist() == modes
            assert (rig.ended is None) == (situation == "held")

    @pytest.mark.parametrize(
        ("name", "column", "kind", "cell", "stated", "bound"),
        [
            ("current_limit", 4, CurrentLimit, 20.0, 7.5, 7.5),
            ("current_limit", 4, CurrentLimit, 20.0, 25.0, 20.0),
            ("current_limit", 4, CurrentLimit, 20.0, np.nan, 20.0),
            ("following_error", 2, FollowingError, 2.0, 0.5, 0.5),
        ],
    )
    def test_the_narrower_limit_of_cell_and_controller_counts(
        self, name, column, kind, cell, stated, bound
    ):
        for sign in (-1, 1):
            rig, _ = moving(init=init_packet(arm_1={name: [*[cell] * 5, stated]}))
            rig.axes["d"][5, column] += sign * 0.999 * bound
            rig.cycle()
            assert rig.state is State.OPEN
            rig.axes["d"][5, 4] = 0.0
            rig.axes["d"][5, column] += sign * (bound + 0.01)
            rig.cycle()
            assert (type(rig.refusal), rig.refusal.joint) == (kind, 5)
            assert rig.refusal.bound == pytest.approx(bound, rel=1e-5)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("mode", [1, 4, 5])
@pytest.mark.parametrize(
    ("columns", "near", "far", "kind"),
    [
        ([0], 0.19, 0.21, FirstSetPoint),
        ([2], 0.19, 0.21, FirstSetPoint),
        ([1], 4e-4, 6e-4, NotAtStandstill),
        ([3], 4e-4, 6e-4, NotAtStandstill),
        ([4], 19.9, 20.1, CurrentLimit),
    ],
)
def test_a_motion_begins_only_at_rest_and_at_its_target(held, mode, columns, near, far, kind):
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


class TestArmThatDoesNotFollow:
    def test_it_goes_on_being_reported_while_the_axes_stay_open(self):
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

    def test_a_later_fault_of_another_kind_is_not_reported_as_508(self):
        rig, _ = moving()
        rig.axes["d"][3, 2] += 2.01
        rig.cycle()
        rig.axes["d"][3, 2] -= 2.01
        rig.cycle(mode=Mode.CLOSED)
        rig.cycle(status=0)
        rig.status, rig.modes = 5, Mode.POSITION
        assert all_drive_off(rig.cycle())


class TestAfterARefusal:
    def refuse(self) -> tuple[Rig, Cruise]:
        rig, source = moving()
        rig.axes["d"][0, 4] = 99.0
        rig.cycle()
        rig.axes["d"][0, 4] = 0.0
        return rig, source

    def test_nothing_moves_before_the_axes_were_closed(self):
        rig, source = self.refuse()
        advances = source.advances
        for _ in range(100):
            assert all_drive_off(rig.cycle())
        assert rig.session.counters.refused == 1
        rig.cycle(3, status=0)
        assert all_drive_off(rig.cycle(status=5)), "open mode again"
        assert source.advances == advances

    def test_after_closing_nothing_moves_until_a_new_motion_does(self):
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

    def test_the_flight_recorder_holds_the_last_cycles_up_to_the_refused_one(self):
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
    """A mode that ends a session's trust in its axes is a refusal like any other: seen, counted."""

    def test_one_packet_of_a_mode_unknown_here_while_closed(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        rig.modes[2] = 3
        rig.cycle(3)
        assert [type(event.error) for event in rig.seen(Refused)] == [ModeRefused]
        assert (rig.refusal.joint, rig.refusal.mode) == (2, 3)
        assert "joint 3 is in mode 3: the reply to that mode is unknown" in str(rig.refusal)
        assert rig.session.counters.refused == 1
        assert (rig.state, rig.ended.outcome) == (State.FAULTED, "lost")

    def test_axes_that_are_open_before_they_were_seen_closed(self):
        rig = started()
        answer = rig.cycle(mode=Mode.POSITION)
        assert all_drive_off(answer)
        assert type(rig.refusal) is ModeRefused
        assert "joint 1 is in mode 4: it was not closed before" in str(rig.refusal)

    def test_every_refusal_has_a_remedy(self):
        def leaves(kind):
            return [kind, *(leaf for one in kind.__subclasses__() for leaf in leaves(one))]

        for kind in leaves(RefusalError):
            assert len(kind.remedy) > 10


OUT_OF_TURN = {
    "another motion": lambda rig: rig.session.request(still(3)),
    "make a new one": lambda rig: rig.cycle(mode=Mode.END_OF_SESSION),
    "state .exiting.": lambda rig: [rig.open(), rig.session.stop(), rig.cycle()],
    "state .open.: open mode is being left": lambda rig: [rig.open(), rig.session.stop()],
    "being left": lambda rig: [rig.cycle(mode=[4] * 5 + [0]), rig.session.stop()],
    "closed first": lambda rig: [rig.axes["d"].__setitem__((0, 2), 99.0), rig.open()],
}
"""What comes before a request that is refused, by the words of its refusal."""


@pytest.mark.parametrize("words", OUT_OF_TURN)
def test_a_request_out_of_turn_is_refused_in_the_words_of_its_state(words):
    rig = closed()
    OUT_OF_TURN[words](rig)
    with pytest.raises(RequestError, match=words) as caught:
        rig.session.request(still(3))
    assert caught.value.state == rig.state.name.lower()


class TestBeforeInit:
    def test_one_as_long_is_none(self):
        rig = Rig()
        assert rig.sync(1, INIT_LENGTH) is None
        assert rig.session.counters.malformed == 1
        assert rig.state is State.SYNC

    @pytest.mark.parametrize("place", [4, 7])
    def test_a_drive_is_on_only_in_the_four_status_bytes(self, place):
        packet = bytearray(b"\x01\x00\x00\x00" + bytes(100))
        packet[8:] = b"\x05" * (len(packet) - 8)
        assert Rig().send(bytes(packet)) is not None
        packet[place] = 5
        assert Rig().send(bytes(packet)) is None

    def test_one_sync_packet_makes_a_cold_start(self):
        rig = Rig()
        rig.sync(1)
        rig.send(rig.init.encode())
        assert rig.sync(11) is not None
        assert rig.state is State.INIT

    def test_the_deadline_begins_with_the_first_packet_even_one_that_is_none(self):
        rig = Rig(init_timeout=30.0)
        assert rig.session.deadline == np.inf
        assert rig.send(b"?") is None
        assert rig.session.deadline == pytest.approx(rig.now + 30.0)


class TestNumbers:
    def test_a_low_number_in_a_running_session_is_stale_and_no_new_beginning(self):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.number = 4
        assert rig.cycle() is None
        assert (rig.state, rig.session.counters.stale) == (State.DRIVE_OFF, 1)

    @pytest.mark.parametrize(("number", "after"), [(9, State.SYNC), (10, State.DRIVE_OFF)])
    def test_after_a_silence_the_numbers_before_that_of_init_begin_anew(self, number, after):
        rig = Rig()
        rig.status = 0
        rig.start()
        rig.cycle(20)
        rig.now += 2.0
        rig.number = number - 1
        assert rig.send(rig.packet()) is not None
        assert rig.state is after

    def test_after_a_silence_a_number_1_that_is_just_the_next_begins_nothing_anew(self):
        rig = Rig()
        rig.status = 0
        rig.start()
        for before in (LAST_NUMBER - 1, LAST_NUMBER):
            rig.now += 2.0
            rig.number = before
            assert rig.cycle() is not None
        assert rig.number == 1
        assert rig.state is State.DRIVE_OFF

    def test_a_packet_at_the_very_deadline_comes_too_late(self):
        rig = closed()
        assert rig.session.reply(rig.packet(), rig.session.deadline) is not None
        assert any(isinstance(event, LinkLost) for event in rig.session.events())

    def test_each_packet_that_looked_stale_meanwhile_counts_as_missed(self):
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
    def test_cycles_begin_at_the_init_packet(self):
        rig = closed()
        rig.cycle(5)
        assert rig.session.cycle == 6
        rig.send(rig.init.encode())
        assert rig.session.cycle == 0

    def test_a_record_is_of_an_interval_until_its_last_axis_has_closed(self):
        rig = opened()
        rig.modes[0] = Mode.CLOSED
        rig.cycle()
        rig.cycle(mode=Mode.CLOSED)
        assert [record["interval"] for record in rig.records] == [-1, 0, 0, -1]


def test_an_answer_lost_in_one_interval_is_not_counted_in_the_next():
    """Lost in its last cycle; the next is left before its last axis has opened."""
    rig, _ = moving(300)
    before = rig.axes.copy()
    rig.cycle()
    rig.axes[:] = before
    rig.cycle()
    assert rig.session.counters.unanswered == 1
    rig.axes["d"][:, 1] = rig.axes["d"][:, 3] = 0.0
    rig.cycle(2, mode=Mode.CLOSED)
    rig.modes[:3] = rig.mode
    rig.cycle()
    rig.session.stop()
    rig.cycle(5)
    assert rig.state is State.EXITING
    assert rig.session.counters.unanswered == 1
    assert len(rig.seen(AnswersLost)) == 1


class TestLeaving:
    """What a controller that goes on is asked, and for how long; limits shortened to be quick."""

    RETRY, TIMEOUT = 10, 25

    @pytest.fixture(autouse=True)
    def short(self, monkeypatch):
        monkeypatch.setattr(reply_policy, "EXIT_RETRY_CYCLES", self.RETRY)
        monkeypatch.setattr(reply_policy, "EXIT_TIMEOUT", self.TIMEOUT * PERIOD)

    def test_the_end_of_open_mode_is_asked_for_again_until_that_is_a_fault(self):
        rig = opened(50)
        rig.session.stop()
        asked = []
        for cycle in range(self.TIMEOUT + 1):
            rig.cycle()
            asked += [cycle] if rig.exits_asked > len(asked) else []
            assert rig.state is (State.EXITING if cycle < self.TIMEOUT else State.FAULTED)
        assert asked == [0, self.RETRY, 2 * self.RETRY]
        assert type(rig.refusal) is ExitTimeout
        assert rig.refusal.cycles == self.TIMEOUT

    def test_where_the_controller_began_to_leave_it_is_asked_after_as_long(self):
        rig = opened(50)
        rig.modes[0] = Mode.CLOSED
        asked = []
        for cycle in range(2 * self.RETRY):
            rig.cycle()
            asked += [cycle] if rig.exits_asked > len(asked) else []
        assert asked == [self.RETRY]


class TestALongGap:
    """Only what goes on in open mode has to have been carried on."""

    def test_after_which_open_mode_is_closed_asks_for_nothing(self):
        rig, _ = moving(100)
        rig.miss(10)
        rig.axes["d"][:, 0] += 5.0
        rig.axes["d"][:, 2] += 5.0
        rig.cycle(mode=Mode.CLOSED)
        assert rig.state is State.CLOSED
        assert not rig.seen(Refused)

    def test_while_an_opening_is_left_does_not_either(self):
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


class TestAnArmThatCannotBeMatched:
    """Its packets are answered and archived, but nothing in them is a joint."""

    def test_records_say_so(self):
        crossed = init_packet(open_axes_map=np.full((4, 10), 3))
        rig = started(init=crossed)
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.ages[4, 2] = 7
        rig.cycle()
        record = rig.records[-1]
        assert (record["mode"] == -1).all()
        assert np.isnan(record["position"]).all()
        assert np.isnan(record["target_position"]).all()
        assert record["age"][2] == 7
        assert record["age"].sum() == 7
        rig.ages = None
        rig.cycle()
        assert not rig.records[-1]["age"].any()


class TestFaulted:
    def test_drive_off_is_asked_for_if_another_axis_could_then_be_held_nowhere(self):
        rig, _ = moving(20)
        rig.axes["d"][3, 2] += 3.0
        assert (rig.cycle().axes["mode"] == Mode.FOLLOWING_ERROR).sum() == 1
        rig.axes["d"][1, 0] = np.nan
        answer = rig.cycle()
        assert (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()


class TestRecordsWhileLeaving:
    """Where an axis was given a set-point, that is what was commanded; elsewhere nothing was."""

    def test_open_axes_rest_at_the_last_set_point(self):
        rig = self.leaving(axis=None)
        for record in rig.records[-2:]:
            np.testing.assert_allclose(record["commanded_position"], START, atol=1e-6)
            np.testing.assert_array_equal(record["commanded_velocity"], np.zeros(N))

    def test_one_that_closed_has_none_and_one_that_opens_again_its_own_target(self):
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

    def test_one_in_another_mode_of_positions_is_held_only_near_its_target(self):
        rig = self.leaving(axis=None)
        rig.modes[2] = Mode.POSITION_RELATIVE
        rig.cycle()
        assert rig.state is State.EXITING
        rig.axes["d"][2, 2] += 2.01
        answer = rig.cycle()
        assert answer.axes["mode"][2] == Mode.FOLLOWING_ERROR
        assert type(rig.refusal) is FollowingError

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_of_corrections_only_one_in_a_mode_of_positions_has_a_target(self, mode):
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
    def test_what_an_axis_that_has_closed_does_is_the_controller_s_business(self, mode, value):
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
        assert (type(rig.refusal), rig.refusal.joint) == (FollowingError, 3)

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
    """Cycles since a value was sent, on links that carry some more slowly."""

    TARGET, TARGET_VELOCITY, ACTUAL, VELOCITY = range(4)

    @pytest.mark.parametrize(("age", "lost"), [(0, 1), (1, 0)])
    def test_a_target_of_an_earlier_cycle_is_no_answer_lost(self, age, lost):
        rig, _ = moving(100)
        before = rig.axes.copy()
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.cycle()
        rig.axes[:] = before
        rig.ages[0, self.TARGET] = age
        rig.cycle()
        assert rig.session.counters.unanswered == lost

    @pytest.mark.parametrize(("axis", "refused"), [(2, False), (3, True)])
    @pytest.mark.parametrize("column", [TARGET, TARGET_VELOCITY, VELOCITY])
    def test_after_a_long_gap_those_of_a_closed_axis_do_not_matter(self, column, axis, refused):
        rig = TestRecordsWhileLeaving.leaving(axis=2)
        rig.miss(10)
        rig.ages = np.zeros((N, 8), np.uint16)
        rig.ages[axis, column] = 1
        rig.cycle()
        assert bool(rig.seen(Refused)) == refused
        if refused:
            assert type(rig.refusal) is AgeAfterGap

    def test_a_target_not_sent_in_each_cycle_may_have_moved_for_all_of_them(self):
        """Mode 7 holds target and offset together to the velocity of the joint, here 2 rad/s."""
        way = rig_way(2.0 * PERIOD)
        for ages, refused in (((1, 2, 0), False), ((0, 0, 0), True)):
            rig = running(Correction(rows=50), mode=Mode.DELTA_POSITION)
            rig.ages = np.zeros((N, 8), np.uint16)
            for age in ages[:-1]:
                rig.ages[:, self.TARGET] = age
                rig.cycle()
            rig.ages[:, self.TARGET] = ages[-1]
            rig.axes["d"][:, [0, 2]] += 2.9 * way[:, None]
            rig.cycle()
            assert bool(rig.seen(Refused)) == refused


def rig_way(radians: float) -> np.ndarray:
    """Motor revolutions of joint 1 alone."""
    train = Rig().train
    first = radians * (np.arange(N) == 0)
    return train.motor_revolutions(first) - train.motor_revolutions(np.zeros(N))


class TestCorrections:
    def test_a_velocity_fed_forward_is_no_way(self):
        """0.05 rad from the end of its range a joint may well go at 0.1 rad/s."""
        near = START.copy()
        near[0] = 1.95
        rig = Rig(mode=Mode.VELOCITY)
        rig.put_arm_at(near)
        rig.session.request(Correction(bump([0.1, 0, 0, 0, 0, 0], 300)))
        rig.open()
        rig.run_to("completed")

    @pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
    def test_one_requested_in_open_mode_begins_only_where_the_arm_stands(self, mode):
        for column, refused in ((3, True), (4, False)):
            rig = opened(mode=mode)
            rig.axes["d"][1, column] = 6e-4
            rig.session.request(Correction(rows=5))
            rig.cycle()
            assert bool(rig.seen(Refused)) == refused
            if refused:
                assert type(rig.refusal) is NotAtStandstill


TIMEOUT = round(EXIT_TIMEOUT / PERIOD)


class TestExitNotGranted:
    def test_one_that_leaves_in_the_last_cycle_is_in_time(self):
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

    def test_exit_is_asked_for_again_however_the_gaps_fall(self):
        rig = exiting()
        rig.miss(EXIT_RETRY_CYCLES + 7)
        rig.cycle()
        assert rig.exits_asked == 2
        rig.cycle(EXIT_RETRY_CYCLES - 1)
        assert rig.exits_asked == 2
        rig.cycle()
        assert rig.exits_asked == 3


class TestReopenedWhileLeaving:
    @pytest.mark.parametrize("mode", [8, 9])
    def test_corrections_stay_zero(self, mode):
        rig = opened(mode=mode)
        rig.session.stop()
        rig.cycle()
        rig.axes["mode"][2] = Mode.CLOSED
        rig.cycle()
        rig.axes["mode"][2] = mode
        assert not rig.cycle().axes["d"].any()


@pytest.mark.parametrize("mode", sorted(CORRECTION_MODES))
@pytest.mark.parametrize(
    ("target", "age", "opening", "kind"),
    [
        (np.nan, 0, False, NotFinite),
        (np.nan, 0, True, NotFinite),
        (50.0, 0, False, FollowingError),
        (None, 1, False, FirstSetPointUnknown),
        (None, 0, False, None),
    ],
)
def test_a_stray_axis_is_given_its_target_back_if_it_can_be_held_there(
    mode, target, age, opening, kind
):
    """It is in a mode of positions while corrections end, or begin."""
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
        assert type(rig.refusal) is kind
        reported = [0, 0, 508, 0, 0, 0] if kind is FollowingError else [505] * N
        assert answer.axes["mode"].tolist() == reported


class TestOpeningThatNeverCompletes:
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
    def test_a_stop_leaves_open_mode_and_holds_each_axis_at_its_target(self, last):
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
    def test_a_motion_that_waits_too_long_is_given_up(self, opened):
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

    def test_without_a_motion_nobody_waits(self):
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
        assert type(error) is TargetNotFinite
        assert isinstance(error, NotFinite)
        assert (error.arm, error.joint) == (arm, 6 if arm == 1 else 0)
        assert f"axis {error.joint + 1} of arm {arm}" in str(error)

    def test_beside_a_motion(self, arm, value):
        rig = OtherAxis(arm)
        rig.session.request(Cruise())
        rig.open()
        rig.cycle(50)
        rig.axes["d"][6, 0] = value
        self.refused(rig, rig.cycle(), arm)
        assert rig.ended.outcome == "refused"

    def test_while_ours_are_closed_it_is_told_once_and_asked_for_in_each_cycle(self, arm, value):
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

    def test_no_motion_begins_beside_it(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        rig.cycle(3)
        rig.session.request(source := Cruise())
        assert all_drive_off(rig.cycle(mode=Mode.POSITION))
        assert source.begun_at is None
        assert rig.ended.outcome == "refused"

    def test_without_its_drive_it_is_echoed(self, arm, value):
        rig = OtherAxis(arm)
        rig.close()
        rig.drive = 0
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        packet = rig.packet()
        answer = CyclicPacket.decode(rig.send(packet), N + 1)
        assert answer.axes[6].tobytes() == CyclicPacket.decode(packet, N + 1).axes[6].tobytes()
        assert not rig.seen(Refused)

    def test_it_counts_though_the_drive_of_the_arm_that_is_moved_is_off(self, arm, value):
        rig = OtherAxis(arm)
        rig.status = 0
        rig.start()
        rig.axes["mode"][6] = Mode.POSITION
        rig.axes["d"][6, 0] = value
        for _ in range(3):
            assert all_drive_off(rig.cycle())
        [refusal] = rig.seen(Refused)
        assert (type(refusal.error), refusal.error.arm) == (TargetNotFinite, arm)


@pytest.mark.parametrize(
    ("column", "off", "kind"),
    [
        (0, 1.9, None),
        *((column, 2.1, FollowingError) for column in (0, 2)),
        *((0, value, TargetNotFinite) for value in NOT_FINITE),
    ],
)
def test_axes_still_open_in_a_pause_are_held_only_near_their_target(column, off, kind):
    rig = opened(5)
    rig.axes["mode"][5] = Mode.PAUSE_BY_CONTROLLER
    rig.cycle()
    rig.axes["d"][0, column] += off
    for _ in range(5):
        answer = rig.cycle()
        modes = {None: [4] * 5 + [0], FollowingError: [508] + [4] * 4 + [0]}.get(kind, [505] * N)
        assert answer.axes["mode"].tolist() == modes
        assert np.isfinite(answer.axes["d"]).all()
    assert [type(event.error) for event in rig.seen(Refused)] == [kind] * (kind is not None)
    if kind is None:
        assert rig.state is State.FREEZING
        assert answer.axes["d"][0, 0] == rig.axes["d"][0, 0]


def test_a_mode_unknown_here_beside_open_axes_asks_for_drive_off():
    rig = closed()
    rig.session.request(source := still(3, START))
    assert all_drive_off(rig.cycle(mode=[4, 4, 4, 4, 4, 3]))
    assert rig.state is State.FAULTED
    assert rig.ended.outcome == "lost"
    assert source.index == 0
