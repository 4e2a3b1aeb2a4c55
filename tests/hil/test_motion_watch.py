"""A motion that is watched: slowed, held, released and stopped while it runs, in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drivers.events import MotionEnded
from drivers.states import State
from hil.archive import Archive, ArchiveSpec, ArchiveWriter, open_archive
from hil.campaign import Stop
from hil.campaign.intervals import START_TOLERANCE
from hil.campaign.link import Link
from hil.campaign.operator import MotionProgress, OperatorRequest
from hil.cell import Cell
from hil.errors import ControllerFault
from hil.simulation import simulated_link
from planner import Move, PiecewiseCubic, TrajectoryPlayer, plan_moves


class Person:
    """Wishes what a script says at a moment of the motion."""

    def __init__(self, script: Callable[[float], OperatorRequest]) -> None:
        self._script, self._time, self._held = script, 0.0, 0
        self.seen: list[MotionProgress] = []

    def show(self, progress: MotionProgress) -> None:
        self.seen.append(progress)
        self._time = progress.motion_time or 0.0

    def request(self) -> OperatorRequest:
        return self._script(self._time)


@dataclass
class Arm:
    """A connected arm and a motion from where it stands and back, some seconds long."""

    cell: Cell
    link: Link
    motion: PiecewiseCubic

    @classmethod
    def connected(cls, cell: Cell) -> Arm:
        link = simulated_link(cell)
        where = link.connect(Stop())
        away = where + 0.6 * np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        moves = (Move(away, speed=0.6), Move(where, speed=0.6))
        return cls(cell, link, plan_moves(where, moves, cell.joint_limits).trajectory)

    def run(
        self, path: Path, watch: Person, stop: Stop | None = None, override: float = 1.0
    ) -> MotionEnded:
        limits = self.cell.joint_limits
        player = TrajectoryPlayer(
            self.motion, self.cell.period, limits, start_tolerance=START_TOLERANCE
        )
        return self.link.run(
            player, spec(self.cell, path), stop or Stop(), override=override, watch=watch
        )


def spec(cell: Cell, path: Path) -> ArchiveSpec:
    return ArchiveSpec(
        path, cell.joint_names, cell.period, {"kind": "move"},
        {"drive_train.json": cell.drive_table.model_dump_json().encode()}, durable=False,
    )  # fmt: skip


@pytest.fixture
def arm(cell: Cell) -> Arm:
    return Arm.connected(cell)


def commanded(archive: Archive) -> np.ndarray:
    """Set-points (k, n) that were sent."""
    rows = archive.columns["commanded_position"]
    return rows[np.isfinite(rows).all(axis=1)]


def require_on_path(arm: Arm, points: np.ndarray) -> None:
    """Each set-point lies on the planned path, whatever the time law."""
    times = np.linspace(0.0, arm.motion.duration, 40_000)
    planned = arm.motion.sample(times)[0]
    for point in points[:: len(points) // 50 + 1]:
        assert np.abs(planned - point).max(axis=1).min() < 2e-4


def test_a_dry_run_is_slow_from_its_first_cycle(arm: Arm, tmp_path: Path) -> None:
    person = Person(lambda _: OperatorRequest())
    ended = arm.run(tmp_path / "a.mcap", person, override=0.2)
    assert ended.outcome == "completed"
    points = commanded(open_archive(tmp_path / "a.mcap"))
    steps = np.abs(np.diff(points, axis=0)).max(axis=0) / arm.cell.period
    planned = np.abs(arm.motion.sample(np.linspace(0, arm.motion.duration, 9999))[1]).max(axis=0)
    np.testing.assert_allclose(steps, 0.2 * planned, rtol=1e-3)
    assert len(points) * arm.cell.period == pytest.approx(5.0 * arm.motion.duration, abs=1.0)
    require_on_path(arm, points)
    assert {progress.override for progress in person.seen} == {0.2}


def test_the_person_may_slow_a_dry_run_and_not_speed_it_up(arm: Arm, tmp_path: Path) -> None:
    person = Person(lambda time: OperatorRequest(0.1 if time > 0.3 else 1.0))
    arm.run(tmp_path / "a.mcap", person, override=0.2)
    assert {progress.override for progress in person.seen} == {0.2, 0.1}
    assert person.seen[-2].rate == pytest.approx(0.1)


def test_a_hold_rests_on_the_path_and_is_gone_on_from(arm: Arm, tmp_path: Path) -> None:
    asked = 0

    def script(time: float) -> OperatorRequest:
        nonlocal asked
        held = time > 0.4 and asked < 12
        asked += held
        return OperatorRequest(0.5, held)

    person = Person(script)
    ended = arm.run(tmp_path / "a.mcap", person)
    assert ended.outcome == "completed"
    held = [progress for progress in person.seen if progress.held]
    assert held
    assert held[-1].rate == 0.0
    points = commanded(open_archive(tmp_path / "a.mcap"))
    rests = (np.diff(points, axis=0) == 0.0).all(axis=1)
    moving = np.flatnonzero(~rests)
    assert rests[moving[0] : moving[-1]].sum() > 10, "no rest in the midst of the motion"
    require_on_path(arm, points)
    np.testing.assert_allclose(points[-1], arm.motion.sample(np.array([1e9]))[0][0], atol=2e-3)


def test_a_stop_ends_a_hold(arm: Arm, tmp_path: Path) -> None:
    stop, asked = Stop(), 0

    def script(time: float) -> OperatorRequest:
        nonlocal asked
        asked += time > 0.4
        stop.requested = asked > 20
        return OperatorRequest(held=time > 0.4)

    ended = arm.run(tmp_path / "a.mcap", Person(script), stop)
    assert ended.outcome == "stopped"
    archive = open_archive(tmp_path / "a.mcap")
    assert archive.complete
    require_on_path(arm, commanded(archive))


def test_nothing_begins_while_a_hold_is_wished_for(arm: Arm, tmp_path: Path) -> None:
    stop, asked = Stop(), 0

    def script(_: float) -> OperatorRequest:
        nonlocal asked
        asked += 1
        stop.requested = asked > 5
        return OperatorRequest(held=True)

    person = Person(script)
    ended = arm.run(tmp_path / "a.mcap", person, stop)
    assert (ended.outcome, ended.interval) == ("stopped", -1)
    assert not open_archive(tmp_path / "a.mcap").n_samples


@pytest.mark.parametrize("what", ["stop", "hold"])
def test_what_is_pressed_while_the_archive_is_created_comes_in_time(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """A slow disk: nothing has been asked of the controller yet, and nothing is."""
    stop, pressed = Stop(), 0
    opened = arm.link._open

    def slowly(given: ArchiveSpec) -> ArchiveWriter:
        nonlocal pressed
        pressed = 1
        stop.requested = what == "stop"
        return opened(given)

    def script(_: float) -> OperatorRequest:
        nonlocal pressed
        pressed += pressed > 0
        stop.requested = stop.requested or pressed > 5
        return OperatorRequest(held=pressed > 0)

    monkeypatch.setattr(arm.link, "_open", slowly)
    ended = arm.run(tmp_path / "a.mcap", Person(script), stop)
    assert (ended.outcome, ended.reason, ended.interval) == ("stopped", "it had not begun", -1)
    archive = open_archive(tmp_path / "a.mcap")
    assert archive.complete
    assert not archive.n_samples


def test_a_motion_held_before_it_begins_rests_and_what_was_wished_is_archived(
    arm: Arm, tmp_path: Path
) -> None:
    asked = 0

    def script(_: float) -> OperatorRequest:
        nonlocal asked
        asked += 1
        if asked <= 2:  # until it was asked for
            return OperatorRequest()
        return OperatorRequest(0.5, held=asked < 20)

    ended = arm.run(tmp_path / "a.mcap", Person(script))
    assert ended.outcome == "completed"
    archive = open_archive(tmp_path / "a.mcap")
    names = [event.name for event in archive.events]
    assert names.index("HoldChanged") < names.index("MotionStarted")
    told = [(event.name, *event.data.values()) for event in archive.events if event.data]
    assert told == [("OverrideChanged", 0.5), ("HoldChanged", True), ("HoldChanged", False)]
    points = commanded(archive)
    assert (points[:50] == points[0]).all()
    require_on_path(arm, points)


def test_what_is_shown_is_what_is_archived(arm: Arm, tmp_path: Path) -> None:
    person = Person(lambda _: OperatorRequest())
    arm.run(tmp_path / "a.mcap", person)
    columns = open_archive(tmp_path / "a.mcap").columns
    moving = [progress for progress in person.seen if progress.state is State.OPEN]
    assert moving
    ratio, table = arm.cell.drive_train.gear_ratio[0], arm.cell.drive_table
    for progress in moving:
        assert progress.position is not None
        assert progress.current is not None
        same = (columns["position"] == progress.position).all(axis=1)
        same &= (columns["target_current"] == progress.current).all(axis=1)
        row = int(np.argmax(same))
        assert same[row]
        error = columns["target_position"][row] - progress.position
        np.testing.assert_array_equal(progress.following_error, error)
        assert progress.following_share is not None
        # The first joint has no coupling to any other: its share by hand.
        by_hand = abs(error[0] * ratio) / (2.0 * np.pi) / table.following_error[0]
        assert progress.following_share[0] == pytest.approx(by_hand, rel=1e-5)
        share = np.abs(progress.current) / table.current_limit
        np.testing.assert_allclose(progress.current_share, share, rtol=1e-5)
        assert progress.latency is None
        assert progress.duration == arm.motion.duration
    cycles = [progress.cycles for progress in person.seen]
    assert cycles == sorted(cycles)
    assert any("first set-point" in event for event in person.seen[-1].events)


class Stubborn:
    """A motion that knows no override: it rests."""

    start = property(lambda self: np.zeros(6))
    finished = True
    bounds = "plan"

    def begin(self, position: np.ndarray) -> None: ...
    def advance(self) -> tuple[np.ndarray, np.ndarray]: ...  # type: ignore[empty-body]
    def stop(self) -> None: ...


def test_a_motion_that_knows_no_override_is_not_run_slowly(arm: Arm, tmp_path: Path) -> None:
    with pytest.raises(ControllerFault, match="knows no override"):
        arm.link.run(Stubborn(), spec(arm.cell, tmp_path / "a.mcap"), Stop(), override=0.2)  # type: ignore[arg-type]
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("override", [-0.1, 1.1, float("nan")])
def test_an_override_is_a_fraction(override: float) -> None:
    with pytest.raises(ValueError, match="override"):
        OperatorRequest(override)
