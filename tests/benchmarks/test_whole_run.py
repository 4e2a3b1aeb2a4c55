"""Time and memory of a command in a process of its own, and of `hil identify` as a whole."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import plain_fit, whole_run
from benchmarks.fresh_process import usage

pytestmark = pytest.mark.long

_MEGABYTE = 1_000_000


class TestFreshProcess:
    def test_memory_is_that_of_the_command_and_not_of_this_process(self) -> None:
        """An interpreter is a few tens of megabytes; this process holds 200 MB more."""
        held = np.ones(200 * _MEGABYTE // 8)
        small = usage([sys.executable, "-c", "pass"])
        large = usage([sys.executable, "-c", f"b'x' * {150 * _MEGABYTE}"])
        assert small.peak_mb < 100.0
        assert large.peak_mb - small.peak_mb == pytest.approx(150.0, rel=0.1)
        assert held.all()

    def test_seconds_are_of_the_processor(self) -> None:
        spinning = "import time\nwhile time.process_time() < 0.3: pass"
        assert usage([sys.executable, "-c", "import time; time.sleep(0.5)"]).seconds < 0.3
        assert 0.3 <= usage([sys.executable, "-c", spinning]).seconds < 0.6

    def test_a_command_that_fails_ends_the_benchmark_with_its_reason(self) -> None:
        failing = [sys.executable, "-c", "raise SystemExit('no such log')"]
        with pytest.raises(SystemExit, match=r"no such log\n.* ended with status 1"):
            usage(failing)
        assert usage([sys.executable, "-c", "exit(5)"], accepted=(0, 5)).seconds < 1.0


@pytest.mark.slow
def test_the_whole_run_is_timed_against_the_ordinary_fit() -> None:
    figures = whole_run.times((100.0,), 10.0)
    assert figures.keys() == {
        "whole_100_hz_s", "whole_100_hz_plain_s", "whole_100_hz_ratio_to_plain",
    }  # fmt: skip
    ratio = figures["whole_100_hz_s"] / figures["whole_100_hz_plain_s"]
    assert figures["whole_100_hz_ratio_to_plain"] == pytest.approx(ratio, rel=0.02)
    assert min(figures.values()) > 0.0


@pytest.mark.slow
def test_a_raw_log_is_timed_in_units_of_the_machine() -> None:
    figures = whole_run.raw_log(10.0, 100.0)
    names = ("help", "help_of_look", "look", "identify", "identify_halves")
    units = {f"log_{name}_units" for name in names}
    assert figures.keys() == {"log_unit", *units, *(f"log_{name}_s" for name in names)}
    assert min(figures.values()) > 0.0
    assert figures["log_help_s"] < figures["log_look_s"] < figures["log_identify_s"]


def test_the_ordinary_fit_as_a_program(tmp_path: Path) -> None:
    """Both parts of a log are predicted to a few times its noise, 1.4 % of the scatter."""
    archive = whole_run.simulated_archive(tmp_path, 10.0, 100.0)
    arguments = [str(archive.with_suffix(".npz")), str(whole_run.urdf(whole_run.URDF))]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.plain_fit", *arguments],
        cwd=Path(__file__).resolve().parents[2], capture_output=True, text=True, check=True,
    )  # fmt: skip
    figures = json.loads(done.stdout)
    assert figures.keys() == {"cutoff", "fitted", "predicted"}
    assert figures["cutoff"] in plain_fit.CUTOFFS
    assert 0.005 < figures["fitted"] < 0.06
    assert 0.005 < figures["predicted"] < 0.06
