"""What a process does against pauses, without any permission."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.safety

_GET_TIMERSLACK = 30
_PROGRAM = f"""
import ctypes, gc
from drivers.exchange.realtime import RealTimeSettings, enter
report = enter(RealTimeSettings(priority=0, lock_memory=False, hold_cpu_awake=False))
slack = ctypes.CDLL(None).prctl({_GET_TIMERSLACK}, 0, 0, 0, 0)
print(slack, gc.isenabled(), gc.get_freeze_count() > 0, report.scheduling, len(report.refused))
"""


def test_timers_are_exact_and_nothing_is_collected() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["1", "False", "True", "ordinary", "0"]
