"""The doctor: judgements of computer and link, measured latencies, the command."""

from __future__ import annotations

import errno
import io
import json
import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from typer.testing import CliRunner

from drivers.exchange.realtime import RealTimeReport
from drivers.transports.base import CanBus, FreePort
from drivers.transports.udp import UdpSpec
from hil.base.progress import Silent
from hil.cli import app
from hil.doctor import checks as system_checks
from hil.doctor import probe
from hil.doctor.checks import DiskTrial, System, disk_checks, route_check, try_port
from hil.doctor.diagnosis import (
    REPLY_RESERVE_SECONDS,
    CycleEvidence,
    Diagnosis,
    Fitness,
    Latency,
    disk_trial,
    examine,
    judge,
    measure,
    run_probe,
)
from hil.doctor.findings import (
    CheckStatus,
    DiskRefused,
    DoctorCheck,
    Governors,
    NoLink,
    Port,
)
from hil.doctor.messages import as_json, check_words, fitness_lines, line_of, reason_of, show
from sim_fixtures.ns16 import CELL_PATH

samples = st.lists(st.floats(0.0, 0.01), min_size=1, max_size=50)


def latency(*seconds: float, length: float = 60.0, name: str = "turnaround") -> Latency:
    return Latency(name, np.array(seconds), length)


# --- latency and verdict ---------------------------------------------------------------------
def test_a_stall_counts_each_of_its_cycles() -> None:
    stall = latency(50e-6, 7.95e-3)
    assert stall.late_cycles(1e-3) == 8
    assert stall.late_cycles(2e-3) == 4
    assert latency(1e-3 - 2 * REPLY_RESERVE_SECONDS).late_cycles(1e-3) == 0


@given(samples, st.floats(0.0, 0.01))
def test_one_more_latency_never_makes_a_cycle_fit(values: list[float], more: float) -> None:
    """Nor a shorter cycle; the worse of two measurements decides."""
    before = judge([latency(*values)], 1)
    after = judge([latency(*values, more)], 1)
    assert after.late_cycles >= before.late_cycles
    both = judge([latency(*values), latency(more)], 1)
    assert both.fit <= before.fit <= judge([latency(*values)], 2).fit
    assert both == judge([latency(more), latency(*values)], 1)


def test_cycles_are_judged_by_late_and_by_usual_latency() -> None:
    quiet = judge([latency(*np.full(60_000, 60e-6))], 1)
    assert quiet.fit
    # A mean of ln 20 = 2.996 late cycles in 60 s shows none with 5 % probability.
    assert quiet.late_per_hour_upper_95 == pytest.approx(60 * np.log(20), abs=1e-4)
    assert "fewer than 180 an hour" in reason_of(quiet)
    rare = judge([latency(*np.full(60_000, 60e-6), 1.2e-3)], 1)
    assert not rare.fit
    assert rare.late_cycles == 1
    assert "1 cycle late in 60 s of turnaround (about 60 an hour)" in reason_of(rare)
    # (1 + m) exp(-m) = 5 % for m = 4.744: the bound lies well above what was seen.
    assert rare.late_per_hour_upper_95 == pytest.approx(60 * 4.744, rel=1e-3)
    slow = judge([latency(*np.full(1000, 450e-6))], 1)
    assert (slow.fit, slow.late_cycles) == (False, 0)
    assert slow.evidence.share_used == pytest.approx(0.55)
    assert "55 % of the cycle" in reason_of(slow)


PORT = DoctorCheck(CheckStatus.BAD, Port(FreePort("10.1.1.1", 1000, "UDP"), errno.EADDRINUSE))


def diagnosis(
    *checks: DoctorCheck, fit: bool = True, fit_at_2: bool = True, seconds: float = 60.0
) -> Diagnosis:
    one_ms, two_ms = (
        Fitness(
            cycle, is_fit, 0, 0.0, CycleEvidence("turnaround", seconds, 3e-3, "turnaround", 0.1)
        )
        for cycle, is_fit in ((1, fit), (2, fit_at_2))
    )
    measured = (latency(50e-6, 3e-3, length=seconds),)
    return Diagnosis(checks, measured, (one_ms, two_ms), 1, seconds)


def page(diagnosed: Diagnosis) -> str:
    console = Console(record=True, width=100, file=io.StringIO())
    show(diagnosed, console)
    return console.export_text()


@pytest.mark.parametrize(("fit_at_1", "fit_at_2"), [(True, True), (False, True), (False, False)])
def test_a_cycle_of_2_ms_is_advised_only_where_it_is_fit(fit_at_1: bool, fit_at_2: bool) -> None:
    assert ("use 2 ms" in page(diagnosis(fit=fit_at_1, fit_at_2=fit_at_2))) is (
        fit_at_2 and not fit_at_1
    )


def test_the_last_remedy_follows_others_only_where_some_are() -> None:
    assert "If it is still not fit" not in page(diagnosis(fit=False))
    bad = DoctorCheck(CheckStatus.BAD, DiskRefused("/d", ""))
    assert "If it is still not fit after that: switch off C-states" in page(
        diagnosis(bad, fit=False)
    )


def test_a_bad_check_makes_a_fast_pc_unfit_and_is_named() -> None:
    assert diagnosis(
        *(DoctorCheck(status, NoLink()) for status in CheckStatus if status is not CheckStatus.BAD)
    ).fit
    unfit = diagnosis(PORT)
    assert not unfit.fit
    assert "UDP port 1000" in line_of(unfit)


@pytest.mark.parametrize(("fit", "seconds", "status"), [
    (True, 60.0, 0), (True, 5.0, 5), (False, 60.0, 5),
])  # fmt: skip
def test_the_exit_status_is_0_only_for_a_reliable_fit(
    fit: bool, seconds: float, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_up = diagnosis(fit=fit, seconds=seconds)
    monkeypatch.setattr("hil.cli.doctor.examine", lambda *_, **__: made_up)
    ran = CliRunner().invoke(app, ["doctor", "--json"])
    assert ran.exit_code == status
    printed = json.loads(ran.stdout)
    assert printed["provisional"] is ("Provisional" in printed["verdict"]) is (seconds < 60)


def test_page_and_json_agree_and_remedies_come_worst_first() -> None:
    slow = DoctorCheck(CheckStatus.WARN, Governors(("[by] hand",)))
    made = diagnosis(slow, PORT, PORT)
    text = page(made)
    document = json.loads(json.dumps(as_json(made)))
    assert "[by] hand" in text
    assert "p50 50" in text and "max 3000" in text
    commands = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    remedies = [command for check in (PORT, slow) for command in check_words(check).remedy]
    assert commands == remedies  # each once
    assert document["fit"] is False
    assert document["checks"][1]["remedy"] == list(check_words(PORT).remedy)
    assert document["latency"]["turnaround"]["late_cycles_1ms"] == 3
    nothing = judge([], 1)
    assert (nothing.fit, nothing.late_per_hour_upper_95) == (False, None)


# --- probes ----------------------------------------------------------------------------------
def test_a_lost_packet_counts_its_whole_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "REPLY_TIMEOUT", 0.05)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.1", 0))

        def echo_all_but_3() -> None:
            while (received := far.recvfrom(1500))[0] != b"end":
                if int.from_bytes(received[0][:4], "little") != 3:
                    far.sendto(received[0], received[1])

        thread = threading.Thread(target=echo_all_but_3)
        thread.start()
        took = probe.round_trips(far.getsockname()[1], 1e-3, 0.2)
        thread.join(timeout=5.0)
    assert took[3] == pytest.approx(0.05)
    assert len(took) > 4
    assert np.median(np.delete(took, 3)) < 0.05


def test_missed_deadlines_are_one_long_latency(monkeypatch: pytest.MonkeyPatch) -> None:
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
    monkeypatch.setattr("hil.doctor.diagnosis._PROBE_GRACE", 0.3)
    began = time.monotonic()
    assert run_probe(["echo"], 0.0) is None  # waits 5 s for packets
    assert time.monotonic() - began < 4.0
    assert measure("no such probe", 1e-3, 0.1, Silent()) is None


def test_the_disk_of_the_archives_is_measured(tmp_path: Path) -> None:
    trial = disk_trial(tmp_path / "runs" / "mine")
    assert trial.folder == str(tmp_path)
    assert len(trial.seconds) > 0
    assert list(tmp_path.iterdir()) == []
    checks = disk_checks(Path("/proc"), disk_trial(Path("/proc")))
    assert checks[-1].status is CheckStatus.BAD


# --- the command -----------------------------------------------------------------------------
def cell_text(**controller: object) -> str:
    text = CELL_PATH.read_text()
    for key, value in controller.items():
        old = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
        text = text.replace(old, f"{key} = {json.dumps(value)}")
    urdf = CELL_PATH.parent / "ns16.urdf"
    return text.replace('"ns16.urdf"', json.dumps(str(urdf)))


@pytest.mark.safety
def test_the_command_sends_the_controller_nothing(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller:
        controller.bind(("127.0.0.2", 0))
        port = controller.getsockname()[1]
        file = tmp_path / "cell.toml"
        file.write_text(cell_text(transport="udp", host="127.0.0.2", port=port))
        # The cell's default bind, every address, is used by the controller here.
        scheduling = os.sched_getscheduler(0)
        ran = CliRunner().invoke(
            app, ["doctor", str(file), "--duration", "1", "--json", "--output", "x"]
        )
        controller.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            controller.recv(1500)
    printed = json.loads(ran.stdout)
    assert ran.exit_code == 5
    assert printed["fit"] is False
    by_name = {check["name"]: check for check in printed["checks"]}
    assert by_name[f"UDP port {port}"]["status"] == "bad"
    assert by_name["route to the controller"]["status"] == "ok"
    assert printed["latency"]["turnaround"]["samples"] > 100
    assert os.sched_getscheduler(0) == scheduling


@pytest.mark.long
def test_every_remedy_is_valid_shell(tmp_path: Path) -> None:
    examined = examine(UdpSpec("10.99.99.99", 999), 1, 0.1, tmp_path, Silent())
    for check in examined.checks:
        for command in check_words(check).remedy:
            checked = subprocess.run(["bash", "-n", "-c", command], capture_output=True, text=True)
            assert checked.returncode == 0, (command, checked.stderr)


# --- judgements: files in place of /proc and /sys, made-up output of commands ------------------
class MadeUp(System):
    """A system below a folder; a command without output is not installed."""

    def __init__(self, root: Path, files: dict[str, str], commands: dict[str, str]) -> None:
        super().__init__(root)
        self.commands = commands
        for name, text in files.items():
            self.path(name).parent.mkdir(parents=True, exist_ok=True)
            self.path(name).write_text(text)

    def run(self, *command: str) -> str | None:
        return self.commands.get(command[0])


ALL = RealTimeReport("SCHED_FIFO 50", True, True)
PARTLY = RealTimeReport("SCHED_FIFO 50", False, True, memory_in_use_locked=True)
NOTHING = RealTimeReport("ordinary", False, False)
CPU = "/sys/devices/system/cpu"
C4G = "10.2.12.150"
FD = CanBus("socketcan", "can0", bitrate=1_000_000, data_bitrate=5_000_000)
BUS = {"/sys/class/net/can0/type": "280", "/sys/class/net/can0/operstate": "up"}


def processors(count: int, **files: str) -> dict[str, str]:
    """Files of so many processors; __ in a name stands for a folder."""
    return {
        f"{CPU}/cpu{i}/{name.replace('__', '/')}": text
        for i in range(count)
        for name, text in files.items()
    }


def ip(*entries: object) -> dict[str, str]:
    return {"ip": json.dumps(entries)}


def rates(nominal: int, data: int | None) -> dict[str, str]:
    fast = {"data_bittiming": {"bitrate": data}} if data else {}
    info = {"bittiming": {"bitrate": nominal}, **fast}
    return ip({"linkinfo": {"info_kind": "can", "info_data": info}})


Judge = Callable[[System], DoctorCheck]
Case = tuple[Judge, dict[str, str], dict[str, str], CheckStatus, str]
OK, WARN, BAD, UNKNOWN = CheckStatus


def of(judge: Judge, *cases: tuple[Any, ...]) -> list[Case]:
    """Cases of one judgement: files, outcome, a word of it or of its remedy, and commands."""
    return [(judge, case[0], case[3] if len(case) > 3 else {}, case[1], case[2]) for case in cases]


def port(error: int) -> Judge:
    return lambda _: system_checks.port_check(FreePort("10.1.1.1", 1000, "UDP"), error)


FULL_SPEED = processors(4, cpufreq__scaling_governor="performance")
JUDGED = [
    *of(
        system_checks.governor,
        (FULL_SPEED, OK, "performance"),
        (FULL_SPEED | processors(1, cpufreq__scaling_governor="powersave"), WARN, "powersave"),
        ({}, OK, "no frequency scaling"),
    ),
    *of(lambda _: system_checks.idle_states(cpu_awake=False),
        ({}, WARN, "/etc/udev/rules.d/90-hil.rules")),
    *of(lambda _: system_checks.idle_states(cpu_awake=True), ({}, OK, "not entered")),
    # What was given applies, not the limit.
    *of(lambda s: system_checks.scheduling(ALL, 0), ({}, OK, "SCHED_FIFO 50")),
    *of(lambda s: system_checks.scheduling(NOTHING, 0),
        ({}, BAD, "'@realtime - rtprio 98' | sudo tee -a /etc/security/limits.d/90-hil.conf"),
        ({}, BAD, "sudo groupadd -f realtime && sudo usermod -aG realtime ")),
    *of(lambda s: system_checks.scheduling(NOTHING, 80), ({}, BAD, "sched_rt_runtime_us")),
    *of(lambda s: system_checks.memory_lock(ALL, 65536), ({}, OK, "64 KiB")),
    *of(lambda s: system_checks.memory_lock(NOTHING, 8 << 20),
        ({}, BAD, "8192 KiB"), ({}, BAD, "memlock unlimited")),
    *of(lambda s: system_checks.memory_lock(PARTLY, 8 << 20), ({}, WARN, "memlock unlimited")),
    *of(lambda s: system_checks.computer_checks(None, s)[0], ({}, BAD, "the probe failed")),
    *of(
        lambda s: system_checks.can_check(FD, s),
        ({}, BAD, "is not a CAN interface"),
        (BUS | {"/sys/class/net/can0/operstate": "down"}, BAD,
         "bitrate 1000000 dbitrate 5000000 fd on"),
        (BUS, OK, "5000000", rates(1_000_000, 5_000_000)),
        (BUS, BAD, "2000000", rates(1_000_000, 2_000_000)),
        (BUS, BAD, "1000000", rates(1_000_000, None)),
        (BUS, UNKNOWN, "not stated", ip()),
        (BUS, OK, "virtual bus", ip({"linkinfo": {"info_kind": "vcan"}})),
    ),
    *of(lambda s: system_checks.can_check(CanBus("slcan", "x"), s),
        ({}, UNKNOWN, "not a kernel device")),
    *of(port(errno.EACCES), ({}, BAD, "net.ipv4.ip_unprivileged_port_start=1000")),
    *of(port(errno.EADDRINUSE), ({}, BAD, "sudo ss -lunp")),
    *of(port(errno.EADDRNOTAVAIL), ({}, BAD, "10.1.1.1 is not an address")),
    *of(port(-1), ({}, BAD, "error -1")),
    *of(port(0), ({}, OK, "10.1.1.1")),
    *of(
        lambda s: route_check(C4G, s),
        ({}, OK, "directly on eth1", ip({"dst": C4G, "dev": "eth1"})),
        ({"/sys/class/net/eth1/carrier": "0"}, BAD, "no carrier", ip({"dev": "eth1"})),
        ({}, BAD, "10.2.12.149/24", ip({"gateway": "192.0.2.1", "dev": "eth0"})),
        ({}, BAD, f"none to {C4G}", {"ip": ""}),
        ({}, OK, "this PC itself", ip({"type": "local", "dst": C4G, "dev": "lo"})),
        ({}, UNKNOWN, "iproute2"),
    ),
    *of(
        lambda s: route_check("robot", s),
        ({"/etc/hosts": "10.2.12.150 c4g robot # ours\n"}, OK, C4G, ip({"dev": "eth1"})),
        ({"/etc/hosts": "10.2.12.150 c4g # robot\n"}, BAD, "nor in /etc/hosts"),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("judge", "files", "commands", "status", "word"), JUDGED)
def test_what_is_found_is_judged(
    tmp_path: Path,
    judge: Judge,
    files: dict[str, str],
    commands: dict[str, str],
    status: CheckStatus,
    word: str,
) -> None:
    check = judge(MadeUp(tmp_path, files, commands))
    assert check.status is status
    words = check_words(check)
    assert word in "\n".join([words.facts, *words.remedy])


@pytest.mark.parametrize(
    ("trial", "statuses"),
    [
        (DiskTrial("/d", 10**12, (0.001, 0.2)), [OK, OK]),
        (DiskTrial("/d", 2 * 10**9, (0.001, 0.8)), [WARN, WARN]),
        (DiskTrial("/d", 10**6, (0.001, 2.6)), [BAD, BAD]),
        (DiskTrial("/d", 10**12, (), "Read-only file system"), [OK, BAD]),
        (None, [BAD]),
    ],
)
def test_room_and_write_time_are_judged_apart(
    trial: DiskTrial | None, statuses: list[CheckStatus]
) -> None:
    assert [check.status for check in disk_checks(Path("/d"), trial)] == statuses


def test_missing_and_hanging_commands_give_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system_checks, "COMMAND_TIMEOUT", 0.05)
    outputs = [System().run(*command.split()) for command in ("no-such-command", "sleep 5", "true")]
    assert outputs == [None, None, ""]


def test_ports_are_tried() -> None:
    errors = [try_port(FreePort(host, 0, "UDP")) for host in ("127.0.0.1", "192.0.2.77")]
    assert errors == [0, errno.EADDRNOTAVAIL]


def test_a_reason_of_both_cycles_is_printed_once() -> None:
    apart = [latency(20e-6, 1.5e-3)]
    lines = fitness_lines([judge(apart, 1), judge(apart, 2)])
    assert [line.split(":")[0] for line in lines] == ["1 ms", "2 ms"]
    (unmeasured,) = fitness_lines([judge([], 1), judge([], 2)])
    assert unmeasured == "1 and 2 ms: not fit; nothing was measured"
