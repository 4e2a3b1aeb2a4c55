"""Supervision of a run: override, hold, stop, heartbeats, failing screens."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cycle_records import cycle_dtype
from drivers.events import MotionEnded, MotionStarted
from drivers.exchange.control import create as create_control
from drivers.exchange.event_log import (
    NO_SUPERVISOR,
    NO_SUPERVISOR_AT_REST,
    SESSION_ENDED,
    EventsLost,
    ExchangeEnded,
)
from drivers.states import State
from hil.archive import Archive, ArchiveSpec, ArchiveWriter, open_archive
from hil.base.errors import ControllerError
from hil.campaign import Stop
from hil.campaign.operator import (
    SECONDS_BETWEEN_MOTIONS,
    ExpectedMotion,
    RequestUnread,
    RunStatus,
    RunWatch,
    ScreenFailed,
)
from hil.cell import Cell
from hil.control.connection import StartTimeout
from hil.control.link import Standstill
from hil.control.live_link import STALL_TIMEOUT, ExchangeMonitor, Heartbeat
from hil.control.motion_watch import MotionProgress, OperatorRequest
from hil.control.motions import player_of
from hil.control.simulated_cell import simulated_link
from hil.control.virtual_link import VirtualLink
from hil.testing import faulty_link
from planner import Move, PiecewiseCubic, TrajectoryPlayer, plan_moves
from tests.hil.control.supervised import spec
from tests.hil.fast_cell import fast_campaign, fast_cell, on_path
from tests.laws.motions import as_planned
from tests.laws.second_reader import read

pytestmark = pytest.mark.safety


class Watcher:
    """Requests by motion time and number of requests so far."""

    def __init__(
        self, script: Callable[[float, int], OperatorRequest] = lambda *_: OperatorRequest()
    ) -> None:
        self._script = script
        self._time = 0.0
        self._asked = 0
        self.seen: list[MotionProgress] = []

    def show(self, progress: MotionProgress) -> None:
        self.seen.append(progress)
        self._time = progress.motion_time or 0.0

    def request(self) -> OperatorRequest:
        self._asked += 1
        return self._script(self._time, self._asked)


@dataclass
class WatchedArm:
    """A connected arm and a motion from where it stands and back, some seconds long."""

    cell: Cell
    link: VirtualLink
    motion: PiecewiseCubic
    path: Path

    @classmethod
    def connected(cls, cell: Cell, path: Path) -> WatchedArm:
        link = simulated_link(cell)
        where = link.connect(Stop())
        away = where + 0.6 * np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        moves = (Move(away, speed=0.6), Move(where, speed=0.6))
        return cls(cell, link, plan_moves(where, moves, cell.joint_limits).trajectory, path)

    def run(self, watch: Watcher, stop: Stop | None = None, override: float = 1.0) -> MotionEnded:
        player = player_of(self.cell, self.motion)
        given = spec(self.cell, self.path)
        return self.link.run(player, given, stop or Stop(), override=override, watch=watch)

    @property
    def archive(self) -> Archive:
        return open_archive(self.path)

    def commanded(self) -> np.ndarray:
        """Set-points (k, n) [rad]; they are on the path, whatever the time law."""
        return on_path(self.archive, self.motion)


@pytest.fixture
def arm(cell: Cell, tmp_path: Path, shown_in_virtual_time: None) -> WatchedArm:
    return WatchedArm.connected(cell, tmp_path / "a.mcap")


def test_a_dry_run_is_slow_and_the_operator_may_slow_it_further(arm: WatchedArm) -> None:
    person = Watcher()
    assert arm.run(person, override=0.2).outcome == "completed"
    points = arm.commanded()
    steps = np.abs(np.diff(points, axis=0)).max(axis=0) / arm.cell.period
    planned = np.abs(arm.motion.sample(np.linspace(0, arm.motion.duration, 9999))[1]).max(axis=0)
    np.testing.assert_allclose(steps, 0.2 * planned, rtol=1e-3)
    assert len(points) * arm.cell.period == pytest.approx(5.0 * arm.motion.duration, abs=1.0)
    assert {progress.override for progress in person.seen} == {0.2}

    slower = Watcher(lambda time, _: OperatorRequest(0.1 if time > 0.3 else 1.0))
    arm.path = arm.path.with_name("b.mcap")
    arm.run(slower, override=0.2)
    assert {progress.override for progress in slower.seen} == {0.2, 0.1}
    assert slower.seen[-2].rate == pytest.approx(0.1)


def test_a_hold_rests_on_the_path_and_is_resumed(arm: WatchedArm) -> None:
    held = 0

    def script(time: float, _: int) -> OperatorRequest:
        nonlocal held
        hold = time > 0.4 and held < 12
        held += hold
        return OperatorRequest(0.5, hold)

    person = Watcher(script)
    assert arm.run(person).outcome == "completed"
    assert [progress for progress in person.seen if progress.held][-1].rate == 0.0
    points = arm.commanded()
    rests = (np.diff(points, axis=0) == 0.0).all(axis=1)
    moving = np.flatnonzero(~rests)
    assert rests[moving[0] : moving[-1]].sum() > 10, "no rest in the midst of the motion"
    np.testing.assert_allclose(points[-1], arm.motion.sample(np.array([1e9]))[0][0], atol=2e-3)


def test_a_motion_that_ends_during_a_hold_ends_its_supervision(
    arm: WatchedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was waited for the operator to release a motion that had ended, forever."""
    advance = TrajectoryPlayer.advance

    def fails_at_rest(player: TrajectoryPlayer) -> tuple[np.ndarray, np.ndarray]:
        if player.rate == 0.0 and player.motion_time > 0.1:
            raise RuntimeError("planted")
        return advance(player)

    def script(time: float, asked: int) -> OperatorRequest:
        assert asked < 1000, "the operator is asked after the end of the motion"
        return OperatorRequest(held=time > 0.4)

    monkeypatch.setattr(TrajectoryPlayer, "advance", fails_at_rest)
    monkeypatch.setattr("hil.control.link.REQUEST_PERIOD", 0.0)
    stop = Stop()
    seen = Watcher(script)
    show = seen.show

    def show_some(progress: MotionProgress) -> None:
        show(progress)
        stop.requested = len(seen.seen) > 1000  # else a failure would not end

    monkeypatch.setattr(seen, "show", show_some)
    ended = arm.run(seen, stop)
    assert (ended.outcome, stop.requested) == ("refused", False)
    assert "planted" in ended.reason


def test_a_stop_ends_a_hold(arm: WatchedArm) -> None:
    stop = Stop()
    held = 0

    def script(time: float, _: int) -> OperatorRequest:
        nonlocal held
        held += time > 0.4
        stop.requested = held > 20
        return OperatorRequest(held=time > 0.4)

    assert arm.run(Watcher(script), stop).outcome == "stopped"
    assert arm.archive.complete
    arm.commanded()


class StopAt(Stop):
    """A stop that is requested from a cycle of the controller on."""

    def __init__(self, link: VirtualLink, cycle: int) -> None:
        super().__init__()
        self._link = link
        self._cycle = cycle

    @property  # type: ignore[override]
    def requested(self) -> bool:
        return self._link.port.status().cycle >= self._cycle

    @requested.setter
    def requested(self, value: bool) -> None:
        assert not value


@pytest.mark.usefixtures("shown_in_virtual_time")
def test_a_motion_is_completed_by_its_last_set_point_only(cell: Cell, tmp_path: Path) -> None:
    """Stopped in any cycle about its end, while the end is held and while its axes close."""
    full = WatchedArm.connected(cell, tmp_path / "full.mcap")
    full.run(Watcher())
    (began,) = (event.time for event in full.archive.events if event.name == "MotionStarted")
    cycles = math.ceil(full.motion.duration / cell.period)
    settled = round(cell.campaign.settle_s / cell.period)
    outcomes = {}
    for after in (-cycles // 2, -20, *range(-3, 4), settled // 2, settled - 1, settled + 20):
        arm = WatchedArm.connected(cell, tmp_path / f"{after}.mcap")
        last = round(began / cell.period) + cycles
        outcomes[after] = arm.run(Watcher(), StopAt(arm.link, last + after)).outcome
        problems = list(as_planned(read(arm.path), arm.motion, cell.period))
        assert (outcomes[after] == "completed") == (not problems), f"{after}: {problems}"
    assert outcomes[-20] == "stopped"
    assert {outcomes[after] for after in outcomes if after > 1} == {"completed"}


@pytest.mark.parametrize("what", ["hold", "hold, opening", "stop, opening"])
def test_a_request_before_a_motion_begins_is_applied(
    arm: WatchedArm, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """Also while a slow disk creates the archive; nothing is asked of the controller."""
    stop = Stop()
    asked = 0
    opened = ArchiveSpec.open
    pressed = what == "hold"

    def slowly(given: ArchiveSpec) -> ArchiveWriter:
        nonlocal pressed
        pressed = True
        stop.requested = stop.requested or what.startswith("stop")
        return opened(given)

    def script(*_: float) -> OperatorRequest:
        nonlocal asked
        asked += pressed
        stop.requested = stop.requested or asked > 5
        return OperatorRequest(held=pressed)

    monkeypatch.setattr(ArchiveSpec, "open", slowly)
    ended = arm.run(Watcher(script), stop)
    assert (ended.outcome, ended.reason, ended.interval) == ("stopped", "it had not started", -1)
    assert arm.archive.complete
    assert not arm.archive.n_samples


def test_a_motion_held_before_it_begins_rests(arm: WatchedArm) -> None:
    def script(_: float, asked: int) -> OperatorRequest:  # from the moment it was asked for on
        return OperatorRequest() if asked <= 2 else OperatorRequest(0.5, held=asked < 20)

    assert arm.run(Watcher(script)).outcome == "completed"
    events = arm.archive.events
    names = [event.name for event in events]
    assert names.index("HoldChanged") < names.index("MotionStarted")
    changes = [(event.name, *event.data.values()) for event in events if event.data]
    assert changes == [("OverrideChanged", 0.5), ("HoldChanged", True), ("HoldChanged", False)]
    points = arm.commanded()
    assert (points[:50] == points[0]).all()


def test_what_is_shown_is_what_is_archived(arm: WatchedArm) -> None:
    person = Watcher()
    arm.run(person)
    columns = arm.archive.columns
    moving = [progress for progress in person.seen if progress.state is State.OPEN]
    assert moving
    ratio = arm.cell.drive_train.gear_ratio[0]
    table = arm.cell.drive_table
    for progress in moving:
        same = (columns["position"] == progress.position).all(axis=1)
        same &= (columns["target_current"] == progress.current).all(axis=1)
        row = int(np.argmax(same))
        assert same[row]
        error = columns["target_position"][row] - progress.position
        np.testing.assert_array_equal(progress.following_error, error)
        # The first joint has no coupling to any other: its share by hand.
        by_hand = abs(error[0] * ratio) / (2.0 * np.pi) / table.following_error[0]
        assert progress.following_share[0] == pytest.approx(by_hand, rel=1e-5)
        share = np.abs(progress.current) / table.current_limit
        np.testing.assert_allclose(progress.current_share, share, rtol=1e-5)
        assert progress.duration == arm.motion.duration
    cycles = [progress.cycles for progress in person.seen]
    assert cycles == sorted(cycles)


class Stubborn:
    """A motion without override, at rest."""

    start = property(lambda self: np.zeros(6))
    finished = True
    bounds = "plan"

    def begin(self, position: np.ndarray) -> None: ...
    def advance(self) -> tuple[np.ndarray, np.ndarray]: ...  # type: ignore[empty-body]
    def stop(self) -> None: ...


def test_a_motion_without_override_is_not_run_slowly(arm: WatchedArm) -> None:
    """And an override is a fraction."""
    with pytest.raises(ControllerError, match="supports no override"):
        arm.link.run(Stubborn(), spec(arm.cell, arm.path), Stop(), override=0.2)  # type: ignore[arg-type]
    assert not arm.path.exists()
    for override in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="override"):
            OperatorRequest(override)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ("state", "waits", "reason"),
    [
        (State.DRIVE_OFF, 1.9, "the drive went off before the motion began"),
        (State.FAULTED, 1.9, "a refusal came before the motion began"),
        (State.CLOSED, 59.0, r"did not begin within 60 s"),
    ],
)
def test_a_motion_that_does_not_begin_ends(state: State, waits: float, reason: str) -> None:
    start = StartTimeout(now := 100.0)
    assert start.no_start(state, now + waits) is None
    assert reason in (start.no_start(state, now + waits + 2.0) or "")


@pytest.mark.parametrize("event", [MotionStarted(0, 10), EventsLost(1)])
def test_a_motion_that_may_have_begun_is_waited_for(
    arm: WatchedArm, monkeypatch: pytest.MonkeyPatch, event: Any
) -> None:
    """Whatever the state; an end whose event was lost is known from the count."""
    monkeypatch.setattr(StartTimeout, "no_start", lambda *_: "the motion will not start")
    link = arm.link
    port = arm.link.port
    monkeypatch.setattr(port, "poll", lambda poll=port.poll: [event, *without_end(poll())])
    ended = arm.run(Watcher())
    assert (ended.outcome, ended.reason, ended.cycle) == ("completed", "the motion is complete", -1)
    assert link.connection.ended is None


def without_end(events: Sequence[Any]) -> list[Any]:
    return [event for event in events if not isinstance(event, MotionEnded)]


def test_heartbeats_end_when_the_supervising_loop_stalls() -> None:
    clock = Clock()
    given = list[float]()
    heart = Heartbeat(lambda: given.append(clock.now), clock)

    def beats_in(seconds: float) -> int:
        before = len(given)
        end = clock.now + seconds
        while clock.now < end:
            clock.now += 0.05
            heart.update()
        return len(given) - before

    assert beats_in(600.0) >= 11_999, "between motions work may take long"
    heart.turn()
    assert beats_in(0.9 * STALL_TIMEOUT) > 10
    heart.turn()
    beats_in(2.0 * STALL_TIMEOUT)
    assert clock.now - given[-1] > 0.9 * STALL_TIMEOUT
    heart.turn()
    assert beats_in(0.5) > 5, "and resume with the loop"
    heart.rest()
    assert beats_in(60.0) >= 1_199


class Failing:
    """An operator whose methods fail on demand."""

    can_answer = False

    def __init__(self) -> None:
        self.shown = 0
        self.fails = False
        self.answer: Any = OperatorRequest()

    def show(self, _: RunStatus) -> None:
        self.shown += 1
        if self.fails:
            raise RuntimeError("no picture")

    def request(self) -> OperatorRequest:
        return self.answer  # type: ignore[no-any-return]

    def accept_dry_run(self, _: object) -> bool:
        return False


def test_a_screen_that_fails_is_asked_all_the_same() -> None:
    operator = Failing()
    watch = RunWatch(operator, Stop())
    operator.fails = True
    for _ in range(3):
        watch.begin("move", 1, 1, 1.0, 1.0)
    assert operator.shown == 1
    operator.answer = OperatorRequest(0.4, held=True)
    assert watch.request() == operator.answer
    (fault,) = watch.faults
    assert isinstance(fault, ScreenFailed)
    assert "no picture" in fault.error
    for answer, expected in ((0.4, 0.4), (None, 0.4), (0.3, 0.3)):
        operator.answer = None if answer is None else OperatorRequest(answer)
        assert watch.request() == OperatorRequest(expected)
    error = "TypeError: None is no OperatorRequest"
    assert watch.faults[-1] == RequestUnread(error, ended_hold=False)
    assert not watch.stop.requested
    # A hold that cannot be released any more becomes a stop.
    operator.answer = OperatorRequest(held=True)
    watch.request()
    assert not watch.stop.requested
    operator.answer = None
    assert watch.request().held
    assert watch.stop.requested
    assert watch.faults[-1] == RequestUnread(error, ended_hold=True)


def test_an_override_is_counted_once_in_the_time_left() -> None:
    """Five motions of 8 s at 20 % of their speed, then two of 10 s at full speed."""
    operator = Failing()
    watch = RunWatch(operator, Stop())
    slow = ExpectedMotion(8.0, 0.2, dry_run=True)
    watch.expect([slow] * 5 + [ExpectedMotion(10.0)] * 2)

    def left(override: float, done: float, duration: float) -> float:
        operator.answer = OperatorRequest(override)
        watch.request()
        watch.show(MotionProgress(done, duration, 0, 0, 0, 0, State.OPEN))
        return watch.status.time_left

    watch.begin("dryrun", 1, 5, 8.0, 0.2)
    full = 5 * 40.0 + 2 * 10.0 + 6 * SECONDS_BETWEEN_MOTIONS
    assert left(1.0, 0.0, 8.0) == pytest.approx(full)
    assert left(0.3, 0.0, 8.0) == pytest.approx(full)
    # What is requested in the dry run does not count for what follows it.
    assert left(0.1, 0.0, 8.0) == pytest.approx(full + 5 * 40.0)
    watch.begin("excitation", 1, 2, 10.0, 1.0)
    assert left(0.5, 5.0, 10.0) == pytest.approx(10.0 + 20.0 + SECONDS_BETWEEN_MOTIONS)
    watch.end()
    assert watch.status.motion is None
    assert watch.status.time_left == pytest.approx(20.0 + SECONDS_BETWEEN_MOTIONS)


@pytest.mark.parametrize(
    ("reason", "remedy"),
    [
        (SESSION_ENDED, "start its Open program again"),
        (NO_SUPERVISOR, "for more than 0.5 s: it was suspended .*; check the arm, then run"),
        (NO_SUPERVISOR_AT_REST, "for more than 5 s: it was suspended .*; run the same command"),
    ],
)
def test_the_end_of_the_exchange_has_a_remedy(reason: str, remedy: str) -> None:
    class Ended:
        alive = False
        control_fd = create_control()

        def events(self) -> list[ExchangeEnded]:
            return [ExchangeEnded(reason)]

    monitor = ExchangeMonitor(Ended())  # type: ignore[arg-type]
    failure = monitor.failure()
    os.close(Ended.control_fd)
    assert failure is not None
    assert re.search(remedy, failure)


PERIOD = 0.002
SECOND = round(1.0 / PERIOD)


def records(
    first: int, count: int, velocity: float = 0.0, noise: float = 0.0, *, measured: bool = True
) -> NDArray[np.void]:
    rows = np.zeros(count, cycle_dtype(2))
    rows["cycle"] = first + np.arange(count)
    rows["target_position"][:, 1] = velocity * PERIOD * rows["cycle"]
    rows["position"] = rows["target_position"] + noise * (-1.0) ** rows["cycle"][:, None]
    if not measured:
        rows["position"][:, 0] = np.nan
    return rows


LONG = records(0, SECOND)


@pytest.mark.parametrize(
    ("parts", "rests"),
    [
        pytest.param([LONG], False, id="less than a second"),
        pytest.param([LONG, records(SECOND, 1)], True, id="a second"),
        pytest.param([records(0, 10 * SECOND, velocity=1e-4)], False, id="creeping"),
        pytest.param([records(0, SECOND + 1, noise=1e-4)], True, id="noise of an encoder"),
        pytest.param([LONG, records(SECOND - 5, 10, 0.5), records(SECOND + 5, SECOND)], False,
                     id="motion between"),
        pytest.param([records(SECOND - 5, 10, 0.5), records(SECOND + 5, SECOND + 10)], True,
                     id="a second after motion"),
        pytest.param([records(0, 5 * SECOND, measured=False)], False, id="not seen"),
        pytest.param([records(10_000, 10), records(0, 10)], False, id="another session"),
    ],
)  # fmt: skip
def test_a_second_without_motion_is_rest(parts: list[NDArray[np.void]], rests: bool) -> None:
    still = Standstill(PERIOD)
    assert [still.add(part) for part in parts][-1] is rests


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
    assert re.search(r"moved at .* rad/s when the arm should stand still", rejected.reason)
    again = [path.name for path in pushed.folder.completed("standstill")]
    assert again == ["standstill_000_a2.mcap"]


PROGRAM = """
import numpy as np
from hil.control.live_link import MMAP_THRESHOLD_BYTES, return_large_arrays

def mapped():
    return int(open("/proc/self/statm").read().split()[0]) * 4096

return_large_arrays()
teacher = np.ones(4_000_000)
del teacher  # glibc would now take what is smaller from its heap
before = mapped()
arrays = [np.ones(2 * MMAP_THRESHOLD_BYTES // 8) for _ in range(40)]
small = [np.ones(100) for _ in range(1000)]  # above them, and stay
del arrays
print(mapped() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the heap of glibc")
def test_freed_arrays_are_returned_to_the_system() -> None:
    """Without it the heap grows by 10 MiB."""
    run = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 2 * 2**20
