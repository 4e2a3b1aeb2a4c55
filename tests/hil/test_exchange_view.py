"""What the supervisor makes of what its exchange process says."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from drivers.events import MotionStarted
from drivers.exchange import EventsLost
from drivers.exchange import control as control_memory
from drivers.states import State
from hil.campaign import exchange_view
from hil.campaign.exchange_view import ExchangeView


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
