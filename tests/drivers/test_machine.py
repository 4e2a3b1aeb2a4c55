"""What each change of state and each loss does to a motion, without a packet."""

from __future__ import annotations

import pytest

from drivers import Mode, RequestError, SourceFailed, State
from drivers.events import (
    AnswersLost,
    Counters,
    GapSeen,
    HoldChanged,
    MotionEnded,
    MotionStarted,
    OverrideChanged,
    StateChanged,
)
from drivers.execution import Execution, execution_of
from drivers.state_machine import LOSS_WINDOW, Machine
from drivers.states import Input
from tests.drivers.rig import START, Cruise, N

TO_OPEN = (Input.INIT, Input.CLOSED, Input.OPEN)
MAX_GAP = 2


class Pausing(Cruise):
    """Can be held, resumed and overridden."""

    def __init__(self):
        super().__init__()
        self.told = []

    def override(self, fraction):
        self.told.append(fraction)

    def hold(self):
        self.told.append("hold")

    def resume(self):
        self.told.append("resume")


def walked(*inputs: Input, source=None) -> Machine:
    """A machine that took these inputs one cycle apart; a source is requested before the last."""
    machine = Machine(Counters())
    for cycle, what in enumerate(inputs, start=1):
        if source is not None and cycle == len(inputs):
            machine.request(requested(source), None)
        machine.cycle = cycle
        machine.take(what)
    return machine


def requested(source) -> Execution:
    execution = execution_of(source, Mode.POSITION, N, 5, 5000)
    assert isinstance(execution, Execution)
    return execution


def moving(source=None) -> Machine:
    machine = walked(*TO_OPEN, source=source or Pausing())
    machine.entering = False
    machine.begin_motion(START)
    machine.events.clear()
    return machine


def only(machine: Machine, kind: type) -> list:
    return [event for event in machine.events if isinstance(event, kind)]


class TestIntervals:
    def test_nothing_has_happened_at_first(self):
        machine = Machine(Counters())
        assert (machine.state, machine.cycle, machine.entered_at) == (State.SYNC, 0, 0)
        assert (machine.interval, machine.in_interval, machine.entering) == (-1, False, False)
        assert (machine.execution, machine.stop_reason, machine.offending) == (None, None, None)

    def test_each_time_in_open_mode_is_one(self):
        machine = walked(*TO_OPEN)
        assert (machine.interval, machine.in_interval, machine.entering) == (0, True, True)
        assert (machine.state, machine.entered_at) == (State.OPEN, 3)
        machine.cycle, machine.entering = 9, False
        machine.take(Input.OPEN)
        assert (machine.interval, machine.entered_at, machine.entering) == (0, 3, False)
        machine.take(Input.CLOSED)
        machine.take(Input.OPEN)
        assert (machine.interval, machine.entered_at, machine.entering) == (1, 9, True)

    @pytest.mark.parametrize("what", [Input.INIT, Input.SILENCE])
    def test_a_restart_and_a_silence_end_it_at_once(self, what):
        machine = walked(*TO_OPEN)
        machine.take(what)
        assert not machine.in_interval

    @pytest.mark.parametrize("what", [Input.CLOSED, Input.OFF, Input.PARTLY_OPEN, Input.REFUSAL])
    def test_axes_that_close_one_by_one_do_not(self, what):
        machine = walked(*TO_OPEN)
        machine.take(what)
        assert machine.in_interval  # the packet may still show an open axis

    def test_each_change_of_state_is_told_with_its_cycle(self):
        told = only(walked(*TO_OPEN), StateChanged)
        assert told == [
            StateChanged(State.SYNC, State.INIT, 1),
            StateChanged(State.INIT, State.CLOSED, 2),
            StateChanged(State.CLOSED, State.OPEN, 3),
        ]

    def test_another_state_forgets_whose_following_error_was_reported(self):
        machine = walked(*TO_OPEN)
        machine.take(Input.REFUSAL)
        machine.offending = 3
        machine.take(Input.OPEN)
        assert machine.offending == 3
        machine.take(Input.CLOSED)
        assert machine.offending is None


class TestStops:
    @pytest.mark.parametrize(
        ("inputs", "left"),
        [
            (TO_OPEN, True),
            ((Input.INIT, Input.CLOSED, Input.PARTLY_OPEN), True),
            (TO_OPEN[:2], False),
        ],
    )
    def test_open_mode_is_left_for_the_first_reason_where_there_is_any(self, inputs, left):
        machine = walked(*inputs)
        machine.stop("first")
        machine.stop("second")
        assert machine.stop_reason == ("first" if left else None)

    def test_the_reason_lasts_until_open_mode_was_left(self):
        machine = walked(*TO_OPEN)
        machine.stop("enough")
        machine.take(Input.EXIT)
        assert (machine.state, machine.stop_reason) == (State.EXITING, "enough")
        machine.take(Input.CLOSED)
        assert machine.stop_reason is None

    def test_a_motion_not_begun_is_dropped_and_one_begun_is_not(self):
        machine = walked(*TO_OPEN[:2], source=Pausing())
        machine.stop("enough")
        assert machine.execution is None
        assert only(machine, MotionEnded) == [MotionEnded("stopped", "enough", -1, 2)]
        machine = moving()
        machine.stop("enough")
        assert machine.execution is not None
        assert not only(machine, MotionEnded)


class TestRequests:
    @pytest.mark.parametrize(
        ("inputs", "reason"),
        [
            ((Input.INIT, Input.END), "ended the session"),
            ((Input.INIT, Input.OPEN), "report its axes closed first"),
            ((*TO_OPEN, Input.EXIT), "open mode is being left"),
        ],
    )
    def test_none_is_promised_that_cannot_be_kept(self, inputs, reason):
        machine = walked(*inputs)
        with pytest.raises(RequestError, match=reason) as caught:
            machine.request(requested(Cruise()), None)
        assert caught.value.state == machine.state.name.lower()
        assert machine.execution is None

    def test_none_is_promised_after_a_stop_nor_for_an_arm_that_cannot_be_moved(self):
        machine = walked(*TO_OPEN)
        with pytest.raises(RequestError, match="another arm"):
            machine.request(requested(Cruise()), "it is another arm")
        machine.stop("enough")
        with pytest.raises(RequestError, match="being left"):
            machine.request(requested(Cruise()), None)

    def test_no_second_motion_is_promised(self):
        with pytest.raises(RequestError, match="another motion"):
            moving().request(requested(Cruise()), None)


class TestEnds:
    @pytest.mark.parametrize("what", [Input.INIT, Input.SILENCE, Input.OFF, Input.CLOSED])
    def test_a_motion_that_is_lost_is_of_the_interval_it_moved_in(self, what):
        machine = moving()
        machine.cycle = 8
        machine.take(what)
        [ended] = only(machine, MotionEnded)
        assert (ended.outcome, ended.interval, ended.cycle) == ("lost", 0, 8)
        assert machine.execution is None

    def test_one_that_was_leaving_came_to_its_end(self):
        machine = moving()
        machine.execution.leaving = True
        machine.take(Input.EXIT)
        assert machine.execution is not None
        machine.take(Input.CLOSED)
        assert only(machine, MotionEnded) == [
            MotionEnded("completed", "the motion came to its end", 0, 3)
        ]

    @pytest.mark.parametrize(("inputs", "interval"), [(TO_OPEN, 0), (TO_OPEN[:2], -1)])
    def test_one_refused_at_its_first_set_point_was_in_the_interval_reached(self, inputs, interval):
        machine = walked(*inputs, source=Cruise())
        machine.take(Input.REFUSAL)
        assert machine.execution is not None  # the refusal itself says why
        machine.end("refused", "too far")
        assert only(machine, MotionEnded) == [
            MotionEnded("refused", "too far", interval, len(inputs))
        ]
        machine.end("refused", "again")
        assert len(only(machine, MotionEnded)) == 1

    def test_an_earlier_interval_is_not_that_of_a_motion_that_saw_none(self):
        machine = walked(*TO_OPEN, Input.CLOSED)
        machine.in_interval = False
        machine.request(requested(Cruise()), None)
        machine.take(Input.OFF)
        [ended] = only(machine, MotionEnded)
        assert (ended.outcome, ended.interval) == ("lost", -1)

    def test_the_beginning_is_told_and_may_fail(self):
        machine = walked(*TO_OPEN, source=Cruise())
        machine.begin_motion(START)
        assert only(machine, MotionStarted) == [MotionStarted(0, 3)]
        assert machine.execution.started
        machine = walked(*TO_OPEN, source=Cruise())
        machine.execution._source.begin = lambda position: 1 / 0
        with pytest.raises(SourceFailed):
            machine.begin_motion(START)
        assert not only(machine, MotionStarted)


class TestHoldAndOverride:
    def test_changes_are_told_once_each(self):
        source = Pausing()
        machine = moving(source)
        for name, held in (("hold", True), ("resume", False)):
            for cycle in (20, 21):
                machine.cycle = cycle
                getattr(machine, name)()
            assert machine.events == [HoldChanged(held, 20)]
            machine.events.clear()
        machine.cycle = 20
        for fraction in (0.5, 0.5, 1):
            machine.override(fraction)
        assert machine.events == [OverrideChanged(0.5, 20), OverrideChanged(1.0, 20)]

    def test_a_motion_being_stopped_is_not_held(self):
        source = Pausing()
        machine = moving(source)
        machine.stop("enough")
        machine.hold()
        assert source.told == []
        assert not machine.events

    def test_one_that_cannot_rest_is_stopped(self):
        machine = moving(Cruise())
        machine.hold()
        assert "stopped instead" in machine.stop_reason
        assert not only(machine, HoldChanged)

    @pytest.mark.parametrize(
        ("name", "args", "what"),
        [
            ("override", (0.5,), "change of override"),
            ("hold", (), "hold"),
            ("resume", (), "resumption"),
        ],
    )
    def test_without_a_motion_there_is_nothing_to_change(self, name, args, what):
        machine = walked(*TO_OPEN)
        with pytest.raises(RequestError, match="no motion was requested") as caught:
            getattr(machine, name)(*args)
        assert (caught.value.state, caught.value.what) == ("open", what)

    @pytest.mark.parametrize(("name", "args"), [("override", (0.5,)), ("resume", ())])
    def test_a_motion_that_cannot_says_so(self, name, args):
        with pytest.raises(RequestError) as caught:
            getattr(moving(Cruise()), name)(*args)
        assert caught.value.state == "open"


class TestLosses:
    @pytest.mark.parametrize(
        ("after", "stopped"), [(1, True), (LOSS_WINDOW - 1, True), (LOSS_WINDOW, False)]
    )
    def test_answers_lost_add_up_over_a_hundred_cycles(self, after, stopped):
        machine = moving()
        machine.cycle = 50
        machine.note_lost(MAX_GAP, MAX_GAP)
        assert machine.stop_reason is None
        machine.cycle += after
        machine.note_lost(1, MAX_GAP)
        assert (machine.stop_reason is not None) == stopped
        assert machine.counters.unanswered == MAX_GAP + 1
        assert machine.events == [AnswersLost(MAX_GAP, 50), AnswersLost(1, 50 + after)]

    def test_too_many_at_once_stop_it_and_the_reason_says_how_many(self):
        machine = moving()
        machine.note_lost(MAX_GAP + 1, MAX_GAP)
        assert machine.stop_reason == "3 answers were lost in 100 cycles"

    def test_none_lost_is_nothing_to_tell(self):
        machine = moving()
        machine.note_lost(0, MAX_GAP)
        machine.note_gap(0, 0, MAX_GAP)
        assert not machine.events
        assert (machine.counters.unanswered, machine.counters.missed) == (0, 0)

    def test_those_of_the_last_interval_do_not_count_in_the_next(self):
        machine = moving()
        machine.note_lost(MAX_GAP, MAX_GAP)
        for what in (Input.CLOSED, Input.OPEN):
            machine.take(what)
        machine.execution = requested(Cruise())
        machine.note_lost(1, MAX_GAP)
        assert machine.stop_reason is None

    def test_packets_missed_in_a_row(self):
        machine = moving()
        machine.note_gap(MAX_GAP, MAX_GAP, MAX_GAP)
        assert machine.stop_reason is None
        machine.note_gap(1, MAX_GAP + 1, MAX_GAP)
        assert machine.stop_reason == "3 packets were missed in a row"
        assert machine.counters.missed == MAX_GAP + 1
        assert machine.events == [GapSeen(MAX_GAP, 3), GapSeen(1, 3)]

    @pytest.mark.parametrize("note", ["answers", "gap"])
    def test_only_a_motion_in_open_mode_is_stopped(self, note):
        def lose(machine: Machine) -> Machine:
            if note == "answers":
                machine.note_lost(9, MAX_GAP)
            else:
                machine.note_gap(9, 9, MAX_GAP)
            return machine

        assert lose(moving()).stop_reason is not None
        assert lose(walked(*TO_OPEN)).stop_reason is None
        leaving = moving()
        leaving.take(Input.EXIT)
        assert lose(leaving).stop_reason is None
        closed = walked(*TO_OPEN[:2], source=Cruise())
        assert lose(closed).execution is not None
