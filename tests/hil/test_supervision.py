"""What supervises a run: its view of the exchange, its own pace, a screen that fails, and rest."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.events import MotionStarted
from drivers.exchange import control as control_memory
from drivers.exchange.event_log import NO_SUPERVISOR, EventsLost
from drivers.record import cycle_dtype
from drivers.states import State
from hil.archive import open_archive
from hil.campaign import live_link
from hil.campaign.live_link import STALL, ExchangeView, Heartbeat, Standstill
from hil.campaign.operator import OperatorRequest, RunStatus, RunWatch, Stop
from hil.testing import faulty_link
from tests.hil.fast_cell import fast_campaign, fast_cell


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
    monkeypatch.setattr(live_link, "time", SimpleNamespace(monotonic=lambda: at.now))
    return at


@pytest.fixture
def exchange(clock: SimpleNamespace) -> Exchange:
    return Exchange()


@pytest.fixture
def view(exchange: Exchange) -> ExchangeView:
    view = ExchangeView(exchange)  # type: ignore[arg-type]
    view.forget_motion()
    return view


@pytest.mark.parametrize(
    ("state", "waits", "words"),
    [
        (State.DRIVE_OFF, 1.9, "the drive went off before the motion began"),
        (State.FAULTED, 1.9, "a refusal came before the motion began"),
        (State.CLOSED, 59.0, r"did not begin within 60 s"),
    ],
)
def test_a_motion_that_does_not_begin_is_given_up(
    view: ExchangeView,
    exchange: Exchange,
    clock: SimpleNamespace,
    state: State,
    waits: float,
    words: str,
) -> None:
    exchange.state = state
    clock.now += waits
    assert view.not_begun() is None
    clock.now += 2.0
    assert words in (view.not_begun() or "")


@pytest.mark.parametrize("event", [MotionStarted(0, 10), EventsLost(1)])
def test_a_motion_that_began_or_may_have_is_not_given_up(
    view: ExchangeView, exchange: Exchange, clock: SimpleNamespace, event: Any
) -> None:
    exchange.said.append(event)
    view.look()
    clock.now += 3600.0
    assert view.not_begun() is None


def test_the_count_tells_an_end_whose_event_was_lost(
    view: ExchangeView, exchange: Exchange
) -> None:
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


def test_beats_end_where_the_supervising_loop_stands_still() -> None:
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


def test_a_program_that_got_no_processor_is_named() -> None:
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
        self.shown, self.fails = 0, False
        self.answer: Any = OperatorRequest()

    def show(self, _: RunStatus) -> None:
        self.shown += 1
        if self.fails:
            raise RuntimeError("no picture")

    def request(self) -> OperatorRequest:
        return self.answer  # type: ignore[no-any-return]

    def accept_dry_run(self, _: object) -> bool:
        return False


@pytest.fixture
def operator() -> Failing:
    return Failing()


@pytest.fixture
def watch(operator: Failing) -> RunWatch:
    return RunWatch(operator, Stop())


def test_a_screen_that_shows_nothing_is_still_asked(operator: Failing, watch: RunWatch) -> None:
    operator.fails = True
    for _ in range(3):
        watch.note("good")
    assert operator.shown == 1
    operator.answer = OperatorRequest(0.4, held=True)
    assert watch.request() == operator.answer
    assert not watch.stop.requested
    (trouble,) = watch.troubles
    assert "no picture" in trouble


def test_a_request_that_is_none_leaves_the_last(operator: Failing, watch: RunWatch) -> None:
    for answer, expected in ((0.4, 0.4), (None, 0.4), (0.3, 0.3)):
        operator.answer = None if answer is None else OperatorRequest(answer)
        assert watch.request() == OperatorRequest(expected)
    assert "None is no OperatorRequest" in watch.troubles[0]
    assert not watch.stop.requested


def test_a_hold_that_nobody_can_release_becomes_a_stop(operator: Failing, watch: RunWatch) -> None:
    operator.answer = OperatorRequest(held=True)
    watch.request()
    assert not watch.stop.requested
    operator.answer = None
    assert watch.request().held
    assert watch.stop.requested
    assert "the run was stopped" in watch.troubles[0]


# --- When an arm that the controller moves counts as being at rest

PERIOD = 0.002
SECOND = round(1.0 / PERIOD)


def records(
    first: int, count: int, velocity: float = 0.0, noise: float = 0.0, *, known: bool = True
) -> NDArray[np.void]:
    rows = np.zeros(count, cycle_dtype(2))
    rows["cycle"] = first + np.arange(count)
    rows["target_position"][:, 1] = velocity * PERIOD * rows["cycle"]
    rows["position"] = rows["target_position"] + noise * (-1.0) ** rows["cycle"][:, None]
    if not known:
        rows["position"][:, 0] = np.nan
    return rows


@pytest.mark.parametrize(
    ("portions", "rests"),
    [
        ([records(0, SECOND)], False),
        ([records(0, SECOND), records(SECOND, 1)], True),
        ([records(0, 10 * SECOND, velocity=1e-4)], False),
        ([records(0, SECOND + 1, noise=1e-4)], True),
        (
            [records(0, SECOND), records(SECOND - 5, 10, 0.5), records(SECOND + 5, SECOND)],
            False,
        ),
        ([records(SECOND - 5, 10, 0.5), records(SECOND + 5, SECOND + 10)], True),
        ([records(0, 5 * SECOND, known=False)], False),
        ([records(10_000, 10), records(0, 10)], False),
    ],
    ids=["less than a second", "a second", "creeping", "noise of an encoder", "motion between",
         "a second after motion", "not seen", "another session"],
)  # fmt: skip
def test_a_second_without_motion_is_rest(portions: list[NDArray[np.void]], rests: bool) -> None:
    still = Standstill(PERIOD)
    assert [still.take(portion) for portion in portions][-1] is rests


def test_noise_recorded_while_the_arm_moved_is_recorded_again(tmp_path: Path) -> None:
    cell = fast_cell(tmp_path)
    quiet = fast_campaign(tmp_path / "quiet", cell)
    assert not quiet.run(unrehearsed=True).rejected
    (archive,) = quiet.folder.completed("standstill")
    cycle = int(open_archive(archive).columns["cycle"].mean())

    pushed = fast_campaign(tmp_path / "pushed", cell)
    result = pushed.run(faulty_link(cell, f"push@{cycle}x20:axis=1"), unrehearsed=True)
    (rejected,) = result.rejected
    assert rejected.archive == "standstill_000_a1.mcap"
    assert re.search(r"moved at .* rad/s while the arm was to stand still", rejected.reason)
    again = [path.name for path in pushed.folder.completed("standstill")]
    assert again == ["standstill_000_a2.mcap"]
