"""`hil record` of a Universal Robots arm that is only listened to."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.c4g_packets import DRIVE_ON
from drivers.states import State
from drivers.ur.description import UrDescription
from hil.archive import Archive, open_archive
from hil.archive.check import check_archive
from hil.archive.recorder import Recorded
from hil.base.errors import ArchiveWriteError, ControllerError, InputError, OperatorStopError
from hil.base.progress import Silent
from hil.batch.cache import CacheLocation
from hil.batch.graph import reidentify
from hil.cell import Cell, CellError
from hil.cli.record import with_rtde
from hil.control.link import Progress
from hil.control.motion_watch import Stop
from hil.control.planted_arm import planted_truth
from hil.control.ur_recording import listening, record_arm
from hil.importers.conclusions import Certainty
from hil.importers.recording_import import ImportOptions
from hil.look.look import look_at
from hil.look.readings import Fact
from hil.pipeline.identification import identify_archives
from hil.pipeline.options import FIXED
from hil.pipeline.sources import source_of
from hil.pipeline.torque_constant_fit import find_gains
from identification.estimators.delay import estimate_delay
from identification.model.known_payload import Payload
from sim_fixtures.plant import Carried
from sim_fixtures.ur import (
    CELL_PATH,
    UR5E_URDF,
    SimulatedUr,
    UrArmTruth,
    UrFault,
    UrProgram,
    UrServer,
    UrSettings,
)
from sim_fixtures.ur.controller import UrPayload
from tests.hil.batch_work import Here

HOST = "127.0.0.1"
NAME = "excitation_000_a1.mcap"


def cell_at(server: UrServer, **values: Any) -> Cell:
    """The cell of the simulated arm, at its ports."""
    ports = {"port": server.ports["rtde"]}
    ports |= {f"{name}_port": server.ports[name] for name in ("primary", "dashboard")}
    return Cell.load(CELL_PATH).with_link(rtde=ports).with_values(values)


@contextmanager
def served(
    *faults: UrFault, program: UrProgram | None = None, settings: UrSettings | None = None
) -> Iterator[UrServer]:
    """A simulated controller in virtual time."""
    robot = SimulatedUr(settings, program, faults=faults)
    with UrServer(robot, real_time=False).running() as server:
        yield server


def recording_of(
    path: Path, server: UrServer, *, kind: str = "excitation", cell: Cell | None = None, **how: Any
) -> Recorded:
    cell = cell or cell_at(server)
    stop = how.pop("stop", Stop())
    with listening(cell, stop=stop) as arm:
        # The archive has the cell file as it is, whatever ports this server has.
        cell = Cell.load(CELL_PATH)
        return record_arm(arm, cell, path, kind=kind, stop=stop, durable=False, **how)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole program of the arm."""
    path = tmp_path_factory.mktemp("ur") / NAME
    with served(program=UrProgram()) as server:
        done = recording_of(path, server, duration=UrProgram().duration)
    assert (done.outcome, done.missed, done.records) == ("completed", 0, 8000)
    return path


def test_every_frame_is_archived_with_its_state(recorded: Path) -> None:
    archive = open_archive(recorded)
    assert archive.complete and check_archive(recorded).conforms
    columns = archive.columns
    assert np.all(np.diff(columns["cycle"]) == 1)
    np.testing.assert_allclose(np.diff(columns["controller_time"]), 0.002)
    assert {*columns["state"]} == {State.CLOSED} and {*columns["status"]} == {DRIVE_ON}
    assert np.isnan(columns["commanded_position"]).all()
    assert np.all(np.ptp(columns["position"], axis=0) > 0.5)
    np.testing.assert_allclose(columns["target_position"], columns["position"], atol=3e-3)
    assert np.isnan(columns["current_as_torque"]).all()  # of newer versions
    assert {*columns["robot_mode"]} == {7} and {*columns["speed_scaling"]} == {1.0}
    assert np.all(columns["joint_temperature"] > 20.0)
    assert np.isfinite(columns["target_moment"]).all()


def test_the_arm_is_named_in_the_archive(recorded: Path) -> None:
    archive = open_archive(recorded)
    entries = archive.header.entries
    assert entries["ur.serial_number"] == "20235500123"
    assert (entries["ur.model"], entries["ur.version"]) == ("UR5e", "5.15.2.0")
    assert archive.header.by_controller_program and archive.header.only_simulated
    identity = json.loads(archive.attachments[UrDescription.attachment])
    assert identity["calibrated"]["a"][1] == -0.425
    assert [event.text for event in archive.events] == [
        "the robot mode is running",
        "the safety mode is normal",
        "the program is playing",
        "the program is stopped",
    ]


def test_torques_are_currents_times_the_cells_constants(recorded: Path) -> None:
    archive = open_archive(recorded)
    constants = Cell.load(CELL_PATH).drive_train.torque_constant * 101.0
    np.testing.assert_allclose(
        archive.columns["torque"], constants * archive.columns["target_current"]
    )


@pytest.mark.long
@pytest.mark.parametrize("share", [0.3, 0.5])
def test_dry_friction_does_not_bias_the_delay(share: float, tmp_path: Path) -> None:
    """The current of a frame acted over the cycle before it: half a cycle."""
    program = UrProgram(amplitude=share * UrProgram().amplitude)
    with served(program=program) as server:
        recording_of(tmp_path / NAME, server, duration=program.duration)
    cell = Cell.load(CELL_PATH)
    recording = source_of(open_archive(tmp_path / NAME), cell).recording
    found = estimate_delay(recording, cell.model)
    assert not found.excludes(0.5 * cell.period), found.describe()


@pytest.mark.long
def test_it_identifies_the_arm_in_units_of_the_stated_constants(
    recorded: Path, tmp_path: Path
) -> None:
    """As on the real arm, the constants are off, and every torque with them."""
    validation = tmp_path / "validation_000_a1.mcap"
    other = UrProgram(amplitude=UrProgram().amplitude[:, [1, 0, 3, 2]] * [1.5, 0.5, 1.0, 1.0])
    with served(program=other) as server:
        recording_of(validation, server, kind="validation", duration=other.duration)
    found = identify_archives([recorded, validation], Silent())
    assert found.verdict.good, found.verdict.line
    truth = UrArmTruth()
    units = truth.stated_constant / truth.torque_constant
    coulomb = [p.estimate for p in found.results.parameters if p.name.startswith("f0_")]
    np.testing.assert_allclose(coulomb, truth.plant.coulomb * units, rtol=0.1)


@pytest.mark.long
def test_a_batch_has_the_mean_temperature_of_each_joint(recorded: Path, tmp_path: Path) -> None:
    """Which may explain a change of its friction."""
    cache = CacheLocation(str(tmp_path))
    result = reidentify([str(recorded)], FIXED, Here(), Silent(), cache=cache)
    (repetition,) = result.repetitions
    means = open_archive(recorded).columns["joint_temperature"].mean(axis=0)
    assert repetition.facts == pytest.approx(
        {f"joint_temperature{number}": mean for number, mean in enumerate(means, 1)}
    )


@pytest.mark.long
def test_a_known_load_decides_the_torque_constants(recorded: Path, tmp_path: Path) -> None:
    """Those that the arm states are 1 to 7 % off."""
    load = Payload(3.0, (0.0, 0.0, 0.05), (0.0,) * 6, "flange")
    loaded = tmp_path / NAME
    place = np.array([0.0, 0.0, 0.0996 + 0.05])  # from the last joint, the flange included
    carried = Carried(5, 3.0, place, np.zeros((3, 3)))
    with UrServer(SimulatedUr(program=UrProgram(), load=carried), real_time=False).running() as at:
        recording_of(loaded, at, duration=UrProgram().duration)
    gains = find_gains([recorded], {loaded: load}, Silent()).gains
    assert gains.determined.tolist() == [True] * 5 + [False]  # the load does not reach the last
    true = UrArmTruth().torque_constant[:5] / 101.0
    error = np.abs(gains.values[:5] - true)
    assert np.all(error < np.maximum(gains.interval_factor * gains.std[:5], 0.005 * true))


@pytest.mark.long
def test_a_look_needs_nothing_but_the_archive(recorded: Path) -> None:
    """Its robot is in it, and its channels state what they are."""
    rows = {row.aspect: row for row in look_at(recorded, None, ImportOptions()).rows}
    for aspect, fact in (("signs", Fact.SIGNS_OF_URDF), ("gravity", Fact.WITH_GRAVITY)):
        assert (rows[aspect].reading, rows[aspect].certainty) == (fact, Certainty.CERTAIN)
    assert rows["side"].certainty is Certainty.CERTAIN
    assert rows["low-pass"].reading is Fact.NO_LOW_PASS


def test_frames_that_did_not_come_are_gaps(tmp_path: Path) -> None:
    with served(UrFault("gap", 200, 5), UrFault("text", 300)) as server:
        done = recording_of(tmp_path / NAME, server, duration=1.0)
    archive = open_archive(tmp_path / NAME)
    assert done.missed == archive.columns["gap"].sum() == 5
    assert archive.n_samples == 495
    assert any("a line of text in between" in event.text for event in archive.events)


@pytest.mark.parametrize(
    ("fault", "samples", "reason"),
    [
        (UrFault("disconnect", 333), 333, "the controller closed the connection"),
        (UrFault("truncate", 250), 250, "closed the connection within a frame"),
        (UrFault("restart", 410), 410, "time stamps go back: it was started again"),
    ],
)
def test_what_came_before_the_link_was_lost_is_archived(
    tmp_path: Path, fault: UrFault, samples: int, reason: str
) -> None:
    with served(fault) as server:
        done = recording_of(tmp_path / NAME, server, duration=10.0)
    assert done.outcome == "lost" and reason in done.reason
    archive = open_archive(tmp_path / NAME)
    assert archive.complete and archive.n_samples == samples
    assert archive.outcome.outcome == "lost"


def test_stops_of_the_controller_are_events(tmp_path: Path) -> None:
    lines: list[str] = []
    stopped = UrFault("stop", 300)
    with served(stopped, UrFault("power-off", 450), program=UrProgram()) as server:
        recording_of(tmp_path / NAME, server, duration=1.2, report=lines.append)
    archive = open_archive(tmp_path / NAME)
    events = {event.text: round(event.time / 0.002) for event in archive.events}
    assert events["the safety mode is protective stop"] == 300
    assert events["the robot mode is power off"] == 450
    assert lines == ["the safety mode is protective stop"]
    assert archive.columns["status"][[449, 450]].tolist() == [DRIVE_ON, 0]


def test_the_operator_ends_it(tmp_path: Path) -> None:
    stop = Stop()

    def enough(progress: Progress) -> None:
        stop.requested = progress.cycles >= 500

    with served() as server:
        done = recording_of(tmp_path / NAME, server, stop=stop, watch=enough)
    assert (done.outcome, done.reason) == ("completed", "ended by the operator")
    assert open_archive(tmp_path / NAME).n_samples == done.records >= 500


def test_a_full_disk_leaves_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = os.write

    def full(descriptor: int, data: Any) -> int:
        if len(data) > 2_000 and full_after.pop(0):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data)

    full_after = [False] * 4 + [True] * 100
    with served() as server:
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(ArchiveWriteError, match=r"No space left.*make room"):
            recording_of(tmp_path / NAME, server, duration=5.0)
        monkeypatch.undo()
    archive = open_archive(tmp_path / NAME)
    assert archive.n_samples == 150 and "the outcome is missing" in (archive.damage or "")


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"cell.serial_number": "2"}, "its serial number is 20235500123, but the cell states 2;"),
        ({"controller.rtde.model": "UR10e"}, "its type is UR5e, but the cell states UR10e;"),
        ({"controller.rtde.calibration": "00"}, "its calibration is 1f2e"),
        ({"controller.cycle_ms": 8}, "cycle is 2 ms, the cell states 8 ms; write cycle_ms = 2"),
    ],
)
def test_another_arm_is_not_recorded(tmp_path: Path, values: dict[str, Any], problem: str) -> None:
    with served() as server, pytest.raises(ControllerError, match=problem):
        recording_of(tmp_path / NAME, server, cell=cell_at(server, **values))
    assert not (tmp_path / NAME).exists()


def test_a_payload_that_the_cell_does_not_have_is_reported(tmp_path: Path) -> None:
    lines: list[str] = []
    settings = UrSettings(payload=UrPayload(2.5, (0.0, 0.0, 0.05)))
    with served(settings=settings) as server:
        recording_of(tmp_path / NAME, server, duration=0.1, report=lines.append)
    assert (
        len(lines) == 1 and "a payload of 2.5 kg, [robot.payload] of the cell to 0 kg" in lines[0]
    )
    columns = open_archive(tmp_path / NAME).columns
    assert {*columns["payload_mass"]} == {2.5}


def test_without_its_services_an_arm_is_not_compared(tmp_path: Path) -> None:
    robot = SimulatedUr()
    with UrServer(robot, primary=None, dashboard=None, real_time=False).running() as server:
        cell = Cell.load(CELL_PATH).with_link(
            rtde={"port": server.ports["rtde"], "primary_port": 1, "dashboard_port": 1}
        )
        with listening(cell, stop=Stop()) as arm:
            done = record_arm(
                arm, cell, tmp_path / NAME, kind="excitation", stop=Stop(), duration=0.2,
                durable=False,
            )  # fmt: skip
    assert done.records == 100
    assert "not compared with the cell by calibration and serial number and type" in " ".join(
        arm.notes
    )


def test_without_a_controller_nothing_is_recorded() -> None:
    cell = Cell.load(CELL_PATH).with_link(rtde={"port": 1})
    with pytest.raises(ControllerError, match="nothing was recorded"), listening(cell, stop=Stop()):
        pass
    waiting: list[str] = []
    with (
        pytest.raises(OperatorStopError),
        listening(cell, stop=Stop(requested=True), wait=60.0, report=waiting.append),
    ):
        pass


def test_a_link_is_given_by_the_cell_or_by_an_option(cell: Cell) -> None:
    given = with_rtde(cell, "rtde:192.168.0.10").controller
    assert (given.transport, given.host, given.rtde.port) == ("rtde", "192.168.0.10", 30004)
    assert with_rtde(cell, "rtde:arm:31004").controller.rtde.port == 31004
    assert with_rtde(cell, None) is cell
    for link in ("192.168.0.10", "udp:192.168.0.10:1000", "rtde:", "rtde:arm:x"):
        with pytest.raises(InputError, match="--link"):
            with_rtde(cell, link)


def test_the_cell_file_states_what_the_arm_is() -> None:
    cell = Cell.load(CELL_PATH)
    truth = UrArmTruth()
    planted = planted_truth(cell)
    for name in ("rotor_inertia", "coulomb", "viscous", "third", "inertia_scale"):
        np.testing.assert_array_equal(getattr(planted, name), getattr(truth.plant, name), name)
    assert cell.simulation.current_noise == truth.current_noise
    assert cell.urdf == UR5E_URDF
    np.testing.assert_allclose(
        101.0 * cell.drive_train.torque_constant, truth.stated_constant, rtol=1e-6
    )


def test_a_cell_of_other_arms_is_refused(cell: Cell) -> None:
    problem = "is not a Universal Robots arm"
    with pytest.raises(CellError, match=problem), listening(cell, stop=Stop()):
        pass


@pytest.mark.long
def test_ctrl_c_ends_it_and_the_next_one_has_another_file(tmp_path: Path) -> None:
    """In real time, against a controller in this process."""
    with UrServer(SimulatedUr(program=UrProgram(), repeats=True)).running() as server:
        cell = cell_at(server)
        path = tmp_path / "cell.toml"
        path.write_text(cell.text)
        (tmp_path / "ur5e.urdf").write_text(cell.urdf)
        for index in range(2):
            command = [sys.executable, "-m", "hil", "record", str(path), "-o", str(tmp_path / "a")]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                assert "listening to 127.0.0.1" in process.stdout.readline()
                archive = tmp_path / "a" / f"excitation_{index:03d}_a1.mcap"
                deadline = time.monotonic() + 60.0
                while (not archive.exists() or archive.stat().st_size < 200_000) and (
                    time.monotonic() < deadline
                ):
                    time.sleep(0.1)
                process.send_signal(signal.SIGINT)
                said = process.stdout.read()
                assert process.wait() == 0
            assert "0 missed; completed: ended by the operator" in said
            assert "hil torque-constants ARCHIVES --loaded LOADED" in said
            written: Archive = open_archive(archive)
            assert written.complete and np.all(np.diff(written.columns["cycle"]) == 1)
