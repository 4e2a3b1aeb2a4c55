"""What a run makes of an operator's screen that fails."""

from __future__ import annotations

from hil.campaign.operator import OperatorRequest, RunStatus, RunWatch, Stop


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
