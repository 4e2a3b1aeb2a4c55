"""What is asked of the operating system, and what becomes of its refusals."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys

import pytest

from drivers.exchange import realtime
from drivers.exchange.realtime import RealTimeReport, RealTimeSettings

ENTER = """
import dataclasses, gc, json, mmap, os, resource, sys
from drivers.exchange.realtime import RealTimeSettings, enter
if {unprivileged}:
    resource.setrlimit(resource.RLIMIT_MEMLOCK, ({memlock}, {memlock}))
    os.setgroups([]); os.setgid(65534); os.setuid(65534)
report = enter(RealTimeSettings({arguments}))
mmap.mmap(-1, 64 << 20).close()
print(json.dumps([dataclasses.asdict(report), gc.isenabled(), sorted(os.sched_getaffinity(0))]))
"""


def enter(arguments: str = "", *, unprivileged=False, memlock=8 << 20):
    """In a process of its own; report, whether the collector is on, processors."""
    script = ENTER.format(arguments=arguments, unprivileged=unprivileged, memlock=memlock)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    report, collecting, cpus = json.loads(run.stdout)
    return RealTimeReport(**report), collecting, cpus


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs the right to drop rights")


def test_the_collector_is_off_and_nothing_else_changed_where_nothing_is_asked_for():
    report, collecting, _ = enter("priority=0, lock_memory=False, hold_cpu_awake=False")
    assert report == RealTimeReport("ordinary", False, False, [])
    assert not collecting


def test_what_was_asked_for_is_granted_or_refused_in_one_sentence_each():
    report, _, _ = enter("priority=37")
    granted = (
        report.scheduling == "SCHED_FIFO 37",
        report.memory_locked,
        report.cpu_awake,
    )
    assert sum(granted) + len(report.refused) == 3


@needs_root
def test_a_user_without_rights_is_told_each_remedy_and_goes_on():
    report, collecting, _ = enter("", unprivileged=True, memlock=4 << 20)
    assert report.scheduling == "ordinary"
    assert not report.memory_locked
    assert not collecting
    text = "\n".join(report.refused)
    assert "rtprio 98" in text
    assert "memlock unlimited" in text
    assert "udev" in text or report.cpu_awake


@pytest.mark.parametrize(
    ("user", "limit", "flags", "locked"),
    [(1000, 8 << 30, 1, False), (1000, resource.RLIM_INFINITY, 3, True), (0, 8 << 20, 3, True)],
    ids=["a finite limit", "no limit", "root"],
)
def test_future_memory_is_locked_only_where_no_later_allocation_can_fail(
    monkeypatch, user, limit, flags, locked
):
    class C:
        """Grants everything."""

        asked = None

        def mallopt(self, *_):
            return 1

        def mlockall(self, wanted):
            self.asked = wanted
            return 0

    c = C()
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: c)
    monkeypatch.setattr(realtime.os, "geteuid", lambda: user)
    monkeypatch.setattr(realtime.resource, "getrlimit", lambda _: (limit, limit))
    refused = []
    assert realtime._lock_memory(refused) is locked
    assert c.asked == flags
    assert len(refused) == (not locked)


def test_a_processor_can_be_chosen():
    cpu = max(os.sched_getaffinity(0))
    report, _, cpus = enter(f"priority=0, lock_memory=False, hold_cpu_awake=False, cpu={cpu}")
    assert cpus == [cpu]
    assert not report.refused


def test_a_processor_that_is_not_there_is_refused():
    report, _, _ = enter("priority=0, lock_memory=False, hold_cpu_awake=False, cpu=4096")
    assert len(report.refused) == 1
    assert "choose one of" in report.refused[0]


@pytest.mark.parametrize("priority", [100, 1000])
def test_a_priority_that_does_not_exist_is_refused(priority):
    report, _, _ = enter(f"priority={priority}, lock_memory=False, hold_cpu_awake=False")
    assert report.scheduling == "ordinary"
    assert len(report.refused) == 1


def test_settings_have_a_default_for_every_wish():
    assert RealTimeSettings() == RealTimeSettings(50, None, True, True)
