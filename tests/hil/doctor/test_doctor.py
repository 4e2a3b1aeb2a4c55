"""Measured latencies, the verdict on them, and the command."""

from __future__ import annotations

import io
import json
import os
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from typer.testing import CliRunner

from hil.cell import Cell
from hil.cell.errors import UnknownFieldsError
from hil.cell.schema import ControllerTable
from hil.cli.doctor import doctor
from hil.doctor import probe
from hil.doctor.check import Check, Status
from hil.doctor.diagnosis import (
    Diagnosis,
    Fitness,
    as_json,
    examine,
    histogram,
    in_words,
    judge,
    remedies,
    show,
)
from hil.doctor.link import CanLink, UdpLink, controller_in, link_of
from hil.doctor.machine import disk_checks
from hil.doctor.measure import RESERVE, Latency, disk_trial, measure, obtained, run_probe
from hil.progress import Silent
from sim_fixtures.ns16 import CELL_PATH

samples = st.lists(st.floats(0.0, 0.01), min_size=1, max_size=50)


def latency(*seconds: float, length: float = 60.0, name: str = "turnaround") -> Latency:
    return Latency(name, np.array(seconds), length)


# --- latency and verdict ---------------------------------------------------------------------


def test_a_stall_costs_as_many_cycles_as_it_is_long() -> None:
    stall = latency(50e-6, 7.95e-3)
    assert stall.late_cycles(1e-3) == 8
    assert stall.late_cycles(2e-3) == 4
    assert latency(1e-3 - 2 * RESERVE).late_cycles(1e-3) == 0


@given(samples)
def test_every_sample_is_in_one_bar(values: list[float]) -> None:
    measured = latency(*values)
    assert sum(count for _, count in measured.histogram()) == len(values)


@given(samples, st.floats(0.1, 99.9))
def test_a_percentile_is_a_sample_that_so_many_do_not_exceed(
    values: list[float], percent: float
) -> None:
    found = latency(*values).percentile(percent)
    assert found in values
    assert np.mean(np.array(values) <= found) >= percent / 100 - 1e-12


@pytest.mark.parametrize("values", [[], [np.nan], [-1e-9], [np.inf], [[1e-6]]])
def test_what_is_no_latency_is_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="turnaround"):
        Latency("turnaround", np.array(values), 1.0)


@given(samples, st.floats(0.0, 0.01))
def test_one_more_latency_never_makes_a_cycle_fit(values: list[float], more: float) -> None:
    before, after = judge([latency(*values)], 1), judge([latency(*values, more)], 1)
    assert after.late >= before.late
    assert judge([latency(*values), latency(more)], 1).fit <= before.fit


@given(samples)
def test_what_is_fit_at_1_ms_is_fit_at_2_ms(values: list[float]) -> None:
    assert judge([latency(*values)], 1).fit <= judge([latency(*values)], 2).fit


def test_a_quiet_pc_is_fit_and_what_cannot_be_excluded_is_said() -> None:
    quiet = judge([latency(*np.full(60_000, 60e-6))], 1)
    assert quiet.fit
    # A mean of ln 20 = 2.996 late cycles in 60 s shows none with 5 % probability.
    assert quiet.late_per_hour_upper_95 == pytest.approx(60 * np.log(20))
    assert "fewer than 180 an hour" in quiet.reason


def test_one_late_cycle_in_the_measurement_is_not_fit() -> None:
    rare = judge([latency(*np.full(60_000, 60e-6), 1.2e-3)], 1)
    assert not rare.fit
    assert rare.late == 1
    assert "some 60 an hour" in rare.reason
    # (1 + m) exp(-m) = 5 % for m = 4.744: the bound lies well above what was seen.
    assert rare.late_per_hour_upper_95 == pytest.approx(60 * 4.744, rel=1e-3)


def test_a_pc_that_is_always_slow_is_not_fit_though_nothing_was_late() -> None:
    slow = judge([latency(*np.full(1000, 450e-6))], 1)
    assert (slow.fit, slow.late) == (False, 0)
    assert "55 % of the cycle" in slow.reason


def test_the_worse_of_two_measurements_decides() -> None:
    good, poor = latency(20e-6, name="wake-up"), latency(3e-3)
    assert "turnaround" in judge([good, poor], 1).reason
    assert judge([good, poor], 1) == judge([poor, good], 1)


def test_nothing_measured_is_not_fit() -> None:
    assert not judge([], 2).fit


@pytest.mark.parametrize(
    ("one", "two", "words"),
    [
        (True, True, "1 ms is fit, and so is 2 ms."),
        (False, True, "2 ms is fit; 1 ms is not."),
        (False, False, "Neither 1 ms nor 2 ms is fit."),
    ],
)
def test_the_verdict_is_a_plain_sentence(one: bool, two: bool, words: str) -> None:
    assert in_words(verdict(1, one), verdict(2, two)) == words


def verdict(cycle_ms: int, fit: bool) -> Fitness:
    return Fitness(cycle_ms, fit, 0, 0.0, 0.1, "for a reason")


# --- diagnosis and report --------------------------------------------------------------------

PORT = Check("UDP port 1000", Status.BAD, "in use [by] a", "the [only] port", ("sudo ss -lunp",))


def diagnosis(*checks: Check, fit: bool = True, seconds: float = 60.0) -> Diagnosis:
    measured = (latency(50e-6, 3e-3, length=seconds),)
    return Diagnosis(checks, measured, verdict(1, fit), verdict(2, True), 1, seconds)


def test_a_bad_check_makes_a_fast_pc_unfit_and_is_named() -> None:
    assert diagnosis().fit
    found = diagnosis(PORT)
    assert not found.fit
    assert "UDP port 1000" in found.line


def test_an_unknown_or_warning_does_not() -> None:
    warn = Check("a", Status.WARN, "x", "y")
    assert diagnosis(warn, Check("b", Status.UNKNOWN, "x", "y")).fit


def test_a_short_measurement_calls_itself_provisional() -> None:
    assert "Provisional" in diagnosis(seconds=5.0).line
    assert "Provisional" not in diagnosis().line


@pytest.mark.parametrize(("fit", "seconds", "status"), [
    (True, 60.0, 0), (True, 5.0, 5), (False, 60.0, 5),
])  # fmt: skip
def test_the_exit_status_is_0_only_for_a_verdict_to_be_relied_upon(
    fit: bool, seconds: float, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made_up(**_: object) -> Diagnosis:
        return diagnosis(fit=fit, seconds=seconds)

    monkeypatch.setattr("hil.cli.doctor.examine", made_up)
    ran = CliRunner().invoke(app, ["--json"])
    assert ran.exit_code == status
    assert json.loads(ran.stdout)["provisional"] is (seconds < 60)


def test_remedies_come_worst_first_and_a_good_check_has_none() -> None:
    warn = Check("w", Status.WARN, "", "slow", ("make it fast",))
    fine = Check("g", Status.OK, "", "good", ("never shown",))
    lines = "\n".join(remedies((warn, fine, PORT)))
    assert lines.index("sudo ss") < lines.index("make it fast")
    assert "never shown" not in lines


def test_a_command_that_helps_twice_is_typed_once() -> None:
    again = Check("other", Status.BAD, "", "", ("sudo ss -lunp", "more"))
    lines = list(remedies((PORT, again)))
    assert [line.strip() for line in lines if line.startswith("    ")] == ["sudo ss -lunp", "more"]


def test_the_page_shows_brackets_as_they_are_and_every_bar() -> None:
    console = Console(record=True, width=100, file=io.StringIO())
    show(diagnosis(PORT), console)
    text = console.export_text()
    assert "in use [by] a" in text
    assert "the [only] port" in text
    assert "2000-5000 µs        1 █" in text


def test_a_cycle_of_2_ms_is_advised_only_where_it_is_fit() -> None:
    def page(two: bool) -> str:
        console = Console(record=True, width=100, file=io.StringIO())
        show(Diagnosis((), (latency(3e-3),), verdict(1, False), verdict(2, two), 1, 60.0), console)
        return console.export_text()

    assert "use 2 ms" in page(two=True)
    assert "Neither 1 ms nor 2 ms is fit." in page(two=False)
    assert "use 2 ms" not in page(two=False)


def test_one_stall_among_many_still_has_a_bar() -> None:
    lines = list(histogram(latency(*np.full(60_000, 30e-6), 8e-3)))
    assert "█" in lines[-1]


def test_the_json_says_what_the_page_says() -> None:
    found = json.loads(json.dumps(as_json(diagnosis(PORT))))
    assert found["fit"] is False
    assert found["checks"][0]["remedy"] == ["sudo ss -lunp"]
    assert found["latency"]["turnaround"]["late_cycles_1ms"] == 3
    empty = Diagnosis((), (), judge([], 1), judge([], 2), 1, 60.0)
    assert json.loads(json.dumps(as_json(empty)))["cycles"][0]["late_per_hour_upper_95"] is None


# --- probes ----------------------------------------------------------------------------------


@pytest.fixture
def far_end() -> Iterator[Callable[[int | None], int]]:
    """Starts an echo that keeps one question to itself; gives its port."""
    threads = []
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.bind(("127.0.0.1", 0))

    def start(unanswered: int | None) -> int:
        def run() -> None:
            while (received := link.recvfrom(1500))[0] != b"end":
                if int.from_bytes(received[0][:4], "little") != unanswered:
                    link.sendto(received[0], received[1])

        threads.append(threading.Thread(target=run))
        threads[-1].start()
        return int(link.getsockname()[1])

    yield start
    for thread in threads:
        thread.join(timeout=5.0)
    link.close()


def test_a_question_never_answered_counts_its_whole_wait_and_the_next_is_asked(
    far_end: Callable[[int | None], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probe, "PATIENCE", 0.05)
    took = probe.ask(far_end(3), 1e-3, 0.2)
    assert took[3] == pytest.approx(0.05)
    assert len(took) > 4
    assert np.median(np.delete(took, 3)) < 0.05


def test_wake_ups_are_measured_at_absolute_deadlines() -> None:
    began = time.perf_counter()
    late = probe.wake_ups(0.01, 0.1)
    assert 0.1 <= time.perf_counter() - began < 5.0
    assert 1 <= len(late) <= 10
    assert (late >= 0).all()


def test_a_process_that_slept_through_deadlines_shows_it_as_one_long_latency(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = [0.0]
    naps = iter([0.0, 0.0, 7.5e-3, *[0.0] * 100])

    def sleep(seconds: float) -> None:
        clock[0] += seconds + next(naps)

    monkeypatch.setattr(probe.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(probe.time, "sleep", sleep)
    late = probe.wake_ups(1e-3, 0.02)
    assert late[2] == pytest.approx(7.5e-3)
    assert len(late) == 20 - 7
    assert Latency("wake-up", late.astype(float), 0.02).late_cycles(1e-3) == 7


def test_a_probe_that_fails_or_hangs_gives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_probe(["no such probe"], 0.0) is None
    monkeypatch.setattr("hil.doctor.measure._GRACE", 0.3)
    began = time.monotonic()
    assert run_probe(["echo"], 0.0) is None  # waits 5 s for packets
    assert time.monotonic() - began < 4.0
    assert measure("wake-up", "no such probe", 1e-3, 0.1, Silent()) is None


def test_the_disk_is_tried_where_the_archives_will_be(tmp_path: Path) -> None:
    trial = disk_trial(tmp_path / "runs" / "mine")
    assert trial is not None
    assert trial.folder == str(tmp_path)
    assert len(trial.seconds) > 0
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_takes_no_files_is_bad() -> None:
    checks = disk_checks(Path("/proc"), disk_trial(Path("/proc")))
    assert checks[-1].status is Status.BAD


# --- the command -----------------------------------------------------------------------------

app = typer.Typer()
app.command()(doctor)


def cell_text(**controller: object) -> str:
    text = CELL_PATH.read_text()
    for key, value in controller.items():
        old = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
        text = text.replace(old, f"{key} = {json.dumps(value)}")
    urdf = CELL_PATH.parent / "ns16.urdf"
    return text.replace('"ns16.urdf"', json.dumps(str(urdf)))


def test_the_link_is_the_cells() -> None:
    def cell(text: str) -> ControllerTable:
        return Cell.from_texts(text, Cell.load(CELL_PATH).urdf, CELL_PATH).controller

    assert link_of(cell(cell_text())) is None
    assert link_of(cell(cell_text(transport="udp"))) == UdpLink("10.2.12.150", 1000, "0.0.0.0")
    bus = '\n[controller.can]\ninterface = "socketcan"\nchannel = "can0"\n'
    assert link_of(cell(cell_text(transport="can") + bus)) == CanLink("socketcan", "can0", True)


def test_of_a_cell_that_is_being_filled_in_the_controller_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(re.sub(r"(?m)^torque_constant = .*$", 'torque_constant = "?"', cell_text()))
    assert link_of(controller_in(path)) is None
    path.write_text(re.sub(r"(?m)^cycle_ms = .*$", 'cycle_ms = "?"', cell_text()))
    with pytest.raises(UnknownFieldsError, match=r"controller\.cycle_ms"):
        controller_in(path)


def test_the_command_measures_judges_and_sends_the_controller_nothing(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller:
        controller.bind(("127.0.0.2", 0))
        port = controller.getsockname()[1]
        file = tmp_path / "cell.toml"
        file.write_text(cell_text(transport="udp", host="127.0.0.2", port=port))
        # The cell's default bind, every address, is taken by the controller here.
        scheduling = os.sched_getscheduler(0)
        ran = CliRunner().invoke(app, [str(file), "--duration", "1", "--json", "--output", "x"])
        controller.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            controller.recv(1500)
    found = json.loads(ran.stdout)
    assert ran.exit_code == 5
    assert found["fit"] is False
    by_name = {check["name"]: check for check in found["checks"]}
    assert by_name[f"UDP port {port}"]["status"] == "bad"
    assert f"process {os.getpid()}" in by_name[f"UDP port {port}"]["found"]
    assert by_name["route to the controller"]["status"] == "ok"
    assert found["latency"]["turnaround"]["samples"] > 100
    assert os.sched_getscheduler(0) == scheduling


def test_a_cell_that_cannot_be_read_is_bad_input(tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, [str(tmp_path / "none.toml")])
    assert getattr(ran.exception, "exit_code", None) == 2


def test_every_remedy_can_be_typed_as_it_stands(tmp_path: Path) -> None:
    found = examine(UdpLink("10.99.99.99", 999), 1, 0.1, tmp_path, Silent())
    for check in found.checks:
        for command in check.remedy:
            checked = subprocess.run(["bash", "-n", "-c", command], capture_output=True, text=True)
            assert checked.returncode == 0, (command, checked.stderr)


def test_what_was_really_given_is_reported() -> None:
    given = obtained()
    assert given is not None
    assert given.scheduling
