"""What supervises a run: its view of the exchange, its own pace, and a screen that fails."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from drivers.events import MotionStarted
from drivers.exchange import control as control_memory
from drivers.exchange.event_log import NO_SUPERVISOR, EventsLost
from drivers.states import State
from hil.campaign import exchange_view
from hil.campaign.exchange_view import ExchangeView
from hil.campaign.live_link import STALL, Heartbeat
from hil.campaign.operator import OperatorRequest, RunStatus, RunWatch, Stop


class Exchange:
    """As much of an exchange process as is looked at."""

    def __init__(self) -> None:
        self.control_fd = control_memory.create()
        self.alive = True
        self.state, self.ended_count = State.CLOSED, 3
        self.said: list[Any] = []

    def status(self) -> Any:
        return SimpleNamespace(state=self.state, ended_count=self.ended_count)

    def events(self) -> list[Any]:
        said, self.said = self.said, []
        return said


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    at = SimpleNamespace(now=100.0)
    monkeypatch.setattr(exchange_view, "time", SimpleNamespace(monotonic=lambda: at.now))
    return at


def test_a_motion_is_not_waited_for_once_the_drive_is_off(clock: SimpleNamespace) -> None:
    exchange = Exchange()
    view = ExchangeView(exchange)  # type: ignore[arg-type]
    view.forget_motion()
    assert view.not_begun() is None
    exchange.state = State.DRIVE_OFF
    clock.now += 1.0
    assert view.not_begun() is None
    clock.now += 1.5
    assert view.not_begun() == "the drive went off before the motion began"


def test_a_motion_that_does_not_begin_is_given_up_after_a_minute(clock: SimpleNamespace) -> None:
    view = ExchangeView(Exchange())  # type: ignore[arg-type]
    view.forget_motion()
    clock.now += 59.0
    assert view.not_begun() is None
    clock.now += 2.0
    assert "did not begin within 60 s" in (view.not_begun() or "")


@pytest.mark.parametrize("event", [MotionStarted(0, 10), EventsLost(1)])
def test_a_motion_that_began_or_may_have_is_not_given_up(
    clock: SimpleNamespace, event: MotionStarted | EventsLost
) -> None:
    exchange = Exchange()
    view = ExchangeView(exchange)  # type: ignore[arg-type]
    view.forget_motion()
    exchange.said.append(event)
    view.look()
    clock.now += 3600.0
    assert view.not_begun() is None


def test_the_count_tells_the_end_of_a_motion_whose_event_was_lost(clock: SimpleNamespace) -> None:
    exchange = Exchange()
    view = ExchangeView(exchange)  # type: ignore[arg-type]
    view.forget_motion()
    assert not view.motion_ended
    exchange.ended_count += 1
    assert view.motion_ended
    assert view.ended is None


# --- Signs of life are given only while the supervision itself is alive


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def beats_in(heart: Heartbeat, clock: Clock, given: list[float], seconds: float) -> int:
    """How often it beats while so long nothing else happens."""
    before, end = len(given), clock.now + seconds
    while clock.now < end:
        clock.now += 0.05
        heart.look()
    return len(given) - before


def test_beats_end_where_a_motion_is_supervised_and_its_loop_stands_still() -> None:
    clock, given = Clock(), list[float]()
    heart = Heartbeat(lambda: given.append(clock.now), clock)
    assert beats_in(heart, clock, given, 600.0) >= 11_999, "between motions work may take long"
    heart.turn()
    assert beats_in(heart, clock, given, 0.9 * STALL) > 10
    heart.turn()
    beats_in(heart, clock, given, 2.0 * STALL)
    assert clock.now - given[-1] > 0.9 * STALL
    explained = heart.explained(f"the exchange process ended ({NO_SUPERVISOR})")
    assert "looks at the motion (show, request) did not return for 2.0 s" in explained
    heart.turn()
    assert beats_in(heart, clock, given, 0.5) > 5, "and goes on with the loop"
    heart.rest()
    assert beats_in(heart, clock, given, 60.0) >= 1_199


def test_a_program_that_got_no_processor_is_told_so_and_other_ends_are_not_explained() -> None:
    clock = Clock()
    heart = Heartbeat(lambda: None, clock)
    assert heart.explained(NO_SUPERVISOR) == NO_SUPERVISOR
    clock.now += 0.7
    assert "got no processor time for 0.7 s, load average" in heart.explained(NO_SUPERVISOR)
    assert heart.explained("stopped by the operator") == "stopped by the operator"


# --- What a run makes of an operator's screen that fails


class Failing:
    """An operator whose parts fail when they are told to."""

    can_answer = False

    def __init__(self) -> None:
        self.shown, self.answer, self.fails = 0, OperatorRequest(), False

    def show(self, _: RunStatus) -> None:
        self.shown += 1
        if self.fails:
            raise RuntimeError("no picture")

    def request(self) -> OperatorRequest:
        return self.answer

    def accept_dry_run(self, _: object) -> bool:
        return False


def test_a_screen_that_shows_nothing_is_still_asked_for_wishes() -> None:
    operator, stop = Failing(), Stop()
    watch = RunWatch(operator, stop)
    operator.fails = True
    for _ in range(3):
        watch.note("good")
    assert operator.shown == 1
    operator.answer = OperatorRequest(0.4, held=True)
    assert watch.request() == OperatorRequest(0.4, held=True)
    assert not stop.requested
    assert len(watch.troubles) == 1
    assert "no picture" in watch.troubles[0]


def test_a_wish_that_is_none_leaves_the_last_and_is_asked_for_anew() -> None:
    operator, stop = Failing(), Stop()
    watch = RunWatch(operator, stop)
    operator.answer = OperatorRequest(0.4)
    watch.request()
    operator.answer = None  # type: ignore[assignment]
    assert watch.request() == OperatorRequest(0.4)
    operator.answer = OperatorRequest(0.3)
    assert watch.request() == OperatorRequest(0.3)
    assert "None is no OperatorRequest" in watch.troubles[0]
    assert not stop.requested


def test_a_hold_that_nobody_can_release_becomes_a_stop() -> None:
    operator, stop = Failing(), Stop()
    watch = RunWatch(operator, stop)
    operator.answer = OperatorRequest(held=True)
    watch.request()
    assert not stop.requested
    operator.answer = None  # type: ignore[assignment]
    assert watch.request().held
    assert stop.requested
    assert "the run was stopped" in watch.troubles[0]
