"""Judgements of a computer, its permissions and its disk: files instead of /proc and /sys."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.exchange.realtime import RealTimeReport
from hil.doctor import machine
from hil.doctor import machine as permissions
from hil.doctor.check import Status, run_command
from hil.doctor.machine import DiskTrial, disk_checks
from tests.hil.doctor.conftest import Tree

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
