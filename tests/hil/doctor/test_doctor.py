"""The doctor: judgements of computer and link, measured latencies, the command."""

from __future__ import annotations

import errno
import gzip
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

from drivers.exchange.realtime import RealTimeReport
from hil.cell import Cell
from hil.cell.errors import UnknownFieldsError
from hil.cell.schema import ControllerTable
from hil.cli.doctor import doctor
from hil.doctor import link as port
from hil.doctor import link as route
from hil.doctor import machine, probe
from hil.doctor import machine as permissions
from hil.doctor.check import Answer, Check, Status, run_command
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
from hil.doctor.link import (
    CanLink,
    UdpLink,
    can_check,
    coalescing,
    controller_in,
    device_check,
    firewall,
    link_of,
    network_checks,
)
from hil.doctor.machine import DiskTrial, disk_checks
from hil.doctor.measure import RESERVE, Latency, disk_trial, measure, obtained, run_probe
from hil.progress import Silent
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.doctor.conftest import Tree

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


# --- Judgements of a computer, its permissions and its disk: files instead of /proc and /sys

ALL = RealTimeReport("SCHED_FIFO 50", True, True)
NOTHING = RealTimeReport("ordinary", False, False)


def processors(count: int, files: dict[str, str]) -> dict[str, str]:
    base = "/sys/devices/system/cpu"
    return {f"{base}/cpu{i}/{name}": text for i in range(count) for name, text in files.items()}


# --- machine ---------------------------------------------------------------------------------
def test_a_coarse_timer_is_bad() -> None:
    assert machine.timer_resolution(1e-9).status is Status.OK
    coarse = machine.timer_resolution(4e-3)
    assert coarse.status is Status.BAD
    assert "4 ms" in coarse.found


def test_a_slow_clock_gets_the_command_that_selects_the_fast_one_only_if_it_is_offered(
    tree: Tree,
) -> None:
    folder = "/sys/devices/system/clocksource/clocksource0"
    tree.write({f"{folder}/current_clocksource": "hpet\n"})
    assert machine.clock_source(tree.system()).remedy == ()
    tree.write({f"{folder}/available_clocksource": "tsc hpet acpi_pm\n"})
    check = machine.clock_source(tree.system())
    assert check.status is Status.WARN
    assert "echo tsc" in check.remedy[0]


def test_one_processor_that_saves_power_is_enough_for_a_warning(tree: Tree) -> None:
    tree.write(processors(4, {"cpufreq/scaling_governor": "performance\n"}))
    assert machine.governor(tree.system()).status is Status.OK
    tree.write(processors(1, {"cpufreq/scaling_governor": "powersave\n"}))
    check = machine.governor(tree.system())
    assert check.status is Status.WARN
    assert "powersave" in check.found


@pytest.mark.parametrize(
    ("no_sleep", "disabled", "status"),
    [(False, "0", Status.WARN), (True, "0", Status.OK), (False, "1", Status.OK)],
)
def test_a_deep_idle_state_matters_unless_disabled_or_kept_out(
    tree: Tree, no_sleep: bool, disabled: str, status: Status
) -> None:
    state = {"cpuidle/state1/name": "C1", "cpuidle/state1/latency": "2"}
    deep = {
        "cpuidle/state3/name": "C6",
        "cpuidle/state3/latency": "133",
        "cpuidle/state3/disable": disabled,
    }
    tree.write(processors(2, state | deep))
    check = machine.idle_states(tree.system(), no_sleep=no_sleep)
    assert check.status is status
    assert ("C6" in check.found) == (disabled == "0")


def test_isolation_is_advised_only_where_there_are_processors_to_spare(tree: Tree) -> None:
    tree.write(processors(2, {"uevent": ""}))
    assert machine.isolation(tree.system()).status is Status.OK
    tree.write(processors(8, {"uevent": ""}))
    check = machine.isolation(tree.system())
    assert check.status is Status.WARN
    assert "isolcpus=managed_irq,domain,7" in check.remedy[0]
    tree.write({"/sys/devices/system/cpu/isolated": "7\n"})
    assert machine.isolation(tree.system()).status is Status.OK


@pytest.mark.parametrize(
    ("files", "found", "status"),
    [
        ({"/proc/version": "Linux 6.1 #1 SMP PREEMPT_RT Debian"}, "PREEMPT_RT", Status.OK),
        ({"/sys/kernel/debug/sched/preempt": "none voluntary (full) "}, "full", Status.OK),
        ({"/proc/cmdline": "quiet preempt=voluntary"}, "voluntary", Status.WARN),
        (
            {"/proc/sys/kernel/osrelease": "6.1", "/boot/config-6.1": "CONFIG_PREEMPT_NONE=y"},
            "none",
            Status.WARN,
        ),
        ({"/proc/version": "Linux"}, "not stated by the kernel", Status.UNKNOWN),
    ],
)
def test_the_preemption_model_is_found_wherever_it_is_stated(
    tree: Tree, files: dict[str, str], found: str, status: Status
) -> None:
    check = machine.preemption(tree.write(files).system())
    assert (check.found, check.status) == (found, status)


def test_the_preemption_model_is_read_from_the_packed_kernel_configuration(tree: Tree) -> None:
    (tree.root / "proc").mkdir()
    packed = gzip.compress(b"# CONFIG_PREEMPT is not set\nCONFIG_PREEMPT_NONE=y\n")
    (tree.root / "proc/config.gz").write_bytes(packed)
    assert machine.preemption(tree.system()).found == "none"
    (tree.root / "proc/config.gz").write_bytes(packed[:20])
    assert machine.preemption(tree.system()).status is Status.UNKNOWN


def test_a_virtual_machine_is_told_and_its_stolen_time(tree: Tree) -> None:
    tree.write({"/proc/cpuinfo": "flags\t\t: fpu vme\n"})
    assert machine.virtualisation(tree.system()).status is Status.OK
    tree.write(
        {
            "/proc/cpuinfo": "flags\t\t: fpu hypervisor vme\n",
            "/proc/stat": "cpu  50 0 0 40 0 0 0 10 0 0\ncpu0 1 2 3\n",
        }
    )
    check = machine.virtualisation(tree.system())
    assert check.status is Status.WARN
    assert "10.00 %" in check.found


def test_only_time_stolen_during_the_measurement_counts() -> None:
    before = "cpu  100 0 0 100 0 0 0 500 0 0\n"
    assert machine.stolen(before, "cpu  200 0 0 200 0 0 0 500 0 0\n").status is Status.OK
    check = machine.stolen(before, "cpu  145 0 0 145 0 0 0 510 0 0\n")
    assert check.status is Status.WARN
    assert check.found == "10.00 %"
    assert machine.stolen("nonsense", "").status is Status.UNKNOWN


@given(text=st.text())
def test_nonsense_in_sysfs_never_stops_the_examination(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    names = ["cpufreq/scaling_governor", "cpuidle/state0/latency", "cpuidle/state0/disable"]
    tree = Tree(tmp_path_factory.mktemp("nonsense"))
    tree.write(processors(2, dict.fromkeys(names, text)))
    files = ["/proc/loadavg", "/proc/stat", "/proc/cpuinfo", "/proc/cmdline", "/proc/version"]
    tree.write(dict.fromkeys(files, text))
    system = tree.system()
    checks = [
        machine.governor(system),
        machine.idle_states(system, no_sleep=False),
        machine.preemption(system),
        machine.virtualisation(system),
        machine.load(system),
    ]
    assert all(check.found for check in checks)


# --- permissions -----------------------------------------------------------------------------
def test_what_was_given_counts_whatever_the_limit_says() -> None:
    assert permissions.scheduling(ALL, 0).status is Status.OK
    assert permissions.memory_lock(ALL, 65536).status is Status.OK


def test_a_refused_right_gets_the_line_that_grants_it() -> None:
    check = permissions.scheduling(NOTHING, 0)
    assert check.status is Status.BAD
    granting = "echo '@realtime - rtprio 98' | sudo tee -a /etc/security/limits.d/90-hil.conf"
    assert check.remedy[1] == granting
    assert check.remedy[0].startswith("sudo groupadd -f realtime && sudo usermod -aG realtime ")
    check = permissions.memory_lock(NOTHING, 8 << 20)
    assert check.status is Status.BAD
    assert "8192 KiB" in check.found
    assert "memlock unlimited" in check.remedy[1]


def test_memory_locked_as_far_as_a_limit_goes_is_a_warning() -> None:
    partly = RealTimeReport("SCHED_FIFO 50", False, True, ("only memory in use now is locked (…)",))
    check = permissions.memory_lock(partly, 8 << 20)
    assert check.status is Status.WARN
    assert "memlock unlimited" in check.remedy[1]


def test_real_time_refused_within_the_limit_points_at_the_kernel_too() -> None:
    assert "sched_rt_runtime_us" in permissions.scheduling(NOTHING, 80).remedy[-1]


def test_a_silent_probe_leaves_permissions_unknown(tree: Tree) -> None:
    assert permissions.scheduling(None, 0).status is Status.UNKNOWN
    assert permissions.memory_lock(None, 0).status is Status.UNKNOWN
    tree.write({"/dev/cpu_dma_latency": ""})
    assert permissions.processor_awake(None, tree.system()).status is Status.UNKNOWN


def test_the_sleep_setting_gets_a_udev_rule_only_where_the_file_exists(tree: Tree) -> None:
    assert permissions.processor_awake(NOTHING, tree.system()).status is Status.UNKNOWN
    tree.write({"/dev/cpu_dma_latency": ""})
    check = permissions.processor_awake(NOTHING, tree.system())
    assert check.status is Status.WARN
    assert any("/etc/udev/rules.d/90-hil.rules" in line for line in check.remedy)
    assert permissions.processor_awake(ALL, tree.system()).status is Status.OK


def test_root_is_told_that_what_root_may_do_says_little() -> None:
    assert permissions.user(0).status is Status.WARN
    assert permissions.user(1000).status is Status.OK


# --- disk ------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("trial", "statuses"),
    [
        (DiskTrial("/d", 10**12, (0.001, 0.2)), [Status.OK, Status.OK]),
        (DiskTrial("/d", 10**9, (0.001, 0.8)), [Status.WARN, Status.WARN]),
        (DiskTrial("/d", 10**6, (0.001, 2.6)), [Status.BAD, Status.BAD]),
        (DiskTrial("/d", 10**12, (), "Read-only file system"), [Status.OK, Status.BAD]),
        (None, [Status.BAD]),
    ],
)
def test_room_and_write_time_are_judged_apart(
    trial: DiskTrial | None, statuses: list[Status]
) -> None:
    assert [check.status for check in disk_checks(Path("/d"), trial)] == statuses


def test_a_command_that_is_not_there_or_hangs_gives_no_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hil.doctor.check.COMMAND_TIMEOUT", 0.05)
    assert run_command(["no-such-command"]) is None
    assert run_command(["sleep", "5"]) is None
    answer = run_command(["true"])
    assert answer is not None
    assert answer.status == 0


# --- Judgements of routes, cards, ports and buses: files instead of /proc and /sys

ROUTES = """Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t010200C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth1\t000C020A\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0
eth2\t000C020A\t00000000\t0001\t0\t0\t200\t00FFFFFF\t0\t0\t0
"""
ARP = "IP address       HW type     Flags       HW address            Mask     Device\n"
C4G = "10.2.12.150"


def card(**files: str) -> dict[str, str]:
    given = {"operstate": "up", "carrier": "1", "speed": "1000", "duplex": "full"} | files
    return {f"/sys/class/net/eth1/{name}": text for name, text in given.items()}


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_the_longest_prefix_and_then_the_lowest_metric_carries_the_route(tree: Tree) -> None:
    system = tree.write({"/proc/net/route": ROUTES}).system()
    assert route.route_to(C4G, system) == route.Route("eth1", None)
    assert route.route_to("10.2.13.1", system) == route.Route("eth0", "192.0.2.1", True)
    assert route.route_to("127.0.0.1", system) == route.Route("lo", None)


def test_a_controller_behind_a_gateway_is_bad_and_none_at_all_too(tree: Tree) -> None:
    tree.write({"/proc/net/route": ROUTES.replace("eth1", "eth9").replace("000C020A", "00636363")})
    checks = by_name(network_checks(C4G, 1000, C4G, tree.system()))
    assert checks["route to the controller"].status is Status.BAD
    assert "192.0.2.1" in checks["route to the controller"].found
    assert "10.2.12.149/24" in checks["route to the controller"].remedy[0]
    tree.write({"/proc/net/route": ""})
    checks = by_name(network_checks(C4G, 1000, C4G, tree.system()))
    assert checks["route to the controller"].found == f"none to {C4G}"


def test_an_own_address_is_loopback_and_needs_no_card(tree: Tree) -> None:
    trie = "Local:\n  +-- 10.2.12.0/24\n     |-- 10.2.12.150\n        /32 host LOCAL\n"
    tree.write({"/proc/net/fib_trie": trie, "/proc/net/route": ROUTES})
    checks = network_checks(C4G, 1000, C4G, tree.system())
    assert {check.status for check in checks} == {Status.OK}


def test_a_name_is_looked_up_in_the_hosts_file_and_nowhere_else(tree: Tree) -> None:
    tree.write({"/etc/hosts": "127.0.0.1 localhost\n10.2.12.150 c4g robot # ours\n"})
    assert route.address_of("robot", tree.system()) == C4G
    assert route.address_of("ours", tree.system()) is None
    check = network_checks("elsewhere.invalid", 1000, None, tree.system())[0]
    assert check.status is Status.BAD


@pytest.mark.parametrize(
    ("files", "status", "word"),
    [
        ({}, Status.OK, "1000 Mbit/s"),
        ({"operstate": "down", "carrier": "0"}, Status.BAD, "no carrier"),
        ({"duplex": "half"}, Status.BAD, "half"),
        ({"speed": "10"}, Status.BAD, "10 Mbit/s"),
        ({"speed": "-1", "duplex": "unknown"}, Status.OK, "speed not stated"),
        ({"speed": "gibberish"}, Status.OK, "speed not stated"),
        ({"wireless/x": ""}, Status.BAD, "wireless"),
    ],
)
def test_the_card_has_to_be_up_wired_and_fast(
    tree: Tree, files: dict[str, str], status: Status, word: str
) -> None:
    check = device_check("eth1", tree.write(card(**files)).system())
    assert check.status is status
    assert word in check.found


def test_a_card_shared_with_the_default_route_is_warned_of(tree: Tree) -> None:
    tree.write(card() | {"/proc/net/route": ROUTES.replace("eth0", "eth1")})
    assert device_check("eth1", tree.system()).status is Status.WARN


def test_a_card_that_is_not_there_is_bad(tree: Tree) -> None:
    assert device_check("eth7", tree.system()).status is Status.BAD


@pytest.mark.parametrize(
    ("line", "status", "word"),
    [
        ("10.2.12.150 0x1 0x6 00:04:50:00:00:01 * eth1", Status.OK, "permanent"),
        ("10.2.12.150 0x1 0x2 00:04:50:00:00:01 * eth1", Status.WARN, "will expire"),
        ("10.2.12.150 0x1 0x0 00:00:00:00:00:00 * eth1", Status.WARN, "none"),
        ("10.2.12.150 0x1 0x6 00:04:50:00:00:01 * eth2", Status.WARN, "none"),
        ("10.2.12.150 0x1 what? 00:04:50:00:00:01 * eth1", Status.WARN, "none"),
        ("", Status.WARN, "none"),
    ],
)
def test_a_permanent_arp_entry_is_wanted(tree: Tree, line: str, status: Status, word: str) -> None:
    tree.write(card() | {"/proc/net/route": ROUTES, "/proc/net/arp": ARP + line + "\n"})
    check = by_name(network_checks(C4G, 1000, C4G, tree.system()))["ARP entry of the controller"]
    assert check.status is status
    assert word in check.found
    if status is Status.WARN:
        assert check.remedy[0].startswith("sudo ip neigh replace 10.2.12.150 lladdr ")


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (Answer(0, "Adaptive RX: off  TX: off\nrx-usecs: 0\n"), Status.OK),
        (Answer(0, "Adaptive RX: on  TX: on\nrx-usecs: 3\n"), Status.WARN),
        (Answer(0, "rx-usecs: 200\n"), Status.WARN),
        (Answer(1, "", "netlink error: Operation not supported"), Status.OK),
        (Answer(1, "", "netlink error: Operation not permitted"), Status.UNKNOWN),
        (Answer(0, "\x00nonsense"), Status.OK),
    ],
)
def test_a_card_that_gathers_packets_is_warned_of(
    tree: Tree, answer: Answer, status: Status
) -> None:
    check = coalescing("eth1", tree.system(ethtool=answer))
    assert check is not None
    assert check.status is status


def test_without_ethtool_coalescing_is_unknown_and_the_command_is_given(tree: Tree) -> None:
    check = coalescing("eth1", tree.system())
    assert check is not None
    assert check.status is Status.UNKNOWN
    assert "ethtool -c eth1" in check.remedy


NFT_DROP = "table inet filter { chain input { type filter hook input priority 0; policy drop; } }"
NFT_OPEN = "table inet filter { chain input { type filter hook input priority 0; policy accept; } }"
UFW = "-P INPUT ACCEPT\n-A INPUT -j ufw-input\n-A ufw-input -p udp -j DROP\n"
NFT_NESTED = """table inet filter { chain input { type filter hook input priority 0; policy accept;
    ct state vmap { established : accept }
    udp dport 1000 drop } }"""


@pytest.mark.parametrize(
    ("commands", "status"),
    [
        ({"nft": Answer(0, "")}, Status.OK),
        ({"nft": Answer(0, NFT_OPEN)}, Status.OK),
        ({"nft": Answer(0, NFT_DROP)}, Status.WARN),
        ({"iptables": Answer(0, "-P INPUT ACCEPT\n")}, Status.OK),
        ({"iptables": Answer(0, "-P INPUT DROP\n")}, Status.WARN),
        ({"iptables": Answer(0, UFW)}, Status.WARN),
        ({"iptables": Answer(0, UFW.replace("DROP", "ACCEPT"))}, Status.OK),
        ({"nft": Answer(0, NFT_NESTED)}, Status.WARN),
        ({"nft": Answer(1, "", "Operation not permitted (you must be root)")}, Status.UNKNOWN),
        ({"nft": Answer(0, ""), "iptables": Answer(4, "", "Permission denied")}, Status.UNKNOWN),
    ],
)
def test_a_firewall_is_judged_only_as_far_as_it_can_be_read(
    tree: Tree, commands: dict[str, Answer], status: Status
) -> None:
    assert firewall(C4G, 1000, tree.system(**commands)).status is status


def test_without_tools_a_loaded_filter_is_unknown_and_none_is_fine(tree: Tree) -> None:
    assert firewall(C4G, 1000, tree.system()).status is Status.OK
    tree.write({"/proc/net/netfilter/nf_log": ""})
    assert firewall(C4G, 1000, tree.system()).status is Status.UNKNOWN


@given(text=st.text())
def test_nonsense_in_the_kernels_tables_is_no_route_and_no_neighbour(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    tree = Tree(tmp_path_factory.mktemp("nonsense"))
    head = "header\n"
    tree.write({"/proc/net/route": head + text, "/proc/net/arp": head + text})
    assert route.route_to(C4G, tree.system()) is None
    assert route.neighbour(C4G, "eth1", tree.system()) is None


@given(text=st.text())
def test_nonsense_about_a_card_is_still_a_verdict(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    tree = Tree(tmp_path_factory.mktemp("nonsense"))
    tree.write(card(speed=text, duplex=text, operstate="up"))
    assert device_check("eth1", tree.system()).found


# --- port ------------------------------------------------------------------------------------
def test_a_privileged_port_gets_the_setting_that_frees_it_for_good(tree: Tree) -> None:
    tree.write({"/proc/sys/net/ipv4/ip_unprivileged_port_start": "1024\n"})
    trial = port.SocketTrial(errno.EACCES)
    check = port.port_check("0.0.0.0", 1000, trial, tree.system())
    assert check.status is Status.BAD
    assert "1024" in check.found
    assert "net.ipv4.ip_unprivileged_port_start=1000" in check.remedy[0]


def test_the_owner_of_a_port_is_named(tree: Tree) -> None:
    line = " 12: 00000000:03E8 00000000:0000 07 00000000:00000000 00:00000000 0 1000 0 4711 2 0 0\n"
    tree.write({"/proc/net/udp": "header\n" + line + "garbage\n", "/proc/42/comm": "orchestra\n"})
    folder = tree.root / "proc/42/fd"
    folder.mkdir()
    (folder / "3").symlink_to("/dev/null")
    (folder / "4").symlink_to("socket:[4711]")
    trial = port.SocketTrial(errno.EADDRINUSE)
    assert "orchestra (process 42)" in port.port_check("", 1000, trial, tree.system()).found
    assert "another user" in port.port_check("", 1001, trial, tree.system()).found


def test_a_port_in_use_here_is_found_in_use() -> None:
    assert port.try_port("127.0.0.1", 0).error == 0
    assert port.try_port("192.0.2.77", 0).error == errno.EADDRNOTAVAIL


def test_every_way_a_bind_can_fail_is_bad(tree: Tree) -> None:
    for number in (errno.EADDRNOTAVAIL, errno.EACCES, errno.EADDRINUSE, errno.ENOBUFS, -1):
        check = port.port_check("10.2.12.149", 1000, port.SocketTrial(number), tree.system())
        assert check.status is Status.BAD


def test_only_busy_polling_may_be_refused_without_a_warning() -> None:
    assert port.options_check(port.SocketTrial(0, ("SO_BUSY_POLL",), 212992)).status is Status.OK
    assert port.options_check(port.SocketTrial(0, ("SO_PRIORITY",), 1)).status is Status.WARN


# --- CAN -------------------------------------------------------------------------------------
FD = CanLink("socketcan", "can0", True, 1_000_000, 5_000_000)
BUS = {"/sys/class/net/can0/type": "280", "/sys/class/net/can0/operstate": "up"}


def ip_says(text: str) -> Answer:
    return Answer(0, text)


def rates(nominal: int, data: int | None) -> Answer:
    fast = f', "data_bittiming": {{"bitrate": {data}}}' if data else ""
    info = f'{{"bittiming": {{"bitrate": {nominal}}}{fast}}}'
    return ip_says(f'[{{"linkinfo": {{"info_kind": "can", "info_data": {info}}}}}]')


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (rates(1_000_000, 5_000_000), Status.OK),
        (rates(500_000, 5_000_000), Status.BAD),
        (rates(1_000_000, 2_000_000), Status.BAD),
        (rates(1_000_000, None), Status.BAD),
        (ip_says("[]"), Status.UNKNOWN),
        (ip_says("not json"), Status.UNKNOWN),
        (ip_says('[{"linkinfo": {"info_kind": "vcan"}}]'), Status.OK),
    ],
)
def test_the_bit_rates_have_to_be_the_cells(tree: Tree, answer: Answer, status: Status) -> None:
    assert can_check(FD, tree.write(BUS).system(ip=answer)).status is status


def test_a_bus_that_is_down_gets_the_command_that_brings_it_up(tree: Tree) -> None:
    tree.write(BUS | {"/sys/class/net/can0/operstate": "down"})
    check = can_check(FD, tree.system())
    assert check.status is Status.BAD
    assert "bitrate 1000000 dbitrate 5000000 fd on" in check.remedy[0]


def test_a_missing_or_foreign_interface_is_bad_and_an_adapter_is_not_touched(tree: Tree) -> None:
    assert can_check(FD, tree.system()).status is Status.BAD
    tree.write(BUS | {"/sys/class/net/can0/type": "1"})
    assert can_check(FD, tree.system()).status is Status.BAD
    serial = CanLink("slcan", "/dev/ttyACM0", False)
    assert can_check(serial, tree.system()).status is Status.UNKNOWN
