"""Large arrays of a supervising process go back to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import sys
import numpy as np
from hil.campaign.live_link import LARGE, return_large_arrays

def mapped():
    return int(open("/proc/self/statm").read().split()[0]) * 4096

if "adapted" not in sys.argv:
    return_large_arrays()
teacher = np.ones(4_000_000)
del teacher  # glibc now takes what is smaller from its heap
before = mapped()
arrays = [np.ones(2 * LARGE // 8) for _ in range(40)]
small = [np.ones(100) for _ in range(1000)]  # above them, and stay
del arrays
print(before, mapped())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the heap of glibc")
def test_what_is_freed_is_not_kept_below_what_is_not() -> None:
    def kept(*words: str) -> int:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, *words], capture_output=True, text=True, check=True
        )
        before, after = map(int, done.stdout.split())
        return after - before

    assert kept() < 2 * 2**20
    assert kept("adapted") > 8 * 2**20, "glibc returns them by itself: this is not needed any more"
