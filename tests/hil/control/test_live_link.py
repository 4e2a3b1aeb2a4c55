"""A real link: over sockets, with other processes; a motion that is watched and steered."""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.c4g_packets import INIT_LENGTH
from drivers.exchange.event_log import NO_ARCHIVE
from drivers.exchange.process_handle import ExchangeProcess, ExchangeSettings
from drivers.motion_source import MotionSource
from drivers.states import State
from drivers.transports.base import TransportSpec
from drivers.transports.udp import UdpSpec
from hil.archive import open_archive
from hil.archive.live import LiveView, LiveViewError
from hil.base.errors import ArchiveWriteError, ControllerError
from hil.base.progress import Silent
from hil.campaign import (
    Campaign,
    CampaignPlan,
    MotionFailedError,
    NotRehearsedError,
    Stop,
)
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cli.record import record
from hil.control.link import archive_silence
from hil.control.live_link import LiveLink
from hil.control.motion_watch import MotionProgress, OperatorRequest
from hil.control.motions import player_of
from hil.control.simulator_process import free_port
from planner import Move, plan_moves
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.control.supervised import spec as spec_of
from tests.hil.fast_cell import fast_cell, on_path, set_points
from tests.hil.loopback import loopback_link, on_loopback
from tests.messages import LEADS_OUT, NAME_LOCAL_ADDRESS

pytestmark = pytest.mark.safety

PATIENT = ("--patience", "2")
"""The controller waits while this computer pauses."""


def campaign_of(folder: Path, cell: Cell, plan: CampaignPlan) -> Campaign:
    """One excitation and one validation run."""
    short = cell.with_campaign(repetitions=1, validation_runs=1)
    return Campaign.create(folder, short, CampaignPlan(plan.excitation, plan.validation[:1]))


def test_a_campaign_over_sockets_leaves_gap_free_archives(tmp_path: Path) -> None:
    fast = fast_cell(tmp_path)
    campaign = campaign_of(tmp_path / "campaign", on_loopback(fast), design(fast, Silent()))
    with loopback_link(campaign.cell, options=PATIENT) as link:
        campaign.run(link, Stop(), Silent(), provenance={"simulated": "yes"}, unrehearsed=True)
        assert not link.port.exchange.alive
        assert not link.port.archive.alive
    names = [entry.name for entry in campaign.folder.manifest()]
    assert [name.split("_")[0] for name in names] == [
        "move", "standstill", "excitation", "validation", "move"
    ]  # fmt: skip
    total = 0
    for name in names:
        archive = open_archive(campaign.folder.archives / name)
        assert archive.complete
        assert archive.outcome.entries["outcome"] == "completed"
        assert archive.outcome.entries["records_lost"] == "0"
        assert len(archive.attachments["init_packet.bin"]) == INIT_LENGTH
        columns = archive.columns
        # What is not in the file is in its gaps: cycles answered are cycles archived.
        span = columns["cycle"][-1] - columns["cycle"][0] + 1
        assert archive.n_samples + columns["gap"][1:].sum() == span
        total += archive.n_samples
    assert link.cycles == total

    excitation = open_archive(campaign.folder.archives / "excitation_000_a1.mcap")
    # The controller may have opened before the motion was asked for: it is held there till then.
    (began,) = (event.time for event in excitation.events if event.name == "MotionStarted")
    first = int(np.searchsorted(excitation.columns["stamp"], round(began * 1e9)))
    sent = excitation.columns["commanded_position"][first:]
    sent = sent[~np.isnan(sent).any(axis=1)]
    time = np.arange(len(sent), dtype=np.float64) * campaign.cell.period
    planned, _, _ = campaign.plan.excitation.trajectory.sample(time)
    assert sent == pytest.approx(planned, abs=2e-6)


def test_a_real_controller_is_not_driven_without_a_rehearsal(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    text = cell.with_link(transport="udp", host="10.2.12.150", port=free_port()).text
    real = Cell.from_texts(text, cell.urdf, cell.path)
    campaign = campaign_of(tmp_path / "real", real, plan)
    with LiveLink.open(campaign.cell) as link:
        with pytest.raises(NotRehearsedError, match="hil rehearse") as refused:
            campaign.run(link, Stop(), Silent())
        with pytest.raises(NotRehearsedError, match=LEADS_OUT):
            campaign.run(link, Stop(), Silent(), unrehearsed=True)
    assert refused.value.exit_code == 3
    assert not list(campaign.folder.archives.iterdir())


def test_the_exchange_that_a_killed_run_has_left_is_waited_for(cell: Cell) -> None:
    """It replies to the controller, so that nobody is told to kill it."""
    linked = cell.with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1", port=free_port())
    earlier = ExchangeProcess.start(
        ExchangeSettings(
            transport=linked.transport_spec(),
            drive_train=linked.drive_train,
            guard_limits=linked.guard_limits,
            period=linked.period,
            session=linked.session_settings(),
        )
    )
    lines: list[str] = []
    stopped = Stop(requested=True)
    with pytest.raises(ControllerError, match="ended by the operator before anything moved"):
        LiveLink.open(linked, report=lines.append, stop=stopped)
    with LiveLink.open(linked, report=lines.append):  # `earlier` gets no heartbeat any more
        assert not earlier.alive
    earlier.close()
    assert lines == [lines[0]] * 2
    assert f"another run of hil (process {earlier.pid})" in lines[0]
    assert "ss -ulnp" not in lines[0]


def test_each_difference_of_the_init_packet_is_named(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    wrong = on_loopback(cell.with_values({"drive_train.k65": 0.045, "drive_train.k54": 0.02}))
    right = tmp_path / "controller"
    right.mkdir()
    (right / "cell.toml").write_text(cell.text)
    (right / "ns16.urdf").write_text(cell.urdf)
    campaign = campaign_of(tmp_path / "init", wrong, plan)
    with (
        loopback_link(campaign.cell, simulated_by=right / "cell.toml", options=PATIENT) as link,
        pytest.raises(ControllerError, match=r"k54 of axis 5 .*k65 of axis 6 .*correct the cell"),
    ):
        campaign.run(link, Stop(), Silent(), provenance={}, unrehearsed=True)
    assert not list(campaign.folder.archives.iterdir())


def test_an_archive_that_cannot_be_created_moves_nothing(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    campaign = campaign_of(tmp_path / "readonly", on_loopback(cell), plan)
    with loopback_link(campaign.cell, options=PATIENT) as link:
        link.connect(Stop())
        campaign.folder.archives.rmdir()
        with pytest.raises(ArchiveWriteError, match="cannot be created"):
            campaign.run(link, Stop(), Silent(), provenance={}, unrehearsed=True)
        assert link.port.exchange.status().program_accepted == 0


def test_a_port_in_use_is_named(cell: Cell) -> None:
    with port_in_use() as port:
        local = on_loopback(cell, port)
        with pytest.raises(ControllerError, match=str(port)):
            LiveLink.open(local)


@contextmanager
def port_in_use() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        yield other.getsockname()[1]


def test_a_refusal_comes_with_its_flight_recorder(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    # The first move is so slow that the fault occurs during it on a loaded computer too.
    slow = cell.with_values({"campaign.approach_speed": 0.01})
    campaign = campaign_of(tmp_path / "refused", on_loopback(slow), plan)
    fault = ("--fault", "following-error@5000x1000:axis=2:slip")
    with (
        loopback_link(campaign.cell, options=(*PATIENT, *fault)) as link,
        pytest.raises(MotionFailedError) as failed,
    ):
        campaign.run(link, Stop(), Silent(), provenance={}, unrehearsed=True)
    assert failed.value.outcome == "refused"
    recorder = failed.value.refused.flight_recorder
    assert 1 < len(recorder) <= 50
    archive = open_archive(campaign.folder.archives / campaign.folder.manifest()[-1].name)
    assert archive.outcome.entries["outcome"] == "refused"
    (refusal,) = (event for event in archive.events if event.name == "Refused")
    assert refusal.data["check"] == "following error"
    assert refusal.data["joint"] == 1
    assert refusal.time == pytest.approx(recorder["cycle"][-1] * cell.period)
    assert refusal.data["value"] > refusal.data["bound"]
    assert str(failed.value).endswith(f"; {failed.value.refused.error.remedy}.")
    assert recorder["cycle"][-1] in archive.columns["cycle"]


def test_an_arm_that_stays_open_is_named_beside_the_error(cell: Cell, monkeypatch) -> None:
    problem = "the exchange process still replies"
    with (
        pytest.raises(RuntimeError, match="first") as failed,
        loopback_link(on_loopback(cell), options=PATIENT) as link,
    ):
        end = link.port._shut
        monkeypatch.setattr(link.port, "_shut", lambda: end() or problem)
        raise RuntimeError("the first error")
    assert failed.value.__notes__ == [problem]


class Operator:
    """Slows the motion, holds it, releases it, holds it again and stops it there."""

    def __init__(self, stop: Stop) -> None:
        self.seen: list[MotionProgress] = []
        self._stop = stop
        self._rested = 0

    def show(self, progress: MotionProgress) -> None:
        self.seen.append(progress)
        self._rested += progress.held and progress.rate == 0.0
        self._stop.requested = self._rested >= 6

    def request(self) -> OperatorRequest:
        time = (self.seen[-1].motion_time or 0.0) if self.seen else 0.0
        first = time > 0.5 and self._rested < 3
        second = time > 1.2
        return OperatorRequest(0.5 if time > 0.2 else 1.0, held=first or second)


def test_a_motion_is_slowed_held_and_stopped_with_a_viewer(cell: Cell, tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
    pytest.importorskip("websockets", reason="websockets is not installed")
    from tests.hil.live_viewer import Viewer

    cell = on_loopback(cell)
    stop = Stop()
    path = tmp_path / "a.mcap"
    with loopback_link(cell, options=PATIENT, live=LiveView(port=0)) as link:
        where = link.connect(Stop())
        away = where + 0.6 * np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        moves = (Move(away, speed=0.3), Move(where, speed=0.3))
        motion = plan_moves(where, moves, cell.joint_limits).trajectory
        player = player_of(cell, motion)
        spec = spec_of(cell, path)
        person = Operator(stop)
        with Viewer(link.live.port) as viewer:
            viewer.subscribe("/hil/cycle", "/hil/events")
            ended = link.run(player, spec, stop, override=0.7, watch=person)
            cycles = {}
            events = []
            while not cycles or max(cycles) <= ended.cycle:
                topic, _, message = viewer.message()
                if topic == "/hil/cycle":
                    cycles[message.cycle] = message
                else:
                    events.append(message.name)
    assert ended.outcome == "stopped"
    archive = open_archive(path)
    assert archive.complete
    require_shown(person.seen)

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

    on_path(archive, motion)


def require_shown(seen: list[MotionProgress]) -> None:
    """Check what the operator is shown of such a motion."""
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
    assert 0.0 < last.current_share.max() < 1.0


def test_a_hold_while_a_motion_is_handed_over_is_applied(
    cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing is sent with limits that were not checked."""
    cell = cell.with_link(transport="udp", host="192.0.2.1", bind="127.0.0.1")
    held = False
    stop = Stop()

    class Holding(Operator):
        def request(self) -> OperatorRequest:
            return OperatorRequest(held=held)

    with loopback_link(cell, options=PATIENT) as link:
        assert link.only_simulated  # though the cell's own host is none of this computer
        where = link.connect(Stop())
        motion = plan_moves(where, (Move(where + 0.3, speed=0.3),), cell.joint_limits).trajectory
        submitting = link.port.exchange.submit

        def asked(source: MotionSource, *how: Callable[[], bool]) -> int:
            nonlocal held
            held = True
            threading.Timer(1.5, setattr, (stop, "requested", True)).start()
            return submitting(source, *how)

        monkeypatch.setattr(link.port.exchange, "submit", asked)
        path = tmp_path / "held.mcap"
        ended = link.run(player_of(cell, motion), spec_of(cell, path), stop, watch=Holding(Stop()))
        assert (ended.outcome, ended.reason) == ("stopped", "it had not started")
        archive = open_archive(path)
        assert archive.complete
        if archive.n_samples:  # none where it was closed at once
            assert np.abs(set_points(archive) - where).max(initial=0.0) < 1e-4
        assert "MotionStarted" not in [event.name for event in archive.events]

        monkeypatch.undo()
        link.connection.inits += 1  # another init packet, whose limits were not checked
        path = tmp_path / "next.mcap"
        with pytest.raises(ControllerError, match=r"new session .* nothing was sent"):
            link.run(player_of(cell, motion), spec_of(cell, path), Stop())
        assert open_archive(path).outcome.outcome == "void"


@pytest.mark.parametrize(
    ("spec", "here"),
    [
        (UdpSpec("127.0.0.1", 1000), True), (UdpSpec("127.8.0.1", 1000), True),
        (UdpSpec("192.0.2.1", 1000, "127.0.0.1"), False), (UdpSpec("localhost", 1000), False),
    ],
)  # fmt: skip
def test_a_link_is_judged_by_the_transport_that_is_opened(spec: TransportSpec, here: bool) -> None:
    assert spec.is_local is here


def test_a_real_transport_makes_a_simulated_cell_a_real_one(cell: Cell) -> None:
    assert cell.only_simulated
    spec = UdpSpec("192.0.2.1", free_port(), "127.0.0.1")
    with LiveLink.open(cell, transport=spec) as link:
        assert not link.only_simulated


@pytest.mark.parametrize("stated", [True, False])
def test_a_local_link_is_simulated_where_the_cell_says_so(cell: Cell, stated: bool) -> None:
    """Otherwise the program at its end may be a bridge to a controller."""
    local = on_loopback(cell)
    if not stated:
        file = local.file.model_copy(update={"simulation": None})
        local = replace(local, file=file)
    assert local.only_simulated is stated


def test_a_live_view_that_cannot_be_served_is_refused(cell: Cell, tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="the extra 'live' is not installed")
    with pytest.raises(LiveViewError, match=NAME_LOCAL_ADDRESS):
        LiveLink.open(on_loopback(cell), live=LiveView("192.0.2.1", 1))
    with pytest.raises(LiveViewError, match=r"--live nonsense is not HOST:PORT"):
        record(CELL_PATH, output=tmp_path, live="nonsense")
    assert not list(tmp_path.iterdir())


def test_a_silent_archive_process_is_named_with_cause_and_remedy() -> None:
    disk = archive_silence(3.2)
    busy = archive_silence(0.0)
    for text in (disk, busy):
        assert text.startswith(f"{NO_ARCHIVE}, for more than 0.5 s")
    assert "its disk for 3.2 s" in disk and "check that disk" in disk
    assert "no processor time" in busy and "`hil doctor`" in busy
