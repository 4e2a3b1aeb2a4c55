"""`hil record`: the controller's own program moves the arm, and what is archived identifies it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from drivers.c4g_packets import DRIVE_ON, INIT_LENGTH
from drivers.errors import ModeRefused
from drivers.states import State
from drivers.transports.simulated import Corrupt, Lose, SimulatedTransport
from hil.archive import open_archive
from hil.archive.recorder import Recorded
from hil.base.errors import ArchiveError, ControllerError, HilError, InputError
from hil.base.progress import Silent
from hil.campaign import Progress, Stop, VirtualLink
from hil.cell import Cell
from hil.cli import record as record_cli
from hil.cli.record import record as record_command
from hil.control.record import archive_path, moved_joints, record
from hil.control.simulated_cell import (
    OWN_SPEED_SHARE,
    controller_settings,
    own_postures,
    simulated_controller,
)
from hil.control.simulator_process import SIMULATE_COMMAND, free_port
from hil.pipeline.identification import identify_archives
from planner.moves import SEGMENT_VELOCITY
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.loopback import on_loopback

pytestmark = pytest.mark.long

NAME = "excitation_000_a1.mcap"


def own_motion_link(cell: Cell, *faults: Lose | Corrupt, stated: Cell | None = None) -> VirtualLink:
    """A link in virtual time to a controller whose own program moves the arm.

    `stated` is the cell that the PC has, by default the controller's.
    """
    settings = replace(controller_settings(cell), own_motion=own_postures(cell))
    controller = simulated_controller(cell, settings=settings)
    transport = SimulatedTransport(controller, faults)
    return VirtualLink.over(transport, stated or cell, controller.finish)


def recording_of(
    cell: Cell, path: Path, *faults: Lose | Corrupt, kind: str = "excitation", **how: Any
) -> Recorded:
    """A recording of the controller's own motion."""
    how = {"stop": Stop(), **how}
    return record(own_motion_link(cell, *faults), cell, path, kind=kind, durable=False, **how)


def after(cycles: int) -> dict[str, Any]:
    """An operator who ends the recording after so many cycles."""
    stop = Stop()

    def enough(progress: Progress) -> None:
        stop.requested = progress.cycles >= cycles

    return {"stop": stop, "watch": enough}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, cell: Cell) -> Path:
    """Twenty-eight seconds of the controller's own motion."""
    path = tmp_path_factory.mktemp("record") / NAME
    done = recording_of(cell, path, duration=28.0)
    assert (done.outcome, done.records_lost) == ("completed", 0)
    assert done.seconds == pytest.approx(28.0)  # of the controller's time since its init packet
    return path


def test_every_cycle_is_archived_with_its_source(recorded: Path) -> None:
    """And the recording alone gives the planted parameters."""
    archive = open_archive(recorded)
    assert archive.complete
    assert archive.outcome.entries["records_lost"] == "0"
    columns = archive.columns
    assert np.all(np.diff(columns["cycle"]) == 1)
    assert columns["state"][0] == State.DRIVE_OFF
    assert columns["status"][-1] == DRIVE_ON
    assert np.isnan(columns["commanded_position"]).all()
    assert np.all(columns["interval"] == -1)
    assert np.all(np.ptp(columns["position"], axis=0) > 0.3)
    assert archive.header.entries["motion"] == "controller"
    assert archive.kind == "excitation"
    assert set(archive.attachments) == {
        "cell.toml", "robot.urdf", "drive_train.json", "init_packet.bin"
    }  # fmt: skip
    assert len(archive.attachments["init_packet.bin"]) == INIT_LENGTH
    identification = identify_archives([recorded], Silent())
    assert identification.verdict.good, identification.verdict.line
    coverage = identification.results.coverage
    # 95 % of 58 parameters are within two standard deviations where the model is the plant's;
    # what smoothing leaves of the controller's jerk costs some of them.
    assert coverage.within_3 >= 0.9 * coverage.total


def test_the_controller_moves_as_its_interpolator_plans(recorded: Path, cell: Cell) -> None:
    """At a constant share of the joints' speed limits, and never above it."""
    rate = np.abs(open_archive(recorded).columns["target_velocity"]) / cell.joint_limits.velocity
    fastest = rate.max(axis=1)
    assert fastest.max() == pytest.approx(SEGMENT_VELOCITY * OWN_SPEED_SHARE, rel=1e-3)
    assert np.mean(fastest > 0.999 * fastest.max()) > 0.2


def test_recordings_are_numbered_and_have_their_kind(tmp_path: Path, cell: Cell) -> None:
    first = archive_path(tmp_path / "records", "validation")
    assert first.name == "validation_000_a1.mcap"
    first.touch()
    assert archive_path(tmp_path / "records", "validation").name == "validation_001_a1.mcap"
    with pytest.raises(InputError, match="exists already"):
        archive_path(first, "validation")
    with pytest.raises(InputError, match="name of a validation; add --kind validation"):
        archive_path(tmp_path / "validation_007_a1.mcap", "excitation")
    path = archive_path(tmp_path / "monday.mcap", "standstill")
    recording_of(cell, path, kind="standstill", duration=0.2)
    assert open_archive(path).kind == "standstill"


def test_a_standstill_in_which_the_arm_moved_is_named(
    recorded: Path, tmp_path: Path, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    assert moved_joints(recorded, cell) == cell.joint_names
    path = tmp_path / "standstill_000_a1.mcap"
    at_rest = recording_of(cell, path, kind="standstill", duration=0.25)
    assert moved_joints(path, cell) == ()
    how = record_cli.RecordRequest(path, "standstill", None, None)
    finish = partial(record_cli._finish, by_operator=False, line=record_cli.LINE, json=False)
    finish(path, at_rest, cell, how)
    assert "warning" not in "".join(capsys.readouterr())
    finish(recorded, at_rest, cell, how)
    assert "moved, so this is no standstill" in capsys.readouterr().err


@pytest.mark.parametrize(("how", "outcome"), [({}, "completed"), ({"duration": 10.0}, "stopped")])
def test_the_operator_ends_a_recording_properly_or_early(
    tmp_path: Path, cell: Cell, how: dict[str, float], outcome: str
) -> None:
    done = recording_of(cell, tmp_path / NAME, **how, **after(500))
    assert (done.outcome, done.reason) == (outcome, "ended by the operator")
    assert done.records == open_archive(tmp_path / NAME).n_samples >= 500


def test_a_lost_packet_is_a_gap_and_not_a_shift(tmp_path: Path, cell: Cell) -> None:
    recording_of(cell, tmp_path / NAME, Lose(600, "to_pc"), duration=1.0)
    archive = open_archive(tmp_path / NAME)
    assert {*np.diff(archive.columns["cycle"]).tolist()} == {1, 2}
    assert archive.columns["gap"].sum() == 1
    assert archive.outcome.entries["lost_packets"] == "1"


def test_a_refusal_is_shown_at_once_and_ends_a_recording(tmp_path: Path, cell: Cell) -> None:
    """One packet of mode 3: cause, axis and remedy stand on one line and in the archive."""
    link = own_motion_link(cell, Corrupt(600, offset=12, mask=3))
    lines: list[str] = []
    link.connection.report = lines.append
    done = record(
        link, cell, tmp_path / NAME, kind="excitation", stop=Stop(), duration=1.0, durable=False
    )
    cause = "joint_1 is in mode 3: the reply to that mode is unknown"
    assert (done.outcome, done.reason.partition(" (cycle")[0]) == ("refused", cause)
    assert [line.partition(" (cycle")[0] for line in lines] == [f"REFUSED: {cause}"]
    assert lines[0].endswith(ModeRefused.remedy)
    archive = open_archive(tmp_path / NAME)
    assert archive.complete
    assert [event.text for event in archive.events if event.name == "Refused"] == [
        line.removeprefix("REFUSED: ") for line in lines
    ]


def test_a_controller_of_another_arm_is_not_recorded(tmp_path: Path, cell: Cell) -> None:
    wrong = cell.with_values({"drive_train.k65": 0.045})
    link = own_motion_link(cell, stated=wrong)
    with pytest.raises(ControllerError, match=r"k65 of axis 6 .*correct the cell file"):
        record(link, wrong, tmp_path / NAME, kind="excitation", stop=Stop(), durable=False)
    assert not (tmp_path / NAME).exists()


@contextmanager
def running(*command: object) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [str(word) for word in command],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def on_udp(tmp_path: Path, cell: Cell) -> tuple[Path, int]:
    """A cell file whose controller is on this computer, and its port."""
    port = free_port()
    (tmp_path / "cell.toml").write_text(on_loopback(cell, port).text)
    (tmp_path / "ns16.urdf").write_text(cell.urdf)
    return tmp_path / "cell.toml", port


def recorder_of(cell: Path, *options: object) -> Any:
    """`hil record` into a.mcap beside the cell."""
    command = (sys.executable, "-m", "hil", "record", cell, "-o", cell.parent / "a.mcap")
    return running(*command, *options)


def own_motion(cell: Path, port: int, *options: str) -> tuple[object, ...]:
    """A simulated controller whose own program moves the arm without a rest of a second."""
    where = ("--udp", f"127.0.0.1:{port}", "--own-motion", "--patience", "2")
    return (*SIMULATE_COMMAND, cell, "--json", *where, *options)


def wait_until_recorded(archive: Path, recorder: subprocess.Popen[str], cycles: int = 500) -> None:
    deadline = time.monotonic() + 60.0
    recorded = 0
    while recorded <= cycles:
        assert time.monotonic() < deadline
        assert recorder.poll() is None, recorder.communicate()
        time.sleep(0.1)
        with suppress(ArchiveError):  # while the file is not there, or empty
            recorded = open_archive(archive).n_samples


def test_a_moving_arm_is_replied_to_until_the_session_ends(
    on_udp: tuple[Path, int],
) -> None:
    path, port = on_udp
    with (
        running(*own_motion(path, port)) as controller,
        recorder_of(path, "--duration", "1.5", "--json") as recorder,
    ):
        assert "recording complete; replying until" in recorder.stderr.readline()
        assert open_archive(path.parent / "a.mcap").complete
        time.sleep(1.5)
        assert recorder.poll() is None, "it left a moving arm alone"
        controller.send_signal(signal.SIGTERM)  # ends its program when the arm stands
        counts, _ = controller.communicate(timeout=60)
        output, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 0, errors
    counters = json.loads(counts)
    assert counters["phase"] == "ended"
    assert counters["missed"] <= 1  # the last packet, 504, needs no answer
    summary = json.loads(output)
    archive = open_archive(summary["archive"])
    assert counters["cycles"] > summary["cycles"] + 1000
    assert summary["outcome"] == "completed"
    assert summary["records_lost"] == summary["events_lost"] == 0
    assert summary["cycles"] == archive.n_samples
    assert archive.outcome.entries["late_answers"] == str(summary["late"])
    assert archive.outcome.entries["answers_not_taken"] == str(summary["not_accepted"])
    cycles = archive.columns["cycle"]
    assert archive.n_samples + archive.columns["gap"][1:].sum() == cycles[-1] - cycles[0] + 1
    assert np.isnan(archive.columns["commanded_position"]).all()


def test_ctrl_c_ends_the_recording_a_second_one_replies(on_udp: tuple[Path, int]) -> None:
    path, port = on_udp
    archive = path.parent / "a.mcap"
    with running(*own_motion(path, port)), recorder_of(path) as recorder:
        wait_until_recorded(archive, recorder)
        recorder.send_signal(signal.SIGINT)
        next(line for line in recorder.stdout if "replying until" in line)
        recorder.send_signal(signal.SIGINT)
        output, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 0, errors
    said = " ".join(output.split())  # lines end at the width of the terminal
    assert "ended by the operator" in said
    assert re.search(r"replies \d+ late", said)
    assert open_archive(archive).complete


def test_an_arm_at_rest_is_left_after_a_second(on_udp: tuple[Path, int]) -> None:
    path, port = on_udp
    # It opens its axes, which are held where they are; only a PC that leaves ends the interval.
    still = [
        argument
        for argument in own_motion(path, port, "--intervals", "1")
        if argument != "--own-motion"
    ]
    with running(*still), recorder_of(path, "--duration", "1.5", "--json") as recorder:
        output, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 0, errors
    assert json.loads(output)["outcome"] == "completed"


@pytest.mark.slow
def test_a_session_that_ends_early_is_reported(on_udp: tuple[Path, int]) -> None:
    path, port = on_udp
    with (
        running(*own_motion(path, port, "--duration", "3")),
        recorder_of(path, "--duration", "60", "--json") as recorder,
    ):
        output, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 4
    result = json.loads(output)  # one object: what was recorded, and why that is not all
    stated = (result["outcome"], result["kind"], result["exit_code"])
    assert stated == ("completed", "ControllerError", 4)
    assert result["cycles"] > 0
    assert re.search("the controller ended the session after .* of 60 s.*a.mcap", flat(errors))
    assert open_archive(path.parent / "a.mcap").outcome.outcome == "completed"


def signal_child(recorder: subprocess.Popen[str], module: str, number: int) -> None:
    """Send a signal to the child that runs a module."""
    for task in Path(f"/proc/{recorder.pid}/task/{recorder.pid}/children").read_text().split():
        if module in Path(f"/proc/{task}/cmdline").read_text():
            return os.kill(int(task), number)
    raise AssertionError(f"no {module}")


def flat(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.slow
def test_a_killed_exchange_ends_a_recording_as_lost(on_udp: tuple[Path, int]) -> None:
    path, port = on_udp
    archive = path.parent / "a.mcap"
    with running(*own_motion(path, port)), recorder_of(path) as recorder:
        wait_until_recorded(archive, recorder)
        signal_child(recorder, "drivers.exchange", signal.SIGKILL)
        _, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 4
    assert "the exchange process ended" in errors
    assert "a.mcap" in errors
    outcome = open_archive(archive).outcome
    assert (outcome.outcome, outcome.reason) == ("lost", "the exchange process ended")


@pytest.mark.slow
def test_a_hanging_archive_process_is_ended(on_udp: tuple[Path, int]) -> None:
    """And the moving arm is replied to until the controller ends the session."""
    path, port = on_udp
    archive = path.parent / "a.mcap"
    with running(*own_motion(path, port)) as controller, recorder_of(path) as recorder:
        wait_until_recorded(archive, recorder)
        signal_child(recorder, "hil.archive.process", signal.SIGSTOP)
        result = next(line for line in recorder.stdout if "replying until" in line)
        assert "sent no heartbeat for 5 s and was ended" in result
        controller.send_signal(signal.SIGTERM)
        counts, _ = controller.communicate(timeout=60)
        _, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 4
    assert "a.mcap is readable up to its last part" in flat(errors)
    assert json.loads(counts)["missed"] <= 1  # the last packet, 504, needs no answer
    assert open_archive(archive).n_samples > 500


def test_on_a_terminal_it_shows_what_it_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = StringIO()
    terminal = Console(file=shown, force_terminal=True, width=200)
    monkeypatch.setattr(record_cli, "progress_console", lambda: terminal)
    waiting = Progress(0, 0, State.SYNC, waiting="no packet from 127.0.0.1 (0 packets)")
    record_cli.View(Cell.load(CELL_PATH), quiet=False).show(waiting)
    assert "no packet from 127.0.0.1 (0 packets)" in shown.getvalue()


def test_a_missing_controller_is_waited_for_as_stated(on_udp: tuple[Path, int]) -> None:
    path, _ = on_udp
    with recorder_of(path, "--wait", "0.5") as recorder:
        _, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 4
    assert "no init packet within 0.5 s; no packet from 127.0.0.1" in " ".join(errors.split())
    with recorder_of(path) as recorder:
        assert "waiting for the controller" in recorder.stdout.readline()
        time.sleep(0.5)
        recorder.send_signal(signal.SIGINT)
        output, errors = recorder.communicate(timeout=60)
    assert recorder.returncode == 130
    assert "nothing was recorded" in errors.replace("\n", " ")
    assert "packets from" not in output, "progress is on standard error"
    assert not (path.parent / "a.mcap").exists()
    with pytest.raises(HilError, match=r"controller\.transport"):
        record_command(CELL_PATH, output=path.parent / "a.mcap")
