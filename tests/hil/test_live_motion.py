"""A motion on a real link that is watched, steered and looked at by a viewer from elsewhere."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.motion_source import MotionSource
from drivers.states import State
from drivers.transports import TransportSpec, UdpSpec
from hil.archive import ArchiveSpec, open_archive
from hil.archive.live import LiveView, LiveViewError
from hil.campaign import Stop
from hil.campaign.intervals import START_TOLERANCE
from hil.campaign.live_link import LiveLink
from hil.campaign.operator import MotionProgress, OperatorRequest
from hil.cell import Cell
from hil.cell.cell import stays_here
from hil.cli.record import record
from hil.demo_link import free_port, loopback_link
from hil.errors import ControllerFault
from hil.move import send, straight_way
from planner import Move, TrajectoryPlayer, plan_moves
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell

PATIENT = ("--patience", "2")
"""A test asks what happens, not how fast: the controller waits where this machine pauses."""


class Person:
    """Slows the motion, holds it, has it go on, holds it again and stops it there."""

    def __init__(self, stop: Stop) -> None:
        self.seen: list[MotionProgress] = []
        self._stop, self._rested = stop, 0

    def show(self, progress: MotionProgress) -> None:
        self.seen.append(progress)
        self._rested += progress.held and progress.rate == 0.0
        self._stop.requested = self._rested >= 6

    def request(self) -> OperatorRequest:
        time = (self.seen[-1].motion_time or 0.0) if self.seen else 0.0
        first, second = time > 0.5 and self._rested < 3, time > 1.2
        return OperatorRequest(0.5 if time > 0.2 else 1.0, held=first or second)


def test_a_motion_is_slowed_held_and_stopped_in_a_hold_while_a_viewer_looks(
    cell: Cell, tmp_path: Path
) -> None:
    pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
    pytest.importorskip("websockets", reason="websockets is not installed")
    from tests.hil.live_viewer import Viewer

    cell = cell.with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1")
    stop = Stop()
    path = tmp_path / "a.mcap"
    with loopback_link(cell, options=PATIENT, live=LiveView(port=0)) as link:
        assert link.live is not None
        where = link.connect(Stop())
        away = where + 0.6 * np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        moves = (Move(away, speed=0.3), Move(where, speed=0.3))
        motion = plan_moves(where, moves, cell.joint_limits).trajectory
        player = TrajectoryPlayer(
            motion, cell.period, cell.joint_limits, start_tolerance=START_TOLERANCE
        )
        drives = {"drive_train.json": cell.drive_table.model_dump_json().encode()}
        spec = ArchiveSpec(path, cell.joint_names, cell.period, {"kind": "move"}, drives)
        person = Person(stop)
        with Viewer(link.live.port) as viewer:
            viewer.subscribe("/hil/cycle", "/hil/events")
            ended = link.run(player, spec, stop, override=0.7, watch=person)
            cycles, events = {}, []
            while not cycles or max(cycles) <= ended.cycle:
                topic, _, message = viewer.message()
                if topic == "/hil/cycle":
                    cycles[message.cycle] = message
                else:
                    events.append(message.name)
    assert ended.outcome == "stopped"
    archive = open_archive(path)
    assert archive.complete
    require_seen(person.seen)

    # What the viewer saw is what the archive has, in those cycles that both have.
    columns = archive.columns
    both = [row for row, cycle in enumerate(columns["cycle"]) if int(cycle) in cycles]
    assert len(both) > 20
    seen = [cycles[int(cycle)] for cycle in columns["cycle"][both]]
    for name in ("position", "target_current", "commanded_velocity"):
        values = np.array([getattr(message, name) for message in seen])
        np.testing.assert_array_equal(values, columns[name][both])
    torque = np.array([message.torque for message in seen])
    np.testing.assert_allclose(torque, columns["torque"][both], rtol=1e-14)  # a product of matrices
    assert "MotionStarted" in events

    # On the path, whatever was done to the time law.
    sent = columns["commanded_position"]
    sent = sent[np.isfinite(sent).all(axis=1)]
    planned = motion.sample(np.linspace(0.0, motion.duration, 40_000))[0]
    for point in sent[:: len(sent) // 40]:
        assert np.abs(planned - point).max(axis=1).min() < 2e-4


def require_seen(seen: list[MotionProgress]) -> None:
    """All that a person is to see of such a motion."""
    assert {progress.override for progress in seen} == {0.7, 0.5}
    moving = [progress for progress in seen if progress.state is State.OPEN]
    times = [progress.motion_time for progress in moving if progress.motion_time is not None]
    assert len(times) == len(moving)
    assert times == sorted(times)
    assert max(progress.rate or 0.0 for progress in moving) <= 0.7 + 1e-9
    held = [progress.held for progress in moving]
    assert sum(now and not before for before, now in itertools.pairwise(held)) == 2
    last = seen[-1]
    assert last.cycles > 500
    assert last.latency is not None
    assert 0.0 < last.latency.median <= last.latency.p99 <= last.latency.worst
    assert last.current_share is not None
    assert 0.0 < last.current_share.max() < 1.0
    told = {event for progress in seen for event in progress.events}
    assert any("first set-point" in event for event in told)  # later ones take its place


class Pressed:
    """Wishes what it is set to."""

    def __init__(self) -> None:
        self.now = OperatorRequest()

    def show(self, progress: MotionProgress) -> None: ...

    def request(self) -> OperatorRequest:
        return self.now


def test_what_is_pressed_before_a_motion_begins_comes_in_time(
    cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stop or hold while the archive is created, hold while the motion is handed over."""
    cell = cell.with_link(transport="udp", host="192.0.2.1", bind="127.0.0.1")
    drives = {"drive_train.json": cell.drive_table.model_dump_json().encode()}
    with loopback_link(cell, options=PATIENT) as link:
        assert link.only_simulated  # though the cell's own host is none of this computer
        where = link.connect(Stop())
        moves = (Move(where + 0.3, speed=0.3),)
        motion = plan_moves(where, moves, cell.joint_limits).trajectory
        opening, submitting = link.open_archive, link.exchange.submit

        for number, what in enumerate(("stop, opening", "hold, opening", "hold, asked for")):
            stop, person = Stop(), Pressed()

            def press(what: str = what, stop: Stop = stop, person: Pressed = person) -> None:
                stop.requested = what.startswith("stop")
                person.now = OperatorRequest(held=what.startswith("hold"))
                threading.Timer(1.5, setattr, (stop, "requested", True)).start()

            def opened(*spec: ArchiveSpec, what: str = what, **how: bool) -> None:
                opening(*spec, **how)
                if what.endswith("opening"):
                    press()

            def asked(source: MotionSource, *how: Callable[[], bool], what: str = what) -> int:
                press() if what.endswith("asked for") else None
                return submitting(source, *how)

            monkeypatch.setattr(link, "open_archive", opened)
            monkeypatch.setattr(link.exchange, "submit", asked)
            path = tmp_path / f"{number}.mcap"
            player = TrajectoryPlayer(
                motion, cell.period, cell.joint_limits, start_tolerance=START_TOLERANCE
            )
            spec = ArchiveSpec(path, cell.joint_names, cell.period, {"kind": "move"}, drives)
            ended = link.run(player, spec, stop, watch=person)
            assert ended.outcome == "stopped", what
            archive = open_archive(path)
            assert archive.complete
            sent = archive.columns["commanded_position"]
            sent = sent[np.isfinite(sent).all(axis=1)]
            assert np.abs(sent - where).max(initial=0.0) < 1e-4, what
            assert ended.reason == "it had not begun"
            assert "MotionStarted" not in [event.name for event in archive.events]

        monkeypatch.undo()
        link.view.inits += 1  # as by another init packet, whose limits nobody has seen
        player = TrajectoryPlayer(
            motion, cell.period, cell.joint_limits, start_tolerance=START_TOLERANCE
        )
        path = tmp_path / "anew.mcap"
        spec = ArchiveSpec(path, cell.joint_names, cell.period, {"kind": "move"}, drives)
        with pytest.raises(ControllerFault, match=r"new session .* nothing was sent"):
            link.run(player, spec, Stop())
        told = open_archive(path).outcome
        assert told is not None
        assert told.outcome == "void"


@pytest.mark.slow  # waits for a real second of silence; test_heartbeat shows the rule by itself
def test_a_watch_that_hangs_brings_the_arm_to_rest(tmp_path: Path) -> None:
    cell = fast_cell(tmp_path).with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1")

    class Hangs(Pressed):
        def show(self, progress: MotionProgress) -> None:
            if (progress.motion_time or 0.0) > 0.5:
                time.sleep(4.0)

    with loopback_link(cell, options=PATIENT) as link:
        where = link.connect(Stop())
        way = straight_way(cell, where, where + np.radians([40.0, 40.0]), speed=0.02)
        assert way.duration > 4.0
        ended = send(way, cell, link, tmp_path / "a.mcap", stop=Stop(), watch=Hangs())
        assert ended.outcome == "stopped"
        assert "looks at the motion (show, request) did not return for" in ended.reason
    archive = open_archive(tmp_path / "a.mcap")
    sent = archive.columns["commanded_position"]
    sent = sent[np.isfinite(sent).all(axis=1)]
    done = (sent[-1] - where) / (way.target - where)
    assert np.all(done < 0.9), "not gone on with to its end"


@pytest.mark.parametrize(
    ("spec", "here"),
    [
        (UdpSpec("127.0.0.1", 1000), True), (UdpSpec("127.8.0.1", 1000), True),
        (UdpSpec("192.0.2.1", 1000, "127.0.0.1"), False), (UdpSpec("localhost", 1000), False),
        (object(), False),
    ],
)  # fmt: skip
def test_a_link_is_judged_by_the_transport_that_is_opened(spec: TransportSpec, here: bool) -> None:
    assert stays_here(spec) is here


def test_a_real_transport_makes_a_simulated_cell_a_real_one(cell: Cell) -> None:
    assert cell.only_simulated
    spec = UdpSpec("192.0.2.1", free_port(), "127.0.0.1")
    with LiveLink.open(cell, transport=spec) as link:
        assert not link.only_simulated


def test_a_live_view_that_cannot_be_served_is_refused_before_anything_moves(cell: Cell) -> None:
    pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
    cell = cell.with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1", port=free_port())
    with pytest.raises(LiveViewError, match="name an address of this computer"):
        LiveLink.open(cell, live=LiveView("192.0.2.1", 8765))


def test_a_live_view_that_is_no_address_is_refused_by_the_command(tmp_path: Path) -> None:
    with pytest.raises(LiveViewError, match=r"--live nonsense is no HOST:PORT"):
        record(CELL_PATH, output=tmp_path, live="nonsense")
    assert not list(tmp_path.iterdir())
